"""`python -m benchmarks`: every stage that the machine can run, and one table."""

import sys

from benchmarks import bench_cold_start, bench_collect, bench_frame, bench_peers, bench_texture, bench_train_step, suite
from benchmarks.scenes import on_each_scene

STAGES: dict[str, suite.Stage] = {
    "project": on_each_scene(bench_collect.project),
    "tiles": on_each_scene(bench_collect.tiles),
    "collect": on_each_scene(bench_collect.collect),
    "rasterize": on_each_scene(bench_collect.rasterize),
    "texture": on_each_scene(bench_texture.texturing),
    "frame": on_each_scene(bench_frame.frame),
    "train_step": bench_train_step.run,
    "peers": bench_peers.run,
    "cpu": bench_collect.cpu,
    "cold_start": bench_cold_start.run,
}


def main(arguments: list[str] | None = None) -> int:
    return suite.main(STAGES, arguments)


if __name__ == "__main__":
    sys.exit(main())
