"""The texture's MLP (paper Sec. 4.1), layer by layer.

Values are (features, points): a column is a point. A BLAS chooses how it divides a product, and so in which order it
adds up, by the number of its threads. Here the parts of the columns are fixed, and each is worked on by one thread of
torch and its BLAS: bits do not depend on how many threads there are.
"""

import functools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch

from nexwarp.kernels import launch as launching

# Matrix products of half precision want their rows at multiples of 16 bytes: 64 also fills their tiles.
POINT_MULTIPLE = 64
# Not among torch's documented functions.
_FUSED_RELU = hasattr(torch, "_addmm_activation")


def padded(count: int, dtype: torch.dtype) -> int:
    """Columns that the MLP works on for `count` points."""
    if dtype == torch.float16:
        return -(-count // POINT_MULTIPLE) * POINT_MULTIPLE
    # An odd number of cache lines a row: with rows at multiples of 4096 bytes, a column would fall into one set of a
    # CPU's cache and push itself out.
    line = 64 // dtype.itemsize
    return (-(-count // line) | 1) * line


def outputs(encoded: torch.Tensor, matrices: Sequence[torch.Tensor], keep: bool) -> list[torch.Tensor]:
    """Return the input (in, n) of each layer if `keep`, and the output of the last one; `encoded` without layers."""
    if not matrices:
        return [encoded]
    if encoded.device.type != "cpu":
        layers = [encoded]
        for matrix in matrices[:-1]:
            layers.append(_product_relu(matrix, layers[-1]))
            if not keep:
                del layers[0]
        return [*layers[: len(layers) * keep], matrices[-1] @ layers[-1]]
    layers = [encoded, *(encoded.new_empty(len(matrix), encoded.shape[1]) for matrix in matrices)]

    def part(_: int, columns: slice) -> None:
        for i, matrix in enumerate(matrices):
            out = torch.mm(matrix, layers[i][:, columns], out=layers[i + 1][:, columns])
            if i + 1 < len(matrices):
                out.relu_()

    _share_columns(encoded.shape[1], part)
    return layers


def _product_relu(matrix: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """Relu(matrix @ layer) on CUDA, in half precision by one kernel, which saves reading and writing the product."""
    if _FUSED_RELU and layer.dtype == torch.float16 and layer.shape[1] > 0:
        return torch._addmm_activation(layer.new_zeros(layer.shape[1]), matrix, layer)
    return torch.relu_(matrix @ layer)


def outputs_backward(
    signal: torch.Tensor, layers: Sequence[torch.Tensor], matrices: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return the gradients of the first layer's input and of the matrices, from that of the output (out, n)."""
    if not matrices:
        return signal, []
    if signal.device.type != "cpu":
        grads: list[torch.Tensor] = []
        for matrix, layer in zip(reversed(matrices), reversed(layers), strict=True):
            grads.insert(0, _product(signal, layer))
            signal = matrix.T @ signal
            if len(grads) < len(matrices):
                signal = _relu_backward(signal, layer)
        return signal, grads
    count = signal.shape[1]
    result = torch.empty_like(layers[0])
    # A slot for each part, added up in order.
    slots = [matrix.new_zeros(max(len(_parts(count)), 1), *matrix.shape) for matrix in matrices]

    def part(index: int, columns: slice) -> None:
        here = signal[:, columns]
        for i in reversed(range(len(matrices))):
            layer = layers[i][:, columns]
            torch.mm(here, layer.T, out=slots[i][index])
            if i == 0:
                torch.mm(matrices[0].T, here, out=result[:, columns])
            else:
                here = _relu_backward(matrices[i].T @ here, layer)

    _share_columns(count, part)
    return result, [functools.reduce(torch.Tensor.add_, slot.unbind()) for slot in slots]


def _relu_backward(signal: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """Zero, in place, the gradient of a layer where the layer is 0."""
    return torch.ops.aten.threshold_backward.grad_input(signal, layer, 0, grad_input=signal)


def _product(signal: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """Signal @ layer.T, summed and returned in at least float32."""
    if signal.dtype == torch.float16:
        return torch.mm(signal, layer.T, out_dtype=torch.float32)
    return signal @ layer.T


# Columns that one part has at least, and what parts begin at multiples of. Small parts stay in a core's cache from one
# layer to the next; what they add up does not depend on the number of threads, so their number must not either.
SMALLEST_PART, ALIGN, MOST_PARTS = 2048, 16, 64


def _share_columns(count: int, part: Callable[[int, slice], None]) -> None:
    """Call `part(index, columns)` for fixed parts of `count` columns, several at a time, without gradients."""
    # A mode of torch holds in one thread alone.
    inference = torch.is_inference_mode_enabled()

    def work(numbered: tuple[int, slice]) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            part(*numbered)

    for _ in _pool(launching.get_num_threads()).map(work, enumerate(_parts(count))):
        pass


def _parts(count: int) -> list[slice]:
    return [slice(*bounds) for bounds in launching.chunks(count, ALIGN, SMALLEST_PART, MOST_PARTS)]


@functools.lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads, all of them started, in which torch and its BLAS use one thread each."""
    started = threading.Barrier(threads + 1)

    def begin() -> None:
        # Asked first, as a thread that never was takes over the number of the others when it begins to work.
        torch.get_num_threads()
        # Holds in the calling thread alone, but is also what threads made later begin with: so it is undone below.
        torch.set_num_threads(1)
        started.wait()

    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(threads, "columns", initializer=begin)
    for _ in range(threads):
        pool.submit(int)
    started.wait()
    torch.set_num_threads(before)
    return pool


def _after_fork() -> None:
    """Forget the parent's threads, which do not survive a fork, and let torch do without them.

    OpenMP, which shares out torch's own loops, waits forever in the child of a process that has used it.
    """
    _pool.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
