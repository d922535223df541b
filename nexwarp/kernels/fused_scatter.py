"""Backward lookup of the fused texturing: gradients of the grid, of positions and of depths.

Eight lanes share the 16 points of a unit, see `fused_texture`; a warp takes four units. Read: gradients of the features
(units, L, 16, F) as `fused_texture` writes them. Written:

    grad_table     (L, T, F) added to, by atomics
    grad_points    (n) gradients of position and depth, 0 for points of depth 0

A launch takes the levels of one range, and adds to `grad_points` unless its first level is 0: the tables of a few
levels stay in the L2 cache, those of all do not.

First each lane looks up the cells of two points. The derivative of the interpolation is written by hand. With s_j =
<features of corner j, incoming gradient>, the position's gradient is that of the interpolation of the s_j, and the
depth's is their interpolation times the derivative of the fade.

Then the lanes walk along the 16 points together. The eight corners of a cell have eight different parities of x, y and
z, and each lane takes the corner of its own parity. It holds the sums of four rows of the table in shared memory, and
adds a sum to the table when another row needs its place: where pixels are smaller than cells, neighbouring points
share an atomic. The number of atomics limits the kernel.
"""

import functools

import warp as wp

from nexwarp.kernels.fused_texture import FIELDS, Fused
from nexwarp.native import snippet
from nexwarp.native.mma import PRELUDE

SCATTER_THREADS = 128  # of a block
SCATTER_BLOCKS = 8  # of a multiprocessor at least: a thread gets 64 registers
ENTRIES = 4  # sums that a lane holds; a power of 2

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
    // Nothing here reads what it adds to, so that the compiler may move loads across it.
    auto add = [](float* to, const float* from) {
#if __CUDA_ARCH__ >= 900
        asm volatile("red.relaxed.gpu.global.add.vFEATURES.f32 [%0], {PLACES};" :: "l"(to), VALUES);
#else
        for (int f = 0; f < F; ++f) atomicAdd(to + f, from[f]);
#endif
    };
    // A lane's sums, and the row of the table that each belongs to; ~0 where an entry is free.
    struct alignas(4 * F) Row { float f[F]; };
    __shared__ Row held_sums[ENTRIES * THREADS];
    __shared__ unsigned held_slots[ENTRIES * THREADS];
    // Of each point of a unit: the negative cell and whether it has a gradient; fractions and fade; gradient.
    // The last bytes let the four units that a warp reads at once lie in different banks.
    struct alignas(16) Point { int4 cell_active; float4 fractions_fade; Row gradient; };
    struct Unit { Point points[16]; int4 unused; };
    __shared__ Unit units[THREADS / 8];
    Point* const staged = units[threadIdx.x >> 3].points;
    const int sub = lane & 7, parity[3] = {sub & 1, (sub >> 1) & 1, sub >> 2};
    const int across = (width + (1 << shift) - 1) >> shift;
    const int unit = thread >> 3, tile = unit / hits, hit = unit % hits;
    const int left = (tile % across) << shift, top = (tile / across) << (4 - shift);
    float at[2][3], per_depth[2], total[2][4] = {};
    int point[2], seen[2], any_seen = 0;
    #pragma unroll
    for (int i = 0; i < 2; ++i) {
        const int row = sub + 8 * i, column = left + (row & ((1 << shift) - 1)), line = top + (row >> shift);
        point[i] = column < width && line < height ? (line * width + column) * hits + hit : -1;
        const float depth = point[i] < 0 ? 0.0f : depths.data[point[i]];
        seen[i] = depth > 0.0f;
        any_seen |= seen[i];
        per_depth[i] = seen[i] ? 1.0f / depth : 0.0f;
        const float* from = reinterpret_cast<const float*>(positions.data) + 3 * (size_t)(seen[i] ? point[i] : 0);
        for (int k = 0; k < 3; ++k) at[i][k] = from[k];
    }
    const bool need_points = grad_points.shape[0] > 0;
    const int last_level = __any_sync(all, any_seen) ? end_level : first_level;
    #pragma unroll 1
    for (int level = first_level; level < last_level; ++level) {
        const float scale = resolutions.data[level];
        float* const grad_rows = reinterpret_cast<float*>(grad_table.data) + (size_t)level * (mask + 1) * F;
        const unsigned* rows = opaque(
            reinterpret_cast<const unsigned*>(table.data) + (size_t)level * (mask + 1) * (F / 2));
        const float per_scale = focal_length * reciprocal(scale);
        #pragma unroll
        for (int i = 0; i < 2; ++i) {
            const unsigned* incoming = reinterpret_cast<const unsigned*>(grad_encoded.data)
                + (size_t)unit * 256 + (level * 16 + sub + 8 * i) * (F / 2);
            float fraction[3];
            Row g;
            unsigned given[F / 2] = {}, found[8][F / 2] = {};
            if (seen[i]) read_row(incoming, given);
            int cell[3];
            #pragma unroll
            for (int k = 0; k < 3; ++k) {
                const float x = at[i][k] * scale, base = floorf(x);
                fraction[k] = x - base;
                cell[k] = (int)-base;
            }
            // All loads before the first use.
            if (need_points && seen[i]) {
                const unsigned hx[2] = {map_negative(cell[0]), map_negative(cell[0] - 1)};
                const unsigned hy[2] = {map_negative(cell[1]) * 2654435761u, map_negative(cell[1] - 1) * 2654435761u};
                const unsigned hz[2] = {map_negative(cell[2]) * 805459861u, map_negative(cell[2] - 1) * 805459861u};
                #pragma unroll
                for (int j = 0; j < 8; ++j)
                    read_row(rows + (size_t)((hx[j & 1] ^ hy[(j >> 1) & 1] ^ hz[j >> 2]) & mask) * (F / 2), found[j]);
            }
            int active = 0;
            #pragma unroll
            for (int f = 0; f < F; ++f) {
                g.f[f] = factor * (f & 1 ? high_half(given[f / 2]) : low_half(given[f / 2]));
                active |= g.f[f] != 0.0f;
            }
            const float fx = fraction[0], fy = fraction[1], fz = fraction[2], ratio = per_scale * per_depth[i];
            const float power = -0.15915494309189535f * 1.4426950408889634f * ratio * ratio;
            const float rest = exponential2(power), fade = 1.0f - rest;
            staged[sub + 8 * i] = {
                make_int4(cell[0], cell[1], cell[2], active), make_float4(fx, fy, fz, fade), g};
            if (need_points && seen[i]) {
                float s[8] = {};
                #pragma unroll
                for (int j = 0; j < 8; ++j) {
                    #pragma unroll
                    for (int f = 0; f < F; ++f)
                        s[j] += (f & 1 ? high_half(found[j][f / 2]) : low_half(found[j][f / 2])) * g.f[f];
                }
                float x1[4], x0[4];
                #pragma unroll
                for (int j = 0; j < 4; ++j) { x1[j] = s[2 * j + 1] - s[2 * j]; x0[j] = s[2 * j] + fx * x1[j]; }
                const float y0 = x0[1] - x0[0], y1 = x0[3] - x0[2], z0 = x0[0] + fy * y0, z1 = x0[2] + fy * y1 - z0;
                const float dx0 = x1[0] + fy * (x1[1] - x1[0]), dx1 = x1[2] + fy * (x1[3] - x1[2]);
                const float steep = fade * scale;
                total[i][0] += steep * (dx0 + fz * (dx1 - dx0));
                total[i][1] += steep * (y0 + fz * (y1 - y0));
                total[i][2] += steep * z1;
                total[i][3] += (z0 + fz * z1) * (power * rest);
            }
        }
        #pragma unroll
        for (int e = 0; e < ENTRIES; ++e) held_slots[e * THREADS + threadIdx.x] = ~0u;
        __syncwarp();
        #pragma unroll 2
        for (int step = 0; step < 16; ++step) {
            // An image's points column by column.
            const Point& point_of_step = staged[shift == 3 ? (step & 1) << 3 | step >> 1 : step];
            const int4 cell = point_of_step.cell_active;
            if (!cell.w) continue;
            const float4 fractions = point_of_step.fractions_fade;
            const Row g = point_of_step.gradient;
            // The cell's vertex of the lane's parity.
            const int bx = (parity[0] ^ cell.x) & 1, by = (parity[1] ^ cell.y) & 1, bz = (parity[2] ^ cell.z) & 1;
            const int x = cell.x - bx, y = cell.y - by, z = cell.z - bz;
            const float weight = (bx ? fractions.x : 1.0f - fractions.x) * (by ? fractions.y : 1.0f - fractions.y)
                * ((bz ? fractions.z : 1.0f - fractions.z) * fractions.w);
            const unsigned slot =
                (map_negative(x) ^ map_negative(y) * 2654435761u ^ map_negative(z) * 805459861u) & mask;
            // Any entry would be right; neighbouring vertices of one parity get different ones.
            const unsigned place = ((unsigned)x + 2u * (unsigned)y + 3u * (unsigned)z) >> 1;
            const int entry = (place & (ENTRIES - 1)) * THREADS + threadIdx.x;
            Row sum = held_sums[entry];
            const unsigned before = held_slots[entry];
            if (before != slot) {
                if (before != ~0u) add(grad_rows + (size_t)before * F, sum.f);
                held_slots[entry] = slot;
                sum = {};
            }
            #pragma unroll
            for (int f = 0; f < F; ++f) sum.f[f] += weight * g.f[f];
            held_sums[entry] = sum;
        }
        #pragma unroll
        for (int e = 0; e < ENTRIES; ++e) {
            const unsigned slot = held_slots[e * THREADS + threadIdx.x];
            if (slot != ~0u) add(grad_rows + (size_t)slot * F, held_sums[e * THREADS + threadIdx.x].f);
        }
        __syncwarp();
    }
    if (need_points) {
        #pragma unroll
        for (int i = 0; i < 2; ++i) if (point[i] >= 0) {
            float4* to = reinterpret_cast<float4*>(grad_points.data) + point[i];
            const float4 before = first_level > 0 ? *to : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            const float depth = total[i][3] * (2.0f * 0.6931471805599453f * per_depth[i]);
            *to = make_float4(
                before.x + total[i][0], before.y + total[i][1], before.z + total[i][2], before.w + depth);
        }
    }
"""


@functools.cache
def fused_scatter_kernel(features: int) -> wp.Kernel:
    """Make the kernel, for F = 2 or 4; threads are 8 a unit, rounded up to whole warps: lanes wait for each other."""
    values = ", ".join(f'"f"(from[{f}])' for f in range(features))
    places = ", ".join(f"%{f + 1}" for f in range(features))
    text = _PROGRAM.replace("FEATURES", str(features)).replace("VALUES", values).replace("PLACES", places)
    text = f"    constexpr int F = {features}, THREADS = {SCATTER_THREADS}, ENTRIES = {ENTRIES};\n" + PRELUDE + text

    @wp.func_native(snippet(FIELDS + text))
    def scatter(thread: wp.int32, fused: Fused): ...

    @wp.kernel(
        enable_backward=False, grid_stride=False, module="unique", launch_bounds=(SCATTER_THREADS, SCATTER_BLOCKS)
    )
    def fused_scatter(first: int, fused: Fused):
        scatter(first + wp.tid(), fused)

    return fused_scatter
