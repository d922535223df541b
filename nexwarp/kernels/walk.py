"""What the kernels share that walk along a tile's list."""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types

BLOCK_DIM = 128


@wp.func
def overflowed(ends: wp.array(dtype=wp.int32), surfel_ids: wp.array(dtype=wp.int32)):
    """Whether there are more entries than the lists have room for."""
    count = ends.shape[0]
    if count == 0:
        return False
    return ends[count - 1] > surfel_ids.shape[0]


@wp.func
def walk(tile: wp.int32, tile_offsets: wp.array(dtype=wp.int32), ends: wp.array(dtype=wp.int32), overflow: wp.bool):
    """Range of the walk: the tile's list, or all surfels when lists lack entries (lists only cull: slow, but right)."""
    if overflow:
        return wp.vec2i(0, ends.shape[0])
    return wp.vec2i(tile_offsets[tile], tile_offsets[tile + 1])


@wp.func
def surfel_at(k: wp.int32, listed: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32), overflow: wp.bool):
    """Surfel at place k of the walk."""
    if overflow:
        return order[k]
    return listed[k]


@functools.cache
def view_functions(real: type, tile_size: int) -> SimpleNamespace:
    """Which pixel a thread has, its ray, and the block of pixels that its warp has."""
    t = types(real)
    vec2, vec4, HALF = t.vec2, t.vec4, t.HALF
    # Half of the distances between the outer pixel centres of a block, and a little.
    HALF_WIDTH, HALF_HEIGHT = wp.constant(real(3.51)), wp.constant(real(1.51))
    pixels = tile_size * tile_size
    across = tile_size // 8

    @wp.func
    def pixel_of(thread: int, tile_columns: int):
        """(column, row): the 32 lanes of a warp cover 8 x 4 pixels, warps cover a tile, tiles the image."""
        tile = thread // pixels
        local = thread % pixels
        warp = local // 32
        lane_ = local % 32
        return wp.vec2i(
            (tile % tile_columns) * tile_size + (warp % across) * 8 + lane_ % 8,
            (tile // tile_columns) * tile_size + (warp // across) * 4 + lane_ // 8,
        )

    @wp.func
    def ray(x: real, y: real, intrinsics: vec4):
        """Direction through pixel coordinates; its z is 1."""
        return vec2((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1])

    @wp.func
    def ray_of(xy: wp.vec2i, intrinsics: vec4):
        return ray(real(float(xy[0])) + HALF, real(float(xy[1])) + HALF, intrinsics)

    @wp.func
    def block_of(xy: wp.vec2i, intrinsics: vec4):
        """Ray through the middle of the 8 x 4 pixels that have pixel xy among them."""
        x = xy[0] - xy[0] % 8 + 4
        y = xy[1] - xy[1] % 4 + 2
        return ray(real(float(x)), real(float(y)), intrinsics)

    @wp.func
    def half_block(intrinsics: vec4):
        return vec2(HALF_WIDTH / intrinsics[0], HALF_HEIGHT / intrinsics[1])

    return SimpleNamespace(pixel_of=pixel_of, ray_of=ray_of, block_of=block_of, half_block=half_block, pixels=pixels)


@functools.cache
def buffer_types(real: type, max_hits: int) -> tuple[type, type, type]:
    """Types of the K-buffer's values, ids and colours: registers, of static length (one unused slot for K = 0)."""
    slots = max(max_hits, 1)
    return (
        wp.types.vector(length=slots, dtype=real),
        wp.types.vector(length=slots, dtype=wp.int32),
        wp.types.matrix(shape=(slots, 3), dtype=real),
    )
