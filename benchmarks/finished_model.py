"""Quality of each stage that turns trained surfels into a finished model: detail limits, SH smoothing, auto exposure.

    python -m benchmarks.finished_model runs/fox/model.safetensors fox

renders the test views of a trained model at the photos' size, a half, a quarter and an eighth of it, and compares them
with the photos reduced by area. The stages are applied one after the other, whatever the model's file holds; only SH
that are smooth already stay as they are. Runs on a CPU or CUDA; nothing is trained.
"""

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
import tyro

import nexwarp as nw
from benchmarks.exposures import gains_of
from benchmarks.quality.metrics import RenderImage, smaller
from benchmarks.quality.scenes import held_out_arc
from benchmarks.timing import ROOT
from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene, load_scene
from nexwarp.data.images import downscale_image
from nexwarp.io.pictures import save_png, side_by_side, to_uint8
from nexwarp.model.detail_limits import NEVER, DetailLimits
from nexwarp.model.exposures import Exposures
from nexwarp.run.metrics import flip, psnr, ssim
from nexwarp.train.config import Config
from nexwarp.train.finish.auto_exposure import with_auto_exposure
from nexwarp.train.finish.detail_limits import measure_detail_limits
from nexwarp.train.finish.sh_smoothing import smooth_sh

FACTORS = (1, 2, 4, 8)

Figures = list[tuple[float, float, float | None]]


@torch.no_grad()
def compare(model: nw.Model, scene: Scene) -> dict[str, Figures]:
    """Finish a model anew, stage by stage, and judge its test views after each stage.

    Args:
        model: changed: it is left finished.
        scene: with the training photos of the model; test views are compared without their masks.

    Returns:
        After each stage, for each of `FACTORS`, the means of PSNR [dB], SSIM and FLIP (None without its package):
        "nearest limits": detail limits for close views alone, and exposures predicted from poses; "detail limits": for
        distant views too; "smooth SH": left out where the file has them; "auto exposure": the finished model; and
        "auto exposure, full size reduced": its renderings at full size, reduced by area.
    """
    cameras = [view.camera for view in scene.train]
    if model.exposures is not None:
        gains, falloff = gains_of(scene.train)
        model.exposures = Exposures.of(gains, cameras, falloff).to(model.device)
    limits = measure_detail_limits(model, cameras)
    smooth = None if model.meta.get("smooth_sh") else smooth_sh(model, scene.train, Config().smooth_sh)

    def image(camera: Camera) -> torch.Tensor:
        return model.render(camera).image.cpu()

    def judge_smaller() -> Figures:
        return judge(scene, lambda camera, factor: image(smaller(camera, factor)))

    model.detail_limits = DetailLimits(limits.nearest, torch.full_like(limits.farthest, NEVER))
    found = {"nearest limits": judge_smaller()}
    model.detail_limits = limits
    found["detail limits"] = judge_smaller()
    if smooth is not None:
        model.surfels.sh0.data, model.surfels.shN.data = smooth
        found["smooth SH"] = judge_smaller()
    if model.exposures is not None:
        model.exposures = with_auto_exposure(model.exposures, model, cameras).to(model.device)
    found["auto exposure"] = judge_smaller()
    found["auto exposure, full size reduced"] = judge(scene, reduced(image))
    return found


def reduced(image: RenderImage) -> Callable[[Camera, int], torch.Tensor]:
    """Return a function that renders at full size and reduces the rendering by area."""

    def render(camera: Camera, factor: int) -> torch.Tensor:
        pooled = torch.nn.functional.avg_pool2d(image(camera).permute(2, 0, 1), factor)
        return pooled.permute(1, 2, 0).contiguous()  # as a rendering lies: sums over pixels round alike

    return render


def judge(scene: Scene, image: Callable[[Camera, int], torch.Tensor]) -> Figures:
    """Return the means over the test views, for each of `FACTORS`.

    Args:
        scene: its test views count.
        image: renders a camera (H, W, 3), reduced by a factor.
    """
    found: Figures = []
    for factor in FACTORS:
        pairs = [
            (to_uint8(image(view.camera, factor)), downscale_image(to_uint8(view.image), factor)) for view in scene.test
        ]
        flips = [figure for pair in pairs if (figure := flip(*pair)) is not None]
        found.append(
            (
                statistics.fmean(psnr(*pair) for pair in pairs),
                statistics.fmean(ssim(*pair) for pair in pairs),
                statistics.fmean(flips) if flips else None,
            )
        )
    return found


@torch.no_grad()
def save_pictures(model: nw.Model, scene: Scene, folder: Path) -> None:
    """Save each test view, photo and rendering side by side, in a folder."""
    for view in scene.test:
        both = [to_uint8(view.image), to_uint8(model.render(view.camera).image).cpu()]
        save_png(folder / f"{Path(view.name).stem}.png", side_by_side(both, captions=["photo", "render"]))


def main(
    model: Annotated[Path, tyro.conf.Positional],
    scene: Annotated[str, tyro.conf.Positional],
    downscale: int = 1,
    held_out: Annotated[str, tyro.conf.arg(metavar="{8th,arc}")] = "8th",
    data: Path = ROOT.parent / "shared" / "data",
    pictures: Path | None = None,
) -> int:
    """Print a Markdown table.

    Args:
        model: file of a trained model, or its run folder.
        scene: folder of its scene, or the name of one of those in --data.
        downscale: of the photos it was trained on.
        held_out: test views: every 8th view, or the held-out arc of `benchmarks.quality`.
        data: folder of scenes.
        pictures: folder for photo and rendering of each test view, by the finished model.
    """
    photos = load_scene(scene if Path(scene).exists() else data / scene, downscale=downscale)
    views = held_out_arc(photos) if held_out == "arc" else photos
    finished = nw.load(model).to("cuda" if torch.cuda.is_available() else "cpu")
    found = compare(finished, views)
    if pictures is not None:
        save_pictures(finished, views, pictures)
    print("| PSNR [dB], SSIM, FLIP | " + " | ".join(f"1/{factor}" for factor in FACTORS) + " |")
    print("|---" * (len(FACTORS) + 1) + "|")
    for name, figures in found.items():
        cells = [f"{p:.2f}, {s:.4f}, " + ("" if f is None else f"{f:.4f}") for p, s, f in figures]
        print(f"| {name} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
