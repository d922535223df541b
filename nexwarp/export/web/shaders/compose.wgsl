// Composition (paper Eq. 7) and exposure; the display of the other modes. A thread is a pixel.
//
// Where texels are coarser than pixels, a hit takes those of its own surfel among the four around it, weighted as in
// bilinear interpolation; without any, that of the hit next in depth.

@group(0) @binding(1) var<storage, read> records: array<vec4f>;
@group(0) @binding(2) var<storage, read> colors: array<vec4f>;
@group(0) @binding(3) var<storage, read> ids: array<i32>;
@group(0) @binding(4) var<storage, read> depths: array<f32>;
@group(0) @binding(5) var<storage, read> weights: array<f32>;
@group(0) @binding(6) var<storage, read> texels: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> image: array<vec4f>;

const SLOTS: u32 = max(K, 1u);

fn texel_of(xy: vec2u, p: u32, k: u32) -> vec4f {
    if (frame.texels.z == 1u) {
        return texels[p * SLOTS + k];
    }
    let step = frame.texels.z;
    let i = ids[p * SLOTS + k];
    let depth = depths[p * SLOTS + k];
    let base = xy / step;
    let f = vec2f(xy % step) / f32(step);
    var sum = vec4f(0.0);
    var weight = 0.0;
    var nearest = vec4f(0.0);
    var distance = 1e30;
    for (var corner = 0u; corner < 4u; corner++) {
        let offset = vec2u(corner & 1u, corner >> 1u);
        let texel = min(base + offset, frame.texels.xy - 1u);
        let source = min(texel * step, frame.size.xy - 1u);
        let q = source.y * frame.size.x + source.x;
        let t = texel.y * frame.texels.x + texel.x;
        let share = select(1.0 - f.x, f.x, offset.x == 1u) * select(1.0 - f.y, f.y, offset.y == 1u) + 1e-4;
        for (var j = 0u; j < K; j++) {
            let other = ids[q * SLOTS + j];
            let value = texels[t * SLOTS + j];
            if (other < 0 || value.w == 0.0) {
                continue;
            }
            if (other == i) {
                sum += value * share;
                weight += share;
            }
            let away = abs(depths[q * SLOTS + j] - depth);
            if (away < distance) {
                distance = away;
                nearest = value;
            }
        }
    }
    if (weight > 0.0) {
        return sum / weight;
    }
    return nearest;
}

fn id_color(id: i32) -> vec3f {
    let h = (vec3u(u32(id + 1)) * vec3u(2654435761u, 2246822519u, 3266489917u)) >> vec3u(16u);
    return 0.2 + 0.8 * vec3f(h & vec3u(255u)) / 255.0;
}

// Viridis, by a polynomial of degree 6 for each channel.
fn scale_color(x: f32) -> vec3f {
    let t = clamp(x, 0.0, 1.0);
    let c0 = vec3f(0.27773, 0.00541, 0.33410);
    let c1 = vec3f(0.10509, 1.40461, 1.38459);
    let c2 = vec3f(-0.33086, 0.21485, 0.09510);
    let c3 = vec3f(-4.63423, -5.79910, -19.33244);
    let c4 = vec3f(6.22827, 14.17993, 56.69055);
    let c5 = vec3f(4.77638, -13.74515, -65.35303);
    let c6 = vec3f(-5.43546, 4.64585, 26.31244);
    return clamp(c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6))))), vec3f(0.0), vec3f(1.0));
}

@compute @workgroup_size(64)
fn compose(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let xy = group.xy * 8u + vec2u(lane % 8u, lane / 8u);
    if (xy.x >= frame.size.x || xy.y >= frame.size.y) {
        return;
    }
    let p = xy.y * frame.size.x + xy.x;
    let plain = colors[p];
    let mode = frame.counts.z;
    if (mode >= MODE_IDS) {
        var shown = vec3f(0.0);
        let id = ids[p * SLOTS];
        if (K > 0u && id >= 0) {
            if (mode == MODE_IDS) {
                shown = id_color(id);
            } else if (mode == MODE_DEPTH) {
                let ends = frame.limits.yz;
                shown = scale_color((depths[p * SLOTS] - ends.x) / (ends.y - ends.x));
            } else {
                let n = rotate_back(records[u32(id) * RECORD + 2u].xyz);
                shown = 0.5 + 0.5 * select(n, -n, records[u32(id) * RECORD + 3u].w > 0.0);
            }
        }
        image[p] = vec4f(shown, 1.0);
        return;
    }
    var textured = vec3f(0.0);
    for (var k = 0u; k < K; k++) {
        let i = ids[p * SLOTS + k];
        if (i < 0) {
            break;
        }
        var color = records[u32(i) * RECORD + 3u].xyz;
        if (TEXTURED && frame.texels.w == 1u && (k == 0u || weights[p * SLOTS + k] >= frame.limits.x)) {
            let texel = texel_of(xy, p, k);
            if (texel.w > 0.0) {
                color = select(texel.xyz, color + texel.xyz, RESIDUAL);
            }
        }
        textured += color * weights[p * SLOTS + k];
    }
    var total = plain.xyz + textured + (1.0 - plain.w) * frame.background.xyz;
    if (mode == MODE_PLAIN) {
        total = plain.xyz;
    } else if (mode == MODE_TEXTURED) {
        total = textured;
    }
    var factors = frame.gains.xyz;
    if (frame.falloff.w > 0.0) {
        let d = ray_of(xy).xy;
        let t = min(dot(d, d) / frame.falloff.z, 1.0);
        factors *= exp(t * (frame.falloff.x + frame.falloff.y * t));
    }
    image[p] = vec4f(total * factors, 1.0);
}
