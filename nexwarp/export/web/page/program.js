// Constants of the shaders and values of a frame.

import { matrixShapes } from "nexwarp/scene.js";

export const TILE = 16;
export const SHARING = 8; // threads that share a surfel's tile rows
export const SCAN_BLOCK = 1024; // elements of a workgroup of scan.wgsl
export const SORT_BLOCK = 2048; // pairs of a workgroup of sort.wgsl
export const FRAME_BYTES = 12 * 16;
export const MODES = ["image", "plain", "textured", "ids", "depth", "normals"];
const MOST_UNIFORM = 2 ** 16; // bytes of a uniform buffer
const FOCAL_WITHOUT_DOWN_WEIGHTING = 1e12;
const WITHOUT_CONSTANTS = ["scan", "sort", "blit"];
const NO_TEXTURE = { levels: 1, features: 2, table_size: 1, width: 4, hidden_layers: 0, sh_degree: 0, residual: false };

const quarters = (x) => Math.ceil(x / 4);

// Constants of the shaders for one scene: names to numbers and booleans.
export function constantsOf({ options, texture, surfels, sh_coefficients }) {
    const shape = texture ?? NO_TEXTURE;
    const used = (Math.min(options.sh_degree, shape.sh_degree) + 1) ** 2;
    return {
        K: options.max_hits,
        SHARING,
        SH_COEFFICIENTS: sh_coefficients,
        PLAIN_COEFFICIENTS: Math.min((options.sh_degree + 1) ** 2, sh_coefficients),
        TOTAL: Math.ceil((surfels * SHARING) / SCAN_BLOCK),
        LEVELS: shape.levels,
        MASK: shape.table_size - 1,
        INPUTS: quarters(shape.levels * shape.features),
        WIDTH: quarters(shape.width),
        HIDDEN: shape.hidden_layers,
        BLOCKS: quarters((shape.sh_degree + 1) ** 2),
        USED_COEFFICIENTS: used,
        USED_BLOCKS: quarters(used),
        LIMITS: options.detail_limits,
        TEXTURED: texture !== null,
        RESIDUAL: shape.residual,
        CLAMP: options.clamp_texture,
    };
}

// WGSL text of a shader. `texts` holds the .wgsl files by name, `half` says whether the MLP is in half precision.
export function sourceOf(name, constants, texts, features, half) {
    if (WITHOUT_CONSTANTS.includes(name)) return texts[name];
    const lines = [];
    let parts = [texts.common, texts[name]];
    if (name === "shade") {
        const scalar = half ? "f16" : "f32";
        if (half) lines.push("enable f16;");
        lines.push(`alias Scalar = ${scalar};`, `alias Weight = vec4<${scalar}>;`);
        const [kind, size] = isUniform(constants, half) ? ["uniform", `, ${mlpBlocks(constants)}`] : ["storage, read", ""];
        lines.push(`@group(0) @binding(6) var<${kind}> mlp: array<mat4x4<${scalar}>${size}>;`);
        parts = [texts.common, texts[`features${features}`], texts.shade];
    }
    for (const [key, value] of Object.entries(constants)) {
        lines.push(typeof value === "number" ? `const ${key}: u32 = ${value}u;` : `const ${key}: bool = ${value};`);
    }
    return [...lines, ...parts].join("\n");
}

// Whether the weights of the MLP fit into a uniform buffer.
export function isUniform(constants, half) {
    return mlpBlocks(constants) * (half ? 32 : 64) <= MOST_UNIFORM;
}

function mlpBlocks({ INPUTS, WIDTH, HIDDEN, BLOCKS }) {
    const last = 3 * BLOCKS;
    return HIDDEN === 0 ? INPUTS * last : WIDTH * (INPUTS + (HIDDEN - 1) * WIDTH + last);
}

// The MLP's matrices in the order of shade.wgsl.
export function packedMatrices(texture, weights) {
    const blocks = [];
    let start = 0;
    const shapes = matrixShapes(texture);
    shapes.forEach(([out, into], layer) => {
        const matrix = weights.subarray(start, start + out * into);
        start += out * into;
        let rows = out;
        let at = (row, column) => matrix[row * into + column];
        if (layer === shapes.length - 1) {
            // By channel, then coefficient, coefficients padded to a multiple of four.
            const coefficients = out / 3;
            const padded = 4 * quarters(coefficients);
            rows = 3 * padded;
            at = (row, column) => {
                const k = row % padded;
                return k < coefficients ? matrix[(3 * k + Math.floor(row / padded)) * into + column] : 0;
            };
        }
        for (let o = 0; o < quarters(rows); o++) {
            for (let i = 0; i < quarters(into); i++) {
                for (let column = 4 * i; column < 4 * i + 4; column++) {
                    for (let row = 4 * o; row < 4 * o + 4; row++) {
                        blocks.push(row < rows && column < into ? at(row, column) : 0);
                    }
                }
            }
        }
    });
    return Float32Array.from(blocks);
}

// Gains (3) of a camera: the Gaussian process over the photos' poses (nexwarp/model/exposures.py).
export function gainsOf(exposures, poses, viewmat) {
    const position = positionOf(viewmat);
    const sums = [...exposures.mean];
    const [size, length] = exposures.lengths;
    for (let i = 0; i < poses.length; i += 9) {
        let squares = 0;
        for (let k = 0; k < 3; k++) {
            squares += (poses[i + k] - position[k]) ** 2 + (size * (poses[i + 3 + k] - viewmat[8 + k])) ** 2;
        }
        const r = Math.sqrt(3 * squares) / length;
        const kernel = (1 + r) * Math.exp(-r);
        for (let k = 0; k < 3; k++) sums[k] += kernel * poses[i + 6 + k];
    }
    return sums.map((x, k) => Math.exp(Math.min(Math.max(x, exposures.lowest[k]), exposures.highest[k])));
}

// The camera with another image size: the same vertical field of view.
export function resized(camera, width, height) {
    const scale = height / camera.height;
    const [fx, fy, cx, cy] = camera.K;
    const K = [fx * scale, fy * scale, (cx - camera.width / 2) * scale + width / 2, cy * scale];
    return { ...camera, K, width, height };
}

export function positionOf(viewmat) {
    return [0, 1, 2].map((k) => -(viewmat[k] * viewmat[3] + viewmat[4 + k] * viewmat[7] + viewmat[8 + k] * viewmat[11]));
}

// Direction of the ray through a place of the image, world frame, with a z-depth of 1.
export function rayOf({ viewmat, K: [fx, fy, cx, cy] }, x, y) {
    return [0, 1, 2].map((k) => (viewmat[k] * (x - cx)) / fx + (viewmat[4 + k] * (y - cy)) / fy + viewmat[8 + k]);
}

// Depths that the depth picture shows from dark to bright: those of a ball around the scene.
export function depthSpan({ bounds: [low, high] }, viewmat) {
    const eye = positionOf(viewmat);
    const radius = Math.hypot(...low.map((x, i) => (high[i] - x) / 2)) || 1;
    const away = Math.hypot(...low.map((x, i) => (x + high[i]) / 2 - eye[i]));
    return [Math.max(away - radius, 0), away + radius];
}

// Uniform values of a frame: struct Frame of common.wgsl.
export function frameValues(header, poses, camera, settings) {
    const buffer = new ArrayBuffer(FRAME_BYTES);
    const floats = new Float32Array(buffer);
    const words = new Uint32Array(buffer);
    const focal = Math.sqrt(camera.K[0] * camera.K[1]);
    const fades = header.texture === null || header.texture.down_weighting;
    let gains = [1, 1, 1];
    let falloff = [0, 0, 1, 0];
    if (header.exposures && poses && settings.exposure === "photos") {
        gains = gainsOf(header.exposures, poses, camera.viewmat);
        const [a, b, largest] = header.exposures.falloff;
        falloff = [a, b, largest, a !== 0 || b !== 0 ? 1 : 0];
    }
    floats.set(camera.viewmat.slice(0, 12), 0);
    floats.set(camera.K, 12);
    floats.set([...positionOf(camera.viewmat), camera.near ?? header.near], 16);
    floats.set([...header.options.background, fades ? focal : FOCAL_WITHOUT_DOWN_WEIGHTING], 20);
    floats.set([...gains, focal], 24);
    floats.set(falloff, 28);
    floats.set([settings.leastWeight, ...settings.depths, 0], 32);
    const size = [camera.width, camera.height];
    words.set([...size, ...size.map((x) => Math.ceil(x / TILE))], 36);
    words.set([header.surfels, settings.capacity, MODES.indexOf(settings.mode), 0], 40);
    words.set([...size.map((x) => Math.ceil(x / settings.step)), settings.step, settings.textured ? 1 : 0], 44);
    return buffer;
}
