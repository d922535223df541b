"""How long the passes take, how much memory, and against whom: `python -m benchmarks --help`.

One `bench_<stage>.py` a stage, each runnable alone (`python -m benchmarks.bench_collect`); they share seeded scenes
(`scenes`), one timer (`timing`) and one command line (`suite`).
"""
