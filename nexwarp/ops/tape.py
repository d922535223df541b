"""The passes for Warp-only programs: each records itself on a `wp.Tape`; `tape.backward()` differentiates a render.

Arrays are Warp arrays of one scalar type (float32 or float64) on one device; what is to receive gradients is made with
`requires_grad=True`. Outputs own gradients. The generated adjoints record themselves, since the calls launch under the
tape; the hand-structured pairs go through `tape.record_func`. The same kernels serve torch in `nexwarp.ops`. What
`nexwarp.model.render` adds for trained models is not here: exposures and detail limits.

    tape = wp.Tape()
    records, centers, limits = project(tape, ...)
    ...
    tape.backward(loss)
"""

from typing import Any, NamedTuple

import warp as wp

from nexwarp.kernels.collect import collect_kernel
from nexwarp.kernels.collect_backward import collect_backward_kernel, gradient_types
from nexwarp.kernels.compose import compose_kernels
from nexwarp.kernels.hashgrid import hashgrid_kernels
from nexwarp.kernels.project import project_kernels
from nexwarp.kernels.sh import plain_colors_kernels, textured_colors_kernels
from nexwarp.kernels.surface import surface_kernel
from nexwarp.kernels.surface_backward import surface_backward_kernel
from nexwarp.kernels.tile_lists import (
    count_kernel,
    depth_keys_kernel,
    emit_kernel,
    list_threads,
    surfel_ids_kernel,
    tile_offsets_kernel,
)
from nexwarp.kernels.tiles import MAX_CORNERS, check_entries, tile_polygon_kernel
from nexwarp.kernels.types import TILE_SIZE, TileLists, types
from nexwarp.kernels.unproject import unproject_kernels
from nexwarp.native.staging import BLOCK_DIM
from nexwarp.ops._interop import Argument


class Image(NamedTuple):
    """The image plane: (fx, fy, cx, cy) and (width, height) in pixels, near depth in world units."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    near: float

    def matrices(self, like: wp.array) -> wp.array:
        """The camera matrix (1) mat33, as the kernels read it."""
        fx, fy, cx, cy = self.intrinsics
        K = [[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]]
        return wp.array(K, dtype=types(_real(like)).mat33, device=like.device)


class Lists(NamedTuple):
    """Tile lists, see `nexwarp.ops.Tiles`."""

    surfel_ids: wp.array
    tile_offsets: wp.array
    order: wp.array
    ends: wp.array
    reaches: wp.array
    columns: int


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


def _real(array: wp.array) -> type:
    return getattr(array.dtype, "_wp_scalar_type_", array.dtype)


def _new(like: wp.array, shape: Any, dtype: type, requires_grad: bool = True) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device=like.device, requires_grad=requires_grad)


def _launch(tape: wp.Tape, kernel: wp.Kernel, dim: int, inputs: list[Argument], outputs: list[wp.array]) -> None:
    with tape:
        wp.launch(kernel, dim, inputs=[0, *inputs], outputs=outputs, device=outputs[0].device)


def _silent(
    kernel: wp.Kernel, dim: Any, inputs: list[Argument], outputs: list[wp.array | None], block_dim: int = 256
) -> None:
    device = next(x.device for x in outputs if x is not None)
    wp.launch(kernel, dim, inputs=[0, *inputs], outputs=outputs, device=device, record_tape=False)


@wp.kernel(enable_backward=False, module="unique")
def _add_points(
    first: wp.int32, points: wp.array(dtype=Any), positions: wp.array(dtype=Any), depths: wp.array(dtype=Any)
):
    p = first + wp.tid()
    g = points[p]
    positions[p] += type(positions[p])(g[0], g[1], g[2])
    depths[p] += g[3]


@wp.kernel(enable_backward=False, module="unique")
def _add_runs(first: wp.int32, values: wp.array(dtype=Any), length: wp.int32, sums: wp.array(dtype=Any)):
    i = first + wp.tid()
    for k in range(length):
        sums[i] += values[i * length + k]


@wp.kernel(enable_backward=False, module="unique")
def _subtract_all(first: wp.int32, values: wp.array(dtype=Any), total: wp.array(dtype=Any)):
    wp.atomic_sub(total, 0, values[first + wp.tid()])


def plain_colors(
    tape: wp.Tape, sh: wp.array | tuple[wp.array, wp.array], means: wp.array, position: wp.array, degree: int
) -> wp.array:
    """Plain colours (N) vec3 of sh (N, C) vec3, means (N) vec3 and the camera's position (1) vec3, world.

    `sh` may come apart, as (N, 1) and (N, C - 1) vec3; `degree` is at most that of the C coefficients.
    """
    sh0, shN = (sh[:, :1], sh[:, 1:]) if isinstance(sh, wp.array) else sh
    colors = _new(means, means.shape, means.dtype)
    kernels = plain_colors_kernels(_real(means), degree)
    _silent(kernels.forward, len(means), [sh0, shN, means, position], [colors])

    def backward() -> None:
        seen, sharing = [means, position, colors, colors.grad], 1 + shN.shape[1]
        *grads, grad_rays = (_new(x, x.shape, x.dtype, requires_grad=False) for x in (sh0, shN, means))
        _silent(kernels.coefficients_backward, len(means) * sharing, [sharing, *seen], grads)
        _silent(kernels.rays_backward, len(means), [shN, *seen], [grad_rays])
        # These kernels write their outputs; a tape adds to what is there.
        for x, grad in zip((sh0, shN, means), (*grads, grad_rays), strict=True):
            if x.requires_grad:
                _silent(_add_columns, len(x), [_columns(grad)], [_columns(x.grad)])
        if position.requires_grad:
            _silent(_subtract_all, len(means), [grad_rays], [position.grad])

    given = [sh] if isinstance(sh, wp.array) else [sh0, shN]
    tape.record_func(backward, [x for x in (*given, means, position, colors) if x.requires_grad])
    return colors


def _columns(x: wp.array) -> wp.array:
    return x if x.ndim == 2 else x.reshape((len(x), 1))


@wp.kernel(enable_backward=False, module="unique")
def _add_columns(first: wp.int32, values: wp.array2d(dtype=Any), sums: wp.array2d(dtype=Any)):
    i = first + wp.tid()
    for c in range(values.shape[1]):
        sums[i, c] += values[i, c]


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
    real = _real(means)
    records = _new(means, (len(means), 4), types(real).vec4)
    centers = _new(means, len(means), means.dtype, requires_grad=False)
    limits = _new(means, len(means), real, requires_grad=False)
    inputs = [means, quats, scales, opacities, gammas, colors, viewmat]
    _launch(tape, project_kernels(real).forward, len(means), inputs, [records, centers, limits])
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
) -> Lists:
    """Tile lists; integers, so no tape is needed."""
    real, count = _real(means), len(means)
    t = types(real)
    columns, rows = (-(-pixels // TILE_SIZE) for pixels in image.size)

    def integers(length: int, dtype: type = wp.int32) -> wp.array:
        return _new(means, length, dtype, requires_grad=False)

    keys, order, ends = integers(2 * count, wp.uint32), integers(2 * count), integers(count)

    def reals(shape: Any, dtype: type) -> wp.array:
        return _new(means, shape, dtype, requires_grad=False)

    reaches = reals(count, t.vec2)
    polygons = t.Polygons()
    polygons.corners = reals((count, MAX_CORNERS), t.vec2)
    polygons.shapes = integers(count, wp.vec3i)
    polygons.margins = reals(count, real)
    surfels = [means, quats, scales, opacities, gammas, viewmat, image.matrices(means), image.near, rows]
    _silent(tile_polygon_kernel(real), count, surfels, [reaches, polygons])
    arguments = [order[:count], polygons, wp.vec2i(columns, rows)]
    threads = list_threads(count, means.device.is_cuda)
    totals = integers(count, wp.int64)
    total = 0
    if count:
        _silent(depth_keys_kernel(real), count, [centers], [keys, order])
        wp.utils.radix_sort_pairs(keys, order, count)
        _silent(count_kernel(real), threads, arguments, [totals])
        wp.utils.array_scan(totals, totals, inclusive=True)
        total = check_entries(int(totals[count - 1 :].numpy()[0]), count, columns * rows)
    tiles, entries, emitted, ids = (integers(2 * total, d) for d in (wp.uint32, wp.int32, wp.int32, wp.int32))
    if total:
        tile_ids = tiles.view(wp.int32)
        listed = [ends, tile_ids[:total], entries[:total], emitted[:total]]
        _silent(emit_kernel(real), threads, [*arguments, totals, threads, columns * rows], listed)
        wp.utils.radix_sort_pairs(tiles, entries, total, end_bit=(columns * rows).bit_length())
        _silent(surfel_ids_kernel, total, [entries, emitted], [ids])
    offsets = integers(columns * rows + 1)
    _silent(tile_offsets_kernel, len(offsets), [tiles.view(wp.int32), total], [offsets])
    return Lists(ids, offsets, order[:count], ends, reaches, columns)


def _walk_arguments(records: wp.array, limits: wp.array, lists: Lists, image: Image) -> list[Argument]:
    """The structs `Surfels`, `TileLists` and `View` of the kernels."""
    t = types(_real(records))
    view = {
        "Ks": image.matrices(records),
        "size": wp.vec2i(*image.size),
        "tile_columns": lists.columns,
        "near": image.near,
    }
    return [
        _filled(t.Surfels, {"records": records, "limits": limits, "reaches": lists.reaches}),
        _filled(TileLists, {name: getattr(lists, name) for name in TileLists.vars}),
        _filled(t.View, view),
    ]


def _filled(kind: Any, fields: dict[str, Argument]) -> Argument:
    """A struct; None is an array that is not there."""
    value = kind()
    for name, field in fields.items():
        if field is not None:
            setattr(value, name, field)
    return value


def _walk(kernel: wp.Kernel, records: wp.array, lists: Lists, arguments: list[Argument]) -> None:
    threads = (len(lists.tile_offsets) - 1) * TILE_SIZE**2
    device = records.device
    wp.launch(kernel, threads, inputs=[0, *arguments], device=device, record_tape=False, block_dim=BLOCK_DIM)


def collect(tape: wp.Tape, records: wp.array, limits: wp.array, lists: Lists, image: Image, max_hits: int) -> Hits:
    """Collection pass; plain, base, depths, weights and alphas differentiate to records."""
    real = _real(records)
    t = types(real)
    pixels, slots = image.size[0] * image.size[1], max(max_hits, 1)
    hits = Hits(
        plain=_new(records, pixels, t.vec3),
        base=_new(records, pixels, t.vec3),
        ids=_new(records, (pixels, slots), wp.int32, requires_grad=False),
        depths=_new(records, (pixels, slots), real),
        weights=_new(records, (pixels, slots), real),
        alphas=_new(records, pixels, real),
        stops=_new(records, pixels, wp.int32, requires_grad=False),
    )
    inputs = [*_walk_arguments(records, limits, lists, image), _filled(t.Hits, hits._asdict())]
    _walk(collect_kernel(real, max_hits), records, lists, inputs)
    differentiable = ("plain", "base", "depths", "weights", "alphas")

    def backward() -> None:
        g = gradient_types(real)
        grads = _filled(g.HitGradients, {name: getattr(hits, name).grad for name in differentiable})
        sums = _filled(g.Sums, {"records": records.grad})
        _walk(collect_backward_kernel(real, max_hits), records, lists, [*inputs, grads, sums])

    tape.record_func(backward, [records, *(getattr(hits, name) for name in differentiable)])
    return hits


def surface(tape: wp.Tape, records: wp.array, limits: wp.array, lists: Lists, image: Image, stops: wp.array) -> Surface:
    """Depths and normals over all hits; all outputs differentiate to records."""
    real = _real(records)
    t = types(real)
    pixels = image.size[0] * image.size[1]
    buffers = Surface(*(_new(records, pixels, dtype) for dtype in (real, real, real, t.vec3)))
    totals, picks = (_new(records, pixels, dtype, requires_grad=False) for dtype in (real, wp.vec2i))
    outputs = _filled(t.Surface, buffers._asdict() | {"totals": totals, "picks": picks})
    inputs = [*_walk_arguments(records, limits, lists, image), stops, outputs]
    _walk(surface_kernel(real), records, lists, inputs)

    def backward() -> None:
        grads = _filled(t.Surface, {name: array.grad for name, array in buffers._asdict().items()})
        sums = _filled(gradient_types(real).Sums, {"records": records.grad})
        _walk(surface_backward_kernel(real), records, lists, [*inputs, grads, sums])

    tape.record_func(backward, [records, *buffers])
    return buffers


def unproject(tape: wp.Tape, depths: wp.array, viewmat: wp.array, image: Image) -> tuple[wp.array, wp.array]:
    """Hit positions (P, K) vec3 and unit ray directions (P) vec3, world, of depths (P, K)."""
    real = _real(depths)
    t = types(real)
    positions, directions = _new(depths, depths.shape, t.vec3), _new(depths, depths.shape[0], t.vec3)
    inputs = [depths, viewmat, image.matrices(depths), image.size[0]]
    _launch(tape, unproject_kernels(real).forward, depths.shape[0], inputs, [positions, directions])
    return positions, directions


def hashgrid(
    tape: wp.Tape, table: wp.array, positions: wp.array, depths: wp.array, resolutions: wp.array, focal: wp.array
) -> wp.array:
    """Features (L * F, n) of table (L, T) vecF at positions (n) vec3 seen at depths (n); focal is (1)."""
    real, features = _real(positions), table.dtype._length_
    levels, size = table.shape
    count = len(positions)
    kernels = hashgrid_kernels(real, real, features)
    encoded = _new(positions, (levels * features, count), real)
    inputs = [table, positions, depths, resolutions, focal, wp.uint32(size - 1)]
    _silent(kernels.forward, (levels, count), inputs, [encoded])
    one = wp.ones(1, dtype=real, device=table.device)

    def backward() -> None:
        points = _new(positions, (1, count), types(real).vec4, requires_grad=False)
        arguments = [*inputs, encoded.grad, one, None, levels]
        _silent(kernels.backward, (1, count), arguments, [table.grad, points, None])
        _silent(_add_points, count, [points.flatten()], [positions.grad, depths.grad])

    tape.record_func(backward, [table, positions, depths, encoded])
    return encoded


def textured_colors(
    tape: wp.Tape,
    coefficients: wp.array,
    directions: wp.array,
    degree: int,
    clamp: bool = False,
    offset: float = 0.5,
) -> wp.array:
    """Colours offset + SH (n) vec3 of coefficients (3 (degree + 1)^2, n) along directions (P) vec3, n = P * K."""
    real, count = _real(coefficients), coefficients.shape[1]
    hits = count // max(len(directions), 1)
    kernels = textured_colors_kernels(real, real, degree, clamp)
    colors = _new(coefficients, count, directions.dtype)
    _silent(kernels.forward, count, [coefficients, directions, hits, offset], [colors])
    one = wp.ones(1, dtype=real, device=coefficients.device)

    def backward() -> None:
        points = _new(colors, count, directions.dtype, requires_grad=False)
        # The kernel stores the gradient of the coefficients, which nothing else reads.
        inputs = [coefficients, directions, hits, offset, one, colors.grad]
        _silent(kernels.backward, count, inputs, [coefficients.grad, points])
        _silent(_add_runs, len(directions), [points, hits], [directions.grad])

    tape.record_func(backward, [coefficients, directions, colors])
    return colors


def compose(
    tape: wp.Tape,
    plain: wp.array,
    colors: wp.array,
    weights: wp.array,
    alphas: wp.array,
    background: wp.array,
    base: wp.array | None = None,
) -> tuple[wp.array, wp.array]:
    """Image and textured, (P) vec3 each, of plain and base (P) vec3, colors (P, K) vec3, weights (P, K), alphas (P)."""
    image, textured = _new(plain, plain.shape, plain.dtype), _new(plain, plain.shape, plain.dtype)
    inputs = [plain, base, colors, weights, alphas, background]
    _launch(tape, compose_kernels(_real(plain)).forward, len(plain), inputs, [image, textured])
    return image, textured
