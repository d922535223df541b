"""The walk along the tiles' lists (paper Sec. 4.2), as collect, collect_backward, splat_error and surface share it.

A thread is a pixel. The 32 threads of a warp are a block of 8 x 4 pixels, the warps of a tile cover its pixels, and the
tiles cover the image, so that some threads lie outside of it. A warp culls the list together: each lane tests one entry
against the whole block, then all lanes walk along the entries that are left, about half of a tile's, whose records wait
in shared memory. On a CPU a warp is one thread, which tests nothing here, since the hit itself is as cheap.

Read: the lists of `nexwarp.ops.Tiles`, and the records of `surfel`. Nothing here is written or differentiated; which
entries are walked is frozen for the backward pass.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.surfel import frame_functions, hit_functions
from nexwarp.kernels.types import types
from nexwarp.native.staging import staging_functions
from nexwarp.native.vector_loads import record_row_function
from nexwarp.native.warp import ballot, lanes_below, population, sync_warp, warp_size

# Threads of a CUDA block.
BLOCK_DIM = 128


@wp.func
def overflowed(ends: wp.array(dtype=wp.int32), surfel_ids: wp.array(dtype=wp.int32)):
    """Whether there are more entries than the lists have room for."""
    count = ends.shape[0]
    if count == 0:
        return False
    return ends[count - 1] > surfel_ids.shape[0]


# Returns a vector and takes `overflow`: with three results the backward pass needs 8 registers more (sm_90).
@wp.func
def walk(tile: wp.int32, tile_offsets: wp.array(dtype=wp.int32), ends: wp.array(dtype=wp.int32), overflow: wp.bool):
    """(first place, end) of a tile's walk.

    The walk goes along the tile's list, or over all surfels where lists lack entries (overflow): lists only cull, so
    this is slow but right.
    """
    if overflow:
        return wp.vec2i(0, ends.shape[0])
    return wp.vec2i(tile_offsets[tile], tile_offsets[tile + 1])


@wp.func
def surfel_at(k: wp.int32, surfel_ids: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32), overflow: wp.bool):
    """Surfel at place k of the walk."""
    if overflow:
        return order[k]
    return surfel_ids[k]


@functools.cache
def walk_functions(real: type, low_pass: bool, tile_size: int) -> SimpleNamespace:
    """Make the functions with which a pixel's thread begins, and `pixels`, their number in a tile."""
    t = types(real)
    vec2, vec3, vec4, mat33, HALF = t.vec2, t.vec3, t.vec4, t.mat33, t.HALF
    intrinsics_of = frame_functions(real).intrinsics_of
    misses_block = hit_functions(real, low_pass).misses_block
    load, staged = record_row_function(real), staging_functions(real, BLOCK_DIM)
    # Half of the distances between the outer pixel centres of a block, and a little.
    HALF_WIDTH, HALF_HEIGHT = wp.constant(real(3.51)), wp.constant(real(1.51))
    pixels = tile_size * tile_size
    across = tile_size // 8

    @wp.func
    def ray(x: real, y: real, intrinsics: vec4):
        """Direction (x, y) through pixel coordinates; its z is 1."""
        return vec2((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1])

    @wp.func
    def pixel_of(thread: int, tile_columns: int, size: wp.vec2i, Ks: wp.array(dtype=mat33)):
        """(pixel's column and row, whether it is in the image, its ray, (fx, fy, cx, cy))."""
        tile = thread // pixels
        local = thread % pixels
        block = local // 32
        lane = local % 32
        xy = wp.vec2i(
            (tile % tile_columns) * tile_size + (block % across) * 8 + lane % 8,
            (tile // tile_columns) * tile_size + (block // across) * 4 + lane // 8,
        )
        intrinsics = intrinsics_of(Ks)
        d = ray(real(float(xy[0])) + HALF, real(float(xy[1])) + HALF, intrinsics)
        return xy, xy[0] < size[0] and xy[1] < size[1], d, intrinsics

    @wp.func
    def block_of(xy: wp.vec2i, intrinsics: vec4):
        """(ray through the middle of the pixel's block, half of the block's extent in such coordinates)."""
        x = xy[0] - xy[0] % 8 + 4
        y = xy[1] - xy[1] % 4 + 2
        middle = ray(real(float(x)), real(float(y)), intrinsics)
        return middle, vec2(HALF_WIDTH / intrinsics[0], HALF_HEIGHT / intrinsics[1])

    @wp.func
    def candidate(
        k: wp.int32,
        end: wp.int32,
        surfel_ids: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        overflow: wp.bool,
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
        reaches: wp.array(dtype=vec2),
        middle: vec2,
        half: vec2,
        focal: vec2,
    ):
        """Surfel at place k of the walk; -1 behind its end, and on CUDA where the surfel misses the whole block."""
        i = int(-1)
        if k < end:
            i = surfel_at(k, surfel_ids, order, overflow)
            if warp_size() > 1:
                center = vec3()
                if wp.static(low_pass):
                    center = centers[i]
                m = load(records, i, 3)[3]
                a = load(records, i, 0)
                b = load(records, i, 1)
                n = load(records, i, 2)
                if misses_block(a, b, n, m, reaches[i], limits[i], center, middle, half, focal):
                    i = int(-1)
        return i

    @wp.func
    def stage(
        k: wp.int32,
        end: wp.int32,
        surfel_ids: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        overflow: wp.bool,
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
        reaches: wp.array(dtype=vec2),
        middle: vec2,
        half: vec2,
        focal: vec2,
    ):
        """(number of surfels staged, this lane's surfel): what `candidate` leaves of the lanes' places k."""
        i = candidate(k, end, surfel_ids, order, overflow, records, centers, limits, reaches, middle, half, focal)
        chosen = ballot(wp.where(i >= 0, 1, 0))
        sync_warp()  # the batch before has been read
        if i >= 0:
            a = load(records, i, 0)
            b = load(records, i, 1)
            n = load(records, i, 2)
            staged.put(lanes_below(chosen), i, k, a, b, n, load(records, i, 3), records)
        sync_warp()
        return wp.vec2i(population(chosen), i)

    return SimpleNamespace(
        pixel_of=pixel_of,
        block_of=block_of,
        candidate=candidate,
        stage=stage,
        staged=staged.name,
        staged_row=staged.row,
        pixels=pixels,
    )


@functools.cache
def buffer_types(real: type, max_hits: int) -> tuple[type, type, type]:
    """Types of the K-buffer's values, ids and colours: registers, of static length (one unused slot for K = 0)."""
    slots = max(max_hits, 1)
    return (
        wp.types.vector(length=slots, dtype=real),
        wp.types.vector(length=slots, dtype=wp.int32),
        wp.types.matrix(shape=(slots, 3), dtype=real),
    )
