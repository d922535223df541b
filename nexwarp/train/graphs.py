"""Training steps as CUDA graphs: a step's launches are captured once and replayed as one."""

import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from typing import NamedTuple, TypeVar

import torch

from nexwarp import ops
from nexwarp.cameras.camera import StagedCamera
from nexwarp.errors import OutOfMemoryError
from nexwarp.machine import needed_memory
from nexwarp.model.frames import release_graphs
from nexwarp.model.options import RenderOptions
from nexwarp.train.target import Target

# Kinds of targets (sizes of photos, with or without a mask) that get graphs; each keeps buffers of its own. A kind that
# was not used for FORGOTTEN steps makes room for another.
MOST_KINDS = 4
FORGOTTEN = 1000

# How often to start again without any graph when memory does not suffice.
CHANCES = 3

T = TypeVar("T")


class GraphKey(NamedTuple):
    """Key that decides whether a captured graph can be reused, beside its target's kind.

    Attributes:
        kernels: what decides which kernels a step launches.
        tensors: what they read and write.
    """

    kernels: Hashable
    tensors: Hashable


class Gradients(NamedTuple):
    """What the ranks of a training sum after a graph, where the graph cannot.

    Attributes:
        of_parameters: their gradients, in the order of the optimizer's groups.
        errors: (N,) sums of the surfels' errors; None outside of density control.
    """

    of_parameters: list[torch.Tensor | None]
    errors: torch.Tensor | None


class StepResult(NamedTuple):
    """What a step leaves behind, without a gradient.

    Attributes:
        losses: terms of the loss, scalars.
        image: (H, W, 3) the rendering.
        room: capacity of its lists of surfels and tiles.
        gradients: what is left to sum over the ranks; None where the step has updated the parameters.
    """

    losses: dict[str, torch.Tensor]
    image: torch.Tensor
    room: ops.ListCapacity
    gradients: Gradients | None = None


class CaptureError(Exception):
    """A step could not be captured; `memory` says whether memory did not suffice."""

    def __init__(self, cause: MemoryError | RuntimeError) -> None:
        super().__init__(" ".join(str(cause).split()))
        self.memory = needed_memory(cause) is not None


class UpdateError(OutOfMemoryError):
    """Memory did not suffice while the parameters were updated: to repeat the step would update some of them twice."""


@contextmanager
def updating() -> Iterator[None]:
    """Turn memory errors of an update of the parameters into UpdateError."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if (needed := needed_memory(error)) is None:
            raise
        raise UpdateError(f"out of memory while the parameters were updated: needed {needed}", needed) from None


class StepGraphs:
    """Runs the GPU's part of training steps, as graphs where that pays.

    A step launches hundreds of small kernels, which keeps the host busy for longer than the GPU. What differs from one
    step to the next, its target and the learning rates, is copied into tensors that the graph reads. Whatever else
    changes needs a new graph: the first step after it is launched kernel by kernel, the next one is captured. Where
    only tensors have been replaced, as by a round of density control, the first one is captured. Both do the same
    arithmetic on the same numbers. Where memory does not suffice for graphs, or a step cannot be captured, all later
    steps are launched kernel by kernel.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.pool: tuple[int, int] | None = None
        self.keeper: torch.cuda.CUDAGraph | None = None
        self.stages: dict[Hashable, _Stage] = {}
        self.steps = 0
        self.chances = CHANCES

    def run(self, target: Target, work: Callable[[Target], StepResult], state: GraphKey) -> StepResult:
        """Do a step.

        Args:
            target: of the step.
            work: does the step for a target; its launches may depend on nothing but the target's kind and `state`.
            state: whatever else the launches depend on; see `graph_key`.

        Returns:
            What `work` returns.
        """
        if self.chances > 0:
            try:
                return self._run(target, work, state)
            except CaptureError as error:
                self.chances = self.chances - 1 if error.memory else 0
                if not error.memory:
                    told = f"training steps are launched kernel by kernel, not as CUDA graphs: {error}"
                    warnings.warn(told, stacklevel=2)
            except (MemoryError, RuntimeError) as error:
                if not self._can_repeat(error):
                    raise
                self.chances -= 1
            self.clear()
        return work(target)

    def beside(self, work: Callable[[], T]) -> T:
        """Do work that is not part of a step; where it lacks memory, drop all graphs and do it again.

        Args:
            work: can be repeated.

        Returns:
            What `work` returns.
        """
        try:
            return work()
        except (MemoryError, RuntimeError) as error:
            if not self._can_repeat(error):
                raise
            self.chances -= 1
        self.clear()
        return work()

    def _can_repeat(self, error: Exception) -> bool:
        """Whether failed work can be repeated: it lacked memory, of which graphs keep some, and it updated nothing."""
        return needed_memory(error) is not None and self.keeper is not None and not isinstance(error, UpdateError)

    def clear(self) -> None:
        """Drop all graphs, those of frames too, and free their memory."""
        self.stages.clear()
        self.keeper = self.pool = None
        release_graphs()
        torch.cuda.empty_cache()

    def _run(self, target: Target, work: Callable[[Target], StepResult], state: GraphKey) -> StepResult:
        self.steps += 1
        kind = _kind(target)
        stage = self.stages.get(kind)
        if stage is None and len(self.stages) == MOST_KINDS:
            oldest = min(self.stages, key=lambda kind: self.stages[kind].seen)
            if self.stages[oldest].seen >= self.steps - FORGOTTEN:
                return work(target)
            del self.stages[oldest]
        if stage is None:
            stage = self.stages[kind] = _Stage(target)
        else:
            stage.take(target)
        stage.seen = self.steps
        if stage.state != state:
            # Kernels that have been launched are loaded, which a capture must not do.
            known = stage.graph is not None and stage.state is not None and stage.state.kernels == state.kernels
            stage.forget()
            stage.state = state
            if not known:
                return work(stage.target)
        if stage.graph is None:
            self._keep_pool()
            with suppress(ops.UnknownLengthError):
                stage.capture(work, self.stream, self.pool)
        return work(stage.target) if stage.graph is None else stage.replay()

    def _keep_pool(self) -> None:
        """Make a graph that keeps the memory pool: torch frees a pool with its last graph."""
        if self.keeper is not None:
            return
        keeper, mark = torch.cuda.CUDAGraph(), torch.zeros(1, device=self.stream.device)
        self.pool = torch.cuda.graph_pool_handle()
        with _capture_errors(), ops.captured(keeper, self.stream, self.pool):
            mark.add_(1)
        self.keeper = keeper


def beside(graphs: StepGraphs | None, work: Callable[[], T]) -> T:
    """Do work that is not part of a step; see `StepGraphs.beside`. Without graphs there is nothing to drop for it."""
    return work() if graphs is None else graphs.beside(work)


class _Stage:
    """Tensors that targets of one kind are copied into, and the graph that reads them."""

    def __init__(self, target: Target) -> None:
        tensors = {f.name: getattr(target, f.name) for f in fields(target)}
        tensors = {name: x.clone() for name, x in tensors.items() if isinstance(x, torch.Tensor)}
        self.camera = StagedCamera.of(target.camera)
        self.target = replace(target, camera=self.camera, **tensors)
        self.tensors = tensors
        self.seen = 0
        self.state: GraphKey | None = None
        self.graph: torch.cuda.CUDAGraph | None = None
        self.result: StepResult | None = None
        self.losses: torch.Tensor | None = None

    def take(self, target: Target) -> None:
        """Overwrite the tensors with those of another target of the kind."""
        for name, place in self.tensors.items():
            place.copy_(getattr(target, name))
        self.camera.copy_(target.camera)

    def capture(
        self, work: Callable[[Target], StepResult], stream: torch.cuda.Stream, pool: tuple[int, int] | None
    ) -> None:
        """Capture the work."""
        graph = torch.cuda.CUDAGraph()
        with _capture_errors(), ops.captured(graph, stream, pool):
            self.result = work(self.target)
            self.losses = torch.stack(list(self.result.losses.values()))
        self.graph = graph

    def replay(self) -> StepResult:
        """Replay the captured work."""
        assert self.graph is not None and self.result is not None and self.losses is not None
        self.graph.replay()
        result = self.result
        with updating():  # the replay has done that
            if not ops.fits(result.room):
                self.state = None
            # Copies: they may be read after the next replay has overwritten the graph's own.
            losses = dict(zip(result.losses, self.losses.clone().unbind(), strict=True))
            return result._replace(losses=losses, image=result.image.clone())

    def forget(self) -> None:
        """Drop the graph."""
        self.graph = self.result = self.losses = None


@contextmanager
def _capture_errors() -> Iterator[None]:
    """Turn errors of a capture into CaptureError."""
    try:
        yield
    except ops.UnknownLengthError:
        raise
    except (MemoryError, RuntimeError) as error:
        raise CaptureError(error) from None  # whose traceback would keep what the step had made


def _kind(target: Target) -> Hashable:
    """Key of a target's kind: everything but its tensors' values."""
    camera = target.camera
    parts: list[Hashable] = [camera.width, camera.height, camera.near]
    for field in fields(target):
        value = getattr(target, field.name)
        if isinstance(value, torch.Tensor):
            value = (field.name, value.shape, value.dtype)
        elif field.name == "camera":
            value = (value.viewmat.dtype, value.K.dtype)
        parts.append(value)
    return tuple(parts)


def can_capture(optimizer: torch.optim.Optimizer) -> bool:
    """Whether an optimizer's step can be captured: it says so, and its learning rates are tensors on the GPU."""
    rates = [group["lr"] for group in optimizer.param_groups if group.get("capturable")]
    on_gpu = all(isinstance(rate, torch.Tensor) and rate.is_cuda for rate in rates)
    return on_gpu and len(rates) == len(optimizer.param_groups)


def graph_key(
    options: RenderOptions, optimizer: torch.optim.Optimizer, tensors: Sequence[torch.Tensor], *, densify: bool
) -> GraphKey:
    """Return the key of a step.

    Args:
        options: how the step renders.
        optimizer: whose learning rates are tensors; a step reads and writes its moments.
        tensors: what else a step reads and writes: the parameters and the densifier's sums.
        densify: whether the step adds to these sums.
    """
    moments = [x for state in optimizer.state.values() for x in state.values() if isinstance(x, torch.Tensor)]
    return GraphKey(
        (densify, options.max_hits, options.sh_degree, torch.are_deterministic_algorithms_enabled()),
        (
            *((x.data_ptr(), x.shape) for x in (*tensors, *moments)),
            *(group["lr"].data_ptr() for group in optimizer.param_groups),
        ),
    )
