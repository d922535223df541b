"""Adam in one kernel for each parameter, which regularises the hash grid and keeps its half-precision copy."""

import inspect
from collections.abc import Callable
from typing import Any

import torch

from nexwarp.model.texture import NeuralTexture
from nexwarp.ops.adam import Moments, adam_step
from nexwarp.train.recipe import LossWeights

# Parameters that share a learning rate, as torch's optimizers take them: `params`, a list of leaves; `name`, one of
# "means", "raw_quats", "log_scales", "logit_opacities", "raw_gammas", "sh0", "shN", "grid", "mlp" (or "texture", of a
# texture of one's own) and, where they are learned, "poses"; `lr`, the learning rate of the first step.
ParameterGroup = dict[str, Any]


class FusedAdam(torch.optim.Adam):
    """Adam whose step is one kernel a parameter; state, groups and checkpoints are those of `torch.optim.Adam`.

    Weight decay, AMSGrad and maximisation are not among its options. Parameters are float32.

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
        """Add a parameter group, as `torch.optim.Adam` does."""
        inspect.unwrap(torch.optim.Adam.add_param_group)(self, param_group)

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
        steps: list[torch.Tensor] = []
        work = []
        for group in self.param_groups:
            for parameter in group["params"]:
                factors = self._factors if parameter is grid else None
                if parameter.grad is None and factors is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                    state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(parameter) for _ in range(2))
                steps.append(state["step"])
                work.append((group, parameter, state, factors))
        if steps:
            torch._foreach_add_(steps, 1)
        self.grid_loss = None
        for group, parameter, state, factors in work:
            loss = adam_step(
                parameter.detach(),
                parameter.grad,
                Moments(state["step"], state["exp_avg"], state["exp_avg_sq"]),
                torch.as_tensor(group["lr"], dtype=torch.float32, device=parameter.device),
                betas=group["betas"],
                epsilon=group["eps"],
                factors=factors,
                half=half if parameter is grid else None,
            )
            self.grid_loss = self.grid_loss if loss is None else loss


def grid_factors(texture: NeuralTexture, weights: LossWeights, cells_unit: float) -> torch.Tensor | None:
    """Return the factors (L,) of the grid's loss, of which `losses.grid_loss` has 1 / s^3; None without any."""
    return weights.grid / (texture.resolutions * cells_unit) ** 3 if weights.grid > 0 else None
