"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A warp takes the 16 points of a unit, see `fused_texture`; two neighbouring lanes share a point, one takes the four
corners of its cell at the lower x, the other those at the upper x. The two rows of a table that differ in x alone
mostly lie in one line of 128 bytes, which a load or an atomic then visits once. Read: gradients of the features
(L, places) as `fused_texture` orders them, F halves each. Written:

    grad_table     (L, T, F) added to, by atomics on CUDA; a CPU launches the whole range in one thread
    grad_points    (n) gradients of position and depth, 0 for points of depth 0

A launch takes the levels of one range, and adds to `grad_points` unless its first level is 0: the tables of a few
levels stay in the L2 cache, those of all do not.

The derivative of the interpolation is written by hand. With s_j = <features of corner j, incoming gradient>, the
position's gradient is that of the interpolation of the s_j, and the depth's is their interpolation times the
derivative of the fade. A lane's share of both is linear in its own four s_j.

Where pixels are smaller than cells, the points of a cell add up theirs before any atomic, by a product on tensor cores:
the matrix that says which points share a cell, times what each point adds to each corner, rounded to half precision and
summed in float32. Elsewhere few points share a cell, and each adds its own.
"""

import functools

import warp as wp

from nexwarp.kernels.native.mma import PRELUDE

_PROGRAM = """
    const float focal_length = focal.data[0], factor = unscale.data[0];
    // 0, 1, -1, 2, -2 ... -> 0, 1, 2, 3, 4 ..., of the negative coordinate.
    auto map_negative = [](int i) { return ((unsigned)i << 1) ^ (unsigned)(i >> 31); };
    auto read_row = [](const unsigned* row, unsigned* word) {
#if defined(__CUDA_ARCH__)
        if (F == 4) {
            const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
            word[0] = both.x;
            word[F / 2 - 1] = both.y;
        } else word[0] = __ldg(row);
#else
        for (int f = 0; f < F / 2; ++f) word[f] = row[f];
#endif
    };
    auto add = [](wp::float32* to, const wp::float32* from) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
        asm volatile("red.relaxed.gpu.global.add.vFEATURES.f32 [%0], {PLACES};" :: "l"(to), VALUES : "memory");
#elif defined(__CUDA_ARCH__)
        for (int f = 0; f < F; ++f) atomicAdd(to + f, from[f]);
#else
        for (int f = 0; f < F; ++f) to[f] += from[f];
#endif
    };
#if defined(__CUDA_ARCH__)
    const int unit = thread >> 5;
    __shared__ __align__(16) unsigned short stages[THREADS / 32][(7 + F) * 16];
    unsigned short* stage = stages[threadIdx.x >> 5];
#else
    const int unit = thread;
    unsigned short stage[(7 + F) * 16];
#endif
    const int across = (width + (1 << shift) - 1) >> shift;
    const int tile = unit / hits, hit = unit % hits;
    const int left = (tile % across) << shift, top = (tile / across) << (4 - shift);
    int seen[LANES], point[LANES];
    wp::float32 per_depth[LANES], at[3][LANES], total[4][LANES] = {};
    EACH_LANE {
        const int row = lane >> 1;
        const int x = left + (row & ((1 << shift) - 1)), y = top + (row >> shift);
        const bool inside = x < width && y < height;
        point[l] = inside ? (y * width + x) * hits + hit : -1;
        const float depth = inside ? depths.data[point[l]] : 0.0f;
        seen[l] = depth > 0.0f;
        const size_t source = seen[l] ? point[l] : 0;
        const wp::float32* from = reinterpret_cast<const wp::float32*>(positions.data) + 3 * source;
        UNROLL
        for (int i = 0; i < 3; ++i) at[i][l] = from[i];
        per_depth[l] = seen[l] ? 1.0f / depth : 0.0f;
    }
    const bool need_points = grad_points.shape[0] > 0;
    const int last_level = any_lane(seen) ? end_level : first_level;
    #pragma unroll 1
    for (int level = first_level; level < last_level; ++level) {
        const float scale = resolutions.data[level];
        const size_t first_row = (size_t)level * (mask + 1u);
        const unsigned* rows = opaque(reinterpret_cast<const unsigned*>(table.data) + first_row * (F / 2));
        wp::float32* sums = const_cast<wp::float32*>(opaque(grad_table.data + first_row * F));
        const float per_scale = focal_length * reciprocal(scale);
        const unsigned* incoming = reinterpret_cast<const unsigned*>(grad_encoded.data)
            + ((size_t)level * places + (size_t)unit * 16) * (F / 2);
        int cell[3][LANES], useful[LANES], wide[LANES];
        unsigned slot[4][LANES], given[F / 2][LANES];
        wp::float32 share[3][LANES], weight[4][LANES];
        EACH_LANE {
            const int side = lane & 1;
            wp::float32 g[F], fraction[3];
            unsigned incoming_row[F / 2] = {}, found[4][F / 2] = {};
            if (seen[l]) read_row(incoming + (lane >> 1) * (F / 2), incoming_row);
            UNROLL
            for (int i = 0; i < 3; ++i) {
                const float x = at[i][l] * scale, base = floorf(x);
                fraction[i] = x - base;
                cell[i][l] = (int)-base;
            }
            const unsigned hx = map_negative(cell[0][l] - side);
            const unsigned hy[2] = {
                map_negative(cell[1][l]) * 2654435761u, map_negative(cell[1][l] - 1) * 2654435761u};
            const unsigned hz[2] = {map_negative(cell[2][l]) * 805459861u, map_negative(cell[2][l] - 1) * 805459861u};
            UNROLL
            for (int j = 0; j < 4; ++j) slot[j][l] = (hx ^ hy[j & 1] ^ hz[j >> 1]) & mask;
            // All loads before the first use.
            if (need_points && seen[l]) {
                UNROLL
                for (int j = 0; j < 4; ++j) read_row(rows + (size_t)slot[j][l] * (F / 2), found[j]);
            }
            const float fx = fraction[0], fy = fraction[1], fz = fraction[2];
            const float ratio = per_scale * per_depth[l];
            const float power = -0.15915494309189535f * 1.4426950408889634f * ratio * ratio;
            const float rest = exponential2(power), fade = 1.0f - rest;
            const float wx = side ? fx : 1.0f - fx;
            useful[l] = 0;
            UNROLL
            for (int f = 0; f < F; ++f) {
                g[f] = f & 1 ? high_half(incoming_row[f / 2]) : low_half(incoming_row[f / 2]);
                useful[l] |= g[f] != 0.0f;
                given[f / 2][l] = incoming_row[f / 2];
            }
            // Pixels smaller than a cell share cells, others hardly.
            wide[l] = useful[l] && ratio > 1.0f;
            share[0][l] = wx;
            share[1][l] = side ? fy : 1.0f - fy;
            share[2][l] = (side ? fz : 1.0f - fz) * fade;
            const float wy[2] = {1.0f - fy, fy}, wz[2] = {(1.0f - fz) * (wx * fade), fz * (wx * fade)};
            UNROLL
            for (int j = 0; j < 4; ++j) weight[j][l] = wy[j & 1] * wz[j >> 1];
            if (need_points && seen[l]) {
                wp::float32 s[4] = {};
                UNROLL
                for (int j = 0; j < 4; ++j) {
                    UNROLL
                    for (int f = 0; f < F; ++f)
                        s[j] += (f & 1 ? high_half(found[j][f / 2]) : low_half(found[j][f / 2])) * g[f];
                }
                const float y0 = s[1] - s[0], y1 = s[3] - s[2];
                const float z0 = s[0] + fy * y0, z1 = (s[2] + fy * y1) - z0;
                const float value = z0 + fz * z1, steep = fade * scale, part = wx * steep;
                total[0][l] += side ? steep * value : -steep * value;
                total[1][l] += part * (y0 + fz * (y1 - y0));
                total[2][l] += part * z1;
                total[3][l] += wx * value * (power * rest);
            }
        }
        if (any_lane(wide)) {
MERGED
        } else {
            EACH_LANE {
                if (useful[l]) {
                    UNROLL
                    for (int j = 0; j < 4; ++j) {
                        wp::float32 part[F];
                        UNROLL
                        for (int f = 0; f < F; ++f)
                            part[f] = factor * weight[j][l]
                                * (f & 1 ? high_half(given[f / 2][l]) : low_half(given[f / 2][l]));
                        add(sums + (size_t)slot[j][l] * F, part);
                    }
                }
            }
        }
    }
    if (need_points) {
        EACH_LANE total[3][l] *= 2.0f * 0.6931471805599453f * per_depth[l];
        UNROLL
        for (int i = 0; i < 4; ++i) {
            wp::float32 other[LANES];
            swap_lanes(total[i], 1, other);
            EACH_LANE total[i][l] = factor * (total[i][l] + other[l]);
        }
        EACH_LANE {
            if (point[l] >= 0) {
                const int side = lane & 1;
                wp::float32* to = reinterpret_cast<wp::float32*>(grad_points.data) + 4 * (size_t)point[l] + 2 * side;
                wp::float32 first = side ? total[2][l] : total[0][l], second = side ? total[3][l] : total[1][l];
#if defined(__CUDA_ARCH__)
                float2* both = reinterpret_cast<float2*>(to);
                const float2 before = first_level > 0 ? *both : make_float2(0.0f, 0.0f);
                *both = make_float2(before.x + first, before.y + second);
#else
                to[0] = (first_level > 0 ? to[0] : 0.0f) + first;
                to[1] = (first_level > 0 ? to[1] : 0.0f) + second;
#endif
            }
        }
    }
"""

# The sums of the cells' points, as a product of matrices: one row for each point that is the first of a cell, with ones
# where the points of its cell stand, times what each point adds, a column for each corner and feature. Columns are
# ordered so that a lane finds all features of a corner in its fragments: it has x by its lowest bit, y by the next one.
_MERGED = """
            unsigned peers[LANES], left[4][LANES], right[F][2][LANES];
            wp::float32 sum[F][4][LANES] = {};
            equal_lanes(cell, peers);
            const unsigned able = vote(useful);
            await_lanes();
            EACH_LANE {
                const int side = lane & 1;
                unsigned short* to = stage + (lane >> 1);
                UNROLL
                for (int i = 0; i < 3; ++i) to[(2 * i + side) * 16] = (unsigned short)halves(share[i][l], 0.0f);
                const unsigned word = side ? given[F / 2 - 1][l] : given[0][l];
                if (F == 4) {
                    to[(6 + 2 * side) * 16] = (unsigned short)word;
                    to[(7 + 2 * side) * 16] = (unsigned short)(word >> 16);
                } else to[(6 + side) * 16] = (unsigned short)(side ? word >> 16 : word);
                if (!side) to[(6 + F) * 16] = useful[l] ? (unsigned short)(lowest_lane(peers[l] & able) >> 1) : NOBODY;
            }
            await_lanes();
            EACH_LANE {
                const unsigned row = lane >> 2;
                UNROLL
                for (int h = 0; h < 2; ++h) {
                    const unsigned short* from = stage + 2 * (lane & 3) + 8 * h;
                    const unsigned xy = times_halves(
                        pair_at(from + ((row >> 1) & 1) * 16), pair_at(from + (2 + (row >> 2)) * 16));
                    UNROLL
                    for (int z = 0; z < 2; ++z) {
                        const unsigned xyz = times_halves(xy, pair_at(from + (4 + z) * 16));
                        UNROLL
                        for (int i = 0; i < F / 2; ++i)
                            right[z * (F / 2) + i][h][l] =
                                times_halves(xyz, pair_at(from + (6 + 2 * i + (row & 1)) * 16));
                    }
                    const unsigned first = pair_at(from + (6 + F) * 16);
                    UNROLL
                    for (int r = 0; r < 2; ++r)
                        left[2 * h + r][l] = ((first & 0xffffu) == row + 8 * r ? ONE : 0u)
                            | ((first >> 16) == row + 8 * r ? ONE << 16 : 0u);
                }
            }
            UNROLL
            for (int t = 0; t < F; ++t) multiply_add(sum[t], left, right[t]);
            UNROLL
            for (int r = 0; r < 2; ++r) {
                int source[LANES];
                unsigned theirs[4][LANES];
                EACH_LANE source[l] = 2 * ((lane >> 2) + 8 * r) + (lane & 1);
                UNROLL
                for (int j = 0; j < 4; ++j) take_from(slot[j], source, theirs[j]);
                EACH_LANE {
                    UNROLL
                    for (int z = 0; z < 2; ++z) {
                        wp::float32 part[F];
                        bool any = false;
                        UNROLL
                        for (int f = 0; f < F; ++f) {
                            part[f] = factor * sum[z * (F / 2) + f / 2][2 * r + (f & 1)][l];
                            any |= part[f] != 0.0f;
                        }
                        const unsigned there = lane & 2 ? theirs[1 + 2 * z][l] : theirs[2 * z][l];
                        if (any) add(sums + (size_t)there * F, part);
                    }
                }
            }
"""


SCATTER_THREADS = 128  # of a block
SCATTER_BLOCKS = 7  # that a multiprocessor holds at least

Halves, Reals = wp.array(dtype=wp.float16), wp.array(dtype=wp.float32)


@functools.cache
def fused_scatter_kernel(features: int) -> wp.Kernel:
    """Make the kernel, for F = 2 or 4; threads are 32 times the number of warps, on a CPU that number."""
    values = ", ".join(f'"f"(from[{f}])' for f in range(features))
    places = ", ".join(f"%{f + 1}" for f in range(features))
    text = _PROGRAM.replace("FEATURES", str(features)).replace("VALUES", values).replace("PLACES", places)
    text = text.replace("MERGED", _MERGED)

    constants = f"    constexpr int F = {features}, THREADS = {SCATTER_THREADS}, NOBODY = 255;\n"
    constants += "    constexpr unsigned ONE = 0x3c00u;\n"

    @wp.func_native(PRELUDE + constants + text)
    def scatter(
        thread: wp.int32,
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
        first_level: wp.int32,
        end_level: wp.int32,
        grad_table: Reals,
        grad_points: wp.array(dtype=wp.vec4),
    ): ...

    @wp.kernel(
        enable_backward=False, grid_stride=False, module="unique", launch_bounds=(SCATTER_THREADS, SCATTER_BLOCKS)
    )
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
        first_level: wp.int32,
        end_level: wp.int32,
        # outputs
        grad_table: Reals,
        grad_points: wp.array(dtype=wp.vec4),
    ):
        scatter(
            first + wp.tid(),
            table,
            positions,
            depths,
            resolutions,
            focal,
            mask,
            grad_encoded,
            places,
            unscale,
            width,
            height,
            hits,
            shift,
            first_level,
            end_level,
            grad_table,
            grad_points,
        )

    return fused_scatter
