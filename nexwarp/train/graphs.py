"""Training steps as CUDA graphs: a step's launches are recorded once and repeated as one."""

import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch

from nexwarp import ops
from nexwarp.camera import Camera
from nexwarp.train.health import needed_memory

# Kinds of targets (sizes of photos, with or without a mask) that get graphs; each keeps buffers of its own. One that
# was not seen for so many steps makes room for others.
MOST_KINDS = 4
FORGOTTEN = 1000

# How often to start again with nothing when memory does not suffice.
CHANCES = 3


class StepResult(NamedTuple):
    """What a step leaves behind.

    Attributes:
        losses: terms of the loss, scalars.
        image: (H, W, 3) the rendering.
        room: of its lists.
    """

    losses: dict[str, torch.Tensor]
    image: torch.Tensor
    room: ops.ListCapacity


@dataclass(frozen=True)
class _StagedCamera(Camera):
    """A camera whose numbers lie on the GPU, where they can change under a graph; its `fx` to `cy` say nothing."""

    @property
    def focal(self) -> torch.Tensor:  # type: ignore[override]
        return self.focals


class CaptureError(Exception):
    """A step could not be recorded; `memory` says whether for lack of that."""

    def __init__(self, cause: RuntimeError) -> None:
        super().__init__(" ".join(str(cause).split()))
        self.memory = needed_memory(cause) is not None


class StepGraphs:
    """Runs the GPU's part of training steps, as graphs where that pays.

    A step launches hundreds of small kernels, which keeps the host busy for longer than the GPU. All that differs from
    one step to the next, its target and the learning rates, is copied to where the graph reads it. Whatever else
    changes, such as the number of surfels, makes for a new graph: the first step after it is launched as ever, the next
    one recorded. Both do the same arithmetic on the same numbers. Where memory does not suffice for graphs, or a step
    cannot be recorded, all steps are launched from then on.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.pool: Any = None
        self.keeper: torch.cuda.CUDAGraph | None = None
        self.stages: dict[Hashable, _Stage] = {}
        self.steps = 0
        self.chances = CHANCES

    def run(self, target: Any, work: Callable[[Any], StepResult], state: Hashable) -> StepResult:
        """Do a step.

        Args:
            target: a frozen dataclass of what the step is to show: tensors, and a camera by the name of `camera`.
            work: does the step for a target; its launches may depend on nothing but the target's kind and `state`.
            state: whatever else `work` depends on.

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
            except RuntimeError as error:
                # Graphs keep memory of their own, which may be what is missing.
                if needed_memory(error) is None or self.keeper is None:
                    raise
                self.chances -= 1
            self.clear()
        return work(target)

    def clear(self) -> None:
        """Drop all graphs, and the memory that they have."""
        self.stages.clear()
        self.keeper = self.pool = None
        torch.cuda.empty_cache()

    def _run(self, target: Any, work: Callable[[Any], StepResult], state: Hashable) -> StepResult:
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
            stage.forget()
            stage.state = state
            return work(stage.target)
        if stage.graph is None:
            self._keep_pool()
            stage.capture(work, self.stream, self.pool)
        return stage.replay()

    def _keep_pool(self) -> None:
        """A pool of memory is gone with its last graph: one that does nothing outlives the others."""
        if self.keeper is not None:
            return
        keeper, mark = torch.cuda.CUDAGraph(), torch.zeros(1, device=self.stream.device)
        self.pool = torch.cuda.graph_pool_handle()
        with _told(), ops.captured(keeper, self.stream, self.pool):
            mark.add_(1)
        self.keeper = keeper


class _Stage:
    """The place where targets of one kind are put, and the graph that looks at it."""

    def __init__(self, target: Any) -> None:
        camera = target.camera
        staged = object.__new__(_StagedCamera)
        for name, value in vars(camera).items():
            object.__setattr__(staged, name, value.clone() if isinstance(value, torch.Tensor) else value)
        object.__setattr__(staged, "focals", camera.viewmat.new_full((1,), camera.focal))
        tensors = {f.name: getattr(target, f.name) for f in fields(target)}
        tensors = {name: x.clone() for name, x in tensors.items() if isinstance(x, torch.Tensor)}
        self.target = replace(target, camera=staged, **tensors)
        self.tensors = tensors
        self.seen = 0
        self.state: Hashable = None
        self.graph: torch.cuda.CUDAGraph | None = None
        self.learnt: StepResult | None = None
        self.losses: torch.Tensor | None = None

    def take(self, target: Any) -> None:
        """Put another target of the kind in the place of the last one."""
        for name, place in self.tensors.items():
            place.copy_(getattr(target, name))
        staged, camera = self.target.camera, target.camera
        staged.viewmat.copy_(camera.viewmat)
        staged.K.copy_(camera.K)
        staged.focals.fill_(camera.focal)

    def capture(self, work: Callable[[Any], StepResult], stream: torch.cuda.Stream, pool: Any) -> None:
        """Record the work."""
        graph = torch.cuda.CUDAGraph()
        with _told(), ops.captured(graph, stream, pool):
            self.learnt = work(self.target)
            self.losses = torch.stack(list(self.learnt.losses.values()))
        self.graph = graph

    def replay(self) -> StepResult:
        """Do the recorded work."""
        assert self.graph is not None and self.learnt is not None and self.losses is not None
        self.graph.replay()
        learnt = self.learnt
        if not ops.fits(learnt.room):
            self.state = None
        # They may be looked at later, when the graph has put others there.
        losses = dict(zip(learnt.losses, self.losses.clone().unbind(), strict=True))
        return learnt._replace(losses=losses, image=learnt.image.clone())

    def forget(self) -> None:
        """Drop the graph."""
        self.graph = self.learnt = self.losses = None


@contextmanager
def _told() -> Iterator[None]:
    """Turn errors of a capture into CaptureError."""
    try:
        yield
    except RuntimeError as error:
        raise CaptureError(error) from None  # whose traceback would keep what the step had made


def _kind(target: Any) -> Hashable:
    """All of a target that is not tensors' values."""
    camera = target.camera
    parts: list[Any] = [camera.width, camera.height, camera.near]
    for field in fields(target):
        value = getattr(target, field.name)
        if isinstance(value, torch.Tensor):
            value = (field.name, value.shape, value.dtype)
        elif field.name == "camera":
            value = (value.viewmat.dtype, value.K.dtype)
        parts.append(value)
    return tuple(parts)
