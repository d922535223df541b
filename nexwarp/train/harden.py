"""Hardening: training that turns soft surfels into opaque quads, for renderers that test depth and do not blend.

The kernel of paper Eq. 3 is a Gaussian at gamma = 1 and a rectangle at large gammas. Cut-outs of a soft model lose what
many transparent surfels blended; cut-outs of a hard model look more like the model.
"""

import math
import weakref
from collections.abc import Callable

import torch

from nexwarp.data import Scene
from nexwarp.model.model import Model
from nexwarp.train.recipe import Config
from nexwarp.train.report import StepReport
from nexwarp.train.trainer import Trainer

OPACITY_FACTOR = 0.3  # of the surfels' mean opacity * (1 - opacity)
LEAST_GAMMA = 3.0
RISING = 0.6  # share of the iterations in which the factor and the least gamma rise
EVERY = 10  # iterations between two rises of the least gamma


def train_hard(
    scene: Scene, config: Config, device: torch.device | str, init: Model, observe: Callable[[StepReport], object]
) -> Model:
    """Return a model of a scene, trained on from `init`, whose surfels are nearly opaque and have hard sides.

    Opacities are pulled to 0 or 1, and gammas kept above a bound that rises to `LEAST_GAMMA`. `observe` is called after
    each step. Errors are those of `Trainer`.
    """
    factor = torch.zeros((), device=device)  # a tensor, which CUDA graphs of steps read anew

    def binary(*_: object) -> torch.Tensor:
        opacities = state.surfels.opacities
        return factor * (opacities * (1 - opacities)).mean()

    def harden(step: StepReport) -> None:
        risen = min(step.iteration / (RISING * config.iterations), 1.0)
        factor.fill_(OPACITY_FACTOR * risen)
        if step.passed(EVERY):
            with torch.no_grad():
                trainer.surfels.raw_gammas.clamp_(min=math.log((LEAST_GAMMA - 1) * risen))
        observe(step)

    trainer = Trainer(scene, config, device, losses={"binary": binary}, init=init)
    state = weakref.proxy(trainer)  # a cycle would keep the memory until the garbage collector comes
    trainer.run(harden)
    return trainer.finish()
