"""Quality over the seconds of a training, of ours and of gsplat's."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from benchmarks.quality.results import mean_of_known
from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import METRICS
from nexwarp.train.stages import Stage, StageStore
from nexwarp.train.trainer import Trainer

RenderImage = Callable[[Camera], torch.Tensor]  # (H, W, 3), not clamped, on any device
TIMES = (3, 5, 8, 10, 12, 15, 20, 25, 30, 35, 40, 45, 50, 60, 75, 90, 120, 150, 180, 240, 300)  # seconds
DRAWN = {"psnr": "PSNR [dB]", "lpips": "LPIPS (VGG)"}


class Curve:
    """Test PSNR and LPIPS at `TIMES` of a training; to compute them stops the clock.

    Attributes:
        points: seconds and metrics, in order of time.
    """

    def __init__(self, scene: Scene, begin: float) -> None:
        """Watch a training of a scene that began at `begin` of `time.perf_counter`, before the scene was loaded."""
        self.scene, self.begin = scene, begin
        self.points: list[dict[str, float | None]] = []
        self.ahead = list(TIMES)

    def look(self, image: Callable[[], RenderImage], *, last: bool = False) -> None:
        """Add a point where it is time for one, or at the end; `image` returns how the model is rendered now."""
        if not last and (not self.ahead or time.perf_counter() - self.begin < self.ahead[0]):
            return
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        seconds = time.perf_counter() - self.begin
        self.ahead = [x for x in self.ahead if x > seconds]
        with torch.no_grad():
            render = image()
            pairs = [(to_uint8(render(v.camera)).cpu(), to_uint8(v.image), v.mask) for v in self.scene.test]
            values = {name: [METRICS[name](*pair) for pair in pairs] for name in DRAWN}
        means = {name: mean_of_known(each) for name, each in values.items()}
        self.points.append({"seconds": seconds, **means})
        self.begin = time.perf_counter() - seconds


class WatchedStages(StageStore):
    """Stages of a training of ours, teachers included, that a curve looks at."""

    def __init__(self, curve: Curve) -> None:
        super().__init__()
        self.curve = curve

    def train(self, stage: Stage, trainer: Trainer) -> None:
        """Do the steps of a stage."""

        def image() -> RenderImage:
            model = trainer.model()
            return lambda camera: model.render(camera).image

        trainer.run(lambda _: self.curve.look(image))


def draw(results: Iterable[dict[str, Any]], out: Path) -> None:
    """Draw the curves of results: a column a scene, PSNR above LPIPS, over seconds from loading on."""
    import matplotlib.pyplot as plt

    lines = [line for line in results if line.get("curve")]
    scenes = list(dict.fromkeys(line["scene"] for line in lines))
    if not scenes:
        raise ValueError("results: expected trainings with --curve, got none")
    figure, axes = plt.subplots(
        len(DRAWN), len(scenes), figsize=(4 * len(scenes), 6), squeeze=False, sharex="col", layout="constrained"
    )
    for line in lines:
        column = scenes.index(line["scene"])
        for row, name in enumerate(DRAWN):
            known = [(p["seconds"], p[name]) for p in line["curve"] if p[name] is not None]
            if known:
                axes[row][column].plot(*zip(*known, strict=True), ".-", label=f"{line['row']}, {line['size']:,}")
    for row, title in enumerate(DRAWN.values()):
        axes[row][0].set_ylabel(title)
    for column, scene in enumerate(scenes):
        axes[0][column].set_title(scene)
        axes[0][column].legend()
        axes[-1][column].set_xlabel("seconds")
    figure.savefig(out)
    plt.close(figure)
