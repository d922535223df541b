"""How far photos differ in exposure, and how well a camera's gains are predicted from the photos around it.

    python -m benchmarks.exposures fox saharov kitchen25

estimates the gains of each scene's training photos, predicts those of its test views from their poses, and compares the
predictions with the gains of the test photos, estimated together with the training photos. Only this benchmark reads
gains from test photos. The last three columns are what the choice of exposures is made by (`choose_fit`): errors at
points that gains were not estimated from. Runs on a CPU; nothing is trained.
"""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from benchmarks.timing import ROOT
from nexwarp.data import View, load_scene
from nexwarp.data.demo import demo_folder
from nexwarp.model.exposures import Exposures
from nexwarp.train.exposure_calibration import held_out_errors, observations, photo_gains


def gains_of(views: list[View]) -> tuple[torch.Tensor, tuple[float, float, float]]:
    """Return log gains (V, 3) of photos, with mean 0, and the falloff of their lens."""
    points = [torch.zeros(0, 3) if view.points is None else view.points for view in views]
    cameras, photos = [view.camera for view in views], [view.image for view in views]
    log_gains, falloff = photo_gains(cameras, photos, points, [view.mask for view in views])
    return torch.from_numpy(log_gains), falloff


def chosen_by(views: list[View]) -> tuple[float, float, float]:
    """Return the errors at held-out points of no exposures, gains, and gains with a falloff."""
    points = [torch.zeros(0, 3) if view.points is None else view.points for view in views]
    cameras = [view.camera for view in views]
    seen = observations(cameras, [view.image for view in views], points, [view.mask for view in views])
    return held_out_errors(seen, cameras)


def compare(train: list[View], test: list[View]) -> dict[str, Any]:
    """Return the spread of the training photos' gains, and the root mean square errors of the test views' gains.

    Returns:
        "spread": (3,) standard deviation of the log gains by channel; "predicted": error of the prediction from the
        pose; "ignored": error of a gain of 1; "edge": the share of light that the lens passes where its falloff ends,
        mostly in the corners.
    """
    (mine, falloff), (all_together, _) = gains_of(train), gains_of([*train, *test])
    # The log gains of each set have mean 0.
    own = all_together[len(train) :] - (all_together[: len(train)] - mine).mean(0)
    exposures = Exposures.of(mine, [view.camera for view in train])
    predicted = torch.stack([exposures.gains(view.camera).double().log() for view in test])
    rms = {"predicted": predicted - own, "ignored": own}
    errors = {name: x.square().mean().sqrt().item() for name, x in rms.items()}
    return {"spread": mine.std(0), "edge": math.exp(falloff[0] + falloff[1]), **errors}


def main(scenes: Annotated[tuple[str, ...], tyro.conf.Positional], data: Path = ROOT.parent / "shared" / "data") -> int:
    """Print a Markdown table.

    Args:
        scenes: folders of scenes, or names of those in --data.
        data: folder of scenes.
    """
    columns = "spread of the gains: red, green, blue | error of test views: predicted | left at 1 | light at edge"
    print(f"| scene | {columns} | held-out error: no gains | gains | gains and falloff |")
    print("|---|---|---|---|---|---|---|---|")
    for name in scenes:
        folder = demo_folder() if name == "demo" else Path(name) if Path(name).exists() else data / name
        scene = load_scene(folder)
        found = compare(scene.train, scene.test)
        spread = ", ".join(f"{100 * x:.1f}" for x in torch.as_tensor(found["spread"]).tolist())
        errors = " | ".join(f"{100 * found[key]:.1f} %" for key in ("predicted", "ignored", "edge"))
        held_out = " | ".join(f"{x:.4f}" for x in chosen_by(scene.train))
        print(f"| {Path(name).name} | {spread} % | {errors} | {held_out} |")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
