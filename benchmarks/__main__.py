"""`python -m benchmarks`: every stage that the machine can run, and one table."""

import sys

from benchmarks import (
    bench_cold_start,
    bench_collect,
    bench_cpu,
    bench_frame,
    bench_kernels,
    bench_peers,
    bench_project,
    bench_sizes,
    bench_surface,
    bench_texture,
    bench_tiles,
    bench_train_step,
    suite,
)

STAGES: dict[str, suite.Stage] = {
    "project": bench_project.run,
    "tiles": bench_tiles.run,
    "collect": bench_collect.run,
    "surface": bench_surface.run,
    "texture": bench_texture.run,
    "frame": bench_frame.run,
    "train_step": bench_train_step.run,
    "peers": bench_peers.run,
    "kernels": bench_kernels.run,
    "cpu": bench_cpu.run,
    "sizes": bench_sizes.run,
    "cold_start": bench_cold_start.run,
}


def main(arguments: list[str] | None = None) -> int:
    return suite.main(STAGES, arguments)


if __name__ == "__main__":
    sys.exit(main())
