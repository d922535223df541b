"""Benchmarks of speed, memory and quality.

`python -m benchmarks --help` times the stages of a frame and of a training step, on seeded scenes (`scenes`), with one
timer (`timing`) and one command line (`suite`). `benchmarks.before_after` compares two checkouts in turns,
`benchmarks.scaling` several GPUs, `benchmarks.quality` trains beside gsplat, `benchmarks.paper` beside the paper,
`benchmarks.picture` draws the README's picture. LOG.md is the lab book; results/ holds the figures that the documents
show.
"""
