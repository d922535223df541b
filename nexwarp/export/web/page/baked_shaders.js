// The WebGL2 shaders of the baked scene: kernel, hit, detail limits and SH are those of the exact renderer.

const COMMON = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
`;

// An instance is a surfel, a vertex a corner of its support. The kernel is paper Eq. 3.
export const QUADS_VERTEX = `${COMMON}
const int PER_ROW = 128;
const float FILTER = 0.125;
uniform sampler2D geometry, harmonics;
uniform mat4 viewmat;
uniform vec4 intrinsics;
uniform vec2 size;
uniform vec3 eye;
uniform float bands[3]; // ranges of degrees 1 to 3
uniform float near;
uniform int mode, coefficients;
in uint surfel;
out vec2 local;
flat out vec3 kernel; // opacity, gammas
flat out vec4 box;
flat out vec4 rect;
flat out vec3 plain;
flat out vec3 normal;
flat out vec2 blur;
out float depth;

vec4 texel(int k) {
  int i = int(surfel);
  return texelFetch(geometry, ivec2((i % PER_ROW) * 8 + k, i / PER_ROW), 0);
}

vec3 coefficient(int k, float range) {
  int i = int(surfel), count = textureSize(harmonics, 0).x / PER_ROW;
  vec3 code = texelFetch(harmonics, ivec2((i % PER_ROW) * count + k - 1, i / PER_ROW), 0).rgb * 255.0 - 128.0;
  return sign(code) * code * code * (range / 16129.0);
}

vec3 color(vec3 d, vec3 constant) {
  vec3 c = vec3(0.5) + 0.28209479177387814 * constant;
  if (coefficients >= 4) {
    float b = 0.4886025119029199;
    c += -b * d.y * coefficient(1, bands[0]) + b * d.z * coefficient(2, bands[0]) - b * d.x * coefficient(3, bands[0]);
  }
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  if (coefficients >= 9) {
    c += 1.0925484305920792 * (d.x * d.y * coefficient(4, bands[1]) - d.y * d.z * coefficient(5, bands[1]) - d.x * d.z * coefficient(7, bands[1]));
    c += 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6, bands[1]);
    c += 0.5462742152960396 * (xx - yy) * coefficient(8, bands[1]);
  }
  if (coefficients >= 16) {
    c += -0.5900435899266435 * d.y * (3.0 * xx - yy) * coefficient(9, bands[2]);
    c += 2.890611442640554 * d.x * d.y * d.z * coefficient(10, bands[2]);
    c += -0.4570457994644658 * d.y * (4.0 * zz - xx - yy) * coefficient(11, bands[2]);
    c += 0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12, bands[2]);
    c += -0.4570457994644658 * d.x * (4.0 * zz - xx - yy) * coefficient(13, bands[2]);
    c += 1.445305721320277 * d.z * (xx - yy) * coefficient(14, bands[2]);
    c += -0.5900435899266435 * d.x * (xx - 3.0 * yy) * coefficient(15, bands[2]);
  }
  return max(c, vec3(0.0));
}

vec3 hashed(uint x) {
  x = (x + 1u) * 2654435761u;
  x ^= x >> 15;
  x *= 2246822519u;
  x ^= x >> 13;
  return vec3(uvec3(x, x >> 8, x >> 16) & 255u) / 255.0;
}

void main() {
  vec4 across = texel(0), along = texel(1), centre = texel(2), shape = texel(3);
  vec2 scales = vec2(across.w, along.w), gammas = shape.xy;
  float opacity = centre.w;
  // Surfels farther away than in any training view are blurred, so that those smaller than a pixel do not alias.
  float pixel = (viewmat * vec4(centre.xyz, 1.0)).z / sqrt(intrinsics.x * intrinsics.y);
  if (pixel > shape.z) {
    float variance = FILTER * (pixel * pixel - shape.z * shape.z);
    vec2 wide = sqrt(scales * scales + variance), share = scales / wide;
    opacity *= share.x * share.y;
    gammas = 1.0 + (gammas - 1.0) * share * share;
    scales = wide;
  }
  float limit = 2.0 * log(255.0 * opacity) + 1e-3;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (limit <= 0.0) return;
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  local = corner * pow(vec2(limit), 0.5 / gammas);
  vec2 offset = local * scales;
  vec3 position = centre.xyz + offset.x * across.xyz + offset.y * along.xyz;
  vec3 x = (viewmat * vec4(position, 1.0)).xyz;
  // The near plane clips hits with a depth of at most near; nothing is clipped at the far end.
  vec2 place = (intrinsics.xy * x.xy + intrinsics.zw * x.z) / size * 2.0;
  gl_Position = vec4(place.x - x.z, x.z - place.y, x.z - 2.0 * near, x.z);
  depth = x.z;
  local *= scales / vec2(across.w, along.w); // in the units of the box
  kernel = vec3(opacity, gammas);
  box = texel(4);
  rect = texel(5);
  normal = texel(7).xyz;
  if (dot(normal, centre.xyz - eye) > 0.0) normal = -normal;
  plain = mode == 2 ? hashed(surfel) : color(normalize(centre.xyz - eye), texel(6).xyz);
  blur = vec2(across.w, along.w) / scales;
}
`;

export const QUADS_FRAGMENT = `${COMMON}
const float ALPHA_MIN = 1.0 / 255.0, ALPHA_MAX = 0.99, TINY = 1e-20;
uniform sampler2D atlas;
uniform vec3 atlasScale; // width, height, value of 127 steps
uniform int mode;
in vec2 local;
flat in vec3 kernel;
flat in vec4 box;
flat in vec4 rect;
flat in vec3 plain;
flat in vec3 normal;
flat in vec2 blur;
in float depth;
out vec4 result;

void main() {
  vec2 place = local * blur;
  vec2 powers = pow(max(place * place, vec2(TINY)), kernel.yz);
  float alpha = min(kernel.x * exp(-0.5 * (powers.x + powers.y)), ALPHA_MAX);
  if (!(alpha >= ALPHA_MIN)) discard;
  vec3 color = plain;
  if (mode == 0) {
    vec2 share = clamp((local - box.xy) / max(box.zw - box.xy, vec2(1e-12)), 0.0, 1.0);
    vec2 texel = (rect.xy + 0.5 + share * rect.zw) / atlasScale.xy;
    vec3 code = texture(atlas, texel).rgb * 255.0 - 128.0;
    color = max(color + code * (atlasScale.z / 127.0), vec3(0.0));
  } else if (mode == 3) {
    color = vec3(depth);
  } else if (mode == 4) {
    color = normal;
  }
  result = vec4(color * alpha, alpha);
}
`;

export const RESOLVE_VERTEX = `${COMMON}
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}
`;

export const RESOLVE_FRAGMENT = `${COMMON}
uniform sampler2D frame;
uniform vec3 background, gains, falloff;
uniform vec4 intrinsics, part; // part of the output: left, bottom, width, height
uniform vec2 size, span;
uniform float cover; // opacity of the background
uniform int mode;
out vec4 result;

// A polynomial close to the colour map viridis.
vec3 viridis(float t) {
  const vec3 c0 = vec3(0.2777, 0.0054, 0.3341), c1 = vec3(0.1051, 1.4046, 1.3846), c2 = vec3(-0.3309, 0.2148, 0.0951);
  const vec3 c3 = vec3(-4.6342, -5.7991, -19.3324), c4 = vec3(6.2283, 14.1799, 56.6906), c5 = vec3(4.7764, -13.7451, -65.3530);
  const vec3 c6 = vec3(-5.4355, 4.6459, 26.3124);
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}

void main() {
  vec2 place = (gl_FragCoord.xy - part.xy) / part.zw;
  vec4 x = texture(frame, place);
  vec3 color = x.rgb;
  if (mode <= 1) {
    color += cover * (1.0 - x.a) * background;
    vec2 pixel = vec2(place.x, 1.0 - place.y) * size;
    vec2 ray = (pixel - intrinsics.zw) / intrinsics.xy;
    float t = min(dot(ray, ray) / falloff.z, 1.0);
    color *= gains * exp(t * (falloff.x + falloff.y * t));
  } else if (mode == 3) {
    color = x.a > 0.0 ? viridis(clamp((x.r / x.a - span.x) / max(span.y - span.x, 1e-12), 0.0, 1.0)) : vec3(0.0);
  } else if (mode == 4) {
    color = length(color) > 0.0 ? normalize(color) * 0.5 + 0.5 : vec3(0.0);
  }
  result = vec4(color, max(x.a, cover));
}
`;
