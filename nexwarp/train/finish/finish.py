"""Turns trained surfels into a finished model."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.machine import deterministic
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.train.finish.detail_limits import measure_detail_limits
from nexwarp.train.finish.order import ordered
from nexwarp.train.finish.sh_smoothing import smooth_sh

FinishObserver = Callable[[str, int, int], None]
Item = TypeVar("Item")


@dataclass(frozen=True)
class FinishSettings:
    """What a finished model gets.

    Attributes:
        smooth_sh: strength of the surfels' SH smoothing; 0 keeps the SH as trained.
        detail_limits: measure how close and how far the training views saw each surfel.
        deterministic: give the same bits in every run, also on CUDA.
    """

    smooth_sh: float
    detail_limits: bool
    deterministic: bool


def finish_model(
    model: Model,
    views: Sequence[View],
    cameras: Sequence[Camera],
    exposures: Exposures | None,
    settings: FinishSettings,
    observe: FinishObserver = lambda *_: None,
) -> Model:
    """Return a finished model with surfels of its own: smooth SH, detail limits and exposures.

    The surfels are ordered by their share of the training pictures, largest first. The texture is shared.

    Args:
        model: the trained surfels and texture, at the photos' mean exposure; stays as it is.
        views: all training views, on any device.
        cameras: of these views, on the model's device.
        exposures: of the training photos; None where they have one exposure.
        settings: what to do.
        observe: called with each stage's name, how many views of it are rendered, and of how many.
    """
    raw = {name: value.detach().clone() for name, value in model.surfels.state_dict().items()}
    finished = Model(Surfels(raw), model.texture, options=model.options)
    if settings.smooth_sh > 0:
        # Detail limits are the same whatever the order of threads.
        with deterministic(settings.deterministic and model.device.type == "cuda"):
            sh0, shN = smooth_sh(finished, views, settings.smooth_sh, partial(observe, "smoothing SH"))
        finished.surfels.sh0.data, finished.surfels.shN.data = sh0, shN
    if settings.detail_limits:
        seen = counted(cameras, "measuring detail limits", observe)
        finished.detail_limits = measure_detail_limits(finished, seen)
    if exposures is not None:
        finished.exposures = copy.deepcopy(exposures).to(model.device)
    finished.meta = model.meta | {"smooth_sh": settings.smooth_sh}
    with deterministic(settings.deterministic and model.device.type == "cuda"):
        return ordered(finished, counted(cameras, "ordering surfels", observe))


def counted(items: Sequence[Item], stage: str, observe: FinishObserver) -> Iterator[Item]:
    """Yield items, each of which is done when the next one is asked for."""
    for done, item in enumerate(items, 1):
        yield item
        observe(stage, done, len(items))
