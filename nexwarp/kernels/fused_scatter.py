"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

A warp takes one hit of 8 x 4 pixels, or of 32 x 1 where the height is 1, so that many of its points share cells; a lane
is a point at all levels. Read: gradients of the features (L, places) as `fused_texture` orders them, F
halves each. Written:

    grad_table     (L, T, F) added to, by atomics on CUDA; a CPU launches the whole range in one thread
    grad_points    (n) gradients of position and depth, 0 for points of depth 0

The derivative of the interpolation is written by hand: this kernel is bound by its instructions, of which `wp.grad`
makes more. With s_j = <features of corner j, incoming gradient>, the position's gradient is that of the interpolation
of the eight s_j, and the depth's is their interpolation times the derivative of the fade.

Lanes in one cell add up theirs before any atomic. Pairs of lanes that share a cell exchange halves: each is left with
four of the eight corners, and the sum of both. Fours in one cell then share out two corners each, eights one. It takes
28 exchanges, where a tree over the lanes of each cell takes 32 for each doubling.
"""

import functools

import warp as wp

from nexwarp.kernels.native.mma import PRELUDE

# Lanes of a group after each step: x, y, x, y, x in the 8 x 4 pixels of a warp.
_BITS = (1, 8, 2, 16, 4)

_PROGRAM = """
    const float focal_length = focal.data[0], factor = unscale.data[0];
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
    auto read_row = [](const unsigned* row, wp::float32* to, auto low, auto high) {
        unsigned word[F / 2];
#if defined(__CUDA_ARCH__)
        if (F == 4) {
            const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
            word[0] = both.x;
            word[F / 2 - 1] = both.y;
        } else word[0] = __ldg(row);
#else
        for (int f = 0; f < F / 2; ++f) word[f] = row[f];
#endif
        UNROLL
        for (int f = 0; f < F / 2; ++f) {
            to[2 * f] = low(word[f]);
            to[2 * f + 1] = high(word[f]);
        }
    };
    auto add = [](wp::float32* to, const wp::float32* from) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
        atomicAdd(reinterpret_cast<floatFEATURES*>(to), make_floatFEATURES(VALUES));
#elif defined(__CUDA_ARCH__)
        for (int f = 0; f < F; ++f) atomicAdd(to + f, from[f]);
#else
        for (int f = 0; f < F; ++f) to[f] += from[f];
#endif
    };
#if defined(__CUDA_ARCH__)
    int block = thread >> 5;
#else
    int block = thread;
#endif
    // Blocks of two tiles: 8 x 4 pixels, or 32 x 1.
    const int wide = 2 * shift - 3, high = 5 - wide;
    const int across = (width + (1 << wide) - 1) >> wide;
    const int hit = block % hits;
    block /= hits;
    const int left = (block % across) << wide, top = (block / across) << high;
    int seen[LANES], point[LANES], place[LANES];
    wp::float32 depth[LANES], at[3][LANES], total[4][LANES] = {};
    EACH_LANE {
        const int x = left + (lane & ((1 << wide) - 1)), y = top + (lane >> wide);
        const bool inside = x < width && y < height;
        point[l] = inside ? (y * width + x) * hits + hit : -1;
        depth[l] = inside ? depths.data[point[l]] : 0.0f;
        seen[l] = depth[l] > 0.0f;
        const int tile = (y >> (4 - shift)) * ((width + (1 << shift) - 1) >> shift) + (x >> shift);
        const int row = ((y & ((16 >> shift) - 1)) << shift) + (x & ((1 << shift) - 1));
        place[l] = (tile * hits + hit) * 16 + row;
        const size_t source = seen[l] ? point[l] : 0;
        const wp::float32* from = reinterpret_cast<const wp::float32*>(positions.data) + 3 * source;
        UNROLL
        for (int i = 0; i < 3; ++i) at[i][l] = from[i];
        if (!seen[l]) depth[l] = 1.0f;
    }
    const unsigned all_seen = vote(seen);
    #pragma unroll 1
    for (int level = 0; level < resolutions.shape[0]; ++level) {
        if (!all_seen) break;
        const size_t first_row = (size_t)level * (mask + 1u);
        const float scale = resolutions.data[level];
        int cell[3][LANES], nonzero[LANES], corner[LANES], held[LANES], whole[LANES];
        unsigned hashes[3][2][LANES], peers[LANES];
        wp::float32 v[8 * F][LANES];
        EACH_LANE {
            wp::float32 g[F] = {}, fraction[3];
            if (seen[l]) {
                const size_t word = ((size_t)level * places + place[l]) * (F / 2);
                read_row(reinterpret_cast<const unsigned*>(grad_encoded.data) + word, g, low_half, high_half);
            }
            nonzero[l] = 0;
            UNROLL
            for (int f = 0; f < F; ++f) {
                g[f] *= factor;
                nonzero[l] |= g[f] != 0.0f;
            }
            UNROLL
            for (int i = 0; i < 3; ++i) {
                const float x = at[i][l] * scale, base = floorf(x);
                fraction[i] = x - base;
                cell[i][l] = (int)base;
                const unsigned prime = i == 0 ? 1u : i == 1 ? 2654435761u : 805459861u;
                hashes[i][0][l] = map_positive(cell[i][l]) * prime;
                hashes[i][1][l] = map_positive(cell[i][l] + 1) * prime;
            }
            const float fx = fraction[0], fy = fraction[1], fz = fraction[2];
            const float ratio = focal_length / (scale * depth[l]), power = 0.15915494309189535f * ratio * ratio;
            const float rest = power_of_e(-power), fade = 1.0f - rest;
            if (grad_points.shape[0] > 0 && seen[l]) {
                wp::float32 s[8];
                UNROLL
                for (int j = 0; j < 8; ++j) {
                    const unsigned hash = hashes[0][j & 1][l] ^ hashes[1][(j >> 1) & 1][l] ^ hashes[2][j >> 2][l];
                    const size_t word = (first_row + (hash & mask)) * (F / 2);
                    wp::float32 features[F];
                    read_row(reinterpret_cast<const unsigned*>(table.data) + word, features, low_half, high_half);
                    s[j] = 0.0f;
                    UNROLL
                    for (int f = 0; f < F; ++f) s[j] += features[f] * g[f];
                }
                const float x0 = s[1] - s[0], x1 = s[3] - s[2], x2 = s[5] - s[4], x3 = s[7] - s[6];
                const float y0 = s[0] + fx * x0, y1 = s[2] + fx * x1, y2 = s[4] + fx * x2, y3 = s[6] + fx * x3;
                const float z0 = y0 + fy * (y1 - y0), z1 = y2 + fy * (y3 - y2);
                const float near_x = x0 + fy * (x1 - x0), far_x = x2 + fy * (x3 - x2);
                const float steep = fade * scale;
                total[0][l] += steep * (near_x + fz * (far_x - near_x));
                total[1][l] += steep * ((y1 - y0) + fz * ((y3 - y2) - (y1 - y0)));
                total[2][l] += steep * (z1 - z0);
                total[3][l] += (z0 + fz * (z1 - z0)) * -2.0f * power * rest / depth[l];
            }
            const float wx[2] = {1.0f - fx, fx}, wy[2] = {1.0f - fy, fy}, wz[2] = {(1.0f - fz) * fade, fz * fade};
            UNROLL
            for (int j = 0; j < 8; ++j) {
                const float weight = wx[j & 1] * wy[(j >> 1) & 1] * wz[j >> 2];
                UNROLL
                for (int f = 0; f < F; ++f) v[j * F + f][l] = weight * g[f];
            }
        }
        equal_lanes(cell, peers);
        const unsigned useful = vote(nonzero);
        EACH_LANE {
            peers[l] = seen[l] ? peers[l] & all_seen : 0u;
            corner[l] = 0;
            held[l] = peers[l] & useful ? 8 : 0;
        }
MERGE
        UNROLL
        for (int t = 0; t < 8; ++t) {
            EACH_LANE {
                if (t < held[l]) {
                    const int j = corner[l] + t;
                    // Not hashes[0][j & 1]: an index that the compiler does not know moves them to memory.
                    unsigned hash = j & 1 ? hashes[0][1][l] : hashes[0][0][l];
                    hash ^= j & 2 ? hashes[1][1][l] : hashes[1][0][l];
                    hash ^= j & 4 ? hashes[2][1][l] : hashes[2][0][l];
                    wp::float32 part[F];
                    UNROLL
                    for (int f = 0; f < F; ++f) part[f] = v[t * F + f][l];
                    add(grad_table.data + (first_row + (hash & mask)) * F, part);
                }
            }
        }
    }
    if (grad_points.shape[0] > 0) {
        EACH_LANE {
            if (point[l] >= 0) {
                wp::float32* to = reinterpret_cast<wp::float32*>(grad_points.data) + 4 * (size_t)point[l];
#if defined(__CUDA_ARCH__)
                *reinterpret_cast<float4*>(to) = make_float4(total[0][l], total[1][l], total[2][l], total[3][l]);
#else
                for (int i = 0; i < 4; ++i) to[i] = total[i][l];
#endif
            }
        }
    }
"""

# A group that lies in one cell: GROUP holds the lanes of the group of lane 0, BITS those in which its lanes differ.
_WHOLE = """
        EACH_LANE {
            const unsigned group = GROUPu << (lane & ~BITS);
            whole[l] = (peers[l] & group) == group;
        }
        if (any_lane(whole)) {
            UNROLL
            for (int k = 0; k < COUNT; ++k) {
                wp::float32 given[LANES], got[LANES];
                STEP
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
    text, bits = "", 0
    for step, bit in enumerate(_BITS):
        bits |= bit
        group = sum(1 << lane for lane in range(32) if not lane & ~bits)
        corners = 4 >> step  # that a lane is left with; none in the last two steps, where it already has but one
        if corners:
            share = f"held[l] = held[l] ? {corners} : 0; corner[l] += lane & {bit} ? {corners} : 0;"
        else:
            share = f"if (lane & {bit}) held[l] = 0;"
        names = {
            "STEP": _HALVES if corners else _SUM,
            "SHARE": share,
            "GROUP": str(group),
            "BITS": str(bits),
            "BIT": str(bit),
            "COUNT": str(max(corners, 1) * features),
        }
        part = _WHOLE
        for name, value in names.items():
            part = part.replace(name, value)
        text += part
    return text + "}" * len(_BITS)


SCATTER_THREADS = 128  # of a block

Halves, Reals = wp.array(dtype=wp.float16), wp.array(dtype=wp.float32)


@functools.cache
def fused_scatter_kernel(features: int) -> wp.Kernel:
    """Make the kernel, for F = 2 or 4; threads are 32 times the number of warps, on a CPU that number."""
    values = ", ".join(f"from[{f}]" for f in range(features))
    text = _PROGRAM.replace("FEATURES", str(features)).replace("VALUES", values).replace("MERGE", _merge(features))

    @wp.func_native(PRELUDE + f"    constexpr int F = {features};\n" + text)
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
        grad_table: Reals,
        grad_points: wp.array(dtype=wp.vec4),
    ): ...

    @wp.kernel(enable_backward=False, grid_stride=False, module="unique")
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
            grad_table,
            grad_points,
        )

    return fused_scatter
