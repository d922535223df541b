"""The passes for Warp programs: each records itself on a `wp.Tape`; `tape.backward()` differentiates a render.

Arrays are Warp arrays of one scalar type (float32 or float64) on one device; what is to receive gradients is made with
`requires_grad=True`. Outputs own gradients. `mlp` is a Warp kernel, which Warp differentiates. Each other pass calls
the torch op of its name with views of the arrays, on Warp's stream, and records the op's derivative. What
`nexwarp.model.render` adds for trained models is not here: exposures and detail limits.

    tape = wp.Tape()
    quats, scales, opacities, gammas = activate(tape, ...)
    ...
    tape.backward(loss)
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import torch
import warp as wp

from nexwarp import ops
from nexwarp.kernels.mlp import POINTS, THREADS, layer_kernel
from nexwarp.kernels.types import types
from nexwarp.ops._interop import Context, Op
from nexwarp.ops.collect import Walked
from nexwarp.ops.neural_field import Field, Points, Rays
from nexwarp.ops.project import Pinhole, Projection
from nexwarp.ops.surface import walk_surface
from nexwarp.ops.texture import colors_backward, write_colors
from nexwarp.ops.tiles import Tiles


class Image(NamedTuple):
    """The image plane: (fx, fy, cx, cy) and (width, height) in pixels, near depth in world units."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    near: float

    def pinhole(self, like: torch.Tensor) -> Pinhole:
        """The image plane as the torch ops take it."""
        fx, fy, cx, cy = self.intrinsics
        return Pinhole(like.new_tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), *self.size, self.near)

    def unflatten(self, x: torch.Tensor) -> torch.Tensor:
        """View what is (P, ...) as (height, width, ...)."""
        return x.view(self.size[1], self.size[0], *x.shape[1:])


class Hits(NamedTuple):
    """Buffers of the collection pass over the pixels P = height * width, see `nexwarp.ops.Hits`."""

    plain: wp.array
    base: wp.array
    ids: wp.array
    depths: wp.array
    weights: wp.array
    alphas: wp.array
    stops: wp.array


class Surface(NamedTuple):
    """Depths, and normals in the camera frame, not normalised, of the P pixels, see `kernels.surface`."""

    expected: wp.array
    median: wp.array
    top: wp.array
    normals: wp.array


def _tensor(x: wp.array) -> torch.Tensor:
    return wp.to_torch(x, requires_grad=False)


def _on_stream(device: wp.Device) -> AbstractContextManager:
    """Torch on Warp's current stream."""
    return torch.cuda.stream(wp.stream_to_torch(device)) if device.is_cuda else nullcontext()


def _record(
    tape: wp.Tape,
    op: Callable[..., Sequence[torch.Tensor]],
    inputs: Sequence[wp.array | None],
    dtypes: Sequence[type],
) -> list[wp.array]:
    """Call a torch op with views of arrays; return its outputs as arrays of these types and record its derivative."""
    device = next(x.device for x in inputs if x is not None)
    leaves = [None if x is None else _tensor(x).detach().requires_grad_(x.requires_grad) for x in inputs]
    with _on_stream(device), torch.enable_grad():
        outputs = op(*leaves)
    results = [
        wp.from_torch(y.detach().contiguous(), dtype=dtype, requires_grad=y.requires_grad)
        for y, dtype in zip(outputs, dtypes, strict=True)
    ]
    wanted = [(x, leaf) for x, leaf in zip(inputs, leaves, strict=True) if x is not None and x.requires_grad]
    reached = [(result, y) for result, y in zip(results, outputs, strict=True) if y.requires_grad]

    def backward() -> None:
        with _on_stream(device):
            signals = [_tensor(result.grad).view_as(y) for result, y in reached]
            grads = torch.autograd.grad(
                [y for _, y in reached], [leaf for _, leaf in wanted], signals, retain_graph=True, allow_unused=True
            )
            for (x, _), grad in zip(wanted, grads, strict=True):
                if grad is not None:
                    _tensor(x.grad).add_(grad)

    if reached:
        tape.record_func(backward, [*(x for x, _ in wanted), *(result for result, _ in reached)])
    return results


def activate(
    tape: wp.Tape, raw_quats: wp.array, log_scales: wp.array, logit_opacities: wp.array, raw_gammas: wp.array
) -> tuple[wp.array, wp.array, wp.array, wp.array]:
    """Activated quats (N) vec4, scales (N) vec2, opacities (N) and gammas (N) vec2 of raw ones, see `Surfels`."""
    raw = [raw_quats, log_scales, logit_opacities, raw_gammas]
    quats, scales, opacities, gammas = _record(tape, ops.activate, raw, [x.dtype for x in raw])
    return quats, scales, opacities, gammas


def plain_colors(
    tape: wp.Tape, sh: wp.array | tuple[wp.array, wp.array], means: wp.array, viewmat: wp.array, degree: int
) -> wp.array:
    """Plain colours (N) vec3 of sh (N, C) vec3 and means (N) vec3, as seen by a camera; viewmat is (1) mat44.

    `sh` may come apart, as (N, 1) and (N, C - 1) vec3; `degree` is at most that of the C coefficients.
    """

    def op(means: torch.Tensor, viewmat: torch.Tensor, *sh: torch.Tensor) -> list[torch.Tensor]:
        position = -(viewmat[0, :3, :3] * viewmat[0, :3, 3:]).sum(0)
        return [ops.plain_colors(sh[0] if len(sh) == 1 else (sh[0], sh[1]), means, position, degree)]

    parts = [sh] if isinstance(sh, wp.array) else sh
    return _record(tape, op, [means, viewmat, *parts], [means.dtype])[0]


def project(
    tape: wp.Tape,
    means: wp.array,
    quats: wp.array,
    scales: wp.array,
    opacities: wp.array,
    gammas: wp.array,
    colors: wp.array,
    viewmat: wp.array,
) -> tuple[wp.array, wp.array, wp.array]:
    """Records (N, 4) vec4, centers (N) vec3 and limits (N) of activated surfels; viewmat is (1) mat44.

    Only the records have gradients.
    """

    def op(*tensors: torch.Tensor) -> list[torch.Tensor]:
        projection = ops.project(*tensors[:6], tensors[6][0])
        return [projection.records, projection.centers.detach(), projection.limits.detach()]

    inputs = [means, quats, scales, opacities, gammas, colors, viewmat]
    records, centers, limits = _record(tape, op, inputs, [quats.dtype, means.dtype, opacities.dtype])
    return records, centers, limits


def intersect_tiles(
    means: wp.array,
    quats: wp.array,
    scales: wp.array,
    opacities: wp.array,
    gammas: wp.array,
    centers: wp.array,
    viewmat: wp.array,
    image: Image,
) -> Tiles:
    """Tile lists; integers, so no tape is needed."""
    with _on_stream(means.device):
        surfels = [_tensor(x) for x in (means, quats, scales, opacities, gammas)]
        projection = Projection(surfels[0].new_empty(0, 4, 4), _tensor(centers), surfels[3])
        return ops.intersect_tiles(surfels, projection, _tensor(viewmat)[0], image.pinhole(surfels[0]))


def collect(tape: wp.Tape, records: wp.array, limits: wp.array, lists: Tiles, image: Image, max_hits: int) -> Hits:
    """Collection pass; plain, base, depths, weights and alphas differentiate to records."""

    def op(records: torch.Tensor, limits: torch.Tensor) -> list[torch.Tensor]:
        projection = Projection(records, limits, limits)
        hits = ops.collect(projection, lists, image.pinhole(records), max_hits=max_hits)
        buffers = (hits.plain, hits.base, hits.ids, hits.depths, hits.weights, hits.alpha, hits.stops)
        return [x.flatten(0, 1) for x in buffers]

    real, vec3 = limits.dtype, types(limits.dtype).vec3
    return Hits(*_record(tape, op, [records, limits], [vec3, vec3, wp.int32, real, real, real, wp.int32]))


def surface(tape: wp.Tape, records: wp.array, limits: wp.array, lists: Tiles, image: Image, stops: wp.array) -> Surface:
    """Depths and normals over all hits; all outputs differentiate to records."""

    def op(records: torch.Tensor, limits: torch.Tensor, stops: torch.Tensor) -> list[torch.Tensor]:
        scene = Walked(records.detach(), limits, lists, image.pinhole(records))
        return [x.flatten(0, 1) for x in walk_surface(records, scene, image.unflatten(stops))]

    real = limits.dtype
    return Surface(*_record(tape, op, [records, limits, stops], [real, real, real, types(real).vec3]))


def unproject(tape: wp.Tape, depths: wp.array, viewmat: wp.array, image: Image) -> tuple[wp.array, wp.array]:
    """Hit positions (P, K) vec3 and unit ray directions (P) vec3, world, of depths (P, K)."""

    def op(depths: torch.Tensor, viewmat: torch.Tensor) -> list[torch.Tensor]:
        outputs = ops.unproject(image.unflatten(depths), viewmat[0], image.pinhole(depths))
        return [x.flatten(0, 1) for x in outputs]

    vec3 = types(depths.dtype).vec3
    positions, directions = _record(tape, op, [depths, viewmat], [vec3, vec3])
    return positions, directions


def hashgrid(
    tape: wp.Tape, table: wp.array, positions: wp.array, depths: wp.array, resolutions: wp.array, image: Image
) -> wp.array:
    """Features (L * F, n) of table (L, T) vecF at positions (P, K) vec3 seen at depths (P, K), n = P * K.

    `resolutions` (L) are cells in a world unit.
    """
    fx, fy, _, _ = image.intrinsics

    def op(
        table: torch.Tensor, positions: torch.Tensor, depths: torch.Tensor, resolutions: torch.Tensor
    ) -> list[torch.Tensor]:
        points = Points(positions.flatten(0, 1), depths.flatten(), depths.new_tensor([(fx * fy) ** 0.5]))
        return [ops.texture(points, Field(table, [], resolutions))]

    return _record(tape, op, [table, positions, depths, resolutions], [depths.dtype])[0]


def mlp(tape: wp.Tape, matrices: Sequence[wp.array], features: wp.array) -> wp.array:
    """Outputs (out, n) of features (in, n) by matrices (out, in) of layers, with a ReLU between two of them.

    A matrix of 64 x 64 fits the shared memory of all GPUs in float32; in float64 it needs 128 KiB.
    """
    count = features.shape[1]
    for i, matrix in enumerate(matrices):
        inputs, shape = features, (matrix.shape[0], count)
        features = wp.empty(shape, dtype=inputs.dtype, device=inputs.device, requires_grad=True)
        kernel = layer_kernel(inputs.dtype, *matrix.shape, i > 0)
        with tape:
            wp.launch_tiled(
                kernel,
                dim=[-(-count // POINTS)],
                inputs=[matrix, inputs],
                outputs=[features],
                block_dim=THREADS,
                device=inputs.device,
            )
    return features


class _Colors(Op):
    @staticmethod
    def forward(ctx: Context, coefficients: torch.Tensor, rays: Rays, directions: torch.Tensor) -> torch.Tensor:
        colors = directions.new_empty(coefficients.shape[1], 3)
        write_colors(colors, coefficients, rays)
        ctx.save_for_backward(coefficients)
        ctx.rest = rays
        return colors

    @staticmethod
    def backward(ctx: Context, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (coefficients,) = ctx.saved_tensors
        signal = torch.empty_like(coefficients)
        grad_directions = colors_backward(signal, coefficients, ctx.rest, grad.contiguous(), grad.new_ones(1), True)
        return signal, None, grad_directions


def textured_colors(
    tape: wp.Tape,
    coefficients: wp.array,
    directions: wp.array,
    degree: int,
    clamp: bool = False,
    offset: float = 0.5,
) -> wp.array:
    """Colours offset + SH (n) vec3 of coefficients (3 (degree + 1)^2, n) along directions (P) vec3, n = P * K.

    The offset of a residual texture is 0.
    """

    def op(coefficients: torch.Tensor, directions: torch.Tensor) -> list[torch.Tensor]:
        rays = Rays(directions.detach(), offset, clamp)
        return [_Colors.apply(coefficients[: 3 * (degree + 1) ** 2], rays, directions)]

    return _record(tape, op, [coefficients, directions], [directions.dtype])[0]


def compose(
    tape: wp.Tape,
    plain: wp.array,
    colors: wp.array,
    weights: wp.array,
    alphas: wp.array,
    background: wp.array,
    base: wp.array | None = None,
) -> tuple[wp.array, wp.array]:
    """Image and textured, (P) vec3 each, of plain and base (P) vec3, colors (P * K) vec3, weights (P, K), alphas (P).

    `base`, of residual textures, is added to `textured`; background is (1) vec3.
    """

    def op(*tensors: torch.Tensor) -> list[torch.Tensor]:
        plain, colors, weights, alphas, background, base = tensors
        slots = (colors.view(1, *weights.shape, 3), weights[None])
        return [
            x[0]
            for x in ops.compose(plain[None], *slots, alphas[None], background[0], None if base is None else base[None])
        ]

    image, textured = _record(tape, op, [plain, colors, weights, alphas, background, base], [plain.dtype, plain.dtype])
    return image, textured
