"""Evaluation on held-out views, by the field's conventions (see `nexwarp.metrics`)."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from nexwarp.camera import Camera
from nexwarp.data import View
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.metrics import CONVENTION, flip, lpips_vgg, psnr, ssim, to_uint8
from nexwarp.pictures import error_map, save_png, side_by_side
from nexwarp.render import render
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture

NEVER = 1e30  # a footprint that no texture survives


@torch.no_grad()
def seen_footprints(
    surfels: Surfels, cameras: Iterable[Camera], *, options: dict[str, Any]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return each surfel's `footprints` and `far_footprints`: depth / focal of some views' looks at its texture.

    Args:
        surfels: the surfels; footprints that they have would count: None is expected.
        cameras: of the training views.
        options: keyword arguments of `nexwarp.render`; a K of 0 counts as 1.

    Returns:
        (N,) of the closest textured hit, NEVER without any; (N,) of the farthest one, or of the centre in those views;
        without any hit, of the centre in all views that it is in front of, NEVER without those either.
    """
    if options.get("max_hits") == 0:
        options = options | {"max_hits": 1}
    closest = surfels.means.new_full((len(surfels),), NEVER)
    if not len(surfels):
        return closest, closest.clone()
    farthest, front = torch.zeros_like(closest), torch.zeros_like(closest)
    for camera in cameras:
        camera = camera.to(surfels.device)
        out = render(surfels, None, camera, **options)
        seen, ids = out.weights >= ALPHA_MIN, out.ids.clamp_min(0).long()
        centres = camera.project(surfels.means)[1]
        front = torch.maximum(front, centres.where(centres > camera.near, 0.0) / camera.focal)
        hits = (out.depths, torch.maximum(out.depths, centres[ids]))
        for found, depths, none, how in ((closest, hits[0], NEVER, "amin"), (farthest, hits[1], 0.0, "amax")):
            found.scatter_reduce_(0, ids.flatten(), (depths / camera.focal).where(seen, none).flatten(), how)
    farthest = farthest.where(farthest > 0, front)
    return closest, farthest.where(farthest > 0, NEVER)


@torch.no_grad()
def evaluate(
    surfels: Surfels,
    texture: NeuralTexture,
    views: Sequence[View],
    *,
    options: dict[str, Any],
    renders: Path | None = None,
    mask_mode: str = "ignore",
    metrics: Sequence[str] = ("psnr", "ssim"),
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Render views and compare them with their photos.

    Args:
        surfels: of the model, on the device to render on.
        texture: of the model, likewise.
        views: held-out views.
        options: keyword arguments of `nexwarp.render`.
        renders: folder for each view's picture and its strip of photo, render and error; None writes nothing.
        mask_mode: what the views' masks leave out: `ignore` does not judge it, `background` wants the background there.
        metrics: which figures, of psnr, ssim, flip and lpips. FLIP and LPIPS are of whole pictures, the photo put where
            a mask ignores them, and None where their packages are not there.
        progress: called with each view's name when it is done.

    Returns:
        Each metric (PSNR in dB): mean over views; "views": name -> the same; "convention".
    """
    if not views:
        raise ValueError("views: expected at least one view to evaluate, got none")
    if unknown := [name for name in metrics if name not in METRICS]:
        raise ValueError(f"metrics: expected some of {', '.join(METRICS)}, got {unknown[0]!r}")
    results: dict[str, dict[str, float | None]] = {}
    for view in views:
        out = render(surfels, texture, view.camera.to(surfels.device), **options)
        picture = to_uint8(out.image).cpu()
        photo, mask = to_uint8(view.image), view.mask
        if mask is not None and mask_mode == "background":
            behind = to_uint8(torch.as_tensor(options["background"], dtype=torch.float32))
            photo, mask = torch.where(mask[..., None], photo, behind), None
        results[view.name] = {name: METRICS[name](picture, photo, mask) for name in metrics}
        if renders is not None:
            stem = Path(view.name).with_suffix("")
            save_png(renders / "test" / f"{stem}.png", picture)
            strip = side_by_side(
                [photo, picture, error_map(picture, photo)],
                captions=["photo", f"render {psnr(picture, photo, mask):.2f} dB", "error (0 to 0.25)"],
            )
            save_png(renders / "compare" / f"{stem}.png", strip)
        if progress is not None:
            progress(view.name)
    means = {name: _mean([r[name] for r in results.values()]) for name in metrics}
    return {**means, "views": results, "convention": CONVENTION}


def _mean(values: list[float | None]) -> float | None:
    return None if None in values else fmean(values)


def _whole(metric: Callable[..., float | None]) -> Callable[..., float | None]:
    """The metric of whole pictures, where what does not count is as it should be."""

    def judge(picture: torch.Tensor, photo: torch.Tensor, mask: torch.Tensor | None) -> float | None:
        return metric(picture if mask is None else torch.where(mask[..., None], picture, photo), photo)

    return judge


METRICS = {"psnr": psnr, "ssim": ssim, "flip": _whole(flip), "lpips": _whole(lpips_vgg)}
