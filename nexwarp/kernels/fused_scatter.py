"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A thread is a point at all levels of its run; a warp is one hit of 8 x 4 pixels, or of 32 x 1 where the height is 1, so
that many of its points share cells. Read: gradients of the features (L, places) as `fused_texture` orders them. Written:

    grad_table     added to, by atomics on CUDA; a CPU launches the whole range in one thread
    grad_points    (runs, n) gradients of position and depth, 0 for points of depth 0
"""

import functools

import warp as wp

# The derivative of a trilinear interpolation by hand: `wp.grad` of the same function takes twice the instructions, and
# this kernel is bound by them. With s_j = <features of corner j, incoming gradient>, the position's gradient is that of
# the interpolation of the eight s_j, and the depth's that of the fade times their interpolation.
_LEVEL = """
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
#if defined(__CUDA_ARCH__)
    auto low_half = [](unsigned x) { float y; asm("{.reg .f16 a, b; mov.b32 {a, b}, %1; cvt.f32.f16 %0, a;}" : "=f"(y) : "r"(x)); return y; };
    auto high_half = [](unsigned x) { float y; asm("{.reg .f16 a, b; mov.b32 {a, b}, %1; cvt.f32.f16 %0, b;}" : "=f"(y) : "r"(x)); return y; };
    auto power_of_e = [](float x) { return __expf(x); };
#else
    auto one_half = [](unsigned x) { wp::half y; y.u = (unsigned short)x; return wp::half_to_float(y); };
    auto low_half = [&](unsigned x) { return one_half(x & 0xffffu); };
    auto high_half = [&](unsigned x) { return one_half(x >> 16); };
    auto power_of_e = [](float x) { return expf(x); };
#endif
    auto read_row = [&](const unsigned* row, wp::float32* to) {
        unsigned word[F / 2];
#if defined(__CUDA_ARCH__)
        if (F == 4) {
            const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
            word[0] = both.x; word[F / 2 - 1] = both.y;
        } else word[0] = __ldg(row);
#else
        for (int f = 0; f < F / 2; ++f) word[f] = row[f];
#endif
        for (int f = 0; f < F / 2; ++f) { to[2 * f] = low_half(word[f]); to[2 * f + 1] = high_half(word[f]); }
    };
    wp::float32 g[F];
    read_row(reinterpret_cast<const unsigned*>(grad_encoded.data) + ((size_t)level * places + place) * (F / 2), g);
    for (int f = 0; f < F; ++f) g[f] *= unscale;
    const float x = at.c[0] * scale, y = at.c[1] * scale, z = at.c[2] * scale;
    const float bx = floorf(x), by = floorf(y), bz = floorf(z);
    const float fx = x - bx, fy = y - by, fz = z - bz;
    const int cx = (int)bx, cy = (int)by, cz = (int)bz;
    const float ratio = focal / (scale * depth), power = 0.15915494309189535f * ratio * ratio;
    const float rest = power_of_e(-power), fade = 1.0f - rest;
    // No arrays: an index that the compiler does not know moves them to memory.
    const unsigned hx0 = map_positive(cx), hx1 = map_positive(cx + 1);
    const unsigned hy0 = map_positive(cy) * 2654435761u, hy1 = map_positive(cy + 1) * 2654435761u;
    const unsigned hz0 = map_positive(cz) * 805459861u, hz1 = map_positive(cz + 1) * 805459861u;
    auto slot_of = [&](int j) { return ((j & 1 ? hx1 : hx0) ^ (j & 2 ? hy1 : hy0) ^ (j & 4 ? hz1 : hz0)) & mask; };
    const size_t first_row = (size_t)level * (mask + 1u);
    wp::vec_t<4, float> points(0.0f, 0.0f, 0.0f, 0.0f);
    if (need_points) {
        wp::float32 s[8];
        for (int j = 0; j < 8; ++j) {
            wp::float32 corner[F];
            read_row(reinterpret_cast<const unsigned*>(table.data) + (first_row + slot_of(j)) * (F / 2), corner);
            s[j] = 0.0f;
            for (int f = 0; f < F; ++f) s[j] += corner[f] * g[f];
        }
        const float x0 = s[1] - s[0], x1 = s[3] - s[2], x2 = s[5] - s[4], x3 = s[7] - s[6];
        const float y0 = s[0] + fx * x0, y1 = s[2] + fx * x1, y2 = s[4] + fx * x2, y3 = s[6] + fx * x3;
        const float z0 = y0 + fy * (y1 - y0), z1 = y2 + fy * (y3 - y2);
        const float near_x = x0 + fy * (x1 - x0), far_x = x2 + fy * (x3 - x2);
        const float steep = fade * scale;
        points = wp::vec_t<4, float>(
            steep * (near_x + fz * (far_x - near_x)),
            steep * ((y1 - y0) + fz * ((y3 - y2) - (y1 - y0))),
            steep * (z1 - z0),
            (z0 + fz * (z1 - z0)) * -2.0f * power * rest / depth);
    }
    const float wx[2] = {1.0f - fx, fx}, wy[2] = {1.0f - fy, fy}, wz[2] = {(1.0f - fz) * fade, fz * fade};
    wp::float32 v[8 * F];
    for (int j = 0; j < 8; ++j) {
        const float weight = wx[j & 1] * wy[(j >> 1) & 1] * wz[j >> 2];
        for (int f = 0; f < F; ++f) v[j * F + f] = weight * g[f];
    }
#if defined(__CUDA_ARCH__)
    auto add = [&](int j, const float* from) {
        float* to = grad_table.data + (first_row + slot_of(j)) * F;
#if __CUDA_ARCH__ >= 900
        atomicAdd(reinterpret_cast<floatFEATURES*>(to), make_floatFEATURES(VALUES));
#else
        for (int f = 0; f < F; ++f) atomicAdd(to + f, from[f]);
#endif
    };
    // Lanes in the same cell add up theirs. Where all lanes are, they exchange halves of what they hold until each has
    // the features of one corner, 36 exchanges instead of 160. Else in a tree over the lanes of each cell, unless so
    // many cells are in the warp that this costs more than it saves.
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    const unsigned long long xy = ((unsigned long long)(unsigned)cy << 32) | (unsigned)cx;
    const unsigned peers = __match_any_sync(active, xy) & __match_any_sync(active, cz);
    if (UNIFORM && active == 0xffffffffu && __all_sync(active, peers == active)) {
        #pragma unroll
        for (int half = 4; half > 0; half >>= 1) {
            const bool upper = lane & (4 * half);
            #pragma unroll
            for (int k = 0; k < 4 * F; ++k) {
                if (k < half * F) {
                    const float given = __shfl_xor_sync(active, upper ? v[k] : v[k + half * F], 4 * half);
                    v[k] = (upper ? v[k + half * F] : v[k]) + given;
                }
            }
        }
        #pragma unroll
        for (int f = 0; f < F; ++f) {
            v[f] += __shfl_xor_sync(active, v[f], 2);
            v[f] += __shfl_xor_sync(active, v[f], 1);
        }
        if ((lane & 3) == 0) add(lane >> 2, v);
        return points;
    }
    int rank = __popc(peers & ((1u << lane) - 1u));
    const bool leads = rank == 0;
    bool adds = true;
    if (__popc(__ballot_sync(active, leads)) <= MOST_CELLS) {
        unsigned others = peers & (0xfffffffeu << lane);
        while (__any_sync(active, others != 0u)) {
            const int next = __ffs(others) - 1;
            #pragma unroll
            for (int k = 0; k < 8 * F; ++k) {
                const float other = __shfl_sync(active, v[k], next < 0 ? lane : next);
                if (next >= 0) v[k] += other;
            }
            others &= __ballot_sync(active, (rank & 1) == 0);
            rank >>= 1;
        }
        adds = leads;
    }
    if (adds) {
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            bool any = false;
            for (int f = 0; f < F; ++f) any |= v[j * F + f] != 0.0f;
            if (any) add(j, v + j * F);
        }
    }
    __syncwarp(active);
#else
    for (int j = 0; j < 8; ++j)
        for (int f = 0; f < F; ++f) grad_table.data[(first_row + slot_of(j)) * F + f] += v[j * F + f];
#endif
    return points;
"""

Halves, Reals = wp.array(dtype=wp.float16), wp.array(dtype=wp.float32)


@functools.cache
def fused_scatter_kernel(features: int, uniform: bool = True, most_cells: int = 24) -> wp.Kernel:
    """Make the kernel.

    Args:
        features: F, 2 or 4.
        uniform: treat warps whose lanes share one cell apart.
        most_cells: warps whose lanes are in more cells than this do not add up theirs.
    """
    values = ", ".join(f"from[{f}]" for f in range(features))
    text = f"    constexpr int F = {features};\n" + _LEVEL.replace("FEATURES", str(features)).replace("VALUES", values)
    text = text.replace("UNIFORM", str(int(uniform))).replace("MOST_CELLS", str(most_cells))

    @wp.func_native(text)
    def scatter_level(
        table: Halves,
        level: wp.int32,
        mask: wp.uint32,
        at: wp.vec3,
        depth: wp.float32,
        scale: wp.float32,
        focal: wp.float32,
        grad_encoded: Halves,
        places: wp.int32,
        place: wp.int32,
        unscale: wp.float32,
        need_points: wp.int32,
        grad_table: Reals,
    ) -> wp.vec4: ...

    @wp.kernel(enable_backward=False, module="unique")
    def fused_scatter(
        first: wp.int32,
        table: Halves,
        positions: wp.array(dtype=wp.vec3),
        depths: Reals,
        resolutions: Reals,
        focal: Reals,
        mask: wp.uint32,
        grad_encoded: Halves,
        places: wp.int32,
        unscale: Reals,
        width: wp.int32,
        height: wp.int32,
        hits: wp.int32,
        shift: wp.int32,
        levels_per_thread: wp.int32,
        # outputs
        grad_table: Reals,
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
            total += scatter_level(
                table,
                level,
                mask,
                positions[p],
                depth,
                resolutions[level],
                focal[0],
                grad_encoded,
                places,
                place,
                unscale[0],
                grad_points.shape[0],
                grad_table,
            )
        if grad_points.shape[0] > 0:
            grad_points[run, p] = total

    return fused_scatter
