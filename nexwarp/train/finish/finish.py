"""Turns trained surfels into a finished model."""

import copy
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.machine import deterministic
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.train.finish.detail_limits import measure_detail_limits
from nexwarp.train.finish.sh_smoothing import smooth_sh
from nexwarp.train.recipe import Config
from nexwarp.train.views import with_cameras

FinishObserver = Callable[[str, int, int], None]
Item = TypeVar("Item")


def finish_model(
    model: Model,
    views: Sequence[View],
    cameras: Sequence[Camera],
    exposures: Exposures | None,
    config: Config,
    observe: FinishObserver = lambda *_: None,
) -> Model:
    """Return a finished model with surfels of its own: smooth SH, detail limits and exposures.

    The texture is shared. `cameras` are those of the training views as their poses are corrected, on the model's
    device. `observe` is called with each stage's name, how many views of it are rendered, and of how many.
    """
    raw = {name: value.detach().clone() for name, value in model.surfels.state_dict().items()}
    finished = Model(Surfels(raw), model.texture, options=model.options)
    if config.smooth_sh > 0:
        # Detail limits are the same whatever the order of threads.
        with deterministic(config.deterministic and model.device.type == "cuda"):
            seen_from = with_cameras(views, cameras)
            sh0, shN = smooth_sh(finished, seen_from, config.smooth_sh, partial(observe, "smoothing SH"))
        finished.surfels.sh0.data, finished.surfels.shN.data = sh0, shN
    if config.footprints:
        seen = counted(cameras, "measuring detail limits", observe)
        finished.detail_limits = measure_detail_limits(finished, seen)
    if exposures is not None:
        finished.exposures = copy.deepcopy(exposures).to(model.device)
    finished.meta = model.meta | {"smooth_sh": config.smooth_sh}
    return finished


def counted(items: Sequence[Item], stage: str, observe: FinishObserver) -> Iterator[Item]:
    """Yield items, each of which is done when the next one is asked for."""
    for done, item in enumerate(items, 1):
        yield item
        observe(stage, done, len(items))
