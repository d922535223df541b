"""The texture's MLP (paper Sec. 4.1), layer by layer.

Values are (features, points): a column is a point.
"""

import functools
from collections.abc import Sequence

import torch

from nexwarp.ops.columns import parts_of, share_columns

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
    """Return the input (in, n) of each layer if `keep`, and the output of the last one."""
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

    share_columns(encoded.shape[1], part)
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
    slots = [matrix.new_zeros(max(parts_of(count), 1), *matrix.shape) for matrix in matrices]

    def part(index: int, columns: slice) -> None:
        here = signal[:, columns]
        for i in reversed(range(len(matrices))):
            layer = layers[i][:, columns]
            torch.mm(here, layer.T, out=slots[i][index])
            if i == 0:
                torch.mm(matrices[0].T, here, out=result[:, columns])
            else:
                here = _relu_backward(matrices[i].T @ here, layer)

    share_columns(count, part)
    return result, [functools.reduce(torch.Tensor.add_, slot.unbind()) for slot in slots]


def _relu_backward(signal: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """Zero, in place, the gradient of a layer where the layer is 0."""
    return torch.ops.aten.threshold_backward.grad_input(signal, layer, 0, grad_input=signal)


def _product(signal: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """Signal @ layer.T, summed and returned in at least float32."""
    if signal.dtype == torch.float16:
        return torch.mm(signal, layer.T, out_dtype=torch.float32)
    return signal @ layer.T
