// Shared by all passes. The page puts constants before this text: see `sourceOf` in program.js.
//
// A surfel is stored for the walk along a ray as RECORD rows (nexwarp/kernels/surfel.py):
//   row 0   a = (v2 x c) / s1, opacity        u = (a . d) / (n . d)
//   row 1   b = (c x v1) / s2, gamma 1        v = (b . d) / (n . d)
//   row 2   n, gamma 2                        t = m / (n . d)
//   row 3   plain colour, m = c . n
// with c its centre and v1, v2, n its axes in the camera frame.

const TILE: u32 = 16u;
const RECORD: u32 = 4u;
const ALPHA_MIN: f32 = 1.0 / 255.0;
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const TINY: f32 = 1e-20;
const MODE_IMAGE: u32 = 0u;
const MODE_PLAIN: u32 = 1u;
const MODE_TEXTURED: u32 = 2u;
const MODE_IDS: u32 = 3u;
const MODE_DEPTH: u32 = 4u;
const MODE_NORMALS: u32 = 5u;

struct Frame {
    row0: vec4f,  // world to camera, by rows
    row1: vec4f,
    row2: vec4f,
    intrinsics: vec4f,  // fx, fy, cx, cy [pixels]
    position: vec4f,  // camera centre, world; near
    background: vec4f,  // colour; focal length of the down-weighting
    gains: vec4f,  // exposure; focal length [pixels]
    falloff: vec4f,  // a, b, T of the lens; 1 where it has a falloff
    limits: vec4f,  // least weight of a textured second hit; depths at the ends of the colour scale; unused
    size: vec4u,  // width, height [pixels]; tile columns and rows
    counts: vec4u,  // surfels; capacity of the tile lists; mode; unused
    texels: vec4u,  // width and height of the texel grid; pixels between texels; whether the texture is complete
}

@group(0) @binding(0) var<uniform> frame: Frame;

fn rotate(x: vec3f) -> vec3f {
    return vec3f(dot(frame.row0.xyz, x), dot(frame.row1.xyz, x), dot(frame.row2.xyz, x));
}

fn rotate_back(x: vec3f) -> vec3f {
    return frame.row0.xyz * x.x + frame.row1.xyz * x.y + frame.row2.xyz * x.z;
}

// Direction of the ray through the centre of a pixel, camera frame; its z is 1.
fn ray_of(pixel: vec2u) -> vec3f {
    return vec3f((vec2f(pixel) + 0.5 - frame.intrinsics.zw) / frame.intrinsics.xy, 1.0);
}

// Four basis functions of spherical harmonics at a unit direction: those of index 4 block to 4 block + 3.
fn basis(block: u32, d: vec3f) -> vec4f {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    switch block {
        case 0u: {
            return vec4f(0.28209479177387814, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x);
        }
        case 1u: {
            return vec4f(
                1.0925484305920792 * x * y,
                -1.0925484305920792 * y * z,
                0.31539156525252005 * (2.0 * z * z - x * x - y * y),
                -1.0925484305920792 * x * z,
            );
        }
        case 2u: {
            return vec4f(
                0.5462742152960396 * (x * x - y * y),
                -0.5900435899266435 * y * (3.0 * x * x - y * y),
                2.890611442640554 * x * y * z,
                -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y),
            );
        }
        default: {
            return vec4f(
                0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
                -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y),
                1.445305721320277 * z * (x * x - y * y),
                -0.5900435899266435 * x * (x * x - 3.0 * y * y),
            );
        }
    }
}
