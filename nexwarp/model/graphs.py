"""CUDA graphs of frames, of work on many cameras and of training steps: launches are captured once, replayed as one.

All launch hundreds of small kernels, which keeps the host busy for longer than the GPU. What differs from one frame to
the next (camera, background) or from one step to the next (target, learning rates) is copied into tensors that the
graph reads. Parameters are read where they are, so that changes in place show at once. Whatever else changes needs
another graph: the first frame or step after it is launched kernel by kernel, so that all kernels are loaded, and the
next one is captured. What cannot be captured is launched kernel by kernel, as is everything for which memory does not
suffice.
"""

import dataclasses
import functools
import logging
import threading
import warnings
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, Generic, NamedTuple, TypeVar, cast

import torch
from torch import nn

from nexwarp import ops
from nexwarp.cameras.camera import Camera, StagedCamera
from nexwarp.errors import OutOfMemoryError
from nexwarp.machine import needed_memory
from nexwarp.model.options import color_numbers
from nexwarp.model.render import Frame, Rendering, draw
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture

log = logging.getLogger(__name__)

CHANCES = 3  # how often to start again without any graph when memory does not suffice

# Frames. Graphs of one model: each keeps its results in memory, and all share the rest.
MOST_GRAPHS = 4
MOST_SEEN = 16  # kinds of frames of one model that are remembered to have been launched once
MOST_POINTS = 2**23  # of one frame, pixels times max(K, 1): larger ones keep the GPU busy anyway

# Work on many cameras: largest number of captures.
MOST_CAPTURES = 8

# Steps. Kinds of targets (sizes of photos, with or without a mask) that get graphs; each keeps buffers of its own. A
# kind that was not used for FORGOTTEN steps makes room for another.
MOST_KINDS = 4
FORGOTTEN = 1000

_COPIED = [field.name for field in dataclasses.fields(Rendering) if field.name != "image"]

T = TypeVar("T")


class CaptureError(Exception):
    """A capture failed; `memory` says whether memory did not suffice."""

    def __init__(self, cause: MemoryError | RuntimeError) -> None:
        super().__init__(" ".join(str(cause).split()))
        self.memory = needed_memory(cause) is not None


class Captured(Generic[T]):
    """Work that was captured, and its result, whose tensors each replay overwrites."""

    def __init__(self, work: Callable[[], T], stream: torch.cuda.Stream, pool: tuple[int, int] | None) -> None:
        self.graph = torch.cuda.CUDAGraph()
        try:
            with ops.captured(self.graph, stream, pool):
                self.result = work()
        except ops.UnknownLengthError:
            raise
        except (MemoryError, RuntimeError) as error:
            raise CaptureError(error) from None  # whose traceback would keep what has been allocated


def capturing(device: torch.device) -> bool:
    """Whether a graph is being captured on the current stream; torch without CUDA cannot be asked."""
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


# Frames


class GraphFrame(Frame):
    """A frame that a graph may draw."""

    @functools.cached_property
    def tensors(self) -> list[torch.Tensor]:
        """Parameters and buffers of all parts."""
        parts = (self.surfels, self.texture, self.exposures, self.limits)
        return [x for part in parts if part is not None for x in _tensors_of(part)]

    @functools.cached_property
    def state(self) -> Hashable:
        """What the launches depend on beside the kind; changes of values in place do not count."""
        exposures, products = self.exposures, torch.backends.cuda.matmul
        neural = self.texture if isinstance(self.texture, NeuralTexture) else None
        return (
            *((x.data_ptr(), x.shape) for x in self.tensors),
            neural and (neural.half_precision, neural.residual, neural.down_weighting, neural.sh_degree),
            # Brought up to date here: a graph reads the copy, where there is one, and not the grid.
            neural and neural.half_copy_key() and neural.half_copy().data_ptr(),
            exposures and exposures.lens,
            torch.are_deterministic_algorithms_enabled(),
            products.allow_tf32,
            products.allow_fp16_reduced_precision_reduction,
        )

    def kind(self) -> tuple[Hashable, ...]:
        """Whose frame it is, and what it has in common with the next ones."""
        o, camera = self.options, self.camera
        options = (o.max_hits, o.sh_degree, o.clamp_texture, o.exposure, o.detail_limits, o.order)
        parts = (self.texture is None, self.exposures is None, self.limits is None)
        return id(self.surfels), options, parts, camera.width, camera.height, camera.near


def _tensors_of(module: nn.Module) -> list[torch.Tensor]:
    """Return parameters and buffers; torch's own iterators take a tenth of a small frame's time."""
    tensors = [x for x in (*module._parameters.values(), *module._buffers.values()) if x is not None]
    for child in module._modules.values():
        if child is not None:
            tensors += _tensors_of(child)
    return tensors


def render(frame: GraphFrame, *, whole: bool = True) -> Rendering:
    """Render by a graph where there can be one; not `whole` keeps the image alone, which takes less memory."""
    device = frame.surfels.device
    if (graphs := _graphs_for(frame)) is not None and (rendering := graphs.render(frame, whole)) is not None:
        return rendering
    if frame.camera.device != device:
        frame = dataclasses.replace(frame, camera=frame.camera.to(device))
    try:
        return draw(frame)
    except OutOfMemoryError:
        # In the middle of another capture, freeing would break it; whoever captures frees afterwards.
        if capturing(device) or not release_graphs():
            raise
    # Outside of the handler: the error's traceback would keep alive what has been allocated.
    return draw(frame)


class FrameGraphs:
    """The captured frames of a model, or of several that share memory, on one GPU. Threads take turns.

    A graph keeps all buffers of its rendering (whole), or only the image. All graphs use the same memory for temporary
    buffers, so that a replay may overwrite the buffers of an earlier rendering. The buffers of a rendering that is
    still referenced are therefore copied before the next replay.
    """

    def __init__(self, device: torch.device, models: int = 1) -> None:
        self.models = models
        self.lock = threading.RLock()
        self.stream = torch.cuda.Stream(device)
        self.pool: tuple[int, int] | None = None
        self.frames: OrderedDict[Hashable, CapturedFrame] = OrderedDict()  # the least recently used first
        self.seen: dict[Hashable, Hashable] = {}  # states of the kinds that have been launched
        self.chances = CHANCES
        # When the memory that all graphs share was last used, and on which stream.
        self.used = torch.cuda.Event()
        self.user: torch.cuda.Stream | None = None
        # The last rendering, whose buffers any graph may overwrite.
        self.latest: weakref.ref[CapturedRendering] | None = None

    def render(self, frame: GraphFrame, whole: bool) -> "CapturedRendering | None":
        """Render by a graph; None if the frame is to be launched kernel by kernel."""
        with self.lock:
            captured = self._find(frame, whole)
            if captured is None:
                return None
            if self.latest is not None and (latest := self.latest()) is not None:
                latest.take_buffers()
            with self.using():
                captured.take(frame)
                captured.graph.replay()
                image = captured.image.clone()  # this and the next line read the graph's memory
                held = ops.fits(captured.room, margin=False)
            if not held:
                # What was rendered is right, but slow, as the next frame by this graph would be.
                del self.frames[captured.kind]
            rendering = CapturedRendering.of(captured, image, torch.cuda.current_stream(self.stream.device))
            self.latest = weakref.ref(rendering) if whole else None
            return rendering

    def _find(self, frame: GraphFrame, whole: bool) -> "CapturedFrame | None":
        """Return the frame's graph, captured first where needed; None if the frame is to be launched."""
        state, common = frame.state, frame.kind()
        for kind in ((True, *common), (whole, *common)):  # one that keeps all buffers has the image, too
            captured = self.frames.get(kind)
            if captured is not None and captured.state == state and self.chances:
                self.frames.move_to_end(kind)
                return captured
        self.frames.pop(kind, None)
        if self.seen.get(kind) != state or not self.chances:
            if len(self.seen) >= MOST_SEEN * self.models:
                self.seen.clear()
            self.seen[kind] = state
            return None
        while len(self.frames) >= MOST_GRAPHS * self.models:
            self.frames.popitem(last=False)
        return self._capture(frame, kind)

    def _capture(self, frame: GraphFrame, kind: tuple[Hashable, ...]) -> "CapturedFrame | None":
        """Capture a frame; return None if that is not possible."""
        if not self.frames:
            self.pool = None  # it has gone with its last graph
        try:
            captured = self.frames[kind] = CapturedFrame(self, frame, kind)
            return captured
        except Exception as error:
            memory = getattr(error, "memory", False)
            log.debug("frames are launched kernel by kernel: %s", error)
        # Outside of the handler: the error's traceback would keep alive what has been allocated.
        self.clear()
        self.chances = self.chances - 1 if memory else 0
        return None

    def clear(self) -> bool:
        """Drop all graphs and free their memory; return whether there were any."""
        with self.lock:
            had = bool(self.frames)
            self.frames.clear()
            self.pool = None
            if had:
                torch.cuda.empty_cache()
            return had

    @contextmanager
    def using(self, stream: torch.cuda.Stream | None = None) -> Iterator[None]:
        """Use the graphs' memory on a stream, by default the current one, after all earlier uses."""
        switched = nullcontext() if stream is None else torch.cuda.stream(stream)
        stream = torch.cuda.current_stream(self.stream.device) if stream is None else stream
        if self.user is not None and self.user != stream:
            stream.wait_event(self.used)
            for frame in self.frames.values():
                # Their memory is for other use only when this stream is done with it, too.
                for x in frame.staged:
                    x.record_stream(stream)
        with switched:
            yield
        self.user = stream
        self.used.record(stream)


class CapturedFrame:
    """One captured frame: the tensors that it reads, the graph, and the results that each replay overwrites."""

    @torch.inference_mode(False)  # later frames write to its tensors in any mode
    @torch.no_grad()
    def __init__(self, graphs: FrameGraphs, frame: GraphFrame, kind: tuple[Hashable, ...]) -> None:
        self.graphs, self.state, self.kind = graphs, frame.state, kind
        device = graphs.stream.device
        exposures = frame.exposures if frame.options.exposure == "photos" else None
        falloff = None if exposures is None else exposures.falloff_of(frame.camera)
        self.lens: Hashable = None
        self.camera = StagedCamera(frame.camera, device, None if falloff is None else falloff.clone())
        self.staged = [x for x in (self.camera.numbers, self.camera.falloff) if x is not None]
        if graphs.pool is None:
            graphs.pool = torch.cuda.graph_pool_handle()
        with graphs.using():
            work = functools.partial(draw, dataclasses.replace(frame, camera=self.camera, background=self.camera.color))
            captured = Captured(work, graphs.stream, graphs.pool)
        self.graph, result = captured.graph, captured.result
        self.image, self.room = result.image, result.intermediates.tiles.room
        # Memory of what is not kept here serves other graphs.
        self.result = result if kind[0] else None

    def take(self, frame: GraphFrame) -> None:
        """Overwrite what the graph reads with another camera and background."""
        camera, background = frame.camera, frame.background
        if isinstance(background, torch.Tensor):
            self.camera.copy_(camera)
            self.camera.color.copy_(background.detach().expand(3))
        else:
            self.camera.copy_(camera, color_numbers(background))
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        if self.camera.falloff is not None and frame.exposures is not None and self.lens != lens:
            self.camera.falloff.copy_(cast(torch.Tensor, frame.exposures.falloff_of(camera)))
            self.lens = lens


class CapturedRendering(Rendering):
    """A rendering by a graph, whose other buffers are copied when asked for, or before the next replay."""

    frame: CapturedFrame | None

    @classmethod
    def of(cls, frame: CapturedFrame, image: torch.Tensor, stream: torch.cuda.Stream) -> "CapturedRendering":
        """Return the rendering that the graph was last replayed for, on a stream."""
        rendering = cls.__new__(cls)
        rendering.__dict__.update(image=image, frame=frame, stream=stream)
        return rendering

    def __getattr__(self, name: str) -> object:
        if name not in _COPIED:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        self.take_buffers()
        return self.__dict__[name]

    def take_buffers(self) -> None:
        """Copy all buffers from the graph's memory, unless that has been done."""
        frame = self.__dict__["frame"]
        if frame is None:
            return
        with frame.graphs.lock:
            if self.__dict__["frame"] is None:  # another thread was faster
                return
            # On the stream of its image, whichever thread it is that needs the graph's memory.
            with frame.graphs.using(self.__dict__["stream"]), torch.inference_mode(False), torch.no_grad():
                copies: dict[tuple[object, ...], torch.Tensor] = {}
                for name in _COPIED:
                    self.__dict__[name] = _copied(getattr(frame.result, name), copies)
            self.__dict__["frame"] = None

    def __reduce__(self) -> tuple[type[Rendering], tuple[object, ...]]:
        return Rendering, tuple(getattr(self, field.name) for field in dataclasses.fields(Rendering))


def _copied(value: object, copies: dict[tuple[object, ...], torch.Tensor]) -> object:
    """Copy a tensor, or a dataclass with all tensors in it; tensors that are the same view of memory get one copy."""
    if isinstance(value, torch.Tensor):
        memory = value.data_ptr(), value.shape, value.stride(), value.dtype
        if memory not in copies:
            copies[memory] = value.clone()
        return copies[memory]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        return dataclasses.replace(value, **{name: _copied(part, copies) for name, part in fields.items()})
    return value


# By their surfels, which several models may share; released with them.
_graphs: "weakref.WeakKeyDictionary[nn.Module, FrameGraphs]" = weakref.WeakKeyDictionary()
_graphs_lock = threading.Lock()
_enabled = True


@contextmanager
def without_graphs() -> Iterator[None]:
    """Launch all frames, inside the context and for all threads, kernel by kernel."""
    global _enabled
    before, _enabled = _enabled, False
    try:
        yield
    finally:
        _enabled = before


def share_graphs(surfels: Sequence[Surfels]) -> None:
    """Let the graphs of several models on one GPU share memory from now on; those that they have are dropped."""
    with _graphs_lock:
        before = {id(graphs): graphs for each in surfels if (graphs := _graphs.get(each)) is not None}
        graphs = FrameGraphs(surfels[0].device, len(surfels))
        for each in surfels:
            _graphs[each] = graphs
    for dropped in before.values():
        dropped.clear()  # it and its frames refer to each other, so that only the garbage collector would free them


def release_graphs() -> bool:
    """Drop the frames' graphs of all models and free their memory; return whether there were any."""
    with _graphs_lock:
        everything = list(_graphs.values())
    return any([graphs.clear() for graphs in everything])


def _graphs_for(frame: GraphFrame) -> FrameGraphs | None:
    """Return the graphs of the frame's model; None if the frame cannot be captured."""
    surfels, device = frame.surfels, frame.surfels.device
    if not _enabled or device.type != "cuda" or not _can_capture(device, frame):
        return None
    with _graphs_lock:
        graphs = _graphs.get(surfels)
        if graphs is None or graphs.stream.device != device:
            graphs = _graphs[surfels] = FrameGraphs(device)
    return graphs


def _can_capture(device: torch.device, frame: GraphFrame) -> bool:
    """Whether a frame fits the tensors that a graph reads, needs no gradients and is none of a larger graph."""
    camera, read = frame.camera, [*frame.tensors]
    if isinstance(frame.background, torch.Tensor):
        if frame.background.dtype != torch.float32 or frame.background.shape not in ((), (3,)):
            return False
        read.append(frame.background)
    if isinstance(camera, StagedCamera) or camera.device not in (device, torch.device("cpu")):
        return False
    if frame.texture is not None and type(frame.texture) is not NeuralTexture:  # it may depend on anything
        return False
    if camera.width * camera.height * max(frame.options.max_hits, 1) > MOST_POINTS:
        return False
    if any(x.device != device for x in read):
        return False
    read.append(camera.viewmat)
    if any(x.is_floating_point() and x.dtype != torch.float32 for x in read):
        return False
    return not (capturing(device) or (torch.is_grad_enabled() and any(x.requires_grad for x in read)))


def on_each_camera(work: Callable[[Camera], ops.ListCapacity], cameras: Iterable[Camera], device: torch.device) -> None:
    """Do work on each camera; on a GPU as a CUDA graph, from the second camera of a size on, for a few sizes.

    The work launches the same for all cameras of a size, adds its results to tensors from outside, and returns the
    capacity of its lists.
    """
    stream = torch.cuda.Stream(device) if _enabled and device.type == "cuda" else None
    graphs: dict[Hashable, tuple[StagedCamera, Captured[ops.ListCapacity]] | None] = {}
    captures = 0
    for camera in cameras:
        size = camera.width, camera.height, camera.near
        graph = graphs.get(size)
        if stream is not None and size in graphs and graph is None and captures < MOST_CAPTURES:
            captures += 1
            staged = StagedCamera(camera, device)
            try:
                graph = staged, Captured(functools.partial(work, staged), stream, None)
            except (CaptureError, ops.UnknownLengthError) as error:
                log.debug("cameras are worked on kernel by kernel: %s", error)
                stream = None
                graphs.clear()
        if graph is None:
            work(camera.to(device))
        else:
            graph[0].copy_(camera)
            graph[1].graph.replay()
            if not ops.fits(graph[1].result, margin=False):
                graph = None
        graphs[size] = graph
    if captures:
        graph = None
        graphs.clear()
        torch.cuda.empty_cache()  # gives back the graphs' memory


# Training steps


class GraphKey(NamedTuple):
    """Key that decides whether a captured step can be reused, beside its target's kind."""

    kernels: Hashable  # what decides which kernels a step launches
    tensors: Hashable  # what they read and write


class Gradients(NamedTuple):
    """What the ranks of a training sum after a graph, where the graph cannot."""

    of_parameters: list[torch.Tensor | None]  # in the order of the optimizer's groups
    errors: torch.Tensor | None  # (N,) sums of the surfels' errors; None outside of density control


class StepResult(NamedTuple):
    """What a step leaves behind, without a gradient."""

    losses: dict[str, torch.Tensor]  # terms of the loss, scalars
    image: torch.Tensor  # (H, W, 3)
    room: ops.ListCapacity
    gradients: Gradients | None = None  # left to sum over the ranks; None where the step has updated the parameters


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

    A step's target is a dataclass of a `camera`, tensors, and values on which the launches depend. Where only tensors
    have been replaced, as by a round of density control, the first step after it is captured.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device)
        self.pool: tuple[int, int] | None = None
        self.keeper: Captured[torch.Tensor] | None = None
        self.stages: dict[Hashable, _Stage] = {}
        self.steps = 0
        self.chances = CHANCES

    def run(self, target: Any, work: Callable[[Any], StepResult], state: GraphKey) -> StepResult:
        """Do a step: `work(target)`, whose launches depend on nothing but the target's kind and `state`."""
        if self.chances > 0:
            try:
                return self._run(target, work, state)
            except CaptureError as error:
                self.chances = self.chances - 1 if error.memory else 0
                if not error.memory:
                    message = f"training steps are launched kernel by kernel, not as CUDA graphs: {error}"
                    warnings.warn(message, stacklevel=2)
            except (MemoryError, RuntimeError) as error:
                if not self.can_repeat(error):
                    raise
                self.chances -= 1
            self.clear()
        return work(target)

    def can_repeat(self, error: Exception) -> bool:
        """Whether failed work can be repeated: it lacked memory, of which graphs keep some, and it updated nothing."""
        held = self.keeper is not None or any(graphs.frames for graphs in list(_graphs.values()))
        return held and needed_memory(error) is not None and not isinstance(error, UpdateError)

    def clear(self) -> None:
        """Drop all graphs, those of frames too, and free their memory."""
        self.stages.clear()
        self.keeper = self.pool = None
        release_graphs()
        torch.cuda.empty_cache()

    def _run(self, target: Any, work: Callable[[Any], StepResult], state: GraphKey) -> StepResult:
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
            known = stage.captured is not None and stage.state is not None and stage.state.kernels == state.kernels
            stage.captured = None
            stage.state = state
            if not known:
                return work(stage.target)
        if stage.captured is None:
            if self.keeper is None:  # torch frees a pool with its last graph
                mark = torch.zeros(1, device=self.stream.device)
                self.pool = torch.cuda.graph_pool_handle()
                self.keeper = Captured(lambda: mark.add_(1), self.stream, self.pool)
            with suppress(ops.UnknownLengthError):
                stage.captured = Captured(functools.partial(_stacked, work, stage.target), self.stream, self.pool)
        return work(stage.target) if stage.captured is None else stage.replay(stage.captured)


def beside(graphs: StepGraphs | None, work: Callable[[], T]) -> T:
    """Do work that is not part of a step; where it lacks memory, drop all graphs and do it again."""
    try:
        return work()
    except (MemoryError, RuntimeError) as error:
        if graphs is None or not graphs.can_repeat(error):
            raise
        graphs.chances -= 1
    graphs.clear()
    return work()


class _Stage:
    """Tensors that targets of one kind are copied into, and the graph that reads them."""

    def __init__(self, target: Any) -> None:
        tensors = {field.name: getattr(target, field.name) for field in dataclasses.fields(target)}
        self.tensors = {name: x.clone() for name, x in tensors.items() if isinstance(x, torch.Tensor)}
        self.camera = StagedCamera(target.camera, target.camera.device)
        self.camera.copy_(target.camera)
        self.target = dataclasses.replace(target, camera=self.camera, **self.tensors)
        self.seen = 0
        self.state: GraphKey | None = None
        self.captured: Captured[tuple[StepResult, torch.Tensor]] | None = None

    def take(self, target: Any) -> None:
        """Overwrite the tensors with those of another target of the kind."""
        for name, place in self.tensors.items():
            place.copy_(getattr(target, name))
        self.camera.copy_(target.camera)

    def replay(self, captured: Captured[tuple[StepResult, torch.Tensor]]) -> StepResult:
        """Replay the captured work."""
        captured.graph.replay()
        result, losses = captured.result
        with updating():  # the replay has done that
            if not ops.fits(result.room):
                self.state = None
            # Copies: they may be read after the next replay has overwritten the graph's own.
            copies = dict(zip(result.losses, losses.clone().unbind(), strict=True))
            return result._replace(losses=copies, image=result.image.clone())


def _stacked(work: Callable[[Any], StepResult], target: Any) -> tuple[StepResult, torch.Tensor]:
    """Do a step; return its losses as one tensor, too."""
    result = work(target)
    return result, torch.stack(list(result.losses.values()))


def _kind(target: Any) -> Hashable:
    """Key of a target's kind: everything but its tensors' values."""
    camera = target.camera
    parts: list[Hashable] = [camera.width, camera.height, camera.near, camera.viewmat.dtype]
    for field in dataclasses.fields(target):
        value = getattr(target, field.name)
        if isinstance(value, torch.Tensor):
            parts.append((field.name, value.shape, value.dtype))
        elif field.name != "camera":
            parts.append(value)
    return tuple(parts)
