"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A warp takes the 16 points of a unit, see `fused_texture`; two neighbouring lanes share a point, one takes the four
corners of its cell at the lower x, the other those at the upper x. The two rows of a table that differ in x alone
mostly lie in one line of 128 bytes, which a load or an atomic then visits once. Read: gradients of the features
(units, L, 16, F) as `fused_texture` writes them. Written:

    grad_table     (L, T, F) added to, by atomics on CUDA; a CPU launches the whole range in one thread
    grad_points    (n) gradients of position and depth, 0 for points of depth 0

A launch takes the levels of one range, and adds to `grad_points` unless its first level is 0: the tables of a few
levels stay in the L2 cache, those of all do not.

The derivative of the interpolation is written by hand. With s_j = <features of corner j, incoming gradient>, the
position's gradient is that of the interpolation of the s_j, and the depth's is their interpolation times the
derivative of the fade. A lane's share of both is linear in its own four s_j.

Where pixels are smaller than cells, points in one cell add up theirs before any atomic. Pairs of points that share a
cell exchange halves: each is left with two of a lane's four corners, and the sum of both points. Fours in one cell then
share out one corner each.
"""

import functools

import warp as wp

from nexwarp.native.mma import PRELUDE

# Lanes of a group after each step: x, y, x, x in the 8 x 2 pixels of a warp, whose lowest bit is the side of the cell.
_BITS = (2, 16, 4, 8)

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
#else
    const int unit = thread;
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
            + (size_t)unit * 256 + level * 16 * (F / 2);
        int cell[3][LANES], held[LANES], whole[LANES], wide[LANES];
        unsigned slot[4][LANES];
        wp::float32 v[4 * F][LANES];
        EACH_LANE {
            const int side = lane & 1;
            wp::float32 g[F], fraction[3];
            unsigned given[F / 2] = {}, found[4][F / 2] = {};
            if (seen[l]) read_row(incoming + (lane >> 1) * (F / 2), given);
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
            whole[l] = 0;
            UNROLL
            for (int f = 0; f < F; ++f) {
                g[f] = factor * (f & 1 ? high_half(given[f / 2]) : low_half(given[f / 2]));
                whole[l] |= g[f] != 0.0f;
            }
            held[l] = whole[l] ? 4 : 0;
            // Pixels smaller than a cell share cells, others hardly.
            wide[l] = whole[l] && ratio > 1.0f;
            const float wy[2] = {1.0f - fy, fy}, wz[2] = {(1.0f - fz) * (wx * fade), fz * (wx * fade)};
            UNROLL
            for (int j = 0; j < 4; ++j) {
                const float weight = wy[j & 1] * wz[j >> 1];
                UNROLL
                for (int f = 0; f < F; ++f) v[j * F + f][l] = weight * g[f];
            }
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
MERGE
        UNROLL
        for (int j = 0; j < 4; ++j) {
            EACH_LANE {
                wp::float32 part[F];
                UNROLL
                for (int f = 0; f < F; ++f) part[f] = v[j * F + f][l];
                if (j < held[l]) add(sums + (size_t)slot[j][l] * F, part);
            }
        }
    }
    if (need_points) {
        EACH_LANE total[3][l] *= 2.0f * 0.6931471805599453f * per_depth[l];
        UNROLL
        for (int i = 0; i < 4; ++i) {
            wp::float32 other[LANES];
            swap_lanes(total[i], 1, other);
            EACH_LANE total[i][l] += other[l];
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

# One step of the exchanges, each inside of the one before it: groups of points that are in one cell already.
_STEP = """
        {
            const unsigned able = vote(whole);
            int other[3][LANES];
            UNROLL
            for (int i = 0; i < 3; ++i) swap_lanes(cell[i], BIT, other[i]);
            EACH_LANE {
                const int same = cell[0][l] == other[0][l] && cell[1][l] == other[1][l] && cell[2][l] == other[2][l];
                whole[l] = same && ((able >> lane) & (able >> (lane ^ BIT)) & 1u);
            }
        }
        if (any_lane(whole)) {
            UNROLL
            for (int k = 0; k < COUNT; ++k) {
                wp::float32 given[LANES], got[LANES];
                EXCHANGE
            }
            EACH_LANE if (whole[l]) { SHARE }
"""
_HALVES = """
                EACH_LANE given[l] = lane & BIT ? v[k][l] : v[k + COUNT][l];
                swap_lanes(given, BIT, got);
                EACH_LANE if (whole[l]) v[k][l] = (lane & BIT ? v[k + COUNT][l] : v[k][l]) + got[l];
"""
_SUM = """
                EACH_LANE given[l] = v[k][l];
                swap_lanes(given, BIT, got);
                EACH_LANE if (whole[l]) v[k][l] += got[l];
"""


def _merge(features: int) -> str:
    """Return the text of the exchanges: each step is inside of the one before it."""
    text = "        if (any_lane(wide)) {"
    for step, bit in enumerate(_BITS):
        corners = 2 >> step  # that a lane is left with; none in the last two steps, where it already has but one
        if corners:
            share = f"held[l] = {corners};"
            share += "".join(f" if (lane & {bit}) slot[{j}][l] = slot[{j + corners}][l];" for j in range(corners))
        else:
            share = f"if (lane & {bit}) held[l] = 0;"
        names = {
            "EXCHANGE": _HALVES if corners else _SUM,
            "SHARE": share,
            "BIT": str(bit),
            "COUNT": str(max(corners, 1) * features),
        }
        part = _STEP
        for name, value in names.items():
            part = part.replace(name, value)
        text += part
    return text + "}" * (len(_BITS) + 1)


SCATTER_THREADS = 128  # of a block
SCATTER_BLOCKS = 7  # that a multiprocessor holds at least

Halves, Reals = wp.array(dtype=wp.float16), wp.array(dtype=wp.float32)


@functools.cache
def fused_scatter_kernel(features: int) -> wp.Kernel:
    """Make the kernel, for F = 2 or 4; threads are 32 times the number of warps, on a CPU that number."""
    values = ", ".join(f'"f"(from[{f}])' for f in range(features))
    places = ", ".join(f"%{f + 1}" for f in range(features))
    text = _PROGRAM.replace("FEATURES", str(features)).replace("VALUES", values).replace("PLACES", places)
    text = text.replace("MERGE", _merge(features))

    @wp.func_native(PRELUDE + f"    constexpr int F = {features};\n" + text)
    def scatter(  # noqa: PLR0913  # the body of a kernel entry point
        thread: wp.int32,
        table: Halves,
        positions: wp.array(dtype=wp.vec3),
        depths: Reals,
        resolutions: Reals,
        focal: Reals,
        mask: wp.uint32,
        grad_encoded: Halves,
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
    def fused_scatter(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        table: Halves,
        positions: wp.array(dtype=wp.vec3),
        depths: Reals,
        resolutions: Reals,
        focal: Reals,
        mask: wp.uint32,
        grad_encoded: Halves,
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
