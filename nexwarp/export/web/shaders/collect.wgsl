// Collection (nexwarp/kernels/collect.py): a workgroup is a tile, a thread a pixel. It walks the tile's list near to
// far, blends, and keeps the K heaviest hits, heaviest first; on a tie the nearer one stays.

@group(0) @binding(1) var<storage, read> records: array<vec4f>;
@group(0) @binding(2) var<storage, read> surfels: array<u32>;
@group(0) @binding(3) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(4) var<storage, read_write> colors: array<vec4f>;  // plain colour N, alpha
@group(0) @binding(5) var<storage, read_write> ids: array<i32>;
@group(0) @binding(6) var<storage, read_write> depths: array<f32>;
@group(0) @binding(7) var<storage, read_write> weights: array<f32>;

const BATCH: u32 = 64u;
const SLOTS: u32 = max(K, 1u);
const FARTHEST: f32 = 11.1;  // more than 2 ln 255, the largest exponent of a hit

var<workgroup> batch: array<vec4f, BATCH * RECORD>;
var<workgroup> batch_ids: array<u32, BATCH>;
var<workgroup> walking: atomic<u32>;
var<workgroup> go: u32;

@compute @workgroup_size(256)
fn collect(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = group.y * frame.size.z + group.x;
    let xy = vec2u(group.x * TILE + lane % TILE, group.y * TILE + lane / TILE);
    let inside = xy.x < frame.size.x && xy.y < frame.size.y;
    let d = ray_of(xy);
    let near = frame.position.w;
    var transmittance = 1.0;
    var color = vec3f(0.0);
    var done = !inside;
    var slot_ids: array<i32, SLOTS>;
    var slot_weights: array<f32, SLOTS>;
    var slot_depths: array<f32, SLOTS>;
    var slot_colors: array<vec3f, SLOTS>;
    for (var j = 0u; j < SLOTS; j++) {
        slot_ids[j] = -1;
    }
    let first = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    for (var start = first; start < end; start += BATCH) {
        if (lane == 0u) {
            atomicStore(&walking, 0u);
        }
        workgroupBarrier();
        if (!done) {
            atomicStore(&walking, 1u);
        }
        // Four threads a surfel, each one of its rows.
        let place = lane / 4u;
        if (start + place < end) {
            let i = surfels[start + place];
            batch[place * RECORD + lane % 4u] = records[i * RECORD + lane % 4u];
            if (lane % 4u == 0u) {
                batch_ids[place] = i;
            }
        }
        workgroupBarrier();
        if (lane == 0u) {
            go = atomicLoad(&walking);
        }
        if (workgroupUniformLoad(&go) == 0u) {
            break;
        }
        let count = min(BATCH, end - start);
        for (var k = 0u; k < count && !done; k++) {
            let a = batch[k * RECORD];
            let b = batch[k * RECORD + 1u];
            let n = batch[k * RECORD + 2u];
            let c = batch[k * RECORD + 3u];
            let cosine = dot(n.xyz, d);
            if (abs(cosine) < 1e-18) {
                continue;
            }
            let inverse = 1.0 / cosine;
            let uv = vec2f(dot(a.xyz, d), dot(b.xyz, d)) * inverse;
            let square = min(uv * uv, vec2f(1e30));
            // Beyond 1, |u|^(2 gamma) is at least u^2.
            if (max(square.x, square.y) > FARTHEST) {
                continue;
            }
            let depth = c.w * inverse;
            let powers = exp2(min(vec2f(b.w, n.w) * log2(max(square, vec2f(TINY))), vec2f(100.0)));
            let exponent = powers.x + powers.y;
            let alpha = min(a.w * exp2(-0.7213475204444817 * exponent), ALPHA_MAX);
            if (!(alpha >= ALPHA_MIN && depth > near)) {
                continue;
            }
            let weight = alpha * transmittance;
            transmittance *= 1.0 - alpha;
            var out_id = i32(batch_ids[k]);
            var out_weight = weight;
            var out_depth = depth;
            var out_color = c.xyz;
            if (K > 0u) {
                // Insert before the first lighter hit; what falls out is blended as plain.
                var displaced = false;
                for (var j = 0u; j < SLOTS; j++) {
                    if (displaced || out_weight > slot_weights[j]) {
                        displaced = true;
                        let w = slot_weights[j];
                        let i = slot_ids[j];
                        let z = slot_depths[j];
                        let rgb = slot_colors[j];
                        slot_weights[j] = out_weight;
                        slot_ids[j] = out_id;
                        slot_depths[j] = out_depth;
                        slot_colors[j] = out_color;
                        out_weight = w;
                        out_id = i;
                        out_depth = z;
                        out_color = rgb;
                    }
                }
            }
            color += out_color * out_weight;
            if (transmittance < TRANSMITTANCE_MIN) {
                done = true;
            }
        }
        workgroupBarrier();
    }
    if (!inside) {
        return;
    }
    let p = xy.y * frame.size.x + xy.x;
    colors[p] = vec4f(color, 1.0 - transmittance);
    for (var j = 0u; j < K; j++) {
        ids[p * SLOTS + j] = slot_ids[j];
        depths[p * SLOTS + j] = slot_depths[j];
        weights[p * SLOTS + j] = slot_weights[j];
    }
}
