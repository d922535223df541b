"""The torch <-> Warp boundary: arrays, types, devices and streams."""

import functools
import os
import threading
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
import warp as wp

from nexwarp.kernels import launch as launching
from nexwarp.kernels.tiles import LARGEST_INT
from nexwarp.kernels.types import PerReal
from nexwarp.native.fixed_point import HIGH, LOW

# What a kernel is launched with: arrays, scalars, vectors, or None for an array that is not there.
Argument: TypeAlias = object

REALS = {torch.float32: wp.float32, torch.float64: wp.float64}
STORAGES = {**REALS, torch.float16: wp.float16}
WarpObject: TypeAlias = Any  # a struct, or the descriptor of an array, which Warp itself gives no types


class Context(torch.autograd.function.FunctionCtx):
    """What torch hands from the forward to the backward pass of an op, as the type checker sees it."""

    saved_tensors: tuple[torch.Tensor, ...]
    needs_input_grad: tuple[bool, ...]
    rest: Any  # what else the backward pass needs

    def save_for_backward(self, *tensors: torch.Tensor | None) -> None:
        """Keep tensors for the backward pass."""


class _Gradients(torch.autograd.Function):
    """The first `count` tensors, gradients that depend on all others in a way that nothing here differentiates."""

    @staticmethod
    def forward(ctx: Context, count: int, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(x.view_as(x) for x in tensors[:count])

    @staticmethod
    def backward(ctx: Context, *signals: torch.Tensor) -> None:
        raise RuntimeError("second derivatives are not supported: nexwarp's kernels have first ones only")


class Op(torch.autograd.Function):
    """An op whose backward pass is given the gradient of at least one output; differentiating what it returns raises.

    Torch's `once_differentiable` takes gradients for constants where the incoming ones are, or where
    `torch.autograd.grad` asks for the gradients of some tensors alone.
    """

    def __init_subclass__(cls) -> None:
        backward = cls.backward

        @functools.wraps(backward)
        def marked(ctx: Context, *signals: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
            if all(x is None for x in signals):
                return (None,) * len(ctx.needs_input_grad)
            with torch.no_grad():
                grads = backward(ctx, *signals)
            if not torch.is_grad_enabled():
                return grads
            given = [x.detach().requires_grad_() for x in grads if x is not None]
            sources = (x for x in (*ctx.saved_tensors, *signals) if x is not None and x.requires_grad)
            marked_grads = iter(_Gradients.apply(len(given), *given, *sources) if given else ())
            return tuple(None if x is None else next(marked_grads) for x in grads)

        cls.backward = staticmethod(marked)  # type: ignore[method-assign]


def contiguous(*tensors: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
    """The tensors, each contiguous; None stays None."""
    return tuple(None if x is None else x.contiguous() for x in tensors)


def real_of(tensor: torch.Tensor) -> type:
    """Warp scalar type of a float32 or float64 tensor."""
    if tensor.dtype not in REALS:
        raise TypeError(f"expected float32 or float64 tensors, got {tensor.dtype}")
    return REALS[tensor.dtype]


def graph_is_kept() -> bool:
    """Whether the running backward pass keeps its graph, and so may be repeated; True where torch does not tell."""
    ask = getattr(torch._C._autograd, "_get_current_graph_task_keep_graph", None)  # not in torch 2.4
    return ask is None or bool(ask())


# Descriptors by layout: copying one costs a quarter of making it anew, and a step makes hundreds.
_layouts: dict[tuple[object, ...], WarpObject] = {}
_MOST_LAYOUTS = 4096


def array(tensor: torch.Tensor | None, dtype: type) -> Argument:
    """View a tensor as a Warp array argument of the given element type; None stays None."""
    if tensor is None:
        return None
    if tensor.numel() == 0:
        # An empty tensor is contiguous whatever its strides, but Warp looks at them.
        tensor = tensor.new_empty(tensor.shape)
    key = (dtype, tensor.dtype, tensor.shape, tensor.stride())
    layout = _layouts.get(key)
    if layout is None:
        if len(_layouts) >= _MOST_LAYOUTS:
            _layouts.clear()
        # Warp keeps the bytes from one row to the next as int32.
        steps = (step for step, size in zip(tensor.stride(), tensor.shape, strict=True) if size > 1)
        if max(steps, default=0) * tensor.itemsize > LARGEST_INT:
            raise ValueError(f"expected a tensor with rows of at most {LARGEST_INT:,} bytes, got {tuple(tensor.shape)}")
        owner: WarpObject = wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
        # Without what it keeps alive.
        layout = _layouts[key] = type(owner).from_buffer_copy(owner)
    view = type(layout).from_buffer_copy(layout)
    view.data = tensor.data_ptr()
    # The view is a bare pointer: it must keep alive what may be a temporary, like grad.contiguous().
    view.tensor = tensor
    return view


Kernel: TypeAlias = wp.Kernel | PerReal
Names: TypeAlias = dict[str, Any]  # that a kernel depends on, see `PerReal`

# What a kernel or a struct declares: an array's elements, and the dimensions of a tensor that holds it; or a struct.
Declared: TypeAlias = WarpObject


def _declared(kind: WarpObject) -> Declared:
    if isinstance(kind, wp.array):
        return kind.dtype, kind.ndim + len(getattr(kind.dtype, "_shape_", ()))
    return kind if hasattr(kind, "ctype") else None


@functools.cache
def _arguments_of(kernel: wp.Kernel) -> list[Declared]:
    return [_declared(argument.type) for argument in kernel.adj.args[1:]]  # behind `first`


@functools.cache
def _fields_of(kind: WarpObject) -> dict[str, Declared]:
    return {name: _declared(field.type) for name, field in kind.vars.items()}


def _as_declared(value: Argument, declared: Declared) -> Argument:
    """View a tensor as an array: dimensions in front of the array's own become one, or are added.

    A tuple becomes a struct whose first fields it has, a dictionary one of values by name; other arrays are null.
    """
    if isinstance(value, tuple):
        value = dict(zip(declared.vars, value, strict=False))
    if isinstance(value, dict):
        return _struct(declared, value)
    if declared is None or not isinstance(value, torch.Tensor):
        return value
    dtype, own = declared
    if value.ndim > own:
        value = value.flatten(0, value.ndim - own)
    return array(value[(None,) * (own - value.ndim)] if value.ndim < own else value, dtype)


def _itself(value: Argument) -> Argument:
    return value


def _struct(kind: WarpObject, given: dict[str, Argument]) -> Argument:
    """Make a `wp.struct` argument of tensors, scalars and vectors; None is an array that is not there."""
    kind.ctype.__ctype__ = _itself  # how Warp asks its own instances
    value, declared = kind.ctype(), _fields_of(kind)
    value.fields = {name: _as_declared(field, declared[name]) for name, field in given.items() if field is not None}
    for name, field in value.fields.items():  # views of arrays, which keep their tensors alive
        setattr(value, name, field)
    return value


# Warp prints a banner when it starts, and a line for each module that it loads: users of nexwarp do not know these.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


@functools.cache
def start_warp() -> None:
    """Initialise Warp; without a GPU, its warning of a missing driver, which Python does not see, is not printed."""
    if torch.cuda.is_available():
        wp.init()
        return
    try:
        stderr = os.dup(2)
    except OSError:  # closed
        wp.init()
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


@functools.lru_cache(maxsize=64)
def _array_at(pointer: int, length: int, dtype: type, device: torch.device) -> "wp.array[Any]":
    return wp.array(ptr=pointer, dtype=dtype, shape=(length,), device=str(device))


def warp_array(tensor: torch.Tensor, dtype: type) -> "wp.array[Any]":
    """View a contiguous tensor (length,) as Warp's own functions take it; the view does not keep the tensor alive."""
    return _array_at(tensor.data_ptr(), len(tensor), dtype, tensor.device)


@functools.cache
def _stream(index: int, pointer: int) -> wp.Stream:
    return wp.Stream(f"cuda:{index}", cuda_stream=pointer)


def stream_of(tensor: torch.Tensor) -> wp.Stream | None:
    """Torch's current stream on the tensor's device, None on a CPU."""
    if tensor.device.type == "cpu":
        return None
    start_warp()
    index = tensor.device.index
    # The stream's address alone: making torch's own object takes ten times as long.
    return _stream(index, torch._C._cuda_getCurrentRawStream(index))


def stream_on(stream: torch.cuda.Stream) -> wp.Stream:
    """Warp's view of a stream of torch."""
    start_warp()
    return _stream(stream.device_index, stream.cuda_stream)


# Warp's own sorts go to its current stream, which is one for all threads: who sets it holds this.
warp_streams = threading.RLock()
if hasattr(os, "register_at_fork"):
    # Otherwise a child that is forked while another thread holds it would wait forever.
    os.register_at_fork(
        before=warp_streams.acquire, after_in_parent=warp_streams.release, after_in_child=warp_streams.release
    )


def launch(
    like: torch.Tensor,
    kernel: Kernel,
    dim: int | tuple[int, int],
    inputs: Sequence[Argument],
    outputs: Sequence[Argument],
    *,
    block_dim: int = launching.LAUNCH_THREADS,
    sharing: launching.Sharing = launching.LIGHT,
    **names: Argument,
) -> None:
    """Launch on the device and current stream of `like`; see `nexwarp.kernels.launch.launch`.

    A `per_real` kernel is made for the type of `like` and `names`. Tensors become arrays, and tuples and dictionaries
    structs, of the types that the kernel declares, see `_as_declared`.
    """
    start_warp()
    kernel = kernel if isinstance(kernel, wp.Kernel) else kernel(real_of(like), **names)
    arguments = [_as_declared(x, kind) for x, kind in zip((*inputs, *outputs), _arguments_of(kernel), strict=True)]
    launching.launch(kernel, dim, arguments, stream_of(like), block_dim=block_dim, sharing=sharing)


def sums_in_fixed_point(like: torch.Tensor) -> bool:
    """Whether sums by atomics must not depend on their order: on CUDA, under torch's deterministic algorithms."""
    return like.is_cuda and torch.are_deterministic_algorithms_enabled()


def sums_like(like: torch.Tensor, shape: tuple[int, ...], fixed_point: bool) -> torch.Tensor:
    """Zeros to add floats to: of the dtype of `like`, or, in fixed point, a pair of integers each (..., 2)."""
    return like.new_zeros(*shape, 2, dtype=torch.int64) if fixed_point else like.new_zeros(shape)


def from_fixed_point(pairs: torch.Tensor, bad: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Values (...) of pairs (..., 2) of integers; NaN throughout when a term raised the flag `bad` (1,)."""
    values = (pairs[..., 0].double() / HIGH + pairs[..., 1].double() / LOW).to(dtype)
    return torch.where(bad.bool(), torch.nan, values)
