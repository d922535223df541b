// Constants of the shaders and values of a frame; nexwarp/export/web/program.py is the same in Python.

import { matrixShapes } from "nexwarp/scene.js";

export const TILE = 16;
export const SHARING = 8;
export const SCAN_BLOCK = 1024;
export const SORT_BLOCK = 2048;
export const FRAME_BYTES = 12 * 16;
export const MODES = ["image", "plain", "textured", "ids", "depth", "weights", "normals", "alpha"];
const MOST_UNROLLED = 1200;
const MOST_UNIFORM = 2 ** 16;
const FOCAL_WITHOUT_DOWN_WEIGHTING = 1e12;
const QUARTERS = (x) => Math.ceil(x / 4);

// Constants of the shaders for one scene: names to WGSL literals.
export function constantsOf(header) {
    const options = header.options;
    const texture = header.texture ?? null;
    const degree = texture === null ? 0 : texture.sh_degree;
    const used = (Math.min(options.sh_degree, degree) + 1) ** 2;
    const features = texture === null ? 2 : texture.features;
    const levels = texture === null ? 1 : texture.levels;
    const plain = Math.min(options.sh_degree, Math.round(Math.sqrt(header.sh_coefficients)) - 1);
    const unsigned = {
        K: options.max_hits,
        SHARING,
        RECORD: options.low_pass ? 5 : 4,
        SH_COEFFICIENTS: header.sh_coefficients,
        PLAIN_COEFFICIENTS: (plain + 1) ** 2,
        TOTAL: Math.ceil((header.surfels * SHARING) / SCAN_BLOCK),
        LEVELS: levels,
        MASK: texture === null ? 0 : texture.table_size - 1,
        INPUTS: QUARTERS(levels * features),
        WIDTH: texture === null ? 1 : QUARTERS(texture.width),
        HIDDEN: texture === null ? 0 : texture.hidden_layers,
        BLOCKS: QUARTERS((degree + 1) ** 2),
        USED_COEFFICIENTS: used,
        USED_BLOCKS: QUARTERS(used),
    };
    const flags = {
        LOW_PASS: options.low_pass,
        LIMITS: options.detail_limits,
        TEXTURED: texture !== null,
        RESIDUAL: texture !== null && texture.residual,
        CLAMP: options.clamp_texture,
    };
    const constants = {};
    for (const [name, value] of Object.entries(unsigned)) {
        constants[name] = `${value}u`;
    }
    for (const [name, value] of Object.entries(flags)) {
        constants[name] = `${value}`;
    }
    return constants;
}

export function number(constants, name) {
    return parseInt(constants[name], 10);
}

// WGSL text of a shader. `texts` holds the .wgsl files by name.
export function sourceOf(name, constants, texts, features, half, unrolled) {
    if (name === "scan" || name === "sort" || name === "blit") {
        return texts[name];
    }
    const lines = [];
    let parts = [texts.common, texts[name]];
    if (name === "shade") {
        const scalar = half ? "f16" : "f32";
        if (half) {
            lines.push("enable f16;");
        }
        lines.push(`alias Scalar = ${scalar};`, `alias Weight = vec4<${scalar}>;`);
        const blocks = mlpBlocks(constants);
        const small = blocks <= MOST_UNROLLED;
        const [kind, size] = isUniform(constants, half) ? ["uniform", `, ${blocks}`] : ["storage, read", ""];
        lines.push(`@group(0) @binding(6) var<${kind}> mlp: array<mat4x4<${scalar}>${size}>;`);
        const mlp = unrolled && small ? unrolledMlp(constants) : texts.mlp;
        parts = [texts.common, texts[`features${features}`], texts.shade, mlp];
    }
    for (const [key, value] of Object.entries(constants)) {
        lines.push(`const ${key}: ${value.endsWith("u") ? "u32" : "bool"} = ${value};`);
    }
    return [...lines, ...parts].join("\n");
}

function unrolledMlp(constants) {
    let inputs = number(constants, "INPUTS");
    const lines = ["fn mlp_color(x: ptr<function, array<Weight, INPUTS>>, direction: vec3f) -> vec3f {"];
    for (let i = 0; i < inputs; i++) {
        lines.push(`    let h0_${i} = (*x)[${i}];`);
    }
    let at = 0;
    const product = (layer) => {
        const terms = [];
        for (let i = 0; i < inputs; i++) {
            terms.push(`block_product(${at + i}u, h${layer}_${i})`);
        }
        at += inputs;
        return terms.join(" + ");
    };
    const hidden = number(constants, "HIDDEN");
    for (let layer = 0; layer < hidden; layer++) {
        for (let o = 0; o < number(constants, "WIDTH"); o++) {
            lines.push(`    let h${layer + 1}_${o} = activation(${product(layer)});`);
        }
        inputs = number(constants, "WIDTH");
    }
    const used = number(constants, "USED_BLOCKS");
    for (let block = 0; block < used; block++) {
        lines.push(`    let b${block} = basis(${block}u, direction) * used(${block}u);`);
    }
    lines.push("    var color = vec3f(0.0);");
    for (let channel = 0; channel < 3; channel++) {
        for (let block = 0; block < number(constants, "BLOCKS"); block++) {
            const text = product(hidden);
            if (block < used) {
                lines.push(`    color[${channel}] += dot(${text}, b${block});`);
            }
        }
    }
    return [...lines, "    return color;", "}"].join("\n");
}

// Whether the weights of the MLP fit into a uniform buffer.
export function isUniform(constants, half) {
    return mlpBlocks(constants) * (half ? 32 : 64) <= MOST_UNIFORM;
}

function mlpBlocks(constants) {
    const [inputs, width, hidden] = ["INPUTS", "WIDTH", "HIDDEN"].map((name) => number(constants, name));
    const last = 3 * number(constants, "BLOCKS");
    return hidden === 0 ? inputs * last : width * (inputs + (hidden - 1) * width + last);
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
            const padded = 4 * QUARTERS(coefficients);
            rows = 3 * padded;
            at = (row, column) => {
                const k = row % padded;
                return k < coefficients ? matrix[(3 * k + Math.floor(row / padded)) * into + column] : 0;
            };
        }
        for (let o = 0; o < QUARTERS(rows); o++) {
            for (let i = 0; i < QUARTERS(into); i++) {
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

// Gains (3) of a camera: the Gaussian process over the photos' poses.
export function gainsOf(exposures, poses, position, direction) {
    const sums = [...exposures.mean];
    const [size, length] = exposures.lengths;
    for (let i = 0; i < poses.length; i += 9) {
        let squares = 0;
        for (let k = 0; k < 3; k++) {
            squares += (poses[i + k] - position[k]) ** 2 + (size * (poses[i + 3 + k] - direction[k])) ** 2;
        }
        const r = Math.sqrt(3 * squares) / length;
        const kernel = (1 + r) * Math.exp(-r);
        for (let k = 0; k < 3; k++) {
            sums[k] += kernel * poses[i + 6 + k];
        }
    }
    return sums.map((x, k) => Math.exp(Math.min(Math.max(x, exposures.lowest[k]), exposures.highest[k])));
}

// The camera with another image size: the same vertical field of view.
export function resized(camera, width, height) {
    const scale = height / camera.height;
    const [fx, fy, cx, cy] = camera.K;
    const K = [fx * scale, fy * scale, (cx - camera.width / 2) * scale + width / 2, (cy - camera.height / 2) * scale + height / 2];
    return { ...camera, K, width, height };
}

export function positionOf(viewmat) {
    return [0, 1, 2].map((k) => -(viewmat[k] * viewmat[3] + viewmat[4 + k] * viewmat[7] + viewmat[8 + k] * viewmat[11]));
}

// Uniform values of a frame: struct Frame of common.wgsl.
export function frameValues(header, poses, camera, settings) {
    const buffer = new ArrayBuffer(FRAME_BYTES);
    const floats = new Float32Array(buffer);
    const words = new Uint32Array(buffer);
    const position = positionOf(camera.viewmat);
    const focal = Math.sqrt(camera.K[0] * camera.K[1]);
    const fades = header.texture === null || header.texture.down_weighting;
    floats.set(camera.viewmat.slice(0, 12), 0);
    floats.set(camera.K, 12);
    floats.set([...position, camera.near ?? header.near], 16);
    floats.set([...header.options.background, fades ? focal : FOCAL_WITHOUT_DOWN_WEIGHTING], 20);
    let gains = [1, 1, 1];
    let falloff = [0, 0, 1, 0];
    if (header.exposures && poses && settings.exposure === "photos") {
        gains = gainsOf(header.exposures, poses, position, camera.viewmat.slice(8, 11));
        const [a, b, largest] = header.exposures.falloff;
        falloff = [a, b, largest, a !== 0 || b !== 0 ? 1 : 0];
    }
    floats.set([...gains, focal], 24);
    floats.set(falloff, 28);
    floats.set([settings.leastWeight, ...settings.depths, 0], 32);
    const size = [camera.width, camera.height];
    words.set([...size, ...size.map((x) => Math.ceil(x / TILE))], 36);
    words.set([header.surfels, settings.capacity, MODES.indexOf(settings.mode), settings.slot], 40);
    words.set([...size.map((x) => Math.ceil(x / settings.step)), settings.step, settings.textured ? 1 : 0], 44);
    return buffer;
}
