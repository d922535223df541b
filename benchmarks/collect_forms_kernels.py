"""Forms of collect that `collect_forms` times: as before, insertion behind a branch, records or colours in shared memory."""

import functools
import warp as wp
from nexwarp.kernels.native.vector_loads import record_row_function
from nexwarp.kernels.native.warp import any_in_warp, ballot, from_lane, lane_index, lowest_lane, warp_size
from nexwarp.kernels.surfel import hit_functions
from nexwarp.kernels.types import types
from nexwarp.kernels.walk import buffer_types, overflowed, surfel_at, walk, walk_functions

STAGE = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 rows[WARPS * 5 * 32];
    float4* mine = rows + (threadIdx.x >> 5) * 160;
    if (op == 0) {
        __syncwarp();
        if (k >= 0) {
            mine[k] = make_float4(a.c[0], a.c[1], a.c[2], a.c[3]);
            mine[32 + k] = make_float4(b.c[0], b.c[1], b.c[2], b.c[3]);
            mine[64 + k] = make_float4(n.c[0], n.c[1], n.c[2], n.c[3]);
            mine[96 + k] = make_float4(c.c[0], c.c[1], c.c[2], c.c[3]);
            reinterpret_cast<int2*>(mine + 128)[k] = make_int2(i, place);
        }
        __syncwarp();
        return wp::vec_t<4, float>();
    }
    const float4 v = mine[32 * (op - 1) + k];
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::vec_t<4, float>();
#endif
"""
IDS = """
#if defined(__CUDA_ARCH__)
    __shared__ int2 ids[WARPS * 32];
    int2* mine = ids + (threadIdx.x >> 5) * 32;
    if (op == 0) {
        if (k >= 0) mine[k] = make_int2(i, place);
        return wp::vec_t<2, int>();
    }
    const int2 v = mine[k];
    return wp::vec_t<2, int>(v.x, v.y);
#else
    return wp::vec_t<2, int>();
#endif
"""
POPC = """
#if defined(__CUDA_ARCH__)
    return __popc(x);
#else
    return x != 0;
#endif
"""
COLORS = """
#if defined(__CUDA_ARCH__)
    __shared__ float kept[SLOTS * 3 * THREADS];
    float* mine = kept + threadIdx.x + 3 * THREADS * slot;
    if (op == 0) {
        mine[0] = c.c[0];
        mine[THREADS] = c.c[1];
        mine[2 * THREADS] = c.c[2];
        return c;
    }
    return wp::vec_t<3, float>(mine[0], mine[THREADS], mine[2 * THREADS]);
#else
    return c;
#endif
"""
vec4f, vec2ii, vec3f = (
    wp.types.vector(length=4, dtype=wp.float32),
    wp.types.vector(length=2, dtype=wp.int32),
    wp.types.vector(length=3, dtype=wp.float32),
)


@wp.func_native(POPC)
def popc(x: wp.int32) -> wp.int32: ...


@functools.cache
def stage_functions(threads, slots):
    @wp.func_native(
        STAGE.replace("WARPS", str(threads // 32))
        .replace("reinterpret_cast<int2*>(mine + 128)[k] = make_int2(i, place);", "")
        .replace("* 5 *", "* 4 *")
        .replace("160", "128")
    )
    def stage(
        op: wp.int32, k: wp.int32, a: vec4f, b: vec4f, n: vec4f, c: vec4f, i: wp.int32, place: wp.int32
    ) -> vec4f: ...

    @wp.func_native(IDS.replace("WARPS", str(threads // 32)))
    def stage_id(op: wp.int32, k: wp.int32, i: wp.int32, place: wp.int32) -> vec2ii: ...

    @wp.func_native(COLORS.replace("THREADS", str(threads)).replace("SLOTS", str(slots)))
    def kept_color(op: wp.int32, slot: wp.int32, c: vec3f) -> vec3f: ...

    return stage, stage_id, kept_color


@functools.cache
def variant(max_hits, tile_size, branch, staged, shared_colors, bounds, threads=128):
    real, low_pass = wp.float32, False
    t = types(real)
    vec2, vec3, vec4, mat33 = t.vec2, t.vec3, t.vec4, t.mat33
    h = hit_functions(real, low_pass)
    load = record_row_function(real)
    vec, ivec, _ = buffer_types(real, max_hits)
    w = walk_functions(real, low_pass, tile_size)
    pixels = w.pixels
    stage, stage_id, kept_color = stage_functions(threads, max(max_hits, 1))
    ALPHA_MIN, TRANSMITTANCE_MIN, ONE = t.ALPHA_MIN, t.TRANSMITTANCE_MIN, t.ONE

    @wp.func
    def staged_candidates(
        k: wp.int32,
        end: wp.int32,
        surfel_ids: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        overflow: wp.bool,
        records: wp.array2d(dtype=vec4),
        limits: wp.array(dtype=real),
        reaches: wp.array(dtype=vec2),
        middle: vec2,
        half: vec2,
        focal: vec2,
        lane: wp.int32,
    ):
        i = int(-1)
        a = vec4()
        b = vec4()
        n = vec4()
        c = vec4()
        if k < end:
            i = surfel_at(k, surfel_ids, order, overflow)
            a = load(records, i, 0)
            b = load(records, i, 1)
            n = load(records, i, 2)
            c = load(records, i, 3)
            if h.misses_block(a, b, n, c[3], reaches[i], limits[i], vec3(), middle, half, focal):
                i = int(-1)
        votes = ballot(wp.where(i >= 0, 1, 0))
        slot = int(-1)
        if i >= 0:
            slot = popc(votes & ((1 << lane) - 1))
        stage_id(0, slot, i, k)
        stage(0, slot, a, b, n, c, i, k)
        return popc(votes)

    @wp.kernel(
        enable_backward=False,
        grid_stride=False,
        module="unique",
        module_options={"fast_math": True},
        launch_bounds=bounds,
    )
    def collect(
        first: wp.int32,
        records: wp.array2d(dtype=vec4),
        centers: wp.array(dtype=vec3),
        limits: wp.array(dtype=real),
        surfel_ids: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        size: wp.vec2i,
        tile_columns: wp.int32,
        Ks: wp.array(dtype=mat33),
        near: real,
        reaches: wp.array(dtype=vec2),
        # outputs
        plain: wp.array(dtype=vec3),
        base: wp.array(dtype=vec3),
        ids: wp.array2d(dtype=wp.int32),
        depths: wp.array2d(dtype=real),
        weights: wp.array2d(dtype=real),
        alphas: wp.array(dtype=real),
        stops: wp.array(dtype=wp.int32),
    ):
        thread = first + wp.tid()
        xy, inside, d, intrinsics = w.pixel_of(thread, tile_columns, size, Ks)
        middle, half = w.block_of(xy, intrinsics)
        focal = vec2(intrinsics[0], intrinsics[1])
        transmittance = real(1.0)
        if not inside:
            transmittance = real(0.0)
        color = vec3()
        buffer_ids = ivec()
        buffer_weights = vec()
        buffer_slots = ivec()
        for j in range(wp.static(max_hits)):
            buffer_ids[j] = -1
            buffer_slots[j] = j
            if wp.static(shared_colors):
                kept_color(0, j, vec3())
        overflow = overflowed(ends, surfel_ids)
        bounds_ = walk(thread // pixels, tile_offsets, ends, overflow)
        stop = int(bounds_[0])
        width = warp_size()
        lane = lane_index()
        for batch in range(bounds_[0], bounds_[1], width):
            if any_in_warp(wp.where(transmittance >= TRANSMITTANCE_MIN, 1, 0)) == 0:
                break
            mine = int(-1)
            left = int(0)
            count = int(0)
            if wp.static(staged):
                count = staged_candidates(
                    batch + lane,
                    bounds_[1],
                    surfel_ids,
                    order,
                    overflow,
                    records,
                    limits,
                    reaches,
                    middle,
                    half,
                    focal,
                    lane,
                )
            else:
                mine = w.candidate(
                    batch + lane,
                    bounds_[1],
                    surfel_ids,
                    order,
                    overflow,
                    records,
                    centers,
                    limits,
                    reaches,
                    middle,
                    half,
                    focal,
                )
                left = ballot(wp.where(mine >= 0, 1, 0))
            if wp.static(staged):
                left = int(count)
            while left != 0:
                i = int(0)
                place = int(0)
                ra = vec4()
                rb = vec4()
                rn = vec4()
                rc = vec4()
                if wp.static(staged):
                    k = count - left
                    left = left - 1
                    both = stage_id(1, k, 0, 0)
                    i = both[0]
                    place = both[1]
                    ra = stage(1, k, ra, ra, ra, ra, 0, 0)
                    rb = stage(2, k, ra, ra, ra, ra, 0, 0)
                    rn = stage(3, k, ra, ra, ra, ra, 0, 0)
                    rc = stage(4, k, ra, ra, ra, ra, 0, 0)
                else:
                    source = lowest_lane(left)
                    left = left & (left - 1)
                    i = from_lane(mine, source)
                    place = batch + source
                    ra = load(records, i, 0)
                    rb = load(records, i, 1)
                    rn = load(records, i, 2)
                    rc = load(records, i, 3)
                u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
                alpha, depth2 = h.kernel(u, v, depth, ra, rb, rn, vec3(), d[0], d[1], focal, near)
                if alpha >= ALPHA_MIN and depth2 > near and transmittance >= TRANSMITTANCE_MIN:
                    weight = alpha * transmittance
                    transmittance = transmittance * (ONE - alpha)
                    stop = place + 1
                    shade = vec3(rc[0], rc[1], rc[2])
                    out_id = int(i)
                    out_weight = real(weight)
                    if wp.static(branch):
                        if weight > buffer_weights[wp.static(max_hits - 1)]:
                            out_slot = buffer_slots[wp.static(max_hits - 1)]
                            if wp.static(shared_colors):
                                old = kept_color(1, out_slot, shade)
                                kept_color(0, out_slot, shade)
                                shade = old
                            new_slot = int(out_slot)
                            displaced = bool(False)
                            for j in range(wp.static(max_hits)):
                                w_ = buffer_weights[j]
                                i_ = buffer_ids[j]
                                s_ = buffer_slots[j]
                                displaced = displaced or out_weight > w_
                                buffer_weights[j] = wp.where(displaced, out_weight, w_)
                                buffer_ids[j] = wp.where(displaced, out_id, i_)
                                out_weight = wp.where(displaced, w_, out_weight)
                                out_id = wp.where(displaced, i_, out_id)
                                if wp.static(shared_colors):
                                    buffer_slots[j] = wp.where(displaced, new_slot, s_)
                                    new_slot = wp.where(displaced, s_, new_slot)
                            if wp.static(not shared_colors):
                                rc2 = load(records, wp.max(out_id, 0), 3)
                                shade = vec3(rc2[0], rc2[1], rc2[2])
                        color += shade * out_weight
                    else:
                        displaced = bool(False)
                        for j in range(wp.static(max_hits)):
                            w_ = buffer_weights[j]
                            i_ = buffer_ids[j]
                            displaced = displaced or out_weight > w_
                            buffer_weights[j] = wp.where(displaced, out_weight, w_)
                            buffer_ids[j] = wp.where(displaced, out_id, i_)
                            out_weight = wp.where(displaced, w_, out_weight)
                            out_id = wp.where(displaced, i_, out_id)
                        rc2 = load(records, wp.max(out_id, 0), 3)
                        color += vec3(rc2[0], rc2[1], rc2[2]) * out_weight
        if not inside:
            return
        p = xy[1] * size[0] + xy[0]
        plain[p] = color
        kept = vec3()
        for j in range(wp.static(max_hits)):
            i = buffer_ids[j]
            depth = real(0.0)
            if i >= 0:
                ra = load(records, i, 0)
                rb = load(records, i, 1)
                rn = load(records, i, 2)
                rc = load(records, i, 3)
                kept += vec3(rc[0], rc[1], rc[2]) * buffer_weights[j]
                u, v, depth = h.plane(ra, rb, rn, rc[3], d[0], d[1])
            ids[p, j] = i
            depths[p, j] = depth
            weights[p, j] = buffer_weights[j]
        base[p] = kept
        alphas[p] = ONE - transmittance
        stops[p] = stop

    return collect
