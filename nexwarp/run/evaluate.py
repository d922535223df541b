"""Evaluation on held-out views, by the field's conventions (see `nexwarp.run.metrics`)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import TypedDict, cast

import torch

from nexwarp.data import View
from nexwarp.io.pictures import error_map, save_png, side_by_side, to_uint8
from nexwarp.model.model import Model
from nexwarp.run.metrics import CONVENTION, flip, lpips_vgg, psnr, ssim


class Evaluation(TypedDict, total=False):
    """Metrics of held-out views: those asked for, each the mean over the views, and each view's own.

    Attributes:
        psnr: dB.
        ssim: 0 to 1.
        flip: 0 to 1, lower is better; None where its package is not there.
        lpips: lower is better; None where its package is not there.
        views: the same by the view's name.
        convention: how the metrics are computed.
    """

    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    views: dict[str, dict[str, float | None]]
    convention: str


@torch.no_grad()
def evaluate(
    model: Model,
    views: Sequence[View],
    *,
    renders: Path | None = None,
    mask_mode: str = "ignore",
    metrics: Sequence[str] = ("psnr", "ssim"),
    progress: Callable[[str], None] | None = None,
) -> Evaluation:
    """Render views and compare them with their photos.

    Args:
        model: on the device to render on.
        views: held-out views.
        renders: folder for each view's picture and its strip of photo, render and error; None writes nothing.
        mask_mode: what the views' masks leave out: `ignore` does not judge it, `background` wants the background there.
        metrics: which figures, of psnr, ssim, flip and lpips. FLIP and LPIPS are of whole pictures, the photo put where
            a mask ignores them, and None where their packages are not there.
        progress: called with each view's name when it is done.

    Raises:
        ValueError: no views, or an unknown metric.
    """
    if not views:
        raise ValueError("views: expected at least one view to evaluate, got none")
    if unknown := [name for name in metrics if name not in METRICS]:
        raise ValueError(f"metrics: expected some of {', '.join(METRICS)}, got {unknown[0]!r}")
    results: dict[str, dict[str, float | None]] = {}
    for view in views:
        out = model.render(view.camera)
        picture = to_uint8(out.image).cpu()
        photo, mask = to_uint8(view.image), view.mask
        if mask is not None and mask_mode == "background":
            behind = to_uint8(torch.as_tensor(model.options.background, dtype=torch.float32))
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
    return cast(Evaluation, {**means, "views": results, "convention": CONVENTION})


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def _whole(metric: Callable[..., float | None]) -> Callable[..., float | None]:
    """The metric of whole pictures, where what does not count is as it should be."""

    def judge(picture: torch.Tensor, photo: torch.Tensor, mask: torch.Tensor | None) -> float | None:
        return metric(picture if mask is None else torch.where(mask[..., None], picture, photo), photo)

    return judge


METRICS = {"psnr": psnr, "ssim": ssim, "flip": _whole(flip), "lpips": _whole(lpips_vgg)}
