"""Adam in one kernel for all parameters; learning rates and schedules over a run."""

import dataclasses
import inspect
import math
from collections.abc import Callable
from typing import Any

import torch

from nexwarp.data import Scene
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture, Texture
from nexwarp.ops.adam import Stepped, adam_step
from nexwarp.train.recipe import REFERENCE_ITERATIONS, Config, LossWeights

# Parameters that share a learning rate, as torch's optimizers take them: `params`, a list of leaves; `name`, one of
# "means", "raw_quats", "log_scales", "logit_opacities", "raw_gammas", "sh0", "shN", "grid", "mlp" (or "texture", of a
# texture of one's own) and, where they are learned, "poses"; `lr`, the learning rate of the first step.
ParameterGroup = dict[str, Any]
EPSILON = 1e-15  # the paper's
USUAL_SCALE = 5.0  # world units; fox, saharov and kitchen25 have 4.4 to 5.0 as COLMAP left them
RATED = (*PARAMETERS, "grid", "mlp")  # the groups of the fields of `LearningRates`, in their order
# First and last learning rates of pose corrections, radians and scene scales, in a run of 30,000 steps.
POSE_RATES = (2e-4, 2e-6)


class FusedAdam(torch.optim.Adam):
    """Adam whose step is one kernel; state, groups and checkpoints are those of `torch.optim.Adam`.

    Weight decay, AMSGrad and maximisation are not among its options. Parameters are float32 and contiguous, and all
    groups have the same betas and eps.

    Attributes:
        grid_loss: the regulariser's value before the last step; None without one.
    """

    def __init__(self, groups: list[ParameterGroup], *, eps: float) -> None:
        """Make an optimizer of groups whose learning rates are numbers, or tensors on the parameters' device."""
        capturable = all(isinstance(group["lr"], torch.Tensor) and group["lr"].is_cuda for group in groups)
        super().__init__(groups, eps=eps, fused=True, capturable=capturable)
        self.grid_loss: torch.Tensor | None = None
        self._texture: NeuralTexture | None = None
        self._factors: torch.Tensor | None = None

    # Torch wraps these for its compiler, whose import takes 0.6 s; a step of ours is never compiled.
    def add_param_group(self, param_group: ParameterGroup) -> None:
        """Add a parameter group, as `torch.optim.Adam` does; ValueError where its parameters or settings do not fit."""
        inspect.unwrap(torch.optim.Adam.add_param_group)(self, param_group)
        first, added = self.param_groups[0], self.param_groups[-1]
        if any(x.dtype != torch.float32 or not x.is_contiguous() for x in added["params"]):
            raise ValueError(f"{added.get('name', 'params')}: expected contiguous float32 parameters")
        if (added["betas"], added["eps"]) != (first["betas"], first["eps"]):
            raise ValueError(f"{added.get('name', 'params')}: expected the betas and eps of the other groups")

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Drop all gradients, or zero them, as `torch.optim.Adam` does."""
        inspect.unwrap(torch.optim.Adam.zero_grad)(self, set_to_none)

    def regularise(self, texture: NeuralTexture, factors: torch.Tensor | None) -> None:
        """Take over a texture's grid: update its half-precision copy, and add sum_l factors[l] sum(H_l^2) to the loss.

        Of the (L,) `factors`, None adds nothing.
        """
        self._texture, self._factors = texture, factors
        if texture.grid.is_cuda:
            texture.half_copy()  # before any step is captured

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Do one step; gradients stay as they are."""
        if closure is not None:
            raise TypeError("closure: expected None; a loss is evaluated once a step")
        texture = self._texture
        grid = None if texture is None else texture.grid
        half = None
        if texture is not None and (texture.grid.is_cuda or texture.half_copy_key() is not None):
            half = texture.half_copy()
        stepped: list[Stepped] = []
        of_first: dict[str, torch.Tensor | None] = {}
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None and (parameter is not grid or self._factors is None):
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                    state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(parameter) for _ in range(2))
                rate = torch.as_tensor(group["lr"], dtype=torch.float32, device=parameter.device)
                moments = state["exp_avg"], state["exp_avg_sq"]
                one = Stepped(parameter.detach(), *moments, parameter.grad, state["step"], rate)
                if parameter is grid:
                    of_first = {"factors": self._factors, "half": half}
                stepped.insert(0 if parameter is grid else len(stepped), one)
        if stepped:
            torch._foreach_add_([one.step for one in stepped], 1)
        group = self.param_groups[0]
        self.grid_loss = adam_step(stepped, betas=group["betas"], epsilon=group["eps"], **of_first)


def grid_factors(texture: NeuralTexture, weights: LossWeights, cells_unit: float) -> torch.Tensor | None:
    """Return the factors (L,) of the grid's loss, sum_l sum(H_l^2) / s_l^3; None without any.

    The paper prints H without its square, which is meant.
    """
    return weights.grid / (texture.resolutions * cells_unit) ** 3 if weights.grid > 0 else None


def cells_unit(scene: Scene, config: Config) -> float:
    """World units in which the grid's loss counts its cells: a scene's own where the grid follows the scene.

    Scenes of `USUAL_SCALE` keep the loss as the paper has it.
    """
    return scene.scale / USUAL_SCALE if config.texture.max_resolution is None else 1.0


def make_optimizer(
    surfels: Surfels, texture: Texture, poses: PoseCorrections | None, scene: Scene, config: Config
) -> FusedAdam:
    """Make the optimizer of surfels, of the texture unless K is 0, and of pose corrections; it regularises the grid.

    Each of its groups gets the ends of its schedule as `group["ends"]`.
    """
    ends = rate_ends(config, scene.scale)
    parts = {name: [getattr(surfels, name)] for name in PARAMETERS}
    rest = {name: x for name, x in texture.named_parameters() if x.requires_grad}
    if isinstance(texture, NeuralTexture):
        if config.max_hits:
            parts |= {"grid": [texture.grid], "mlp": list(texture.mlp.parameters())}
        rest = {name: x for name, x in rest.items() if name != "grid" and not name.startswith("mlp.")}
    if rest:
        parts["texture"], ends["texture"] = list(rest.values()), texture.rates
    if poses is not None:
        parts["poses"] = [poses.corrections]
    groups: list[ParameterGroup] = [
        {"params": x, "name": name, "lr": ends[name][0], "ends": ends[name]} for name, x in parts.items()
    ]
    if surfels.device.type == "cuda":  # rates that a CUDA graph reads
        groups = [group | {"lr": torch.tensor(group["lr"], device=surfels.device)} for group in groups]
    optimizer = FusedAdam(groups, eps=EPSILON)
    if isinstance(texture, NeuralTexture) and config.max_hits:
        optimizer.regularise(texture, grid_factors(texture, config.losses, cells_unit(scene, config)))
    return optimizer


def rate_ends(config: Config, scale: float) -> dict[str, tuple[float, float]]:
    """Return the learning rates of a run's first and last step by group; the means' follow the scene's scale."""
    rates = dataclasses.astuple(config.rates)
    ends = {name: x if isinstance(x, tuple) else (x, x) for name, x in zip(RATED, rates, strict=True)}
    # Adam moves a pose by at most its rate a step: a short run needs longer steps.
    longer = math.sqrt(REFERENCE_ITERATIONS / config.iterations)
    ends["poses"] = POSE_RATES[0] * longer, POSE_RATES[1] * longer
    return ends | {"means": (ends["means"][0] * scale, ends["means"][1] * scale)}


def set_rates(optimizer: torch.optim.Optimizer, iteration: int, iterations: int) -> None:
    """Set the rates of a step, counted from 1: log-linear between the ends of each group."""
    progress = (iteration - 1) / max(iterations - 1, 1)
    groups, ends = optimizer.param_groups, [group["ends"] for group in optimizer.param_groups]
    rates = [math.exp((1 - progress) * math.log(a) + progress * math.log(b)) if a else 0.0 for a, b in ends]
    if isinstance(groups[0]["lr"], torch.Tensor):  # two kernels, however many groups there are
        held = [group["lr"] for group in groups]
        torch._foreach_zero_(held)
        torch._foreach_add_(held, rates)
    else:
        for group, rate in zip(groups, rates, strict=True):
            group["lr"] = rate
