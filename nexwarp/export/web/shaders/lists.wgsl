// Tile lists (nexwarp/kernels/tiles.py): SHARING threads a surfel, in depth order, take turns at its tile rows.
// `count` counts the entries, `emit` writes them, `offsets` finds each tile's range in the sorted list.

@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> polygons: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> starts: array<u32>;  // counts, then their prefix sums
@group(0) @binding(4) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(5) var<storage, read_write> surfels: array<u32>;
@group(0) @binding(6) var<storage, read> totals: array<u32>;
@group(0) @binding(7) var<storage, read_write> tile_starts: array<u32>;

const HUGE: f32 = 1e30;

struct Polygon {
    corners: array<vec2f, 5>,
    count: u32,
    margin: f32,
    rows: vec2u,  // first, and one behind the last
}

fn polygon_of(i: u32) -> Polygon {
    let p0 = polygons[4u * i];
    let p1 = polygons[4u * i + 1u];
    let p2 = polygons[4u * i + 2u];
    let p3 = polygons[4u * i + 3u];
    return Polygon(array<vec2f, 5>(p0.xy, p0.zw, p1.xy, p1.zw, p2.xy), u32(p3.x), p2.z, vec2u(p3.yz));
}

fn tile_index(x: f32) -> i32 {
    return i32(clamp(floor(x), -1.0, f32(frame.size.z)));
}

// First tile of a tile row that the polygon touches, and one behind the last.
fn span(polygon: ptr<function, Polygon>, row: u32) -> vec2u {
    let margin = (*polygon).margin;
    let top = f32(row * TILE) + 0.5 - margin;
    let bottom = f32((row + 1u) * TILE) - 0.5 + margin;
    var low = HUGE;
    var high = -HUGE;
    let count = (*polygon).count;
    var p = (*polygon).corners[max(count, 1u) - 1u];
    for (var k = 0u; k < count; k++) {
        let q = (*polygon).corners[k];
        if (q.y >= top && q.y <= bottom) {
            low = min(low, q.x);
            high = max(high, q.x);
        }
        if ((p.y < top) != (q.y < top)) {
            let x = p.x + (q.x - p.x) * ((top - p.y) / (q.y - p.y));
            low = min(low, x);
            high = max(high, x);
        }
        if ((p.y > bottom) != (q.y > bottom)) {
            let x = p.x + (q.x - p.x) * ((bottom - p.y) / (q.y - p.y));
            low = min(low, x);
            high = max(high, x);
        }
        p = q;
    }
    if (!(low <= high)) {
        return vec2u(0u);
    }
    let left = (low - margin + 0.5) / f32(TILE) - 1.0;
    var first = tile_index(left);
    if (left > f32(first)) {
        first++;
    }
    let last = min(tile_index((high + margin - 0.5) / f32(TILE)), i32(frame.size.z) - 1);
    first = max(first, 0);
    if (first > last) {
        return vec2u(0u);
    }
    return vec2u(u32(first), u32(last) + 1u);
}

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let thread = (group.y * groups.x + group.x) * 256u + lane;
    if (thread >= frame.counts.x * SHARING) {
        return;
    }
    var polygon = polygon_of(order[thread / SHARING]);
    var total = 0u;
    for (var row = polygon.rows.x + thread % SHARING; row < polygon.rows.y; row += SHARING) {
        let s = span(&polygon, row);
        total += s.y - s.x;
    }
    starts[thread] = total;
}

@compute @workgroup_size(256)
fn emit(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let thread = (group.y * groups.x + group.x) * 256u + lane;
    let threads = frame.counts.x * SHARING;
    if (thread >= threads) {
        return;
    }
    var e = starts[thread];
    // Entries beyond the capacity, the farthest ones, are left out; the host then enlarges the lists.
    var end = frame.counts.y;
    if (thread + 1u < threads) {
        end = min(end, starts[thread + 1u]);
    } else {
        end = min(end, totals[TOTAL]);
    }
    if (e >= end) {
        return;
    }
    let i = order[thread / SHARING];
    var polygon = polygon_of(i);
    for (var row = polygon.rows.x + thread % SHARING; row < polygon.rows.y; row += SHARING) {
        let s = span(&polygon, row);
        for (var column = s.x; column < s.y; column++) {
            if (e < end) {
                tiles[e] = row * frame.size.z + column;
                surfels[e] = i;
            }
            e++;
        }
    }
    // A compiler may round here otherwise than in `count`: fill what is left with the tile behind the last.
    for (; e < end; e++) {
        tiles[e] = frame.size.z * frame.size.w;
        surfels[e] = i;
    }
}

@compute @workgroup_size(256)
fn offsets(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = (group.y * groups.x + group.x) * 256u + lane;
    if (tile > frame.size.z * frame.size.w) {
        return;
    }
    var low = 0u;
    var high = min(totals[TOTAL], frame.counts.y);
    while (low < high) {
        let middle = (low + high) / 2u;
        if (tiles[middle] < tile) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    tile_starts[tile] = low;
}
