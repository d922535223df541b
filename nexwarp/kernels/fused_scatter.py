"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A thread is a point at all levels of its run; a warp is one hit of 8 x 4 pixels, or of 32 x 1 where the height is 1, so
that many of its points share cells. Read: gradients of the features (L, places) as `fused_texture` orders them. Written:

    grad_table     added to, by atomics on CUDA; a CPU launches the whole range in one thread
    grad_points    (runs, n) gradients of position and depth, 0 for points of depth 0
"""

import functools

import warp as wp

from nexwarp.kernels.hashgrid import hash_slot, interpolation_functions
from nexwarp.kernels.native.vector_loads import load_function

# `value` is added to the eight corners of the cell (x, y, z). Lanes that share it add up theirs first: where all do,
# they exchange halves of what they hold until each has the features of one corner, 36 exchanges instead of 160; else
# in a tree over the lanes of each cell, unless so many cells are in the warp that this costs more than it saves.
_ADD_CELL = """
#if defined(__CUDA_ARCH__)
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
    auto add = [&](int j, const float* v) {
        const unsigned slot = (map_positive(x + (j & 1)) ^ map_positive(y + ((j >> 1) & 1)) * 2654435761u
            ^ map_positive(z + (j >> 2)) * 805459861u) & mask;
        float* to = reinterpret_cast<float*>(&wp::index(table, level, (int)slot));
#if __CUDA_ARCH__ >= 900
        atomicAdd(reinterpret_cast<floatFEATURES*>(to), make_floatFEATURES(VALUES));
#else
        for (int k = 0; k < FEATURES; ++k) atomicAdd(to + k, v[k]);
#endif
    };
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    const unsigned long long xy = ((unsigned long long)(unsigned)y << 32) | (unsigned)x;
    const unsigned peers = __match_any_sync(active, xy) & __match_any_sync(active, z);
    float v[8 * FEATURES];
    #pragma unroll
    for (int j = 0; j < 8; ++j) for (int k = 0; k < FEATURES; ++k) v[j * FEATURES + k] = value.data[j][k];
    if (UNIFORM && active == 0xffffffffu && __all_sync(active, peers == active)) {
        #pragma unroll
        for (int half = 4; half > 0; half >>= 1) {
            const bool upper = lane & (4 * half);
            #pragma unroll
            for (int k = 0; k < 4 * FEATURES; ++k) {
                if (k < half * FEATURES) {
                    const float given = __shfl_xor_sync(active, upper ? v[k] : v[k + half * FEATURES], 4 * half);
                    v[k] = (upper ? v[k + half * FEATURES] : v[k]) + given;
                }
            }
        }
        #pragma unroll
        for (int k = 0; k < FEATURES; ++k) {
            v[k] += __shfl_xor_sync(active, v[k], 2);
            v[k] += __shfl_xor_sync(active, v[k], 1);
        }
        if ((lane & 3) == 0) add(lane >> 2, v);
        return;
    }
    int rank = __popc(peers & ((1u << lane) - 1u));
    const bool first = rank == 0;
    if (__popc(__ballot_sync(active, first)) <= MOST_CELLS) {
        unsigned rest = peers & (0xfffffffeu << lane);
        while (__any_sync(active, rest != 0u)) {
            const int next = __ffs(rest) - 1;
            #pragma unroll
            for (int k = 0; k < 8 * FEATURES; ++k) {
                const float other = __shfl_sync(active, v[k], next < 0 ? lane : next);
                if (next >= 0) v[k] += other;
            }
            rest &= __ballot_sync(active, (rank & 1) == 0);
            rank >>= 1;
        }
        if (!first) return;
    }
    #pragma unroll
    for (int j = 0; j < 8; ++j) {
        bool any = false;
        for (int k = 0; k < FEATURES; ++k) any |= v[j * FEATURES + k] != 0.0f;
        if (any) add(j, v + j * FEATURES);
    }
#else
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
    for (int j = 0; j < 8; ++j) {
        const unsigned slot = (map_positive(x + (j & 1)) ^ map_positive(y + ((j >> 1) & 1)) * 2654435761u
            ^ map_positive(z + (j >> 2)) * 805459861u) & mask;
        for (int k = 0; k < FEATURES; ++k) wp::index(table, level, (int)slot).c[k] += value.data[j][k];
    }
#endif
"""


@functools.cache
def fused_scatter_kernel(features: int, uniform: bool = True, most_cells: int = 24) -> wp.Kernel:
    """Make the kernel.

    Args:
        features: F, 2 or 4.
        uniform: treat warps whose lanes share one cell apart.
        most_cells: warps whose lanes are in more cells than this do not add up theirs.
    """
    row = wp.types.vector(length=features, dtype=wp.float16)
    vec = wp.types.vector(length=features, dtype=wp.float32)
    f = interpolation_functions(wp.float32, features)
    mat, interpolate_dot = f.corners, f.interpolate_dot
    load = load_function(features, wp.float16)
    values = ", ".join(f"v[{k}]" for k in range(features))
    text = _ADD_CELL.replace("FEATURES", str(features)).replace("VALUES", values)
    text = text.replace("UNIFORM", str(int(uniform))).replace("MOST_CELLS", str(most_cells))

    @wp.func_native(text)
    def add_cell(
        table: wp.array2d(dtype=vec),
        level: wp.int32,
        x: wp.int32,
        y: wp.int32,
        z: wp.int32,
        mask: wp.uint32,
        value: mat,
    ): ...

    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
    def fused_scatter(
        first: wp.int32,
        table: wp.array2d(dtype=row),
        positions: wp.array(dtype=wp.vec3),
        depths: wp.array(dtype=wp.float32),
        resolutions: wp.array(dtype=wp.float32),
        focal: wp.array(dtype=wp.float32),
        mask: wp.uint32,
        grad_encoded: wp.array2d(dtype=row),
        unscale: wp.array(dtype=wp.float32),
        width: wp.int32,
        height: wp.int32,
        hits: wp.int32,
        shift: wp.int32,
        levels_per_thread: wp.int32,
        # outputs
        grad_table: wp.array2d(dtype=vec),
        grad_points: wp.array2d(dtype=wp.vec4),
    ):
        # Blocks of two tiles: 8 x 4 pixels, or 32 x 1.
        block_x = 2 * shift - 3
        block_y = 5 - block_x
        across = (width + (1 << block_x) - 1) >> block_x
        blocks = across * ((height + (1 << block_y) - 1) >> block_y)
        i = first + wp.tid()
        row_ = i & 31
        block = i >> 5
        hit = block % hits
        block = block // hits
        run = block // blocks
        block -= run * blocks
        x = ((block % across) << block_x) + (row_ & ((1 << block_x) - 1))
        y = ((block // across) << block_y) + (row_ >> block_x)
        if x >= width or y >= height:
            return
        p = (y * width + x) * hits + hit
        depth = depths[p]
        if not (depth > 0.0):
            if grad_points.shape[0] > 0:
                grad_points[run, p] = wp.vec4()
            return
        tile = (y >> (4 - shift)) * ((width + (1 << shift) - 1) >> shift) + (x >> shift)
        inside = ((y & ((16 >> shift) - 1)) << shift) + (x & ((1 << shift) - 1))
        place = (tile * hits + hit) * 16 + inside
        total = wp.vec4()
        start = run * levels_per_thread
        for level in range(start, wp.min(start + levels_per_thread, resolutions.shape[0])):
            value = load(grad_encoded, level, place)
            grad = vec()
            for k in range(wp.static(features)):
                grad[k] = float(value[k]) * unscale[0]
            scale = resolutions[level]
            at = positions[p] * scale
            base = wp.vec3(wp.floor(at[0]), wp.floor(at[1]), wp.floor(at[2]))
            corner = wp.vec3i(int(base[0]), int(base[1]), int(base[2]))
            at -= base
            corners = mat()
            for j in range(8):
                entry = load(table, level, hash_slot(corner, j, mask))
                for k in range(wp.static(features)):
                    corners[j, k] = float(entry[k])
            gx, gy, gz, gc, _s, gd, _f, _g = wp.grad(interpolate_dot)(
                at[0], at[1], at[2], corners, scale, depth, focal[0], grad
            )
            add_cell(grad_table, level, corner[0], corner[1], corner[2], mask, gc)
            total += wp.vec4(gx * scale, gy * scale, gz * scale, gd)
        if grad_points.shape[0] > 0:
            grad_points[run, p] = total

    return fused_scatter
