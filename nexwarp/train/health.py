"""Health of a training: numbers that are not finite, going back from them, and memory that does not suffice."""

import math
from collections.abc import Iterable, Mapping
from typing import Protocol

import torch

from nexwarp.errors import DivergedError
from nexwarp.train.report import StepReport
from nexwarp.train.state import Snapshot, TrainingState

LOWERED_RATES = 0.5


class RestorableRun(Protocol):
    """A run that can be taken back to a snapshot and repeated from there.

    Attributes:
        iteration: steps done.
        rate_factor: multiplies all learning rates.
        health: of the steps since the last check.
    """

    iteration: int
    rate_factor: float
    health: "Health"

    def step(self) -> StepReport:
        """Do one step."""

    def check(self) -> None:
        """Raise DivergedError where something is not finite."""

    def load_snapshot(self, snapshot: Snapshot) -> None:
        """Return to a snapshot."""


class Health:
    """Losses of the iterations since the last check; a check waits for the GPU once, noting does not.

    Attributes:
        checked: iteration of the last check.
    """

    def __init__(self, checked: int = 0) -> None:
        self.checked = checked
        self.noted: list[tuple[int, str, torch.Tensor]] = []

    def note(self, iteration: int, losses: Mapping[str, torch.Tensor]) -> None:
        """Keep the terms (scalars) of an iteration."""
        self.noted += [(iteration, name, value.detach()) for name, value in losses.items()]

    def first_bad(self) -> tuple[int, str, float] | None:
        """Return iteration, term and value of the first loss that is not finite, if any; forget all."""
        noted, self.noted = self.noted, []
        if not noted:
            return None
        values = torch.stack([value for _, _, value in noted]).tolist()
        bad = ((i, name, x) for (i, name, _), x in zip(noted, values, strict=True) if not math.isfinite(x))
        return next(bad, None)

    def check(self, state: TrainingState, tensors: Mapping[str, torch.Tensor]) -> None:
        """Raise DivergedError unless the noted losses and all tensors are finite; forget the noted losses.

        Args:
            state: of the training, for the message and the report.
            tensors: parameters, the optimizer's state and whatever else must stay finite, by name.
        """
        before, self.checked = self.checked, state.iteration
        loss, bad = self.first_bad(), not_finite(tensors)
        if loss is None and not bad:
            return
        if loss is not None:
            when, name, value = loss
            message = f"iteration {when}: the loss {name!r} is {value}"
        else:
            span = f"{before + 1} to " if before + 1 < state.iteration else ""
            message = f"iteration {span}{state.iteration}: not finite"
        places = [describe(name, tensors[name]) for name in bad]
        if len(places) > 1:
            others = dict.fromkeys(name.rpartition(" ")[2] for name in bad)
            places[0] += f" (in all: {', '.join(others)})"
        report = {
            "iteration": state.iteration,
            "checked_before": before,
            "loss": None if loss is None else {"iteration": loss[0], "term": loss[1], "value": str(loss[2])},
            "tensors": places,
            "surfels": len(state.surfels),
            "rate_factor": state.rate_factor,
        }
        raise DivergedError("; ".join([message, *places[:1]]), report)


def not_finite(tensors: Mapping[str, torch.Tensor]) -> list[str]:
    """Return the names of the tensors that hold NaN or infinity: one reduction of each, one wait for the GPU."""
    filled = {name: x.detach() for name, x in tensors.items() if x.numel()}
    if not filled:
        return []
    # A maximum hands NaN on, and cannot overflow as a sum does.
    largest = torch.stack([torch.linalg.vector_norm(x, math.inf).float() for x in filled.values()])
    return [name for name, x in zip(filled, largest.tolist(), strict=True) if not math.isfinite(x)]


def describe(name: str, tensor: torch.Tensor) -> str:
    """Tell how many values of a tensor are not finite, and where the first one is."""
    bad = (~torch.isfinite(tensor.detach())).nonzero()
    where = tuple(bad[0].tolist())
    return f"{name}: {len(bad):,} of {tensor.numel():,} values, the first {tensor[where].item()} at index {where}"


def watched_tensors(
    parameters: Iterable[tuple[str, torch.Tensor]], optimizer: torch.optim.Optimizer
) -> dict[str, torch.Tensor]:
    """Return parameters and optimizer state, which must stay finite, by the names that a report gives them."""
    watched: dict[str, torch.Tensor] = {}
    moments = {"exp_avg": "gradient", "exp_avg_sq": "squared gradient"}
    for name, parameter in parameters:
        # The gradient itself is freed by now; a gradient that is not finite shows in the optimizer's state.
        for key, value in optimizer.state.get(parameter, {}).items():
            if isinstance(value, torch.Tensor) and value.shape == parameter.shape:
                watched[f"{moments.get(key, key)} of {name}"] = value
        watched[name] = parameter
    return watched


def go_back(run: RestorableRun, good: Snapshot, fault: DivergedError) -> str:
    """Return a run to its last good snapshot with half the learning rates.

    Args:
        run: the run.
        good: the snapshot.
        fault: what was found.

    Returns:
        A warning that names the fault.

    Raises:
        DivergedError: the run had gone back before; it is in its last good state, and its rates are halved.
    """
    again = run.rate_factor < 1.0
    fault = first_fault(run, good, fault)
    run.load_snapshot(good)
    run.rate_factor = LOWERED_RATES
    if again:
        told = f"{fault}; it had gone back and halved its learning rates before, so training gives up"
        raise DivergedError(told, fault.report | {"good_iteration": run.iteration}) from None
    return f"{fault}; going back to iteration {run.iteration:,} with half the learning rates"


def first_fault(run: RestorableRun, good: Snapshot, fault: DivergedError) -> DivergedError:
    """Replay the steps since a good snapshot, checking each one: NaNs spread within a few steps.

    Returns:
        The first fault of the replay; where the replay has none, the one given.
    """
    until, rate_factor = run.iteration, run.rate_factor
    run.load_snapshot(good)
    run.rate_factor = rate_factor
    try:
        while run.iteration < until:
            run.health.note(run.iteration + 1, run.step().losses)
            run.check()
    except DivergedError as first:
        return first
    return fault


def oom_message(state: TrainingState, needed: str, *, graphs: bool) -> str:
    """Return what to say when memory does not suffice: what it was needed for, and what to lower.

    Args:
        state: of the training.
        needed: as `needed_memory` tells it.
        graphs: whether CUDA graphs are in use.
    """
    place, used, advice = "memory", "", ""
    if state.device.type == "cuda":
        free, total = torch.cuda.mem_get_info(state.device)
        place, used = "GPU memory", f", with {(total - free) / 2**30:.1f} of {total / 2**30:.1f} GiB in use"
        advice = ", or do without CUDA graphs (--set cuda_graphs=false)" if graphs else ""
    camera, config = state.scene.train[0].camera, state.config
    return (
        f"out of {place} at iteration {state.iteration}: it needed {needed}{used}, for {len(state.surfels):,} "
        f"surfels and photos of {camera.width}x{camera.height}; lower --max-surfels (now "
        f"{config.max_surfels:,}) or --max-hits (now {config.max_hits}), or raise --downscale{advice}"
    )
