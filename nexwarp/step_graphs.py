"""Training steps as CUDA graphs: a step's launches are recorded once and repeated as one."""

import warnings
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch

from nexwarp import ops
from nexwarp.camera import Camera

# Kinds of targets (sizes of photos, with or without a mask) that get graphs; each keeps buffers of its own.
MOST_KINDS = 4


class Learnt(NamedTuple):
    """What a step leaves behind.

    Attributes:
        losses: terms of the loss, scalars.
        image: (H, W, 3) the rendering.
        tiles: its lists.
    """

    losses: dict[str, torch.Tensor]
    image: torch.Tensor
    tiles: ops.Tiles


@dataclass(frozen=True)
class _StagedCamera(Camera):
    """A camera whose numbers lie on the GPU, where they can change under a graph; its `fx` to `cy` say nothing."""

    @property
    def focal(self) -> torch.Tensor:  # type: ignore[override]
        return self.focals


class StepGraphs:
    """Runs the GPU's part of training steps, as graphs where that pays.

    A step launches hundreds of small kernels, which keeps the host busy for longer than the GPU. All that differs from
    one step to the next, its target and the learning rates, is copied to where the graph reads it. Whatever else
    changes, such as the number of surfels, makes for a new graph: the first step after it is launched as ever, the next
    one recorded. Both do the same arithmetic on the same numbers.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.pool = torch.cuda.graph_pool_handle()
        # A pool is gone with its last graph: this one outlives the others.
        self.keeper, mark = torch.cuda.CUDAGraph(), torch.zeros(1, device=device)
        with ops.captured(self.keeper, self.stream, self.pool):
            mark.add_(1)
        self.stages: dict[Hashable, _Stage] = {}
        self.able = True

    def run(self, target: Any, work: Callable[[Any], Learnt], state: Hashable) -> Learnt:
        """Do a step.

        Args:
            target: a frozen dataclass of what the step is to show: tensors, and a camera by the name of `camera`.
            work: does the step for a target; its launches may depend on nothing but the target's kind and `state`.
            state: whatever else `work` depends on.

        Returns:
            What `work` returns; its image is there until the next step.
        """
        kind = _kind(target)
        stage = self.stages.get(kind)
        if stage is None and (not self.able or len(self.stages) == MOST_KINDS):
            return work(target)
        if stage is None:
            stage = self.stages[kind] = _Stage(target)
        else:
            stage.take(target)
        if stage.state != state:
            stage.forget()
            stage.state = state
            return work(stage.target)
        if stage.graph is None and not (self.able and self._capture(stage, work)):
            return work(stage.target)
        return stage.replay()

    def _capture(self, stage: "_Stage", work: Callable[[Any], Learnt]) -> bool:
        try:
            stage.capture(work, self.stream, self.pool)
        except RuntimeError as error:
            stage.forget()
            self.able = False
            self.stages.clear()
            # A pool cannot grow at the cost of what torch keeps in reserve, as other memory can.
            if not isinstance(error, torch.OutOfMemoryError):
                told = " ".join(str(error).split())
                warnings.warn(f"training steps are launched kernel by kernel, which is slower: {told}", stacklevel=2)
            torch.cuda.empty_cache()
            return False
        return True


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
        self.state: Hashable = None
        self.graph: torch.cuda.CUDAGraph | None = None
        self.learnt: Learnt | None = None
        self.losses: torch.Tensor | None = None

    def take(self, target: Any) -> None:
        """Put another target of the kind in the place of the last one."""
        for name, place in self.tensors.items():
            place.copy_(getattr(target, name))
        staged, camera = self.target.camera, target.camera
        staged.viewmat.copy_(camera.viewmat)
        staged.K.copy_(camera.K)
        staged.focals.fill_(camera.focal)

    def capture(self, work: Callable[[Any], Learnt], stream: torch.cuda.Stream, pool: Any) -> None:
        """Record the work."""
        graph = torch.cuda.CUDAGraph()
        with ops.captured(graph, stream, pool):
            self.learnt = work(self.target)
            self.losses = torch.stack(list(self.learnt.losses.values()))
        self.graph = graph

    def replay(self) -> Learnt:
        """Do the recorded work."""
        assert self.graph is not None and self.learnt is not None and self.losses is not None
        self.graph.replay()
        learnt = self.learnt
        if not ops.roomy(learnt.tiles):
            self.state = None
        # Losses are looked at later, when the graph has put others there.
        losses = dict(zip(learnt.losses, self.losses.clone().unbind(), strict=True))
        return learnt._replace(losses=losses)

    def forget(self) -> None:
        """Drop the graph."""
        self.graph = self.learnt = self.losses = None


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
