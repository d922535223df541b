"""Evaluation on held-out views; `nexwarp.run.metrics` defines the metrics."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import TypedDict, cast

import torch

from nexwarp.data import View
from nexwarp.io.pictures import error_map, save_png, side_by_side, to_uint8
from nexwarp.model.model import Model
from nexwarp.run.contents import COMPARE, TEST, picture_name
from nexwarp.run.metrics import CONVENTION, METRICS, psnr
from nexwarp.train.ranks.ranks import Ranks

Values = dict[str, float | None]  # of a view, by metric


class Evaluation(TypedDict, total=False):
    """The requested metrics of held-out views; flip and lpips are None where their packages are not installed."""

    psnr: float  # means over the views, dB
    ssim: float  # at most 1
    flip: float | None  # 0 to 1, lower is better
    lpips: float | None  # lower is better
    views: dict[str, Values]  # by view name
    convention: str  # how the metrics are computed


@torch.no_grad()
def evaluate(
    model: Model,
    views: Sequence[View],
    *,
    renders: Path | None = None,
    mask_mode: str = "ignore",
    metrics: Sequence[str] = ("psnr", "ssim"),
    progress: Callable[[str], None] | None = None,
    ranks: Ranks | None = None,
) -> Evaluation:
    """Render views and compare them with their photos.

    Args:
        model: the model, on the device to render on.
        views: held-out views.
        renders: folder for the images: `test/` gets each rendering, `compare/` a strip of photo, rendering and error
            map. None writes nothing.
        mask_mode: treatment of masked-out pixels: `ignore` excludes them from the metrics, `background` compares them
            with the background colour.
        metrics: names among psnr, ssim, flip and lpips. FLIP and LPIPS need whole images: ignored pixels are copied
            from the photo.
        progress: called with each view's name after the view is evaluated.
        ranks: share the views, and return the same on all of them; only rank 0 writes. None is this process alone.

    Raises:
        ValueError: there are no views, or a metric is unknown.
    """
    if not views:
        raise ValueError("views: expected at least one view to evaluate, got none")
    if unknown := [name for name in metrics if name not in METRICS]:
        raise ValueError(f"metrics: expected some of {', '.join(METRICS)}, got {unknown[0]!r}")
    ranks = Ranks.alone(model.device) if ranks is None else ranks
    results: dict[str, Values] = {}
    for begin in range(0, len(views), ranks.size):
        group = views[begin : begin + ranks.size]
        mine = _judge(model, group[ranks.rank], mask_mode, metrics) if ranks.rank < len(group) else None
        for view, (picture, values) in zip(group, _gathered(mine, group, ranks), strict=True):
            results[view.name] = values
            if renders is not None and ranks.first:
                _write(renders, view, picture, *_compared(model, view, mask_mode))
            if progress is not None:
                progress(view.name)
    means = {name: _mean([values[name] for values in results.values()]) for name in metrics}
    return cast(Evaluation, {**means, "views": results, "convention": CONVENTION})


def _judge(model: Model, view: View, mask_mode: str, metrics: Sequence[str]) -> tuple[torch.Tensor, Values]:
    """Render a view; return the picture, (H, W, 3) uint8 on the CPU, and its metrics."""
    picture = to_uint8(model.render_image(view.camera)).cpu()
    photo, mask = _compared(model, view, mask_mode)
    return picture, {name: METRICS[name](picture, photo, mask) for name in metrics}


def _compared(model: Model, view: View, mask_mode: str) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the photo that a rendering is compared with, (H, W, 3) uint8, and the mask of what counts."""
    photo = to_uint8(view.image)
    if view.mask is None or mask_mode != "background":
        return photo, view.mask
    background = to_uint8(torch.as_tensor(model.options.background, dtype=torch.float32))
    return torch.where(view.mask[..., None], photo, background), None


def _gathered(
    mine: tuple[torch.Tensor, Values] | None, views: Sequence[View], ranks: Ranks
) -> list[tuple[torch.Tensor, Values]]:
    """Return what each rank has made of its view; None is a rank without one."""
    if ranks.size == 1:
        assert mine is not None
        return [mine]
    values = ranks.gather(None if mine is None else mine[1])[: len(views)]
    pictures = ranks.gather_bytes(b"" if mine is None else mine[0].contiguous().numpy().tobytes())
    shapes = [(view.camera.height, view.camera.width, 3) for view in views]
    return [
        (torch.frombuffer(bytearray(pixels), dtype=torch.uint8).view(shape), cast(Values, value))
        for pixels, shape, value in zip(pictures, shapes, values, strict=False)
    ]


def _write(renders: Path, view: View, picture: torch.Tensor, photo: torch.Tensor, mask: torch.Tensor | None) -> None:
    """Write a rendering, and the strip that compares it with its photo."""
    save_png(renders / TEST / picture_name(view.name), picture)
    strip = side_by_side(
        [photo, picture, error_map(picture, photo)],
        captions=["photo", f"render {psnr(picture, photo, mask):.2f} dB", "error (0 to 0.25)"],
    )
    save_png(renders / COMPARE / picture_name(view.name), strip)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None
