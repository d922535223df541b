// Shows the image, which may have another size than the canvas, by bilinear interpolation.

struct Blit {
    image: vec2u,
    canvas: vec2u,
}

@group(0) @binding(0) var<uniform> blit: Blit;
@group(0) @binding(1) var<storage, read> image: array<vec4f>;

@vertex
fn corner(@builtin(vertex_index) index: u32) -> @builtin(position) vec4f {
    return vec4f(f32(4u * (index & 1u)) - 1.0, f32(2u * (index & 2u)) - 1.0, 0.0, 1.0);
}

fn at(x: u32, y: u32) -> vec3f {
    return clamp(image[y * blit.image.x + x].xyz, vec3f(0.0), vec3f(1.0));
}

@fragment
fn show(@builtin(position) position: vec4f) -> @location(0) vec4f {
    let last = blit.image - 1u;
    let x = clamp(position.xy * vec2f(blit.image) / vec2f(blit.canvas) - 0.5, vec2f(0.0), vec2f(last));
    let low = vec2u(x);
    let high = min(low + 1u, last);
    let f = fract(x);
    let top = mix(at(low.x, low.y), at(high.x, low.y), f.x);
    let bottom = mix(at(low.x, high.y), at(high.x, high.y), f.x);
    return vec4f(mix(top, bottom, f.y), 1.0);
}
