// Projection: a thread is a surfel. Antialiasing, record, tile polygon, plain colour and sorting key
// (nexwarp/kernels/detail.py, project.py, tiles.py and sh.py).
//
// A tile polygon is four rows: corners 0 and 1; 2 and 3; corner 4, margin; number of corners, first tile row, and one
// behind the last.

@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;  // mean, opacity; quaternion wxyz; scales, gammas
@group(0) @binding(2) var<storage, read> seen: array<vec2f>;  // detail limits: nearest, farthest
@group(0) @binding(3) var<storage, read> sh: array<f32>;
@group(0) @binding(4) var<storage, read_write> records: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> polygons: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> order: array<u32>;

const HUGE: f32 = 1e30;
const VARIANCE: f32 = 0.125;  // of a pixel's filter, in squared pixels
const MARGIN: f32 = 0.01;
const RELATIVE: f32 = 1e-6;

fn widened(scale: f32, blurred: f32) -> f32 {
    let high = max(scale, blurred);
    let ratio = min(scale, blurred) / high;
    return high * sqrt(1.0 + ratio * ratio);
}

fn plain_color(i: u32, mean: vec3f) -> vec3f {
    let ray = mean - frame.position.xyz;
    let distance = length(ray);
    var d = vec3f(0.0, 0.0, 1.0);
    if (distance > 1e-12) {
        d = ray / distance;
    }
    var color = vec3f(0.5);
    for (var k = 0u; k < PLAIN_COEFFICIENTS; k += 4u) {
        let b = basis(k / 4u, d);
        let start = (i * SH_COEFFICIENTS + k) * 3u;
        for (var j = 0u; j < min(4u, PLAIN_COEFFICIENTS - k); j++) {
            let c = start + 3u * j;
            color += vec3f(sh[c], sh[c + 1u], sh[c + 2u]) * b[j];
        }
    }
    return max(color, vec3f(0.0));
}

fn pixel(x: vec3f) -> vec2f {
    return frame.intrinsics.xy * x.xy / x.z + frame.intrinsics.zw;
}

// Index of a tile row, from x in tiles. Clamped before the cast.
fn tile_index(x: f32, count: u32) -> i32 {
    return i32(clamp(floor(x), -1.0, f32(count)));
}

@compute @workgroup_size(256)
fn project(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = (group.y * groups.x + group.x) * 256u + lane;
    if (i >= frame.counts.x) {
        return;
    }
    let mean = geometry[3u * i].xyz;
    var opacity = geometry[3u * i].w;
    let q = geometry[3u * i + 1u];
    var scales = geometry[3u * i + 2u].xy;
    var gammas = geometry[3u * i + 2u].zw;
    let center = rotate(mean) + vec3f(frame.row0.w, frame.row1.w, frame.row2.w);
    order[i] = i;
    keys[i] = 0xffffffffu;  // nothing to see: behind all others
    polygons[4u * i + 3u] = vec4f(0.0);
    if (LIMITS) {
        let size = center.z / frame.gains.w;
        let farthest = seen[i].y;
        if (size > farthest) {
            let blurred = sqrt(VARIANCE * (size * size - farthest * farthest));
            let wide = vec2f(widened(scales.x, blurred), widened(scales.y, blurred));
            let share = scales / wide;
            opacity *= share.x * share.y;
            gammas = 1.0 + (gammas - 1.0) * share * share;
            scales = wide;
        }
    }
    // 0.1 % beyond the support, so that rounding in log and pow cannot cull a hit.
    let limit = 2.0 * log(255.0 * 1.001 * max(opacity, 1e-30));
    if (!(limit > 0.0)) {
        return;
    }
    let v1 = rotate(vec3f(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z)));
    let v2 = rotate(vec3f(2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y)));
    let n = rotate(vec3f(2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)));

    let near = frame.position.w;
    let reach = pow(vec2f(limit), 0.5 / gammas);
    let w1 = v1 * (scales.x * reach.x);
    let w2 = v2 * (scales.y * reach.y);
    let extent = length(center) + length(w1) + length(w2);
    var plane = near * 0.999;
    if (!(plane > 0.0)) {
        plane = length(center) * 1e-6;
    }
    let quad = array<vec3f, 4>(center + w1 + w2, center - w1 + w2, center - w1 - w2, center + w1 - w2);
    var corners: array<vec2f, 5>;
    var low = vec2f(HUGE);
    var high = vec2f(-HUGE);
    var nearest = HUGE;
    var count = 0u;
    for (var k = 0u; k < 4u; k++) {
        let p = quad[k];
        let r = quad[(k + 1u) % 4u];
        if (p.z >= plane) {
            let x = pixel(p);
            corners[count] = x;
            count++;
            low = min(low, x);
            high = max(high, x);
            nearest = min(nearest, p.z);
        }
        if ((p.z >= plane) != (r.z >= plane)) {
            let cut = p + (r - p) * ((plane - p.z) / (r.z - p.z));
            let x = pixel(vec3f(cut.xy, plane));
            nearest = plane;
            if (count < 5u) {
                corners[count] = x;
                count++;
                low = min(low, x);
                high = max(high, x);
            }
        }
    }
    if (count == 0u) {
        return;
    }
    let size = max(max(abs(low.x), abs(low.y)), max(abs(high.x), abs(high.y)));
    var margin = 0.0;
    var rows = vec2i(0, i32(frame.size.w) - 1);
    if (size < HUGE) {
        // A corner is known to a rounding of the extent: pixels by the focal length over the depth.
        let blur = RELATIVE * extent * max(frame.intrinsics.x, frame.intrinsics.y) / nearest;
        margin = MARGIN + RELATIVE * size + blur;
        // A tile's samples are its pixel centres, half a pixel inside its border.
        rows.x = max(tile_index((low.y - margin + 0.5) / f32(TILE) - 1.0, frame.size.w), 0);
        rows.y = min(tile_index((high.y + margin - 0.5) / f32(TILE), frame.size.w), i32(frame.size.w) - 1);
        if (high.x + margin < 0.0 || low.x - margin > f32(frame.size.x)) {
            return;
        }
    } else {
        // Too large for arithmetic: list it everywhere, the walk decides.
        count = 4u;
        corners[0] = vec2f(-HUGE, -HUGE);
        corners[1] = vec2f(HUGE, -HUGE);
        corners[2] = vec2f(HUGE, HUGE);
        corners[3] = vec2f(-HUGE, HUGE);
    }
    if (rows.x > rows.y) {
        return;
    }
    polygons[4u * i] = vec4f(corners[0], corners[1]);
    polygons[4u * i + 1u] = vec4f(corners[2], corners[3]);
    polygons[4u * i + 2u] = vec4f(corners[4], margin, 0.0);
    polygons[4u * i + 3u] = vec4f(f32(count), f32(rows.x), f32(rows.y + 1), 0.0);
    records[RECORD * i] = vec4f(cross(v2, center) * (1.0 / max(scales.x, TINY)), opacity);
    records[RECORD * i + 1u] = vec4f(cross(center, v1) * (1.0 / max(scales.y, TINY)), gammas.x);
    records[RECORD * i + 2u] = vec4f(n, gammas.y);
    records[RECORD * i + 3u] = vec4f(plain_color(i, mean), dot(center, n));
    // Sortable bits of the signed depth; adding 0 makes -0 and 0 tie.
    let bits = bitcast<u32>(center.z + 0.0);
    keys[i] = select(bits | 0x80000000u, ~bits, (bits & 0x80000000u) != 0u);
}
