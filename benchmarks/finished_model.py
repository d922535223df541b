"""What a finished model has beside what was trained: far looks, smooth SH, and exposures of other cameras.

    python -m benchmarks.finished_model runs/fox/model.safetensors fox

renders the test views of a trained model at the photos' size, a half, a quarter and an eighth of it, and compares with
the photos reduced by area: as its file was before each of the three was there, and as it is finished now, whatever its
file has; but SH that are smooth already, with whatever strength, stay. On a CPU or CUDA; nothing is trained.
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
from benchmarks.quality import arc, smaller
from benchmarks.timing import ROOT
from nexwarp.camera import Camera
from nexwarp.data import Scene, load_scene
from nexwarp.data.images import downscale_image
from nexwarp.finish.auto_exposure import metered
from nexwarp.finish.detail_limits import seen_footprints
from nexwarp.finish.sh_smoothing import smooth_sh
from nexwarp.io.pictures import save_png, side_by_side, to_uint8
from nexwarp.representation.exposures import Exposures
from nexwarp.run.metrics import flip, psnr, ssim
from nexwarp.train.config import Config

FACTORS = (1, 2, 4, 8)


@torch.no_grad()
def compare(model: nw.Model, scene: Scene) -> dict[str, list[tuple[float, float, float | None]]]:
    """Finish a model anew, and judge its test views.

    Args:
        model: changed: it is left finished.
        scene: with the training photos of the model; test views are compared without their masks.

    Returns:
        By form of the model, for each of `FACTORS`, the means of PSNR [dB], SSIM and FLIP (None without its package):
        "before", "far looks", "smooth SH" (but where the file has them), "finished" (with metered exposures, too),
        and "finished, full size reduced".
    """
    surfels, options = model.surfels, model.render_options
    cameras = [view.camera for view in scene.train]
    if surfels.exposures is not None:
        gains, falloff = gains_of(scene.train)
        surfels.exposures = Exposures.of(gains, cameras, falloff).to(surfels.device)
    surfels.footprints = surfels.far_footprints = None
    closest, farthest = seen_footprints(surfels, cameras, options=options)
    smooth = (
        None if model.meta.get("smooth_sh") else smooth_sh(surfels, scene.train, Config().smooth_sh, options=options)
    )

    def image(camera: Camera) -> torch.Tensor:
        return nw.render(surfels, model.texture, camera.to(surfels.device), **options).image.cpu()

    def looked() -> list[tuple[float, float, float | None]]:
        return judge(scene, lambda camera, factor: image(smaller(camera, factor)))

    surfels.footprints = closest
    found = {"before": looked()}
    surfels.far_footprints = farthest
    found["far looks"] = looked()
    if smooth is not None:
        surfels.sh0.data, surfels.shN.data = smooth
        found["smooth SH"] = looked()
    if surfels.exposures is not None:
        exposures = metered(surfels.exposures, surfels, model.texture, cameras, options=options)
        surfels.exposures = exposures.to(surfels.device)
    found["finished"] = looked()
    found["finished, full size reduced"] = judge(
        scene,
        lambda camera, factor: torch.nn.functional.avg_pool2d(image(camera).permute(2, 0, 1), factor).permute(1, 2, 0),
    )
    return found


def judge(scene: Scene, image: Callable[[Camera, int], torch.Tensor]) -> list[tuple[float, float, float | None]]:
    """Means over test views, for each of `FACTORS`."""
    found = []
    for factor in FACTORS:
        pairs = [
            (to_uint8(image(view.camera, factor)), downscale_image(to_uint8(view.image), factor)) for view in scene.test
        ]
        each = [[metric(*pair) for pair in pairs] for metric in (psnr, ssim, flip)]
        found.append(tuple(None if None in figures else statistics.fmean(figures) for figures in each))
    return found


@torch.no_grad()
def picture(model: nw.Model, scene: Scene, folder: Path) -> None:
    """Save each test view, photo and render side by side, in a folder."""
    for view in scene.test:
        camera = view.camera.to(model.surfels.device)
        image = nw.render(model.surfels, model.texture, camera, **model.render_options).image
        both = [to_uint8(view.image), to_uint8(image).cpu()]
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
        held_out: test views: every 8th, or the arc of `benchmarks.quality`.
        data: folder of scenes.
        pictures: folder for photo and render of each test view, as finished.
    """
    photos = load_scene(scene if Path(scene).exists() else data / scene, downscale=downscale)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    views = arc(photos) if held_out == "arc" else photos
    finished = nw.load(model).to(device)
    found = compare(finished, views)
    if pictures is not None:
        picture(finished, views, pictures)
    print("| PSNR [dB], SSIM, FLIP | " + " | ".join(f"1/{factor}" for factor in FACTORS) + " |")
    print("|---" * (len(FACTORS) + 1) + "|")
    for name, figures in found.items():
        cells = [f"{p:.2f}, {s:.4f}, " + ("" if f is None else f"{f:.4f}") for p, s, f in figures]
        print(f"| {name} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
