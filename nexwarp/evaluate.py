"""Evaluation on held-out views, by the field's conventions (see `nexwarp.metrics`)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from nexwarp.data import View
from nexwarp.metrics import CONVENTION, psnr, ssim, to_uint8
from nexwarp.pictures import error_map, save_png, side_by_side
from nexwarp.render import render
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture


@torch.no_grad()
def evaluate(
    surfels: Surfels,
    texture: NeuralTexture,
    views: Sequence[View],
    *,
    options: dict[str, Any],
    renders: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Render views and compare them with their photos.

    Args:
        surfels: of the model, on the device to render on.
        texture: of the model, likewise.
        views: held-out views.
        options: keyword arguments of `nexwarp.render`.
        renders: folder for each view's picture and its strip of photo, render and error; None writes nothing.
        progress: called with each view's name when it is done.

    Returns:
        "psnr" (dB), "ssim": means over views; "views": name -> the same; "convention".
    """
    if not views:
        raise ValueError("views: expected at least one view to evaluate, got none")
    results: dict[str, dict[str, float]] = {}
    for view in views:
        out = render(surfels, texture, view.camera.to(surfels.device), **options)
        picture = to_uint8(out.image).cpu()
        photo = to_uint8(view.image)
        results[view.name] = {"psnr": psnr(picture, photo), "ssim": ssim(picture, photo)}
        if renders is not None:
            stem = Path(view.name).with_suffix("")
            save_png(renders / "test" / f"{stem}.png", picture)
            strip = side_by_side(
                [photo, picture, error_map(picture, photo)],
                captions=["photo", f"render {results[view.name]['psnr']:.2f} dB", "error (0 to 0.25)"],
            )
            save_png(renders / "compare" / f"{stem}.png", strip)
        if progress is not None:
            progress(view.name)
    means = {key: fmean(r[key] for r in results.values()) for key in ("psnr", "ssim")}
    return {**means, "views": results, "convention": CONVENTION}
