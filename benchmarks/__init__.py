"""Benchmarks of speed, memory and quality, and tests that take too long for CI.

`python -m benchmarks --help` times every stage. Each `bench_<stage>.py` is one stage and runs alone, too (`python -m
benchmarks.bench_collect`). They share seeded scenes (`scenes`), one timer (`timing`) and one command line (`suite`).

Commands of their own: `quality` (trainings beside gsplat, ablations), `before_after` (two checkouts), `finished_model`
and `exposures` (stages of finishing a model), `inputs` (scene formats), `splats` (exported Gaussians in gsplat),
`repeat` (determinism), `kills` (resuming), `soak` (memory leaks), `sanitize` (compute-sanitizer), `fuzz` (damaged
files).
"""
