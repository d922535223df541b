"""Frames as CUDA graphs: a frame's launches are captured once and replayed for any camera of the same image size.

A frame launches about a hundred small kernels, which keeps a slow host busy for longer than the GPU. What differs from
one frame to the next, the camera and the background, is copied into tensors that the graph reads. The graph also reads
the model's own parameters, so that changes in place show at once. Whatever else changes, such as the options, the
number of surfels or a parameter that is replaced, needs another graph: the first frame after it is launched kernel by
kernel, the next one is captured. Both do the same arithmetic on the same numbers.

A graph keeps all buffers of its rendering, or only the image (`Model.render_image`). Graphs of one model, or of models
that share graphs, use the same memory for temporary buffers, so that a replay may overwrite the buffers of an earlier
rendering. The buffers of a rendering that is still referenced are therefore copied before the next replay.

Where a frame cannot be captured, it is launched kernel by kernel: on a CPU, with gradients, in float64, with a depth
jitter, of very large images (which keep the GPU busy anyway), of models merged from blocks, and where memory does not
suffice.
"""

import dataclasses
import logging
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

import torch
from torch import nn

from nexwarp import ops
from nexwarp.cameras.camera import Camera, StagedCamera
from nexwarp.errors import OutOfMemoryError
from nexwarp.machine import needed_memory
from nexwarp.model.background import Color, background_numbers
from nexwarp.model.exposures import Exposures
from nexwarp.model.frame_request import FrameRequest
from nexwarp.model.merged_texture import MergedTexture
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels

log = logging.getLogger(__name__)

# Graphs of one model; each keeps its results in memory, and all share the rest. The least recently used makes room.
# M models that share graphs have M times as many.
MOST_GRAPHS = 4
# Kinds of frames of one model that are remembered to have been launched once.
MOST_SEEN = 16
# Of one frame, pixels times max(K, 1).
MOST_POINTS = 2**23
# How often to start again without any graph when memory does not suffice.
CHANCES = 3

FIELDS = frozenset(field.name for field in dataclasses.fields(Rendering))
_RELEASABLE = FIELDS - {"image"}

T = TypeVar("T")

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


class FrameGraphs:
    """The captured frames of a model, or of several that share memory, on one GPU. Threads take turns."""

    def __init__(self, device: torch.device, models: int = 1) -> None:
        self.most, self.most_seen = MOST_GRAPHS * models, MOST_SEEN * models
        self.lock = threading.RLock()
        self.stream = torch.cuda.Stream(device)
        self.pool: tuple[int, int] | None = None
        self.frames: OrderedDict[Hashable, _Frame] = OrderedDict()
        self.seen: OrderedDict[Hashable, Hashable] = OrderedDict()
        self.chances = CHANCES
        # When the memory that all graphs share was last used, and on which stream.
        self.used = torch.cuda.Event()
        self.user: torch.cuda.Stream | None = None
        # The last rendering, whose buffers may still be in that memory. Any graph overwrites them: the results of one
        # may lie where another one has its temporary buffers.
        self.latest: weakref.ref[CapturedRendering] | None = None

    def render(self, request: FrameRequest) -> Rendering | None:
        """Render by a graph; None if the frame is to be launched kernel by kernel."""
        with self.lock:
            rendering = self._run(request, whole=True, take=CapturedRendering.of)
            if rendering is not None:
                self.latest = weakref.ref(rendering)
            return rendering

    def render_image(self, request: FrameRequest) -> torch.Tensor | None:
        """Render by a graph that keeps the image alone; None if the frame is to be launched kernel by kernel."""
        with self.lock:
            return self._run(request, whole=False, take=_image_of)

    def _run(self, request: FrameRequest, whole: bool, take: "Callable[[_Frame, torch.cuda.Stream], T]") -> T | None:
        """Replay the request's graph, captured first where needed; None if the frame is to be launched."""
        state, common = request.state, request.kind()
        if not whole and (frame := self.frames.get((True, *common))) is not None and frame.state == state:
            whole = True  # a graph that keeps all buffers is there: it has the image, too
        kind = (whole, *common)
        frame = self.frames.get(kind)
        if frame is None or frame.state != state or not self.chances:
            self.frames.pop(kind, None)
            if self.seen.get(kind) != state or not self.chances:
                self.seen[kind] = state
                self.seen.move_to_end(kind)
                while len(self.seen) > self.most_seen:
                    self.seen.popitem(last=False)
                return None
            while len(self.frames) >= self.most:
                self.frames.popitem(last=False)
            frame = self._capture(request, whole)
            if frame is None:
                return None
            self.frames[kind] = frame
        self.frames.move_to_end(kind)
        taken, held = frame.replay(request, take)
        if not held:
            # What was taken is right, but slow, as the next frame by this graph would be.
            del self.frames[kind]
        return taken

    def _capture(self, request: FrameRequest, whole: bool) -> "_Frame | None":
        """Return the captured frame; None if that is not possible."""
        if not self.frames:
            self.pool = None  # it has gone with its last graph
        try:
            return _Frame(self, request, whole)
        except Exception as error:
            memory = isinstance(error, OutOfMemoryError) or needed_memory(error) is not None
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
    def using(self, stream: torch.cuda.Stream | None = None) -> Iterator[torch.cuda.Stream]:
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
            yield stream
        self.user = stream
        self.used.record(stream)


class _Frame:
    """One captured frame: the tensors that it reads, the graph, and the results that each replay overwrites."""

    @torch.inference_mode(False)  # later frames write to its tensors in any mode
    @torch.no_grad()
    def __init__(self, graphs: FrameGraphs, request: FrameRequest, whole: bool) -> None:
        self.graphs, self.state = graphs, request.state
        camera, exposures = request.camera, request.parts.exposures
        device = graphs.stream.device
        # Pose (4, 4), intrinsics (3, 3), two focal lengths and the background, so that one copy brings them all.
        self.numbers = torch.zeros(32, device=device)
        self.matrices, self.scalars, self.background = self.numbers[:25], self.numbers[25:30], self.numbers[27:30]
        falloff = None if exposures is None else exposures.falloff_of(camera)
        self.lens: Hashable = None
        self.camera = StagedCamera(
            self.numbers[:16].view(4, 4),
            self.numbers[16:25].view(3, 3),
            camera.width,
            camera.height,
            camera.near,
            checked=(camera.fx, camera.fy, camera.cx, camera.cy),
            focals=self.numbers[25:27],
            falloff=None if falloff is None else falloff.clone(),
        )
        self.staged = [x for x in (self.numbers, self.camera.falloff) if x is not None]
        if graphs.pool is None:
            graphs.pool = torch.cuda.graph_pool_handle()
        self.graph = torch.cuda.CUDAGraph()
        with graphs.using(), ops.captured(self.graph, graphs.stream, graphs.pool):
            result = request.work(self.camera, self.background)
        self.image, self.room = result.image, result.intermediates.tiles.room
        # Memory of what is not kept here serves other graphs.
        self.result = result if whole else None

    def replay(self, request: FrameRequest, take: "Callable[[_Frame, torch.cuda.Stream], T]") -> tuple[T, bool]:
        """Render another camera; what the rendering before still holds is copied for it first.

        Args:
            request: of the frame's kind and state.
            take: copies the wanted result from the frame, on the stream of its replay.

        Returns:
            What was taken, and whether the lists of surfels have held all entries, as far as is known.
        """
        if self.graphs.latest is not None and (latest := self.graphs.latest()) is not None:
            latest.take_buffers()
        self.graphs.latest = None
        with self.graphs.using() as stream:
            self._stage(request.camera, request.background, request.parts.exposures)
            self.graph.replay()
            return take(self, stream), ops.held(self.room)

    def _stage(self, camera: Camera, background: Color, exposures: Exposures | None) -> None:
        """Copy what differs from one frame to the next into the tensors that the graph reads."""
        color = [0.0] * 3
        if not isinstance(background, torch.Tensor):
            color = background_numbers(background, self.numbers.dtype)
        # From pageable memory, which is read before the copy returns.
        scalars = torch.tensor([camera.focal, camera.pixel_focal, *color])
        matrices = [camera.viewmat.detach().reshape(-1), camera.K.detach().to(self.numbers.dtype).reshape(-1)]
        if camera.device.type == "cpu":
            self.numbers[:30].copy_(torch.cat([*matrices, scalars]), non_blocking=True)
        else:
            torch.cat(matrices, out=self.matrices)
            self.scalars.copy_(scalars, non_blocking=True)
        if isinstance(background, torch.Tensor):
            self.background.copy_(background.detach().expand(3))
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        if self.camera.falloff is not None and self.lens != lens:
            assert exposures is not None
            falloff = exposures.falloff_of(camera)
            assert falloff is not None
            self.camera.falloff.copy_(falloff)
            self.lens = lens


def _image_of(frame: _Frame, _: torch.cuda.Stream) -> torch.Tensor:
    return frame.image.clone()


class CapturedRendering(Rendering):
    """A rendering by a graph. All but the image is copied from the graph's memory when it is first asked for.

    A rendering that is still there when a graph of the model is replayed gets its copies before.
    """

    frame: "_Frame | None"

    @classmethod
    def of(cls, frame: _Frame, stream: torch.cuda.Stream) -> "CapturedRendering":
        """Return the rendering that the graph was last replayed for, on a stream."""
        rendering = cls.__new__(cls)
        rendering.__dict__.update(image=_image_of(frame, stream), frame=frame, stream=stream)
        return rendering

    def __getattr__(self, name: str) -> Any:
        if name not in _RELEASABLE:
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
                copies: dict[int, torch.Tensor] = {}
                for name in _RELEASABLE:
                    self.__dict__[name] = _copied(getattr(frame.result, name), copies)
            self.__dict__["frame"] = None

    def __reduce__(self) -> Any:
        return Rendering, tuple(getattr(self, field.name) for field in dataclasses.fields(Rendering))


def _copied(value: Any, copies: dict[int, torch.Tensor]) -> Any:
    """Copy a tensor, or a dataclass with all tensors in it; a tensor that occurs twice is copied once."""
    if isinstance(value, torch.Tensor):
        if id(value) not in copies:
            copies[id(value)] = value.clone()
        return copies[id(value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        return type(value)(**{name: _copied(part, copies) for name, part in fields.items()})
    return value


# By their surfels, which several models may share; released with them.
_graphs: "weakref.WeakKeyDictionary[nn.Module, FrameGraphs]" = weakref.WeakKeyDictionary()
_graphs_lock = threading.Lock()


def share_graphs(surfels: Sequence[Surfels]) -> None:
    """Let the graphs of several models share memory from now on, and drop the graphs that the models have.

    The graphs are freed with the last of the models. If a frame of one model cannot be captured, all are dropped.

    Args:
        surfels: those of the models, at least one, all on one GPU.
    """
    with _graphs_lock:
        before = {id(graphs): graphs for each in surfels if (graphs := _graphs.get(each)) is not None}
        graphs = FrameGraphs(surfels[0].device, len(surfels))
        for each in surfels:
            _graphs[each] = graphs
    for dropped in before.values():
        dropped.clear()  # it and its frames refer to each other, so that only the garbage collector would free them


def render_by_graph(request: FrameRequest) -> Rendering | None:
    """Return a rendering; None if the frame is to be launched kernel by kernel."""
    graphs = _graphs_for(request)
    return None if graphs is None else graphs.render(request)


def render_image_by_graph(request: FrameRequest) -> torch.Tensor | None:
    """Return the image alone, which takes less memory; None if the frame is to be launched kernel by kernel."""
    graphs = _graphs_for(request)
    return None if graphs is None else graphs.render_image(request)


def _graphs_for(request: FrameRequest) -> FrameGraphs | None:
    """Return the graphs of the request's model; None if the frame cannot be captured."""
    surfels = request.parts.surfels
    device = surfels.device
    if not _enabled or device.type != "cuda" or isinstance(request.parts.texture, MergedTexture):
        return None
    if not _can_capture(device, request):
        return None
    with _graphs_lock:
        graphs = _graphs.get(surfels)
        if graphs is None or graphs.stream.device != device:
            graphs = _graphs[surfels] = FrameGraphs(device)
    return graphs


def release_graphs() -> bool:
    """Drop the graphs of all models and free their memory; return whether there were any."""
    with _graphs_lock:
        everything = list(_graphs.values())
    return any([graphs.clear() for graphs in everything])


def capturing(device: torch.device) -> bool:
    """Whether a graph is being captured on the current stream; torch without CUDA cannot be asked."""
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def _can_capture(device: torch.device, request: FrameRequest) -> bool:
    """Whether a frame fits the tensors that a graph reads, needs no gradients and is none of a larger graph."""
    tensors, options, camera, background = request.tensors, request.options, request.camera, request.background
    if camera.width * camera.height * max(options.max_hits, 1) > MOST_POINTS or isinstance(camera, StagedCamera):
        return False
    if camera.viewmat.dtype != torch.float32 or camera.device not in (device, torch.device("cpu")):
        return False
    if any(x.device != device or (x.is_floating_point() and x.dtype != torch.float32) for x in tensors):
        return False
    differentiated = [*tensors, camera.viewmat]
    if isinstance(background, torch.Tensor):
        given = (background.dtype, background.device, *background.shape)
        if given not in ((torch.float32, device), (torch.float32, device, 3)):
            return False
        differentiated.append(background)
    if torch.is_grad_enabled() and any(x.requires_grad for x in differentiated):
        return False
    return not capturing(device)
