// Texturing: a thread is a pixel of the texel grid, which samples every frame.texels.z-th pixel of the image.
// Hash lookup (nexwarp/kernels/hashgrid.py, paper Eq. 2 and 4), MLP, spherical harmonics of each of its K hits.
//
// The MLP's matrices `mlp` are in blocks of 4 x 4, a row of blocks after the other. The rows of the last one are by
// channel, then coefficient, so that a block's dot product with the basis is a part of one channel. Weights and
// activations are in half precision where the device has it; weights that fit are in a uniform buffer, which the page
// declares: GPUs have a cache for those.

@group(0) @binding(1) var<storage, read> seen: array<vec2f>;
@group(0) @binding(2) var<storage, read> ids: array<i32>;
@group(0) @binding(3) var<storage, read> depths: array<f32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
@group(0) @binding(5) var<storage, read> grid: array<Row>;
@group(0) @binding(7) var<storage, read_write> texels: array<vec4f>;  // colour; 1 where the hit is textured
@group(0) @binding(8) var<uniform> resolutions: array<vec4f, 16>;  // cells per world unit of each level

const INVERSE_TWO_PI: f32 = 0.15915494309189535;

fn map_positive(i: i32) -> u32 {
    return u32(select(-2 * i, 2 * i - 1, i > 0));
}

fn lookup(level: u32, position: vec3f, depth: f32) -> Features {
    let scale = resolutions[level / 4u][level % 4u];
    let x = position * scale;
    let base = floor(x);
    let f = x - base;
    let corner = vec3i(base);
    let start = level * (MASK + 1u);
    let x0 = map_positive(corner.x);
    let x1 = map_positive(corner.x + 1);
    let y0 = map_positive(corner.y) * 2654435761u;
    let y1 = map_positive(corner.y + 1) * 2654435761u;
    let z0 = map_positive(corner.z) * 805459861u;
    let z1 = map_positive(corner.z + 1) * 805459861u;
    let g = 1.0 - f;
    let ratio = frame.background.w / (scale * depth);
    let fade = 1.0 - exp(-INVERSE_TWO_PI * ratio * ratio);
    let front = fetch(start + ((x0 ^ y0 ^ z0) & MASK)) * (g.x * g.y)
        + fetch(start + ((x1 ^ y0 ^ z0) & MASK)) * (f.x * g.y)
        + fetch(start + ((x0 ^ y1 ^ z0) & MASK)) * (g.x * f.y)
        + fetch(start + ((x1 ^ y1 ^ z0) & MASK)) * (f.x * f.y);
    let back = fetch(start + ((x0 ^ y0 ^ z1) & MASK)) * (g.x * g.y)
        + fetch(start + ((x1 ^ y0 ^ z1) & MASK)) * (f.x * g.y)
        + fetch(start + ((x0 ^ y1 ^ z1) & MASK)) * (g.x * f.y)
        + fetch(start + ((x1 ^ y1 ^ z1) & MASK)) * (f.x * f.y);
    return front * (g.z * fade) + back * (f.z * fade);
}

fn block_product(block: u32, x: Weight) -> vec4f {
    return vec4f(mlp[block] * x);
}

fn activation(sum: vec4f) -> Weight {
    return Weight(clamp(sum, vec4f(0.0), vec4f(60000.0)));
}

// 1 for the coefficients of a block that the SH degree of the rendering includes.
fn used(block: u32) -> vec4f {
    return select(vec4f(0.0), vec4f(1.0), vec4u(4u * block) + vec4u(0u, 1u, 2u, 3u) < vec4u(USED_COEFFICIENTS));
}

fn mlp_color(x: ptr<function, array<Weight, INPUTS>>, direction: vec3f) -> vec3f {
    var h: array<Weight, max(INPUTS, WIDTH)>;
    for (var i = 0u; i < INPUTS; i++) {
        h[i] = (*x)[i];
    }
    var at = 0u;
    var inputs = INPUTS;
    for (var layer = 0u; layer < HIDDEN; layer++) {
        var next: array<Weight, max(INPUTS, WIDTH)>;
        for (var o = 0u; o < WIDTH; o++) {
            var sum = vec4f(0.0);
            for (var i = 0u; i < inputs; i++) {
                sum += block_product(at, h[i]);
                at += 1u;
            }
            next[o] = activation(sum);
        }
        h = next;
        inputs = WIDTH;
    }
    var color = vec3f(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var block = 0u; block < BLOCKS; block++) {
            if (block < USED_BLOCKS) {
                var sum = vec4f(0.0);
                for (var i = 0u; i < inputs; i++) {
                    sum += block_product(at + i, h[i]);
                }
                color[channel] += dot(sum, basis(block, direction) * used(block));
            }
            at += inputs;
        }
    }
    return color;
}

@compute @workgroup_size(64)
fn shade(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let texel = group.xy * 8u + vec2u(lane % 8u, lane / 8u);
    if (texel.x >= frame.texels.x || texel.y >= frame.texels.y) {
        return;
    }
    let xy = min(texel * frame.texels.z, frame.size.xy - 1u);
    let p = xy.y * frame.size.x + xy.x;
    let t = texel.y * frame.texels.x + texel.x;
    let ray = rotate_back(ray_of(xy));
    let direction = normalize(ray);
    let focal = frame.gains.w;
    for (var k = 0u; k < K; k++) {
        let i = ids[p * K + k];
        var color = vec4f(0.0);
        if (i >= 0 && (k == 0u || weights[p * K + k] >= frame.limits.x)) {
            let depth = depths[p * K + k];
            var seen_depth = depth;
            if (LIMITS) {
                // `nearest` last: where no training view saw the texture, it removes all detail.
                let range = seen[i] * focal;
                seen_depth = max(min(depth, range.y), range.x);
            }
            let position = frame.position.xyz + ray * depth;
            var x: array<Weight, INPUTS>;
            for (var level = 0u; level < LEVELS; level++) {
                store_features(&x, level, lookup(level, position, seen_depth));
            }
            var c = mlp_color(&x, direction);
            if (!RESIDUAL) {
                c += 0.5;
                if (CLAMP) {
                    c = max(c, vec3f(0.0));
                }
            }
            color = vec4f(c, 1.0);
        }
        texels[t * K + k] = color;
    }
}
