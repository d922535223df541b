"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A warp takes the 16 points of a unit, see `fused_texture`; two neighbouring lanes share a point, one takes the four
corners of its cell at the lower x, the other those at the upper x. The two rows of a table that differ in x alone
mostly lie in one line of 128 bytes, which a load or an atomic then visits once. Read: gradients of the features
(units, L, 16, F) as `fused_texture` writes them. Written:

    grad_table     (L, T, F) added to, by atomics
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

from nexwarp.kernels.fused_texture import FIELDS, Fused
from nexwarp.native import snippet
from nexwarp.native.mma import PRELUDE

SCATTER_THREADS = 128  # of a block
SCATTER_BLOCKS = 7  # that a multiprocessor holds at least

# Lanes of a group after each step: x, y, x, x in the 8 x 2 pixels of a warp, whose lowest bit is the side of the cell.
_BITS = (2, 16, 4, 8)

_PROGRAM = """
    const unsigned all = 0xffffffffu;
    const float focal_length = focal.data[0], factor = unscale.data[0];
    // 0, 1, -1, 2, -2 ... -> 0, 1, 2, 3, 4 ..., of the negative coordinate.
    auto map_negative = [](int i) { return ((unsigned)i << 1) ^ (unsigned)(i >> 31); };
    auto exponential2 = [](float x) {
        float y;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    auto reciprocal = [](float x) {
        float y;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    // An address that the compiler adds an index to by one instruction, as it does not know how it came about.
    auto opaque = [](const auto* x) {
        asm volatile("" : "+l"(x));
        return x;
    };
    auto read_row = [](const unsigned* row, unsigned* word) {
        if (F == 4) {
            const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
            word[0] = both.x;
            word[F / 2 - 1] = both.y;
        } else word[0] = __ldg(row);
    };
    auto add = [](float* to, const float* from) {
#if __CUDA_ARCH__ >= 900
        asm volatile("red.relaxed.gpu.global.add.vFEATURES.f32 [%0], {PLACES};" :: "l"(to), VALUES : "memory");
#else
        for (int f = 0; f < F; ++f) atomicAdd(to + f, from[f]);
#endif
    };
    const int unit = thread >> 5;
    const int across = (width + (1 << shift) - 1) >> shift;
    const int tile = unit / hits, hit = unit % hits;
    const int left = (tile % across) << shift, top = (tile / across) << (4 - shift);
    const int row = lane >> 1, side = lane & 1;
    float at[3], total[4] = {};
    const int column = left + (row & ((1 << shift) - 1)), line = top + (row >> shift);
    const bool inside = column < width && line < height;
    const int point = inside ? (line * width + column) * hits + hit : -1;
    const float depth = inside ? depths.data[point] : 0.0f;
    const int seen = depth > 0.0f;
    const float* from = reinterpret_cast<const float*>(positions.data) + 3 * (size_t)(seen ? point : 0);
    #pragma unroll
    for (int i = 0; i < 3; ++i) at[i] = from[i];
    const float per_depth = seen ? 1.0f / depth : 0.0f;
    const bool need_points = grad_points.shape[0] > 0;
    const int last_level = __any_sync(all, seen) ? end_level : first_level;
    #pragma unroll 1
    for (int level = first_level; level < last_level; ++level) {
        const float scale = resolutions.data[level];
        const size_t first_row = (size_t)level * (mask + 1u);
        const unsigned* rows = opaque(reinterpret_cast<const unsigned*>(table.data) + first_row * (F / 2));
        float* sums = const_cast<float*>(opaque(grad_table.data + first_row * F));
        const float per_scale = focal_length * reciprocal(scale);
        const unsigned* incoming = reinterpret_cast<const unsigned*>(grad_encoded.data)
            + (size_t)unit * 256 + level * 16 * (F / 2);
        int cell[3];
        unsigned slot[4];
        float v[4 * F], g[F], fraction[3];
        unsigned given[F / 2] = {}, found[4][F / 2] = {};
        if (seen) read_row(incoming + row * (F / 2), given);
        #pragma unroll
        for (int i = 0; i < 3; ++i) {
            const float x = at[i] * scale, base = floorf(x);
            fraction[i] = x - base;
            cell[i] = (int)-base;
        }
        const unsigned hx = map_negative(cell[0] - side);
        const unsigned hy[2] = {map_negative(cell[1]) * 2654435761u, map_negative(cell[1] - 1) * 2654435761u};
        const unsigned hz[2] = {map_negative(cell[2]) * 805459861u, map_negative(cell[2] - 1) * 805459861u};
        #pragma unroll
        for (int j = 0; j < 4; ++j) slot[j] = (hx ^ hy[j & 1] ^ hz[j >> 1]) & mask;
        // All loads before the first use.
        if (need_points && seen) {
            #pragma unroll
            for (int j = 0; j < 4; ++j) read_row(rows + (size_t)slot[j] * (F / 2), found[j]);
        }
        const float fx = fraction[0], fy = fraction[1], fz = fraction[2];
        const float ratio = per_scale * per_depth;
        const float power = -0.15915494309189535f * 1.4426950408889634f * ratio * ratio;
        const float rest = exponential2(power), fade = 1.0f - rest;
        const float wx = side ? fx : 1.0f - fx;
        int whole = 0;
        #pragma unroll
        for (int f = 0; f < F; ++f) {
            g[f] = factor * (f & 1 ? high_half(given[f / 2]) : low_half(given[f / 2]));
            whole |= g[f] != 0.0f;
        }
        int held = whole ? 4 : 0;
        // Pixels smaller than a cell share cells, others hardly.
        const int wide = whole && ratio > 1.0f;
        const float wy[2] = {1.0f - fy, fy}, wz[2] = {(1.0f - fz) * (wx * fade), fz * (wx * fade)};
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            const float weight = wy[j & 1] * wz[j >> 1];
            #pragma unroll
            for (int f = 0; f < F; ++f) v[j * F + f] = weight * g[f];
        }
        if (need_points && seen) {
            float s[4] = {};
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                #pragma unroll
                for (int f = 0; f < F; ++f)
                    s[j] += (f & 1 ? high_half(found[j][f / 2]) : low_half(found[j][f / 2])) * g[f];
            }
            const float y0 = s[1] - s[0], y1 = s[3] - s[2];
            const float z0 = s[0] + fy * y0, z1 = (s[2] + fy * y1) - z0;
            const float value = z0 + fz * z1, steep = fade * scale, part = wx * steep;
            total[0] += side ? steep * value : -steep * value;
            total[1] += part * (y0 + fz * (y1 - y0));
            total[2] += part * z1;
            total[3] += wx * value * (power * rest);
        }
MERGE
        #pragma unroll
        for (int j = 0; j < 4; ++j) if (j < held) add(sums + (size_t)slot[j] * F, v + j * F);
    }
    if (need_points) {
        total[3] *= 2.0f * 0.6931471805599453f * per_depth;
        #pragma unroll
        for (int i = 0; i < 4; ++i) total[i] += __shfl_xor_sync(all, total[i], 1);
        if (point >= 0) {
            const float first = side ? total[2] : total[0], second = side ? total[3] : total[1];
            float2* both = reinterpret_cast<float2*>(grad_points.data) + 2 * (size_t)point + side;
            const float2 before = first_level > 0 ? *both : make_float2(0.0f, 0.0f);
            *both = make_float2(before.x + first, before.y + second);
        }
    }
"""

# One step of the exchanges, each inside of the one before it: groups of points that are in one cell already.
_STEP = """
        {
            const unsigned able = __ballot_sync(all, whole);
            int other[3];
            #pragma unroll
            for (int i = 0; i < 3; ++i) other[i] = __shfl_xor_sync(all, cell[i], BIT);
            const int same = cell[0] == other[0] && cell[1] == other[1] && cell[2] == other[2];
            whole = same && ((able >> lane) & (able >> (lane ^ BIT)) & 1u);
        }
        if (__any_sync(all, whole)) {
            #pragma unroll
            for (int k = 0; k < COUNT; ++k) { EXCHANGE }
            if (whole) { SHARE }
"""
_HALVES = """
                const float got = __shfl_xor_sync(all, lane & BIT ? v[k] : v[k + COUNT], BIT);
                if (whole) v[k] = (lane & BIT ? v[k + COUNT] : v[k]) + got;
"""
_SUM = """
                const float got = __shfl_xor_sync(all, v[k], BIT);
                if (whole) v[k] += got;
"""


def _merge(features: int) -> str:
    """Return the text of the exchanges: each step is inside of the one before it."""
    text = "        if (__any_sync(all, wide)) {"
    for step, bit in enumerate(_BITS):
        corners = 2 >> step  # that a lane is left with; none in the last two steps, where it already has but one
        if corners:
            share = f"held = {corners};"
            share += "".join(f" if (lane & {bit}) slot[{j}] = slot[{j + corners}];" for j in range(corners))
        else:
            share = f"if (lane & {bit}) held = 0;"
        part = _STEP.replace("EXCHANGE", _HALVES if corners else _SUM).replace("SHARE", share)
        text += part.replace("BIT", str(bit)).replace("COUNT", str(max(corners, 1) * features))
    return text + "}" * (len(_BITS) + 1)


@functools.cache
def fused_scatter_kernel(features: int) -> wp.Kernel:
    """Make the kernel, for F = 2 or 4; threads are 32 times the number of units."""
    values = ", ".join(f'"f"(from[{f}])' for f in range(features))
    places = ", ".join(f"%{f + 1}" for f in range(features))
    text = _PROGRAM.replace("FEATURES", str(features)).replace("VALUES", values).replace("PLACES", places)
    text = f"    constexpr int F = {features};\n" + PRELUDE + text.replace("MERGE", _merge(features))

    @wp.func_native(snippet(FIELDS + text))
    def scatter(thread: wp.int32, fused: Fused): ...

    @wp.kernel(
        enable_backward=False, grid_stride=False, module="unique", launch_bounds=(SCATTER_THREADS, SCATTER_BLOCKS)
    )
    def fused_scatter(first: int, fused: Fused):
        scatter(first + wp.tid(), fused)

    return fused_scatter
