// Reader of scene files and baked scenes (FORMAT.md): checks what the header says before anything is allocated, and
// unpacks section by section while the file arrives.

export class SceneError extends Error {
    constructor(message) {
        super(message);
        this.name = "SceneError";
    }
}

const VERSION = 1;
const LARGEST_HEADER = 4 * 2 ** 20;
const LARGEST_SURFELS = 2 ** 24;
const LARGEST_SECTION = 2 ** 30;
// Bytes that a file may unpack to: so many, and so many times its size.
const UNPACKED = 2 ** 27;
const LARGEST_RATIO = 128;
const LARGEST_VALUE = 1e16;
const LARGEST_SIDE = 16384; // of the atlas of a baked scene
const NEVER = 1e30;
const CHUNK = 256;
const COEFFICIENTS = [1, 4, 9, 16]; // of SH degrees 0 to 3
const SIZES = { u8: 1, u16: 2, u32: 4, f16: 2, f32: 4 };
const ARRAYS = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array, f16: Uint16Array, f32: Float32Array };

function expect(condition, message) {
    if (!condition) throw new SceneError(`scene file: ${message}`);
}

function isInteger(value, low, high) {
    return Number.isInteger(value) && value >= low && value <= high;
}

function areNumbers(values, count, low = -1e30, high = 1e30) {
    const inside = (x) => typeof x === "number" && x >= low && x <= high;
    return Array.isArray(values) && values.length === count && values.every(inside);
}

function isObject(value) {
    return typeof value === "object" && value !== null && !Array.isArray(value);
}

// Throws SceneError unless the header is one that scenes and baked scenes may have.
function checkHeader(header) {
    expect(isObject(header), "expected a JSON object as the header");
    expect(header.format_version === VERSION, `expected format version ${VERSION}`);
    expect(isInteger(header.surfels, 0, LARGEST_SURFELS), `surfels: expected at most ${LARGEST_SURFELS}`);
    expect(COEFFICIENTS.includes(header.sh_coefficients), `sh_coefficients: expected one of ${COEFFICIENTS}`);
    const options = header.options;
    expect(isObject(options), "options: expected an object");
    expect(isInteger(options.sh_degree, 0, 3), "options.sh_degree: expected 0 to 3");
    expect(areNumbers(options.background, 3, -1e6, 1e6), "options.background: expected three numbers");
    expect(options.low_pass !== true, "options.low_pass: expected false, the filter has been removed");
    checkExposures(header.exposures);
    checkCameras(header);
    expect(Array.isArray(header.sections) && header.sections.every(isObject), "sections: expected a list of objects");
    expect(header.sections.length <= 32, "sections: expected at most 32");
}

function checkScene(header) {
    const { options, quality } = header;
    expect(quality === "quantised" || quality === "full", "quality: expected quantised or full");
    expect(isInteger(options.max_hits, 0, 8), "options.max_hits: expected 0 to 8");
    for (const name of ["clamp_texture", "detail_limits"]) {
        expect(typeof options[name] === "boolean", `options.${name}: expected true or false`);
    }
    checkTexture(header.texture);
}

function checkTexture(texture) {
    if (texture === null) return;
    expect(isObject(texture), "texture: expected an object");
    const ranges = { levels: [1, 64], table_size: [1, 2 ** 26], width: [1, 4096], hidden_layers: [0, 64], sh_degree: [0, 3] };
    for (const [name, [low, high]] of Object.entries(ranges)) {
        expect(isInteger(texture[name], low, high), `texture.${name}: expected ${low} to ${high}`);
    }
    expect((texture.table_size & (texture.table_size - 1)) === 0, "texture.table_size: expected a power of two");
    expect([1, 2, 4, 8].includes(texture.features), "texture.features: expected 1, 2, 4 or 8");
    for (const name of ["residual", "down_weighting"]) {
        expect(typeof texture[name] === "boolean", `texture.${name}: expected true or false`);
    }
    expect(areNumbers(texture.resolutions, texture.levels, 1e-30, 1e10), "texture.resolutions: expected one a level");
}

function checkExposures(exposures) {
    if (exposures === null) return;
    expect(isObject(exposures) && isInteger(exposures.count, 1, 30000), "exposures.count: expected 1 to 30000");
    for (const [name, count] of Object.entries({ mean: 3, lengths: 2, falloff: 3, lowest: 3, highest: 3 })) {
        expect(areNumbers(exposures[name], count), `exposures.${name}: expected ${count} numbers`);
    }
}

function checkCameras({ cameras, start, center, radius, metres, up, near, bounds }) {
    expect(Array.isArray(cameras) && cameras.length <= 1000, "cameras: expected a list of at most 1000");
    for (const camera of cameras) {
        const good =
            isObject(camera) &&
            typeof camera.name === "string" &&
            areNumbers(camera.viewmat, 16, -1e16, 1e16) &&
            areNumbers(camera.K, 4, -1e9, 1e9) &&
            camera.K[0] > 0 &&
            camera.K[1] > 0 &&
            isInteger(camera.width, 1, 65536) &&
            isInteger(camera.height, 1, 65536) &&
            areNumbers([camera.near], 1, 0, 1e16);
        expect(good, "cameras: expected name, viewmat, K, width, height and near");
    }
    expect(isInteger(start, 0, Math.max(cameras.length - 1, 0)), "start: expected the index of a camera");
    expect(areNumbers(center, 3) && areNumbers(up, 3), "center, up: expected three numbers each");
    expect(areNumbers([near], 1, 0, 1e16), "near: expected a number");
    const points = Array.isArray(bounds) && bounds.length === 2 && bounds.every((point) => areNumbers(point, 3));
    expect(points, "bounds: expected two points");
    for (const [name, x] of Object.entries({ radius, metres })) {
        expect(x === null || (areNumbers([x], 1) && x > 0), `${name}: expected a number above 0`);
    }
}

function checkBaked({ atlas, sh_coefficients: coefficients, sh_ranges: ranges }) {
    const sizes = isObject(atlas) && isInteger(atlas.width, 1, LARGEST_SIDE) && isInteger(atlas.height, 1, LARGEST_SIDE);
    expect(sizes && areNumbers([atlas.scale], 1) && /^[\w-]+\.webp$/.test(atlas.file), "atlas: expected a picture's file");
    expect(areNumbers(ranges, Math.max(3, Math.sqrt(coefficients) - 1)), "sh_ranges: expected three numbers");
}

// Shapes (out, in) of the MLP's matrices.
export function matrixShapes(texture) {
    const hidden = Array(texture.hidden_layers).fill(texture.width);
    const sizes = [texture.levels * texture.features, ...hidden, 3 * (texture.sh_degree + 1) ** 2];
    return sizes.slice(1).map((out, i) => [out, sizes[i]]);
}

// The sections that a scene's header describes, in order: [name, dtype, shape].
function sceneSections(header) {
    const { surfels: count, sh_coefficients: coefficients, texture, options } = header;
    const full = header.quality === "full";
    const limits = (...sections) => (options.detail_limits ? sections : []);
    const sections = full
        ? [
              ["means", "f32", [count, 3]],
              ["quats", "f32", [count, 4]],
              ["scales", "f32", [count, 2]],
              ["opacities", "f32", [count]],
              ["gammas", "f32", [count, 2]],
              ...limits(["limits", "f32", [count, 2]]),
              ["sh", "f32", [count, coefficients, 3]],
          ]
        : [
              ["ranges", "f32", [Math.ceil(count / CHUNK), 7 + Math.sqrt(coefficients), 2]],
              ["means", "u16", [3, count]],
              ["quats", "u32", [count]],
              ["scales", "u16", [2, count]],
              ["opacities", "u8", [count]],
              ["gammas", "u8", [2, count]],
              ...limits(["limits_scale", "f32", [2]], ["limits", "u16", [2, count]]),
              ["sh", "u8", [coefficients * 3, count]],
          ];
    if (header.exposures !== null) sections.push(["exposures", "f32", [header.exposures.count, 9]]);
    if (texture !== null) {
        const weights = matrixShapes(texture).reduce((sum, [out, into]) => sum + out * into, 0);
        sections.push(["mlp", full ? "f32" : "f16", [weights]]);
        if (!full) sections.push(["grid_ranges", "f32", [texture.levels, 2]]);
        sections.push(["grid", full ? "f16" : "u8", [texture.levels, texture.table_size, texture.features]]);
    }
    return sections;
}

function bakedSections({ surfels: count, sh_coefficients: coefficients, exposures }) {
    return [
        ["means", "f32", [count, 3]],
        ["quats", "u16", [count, 4]],
        ["scales", "f32", [count, 2]],
        ["opacities", "f32", [count]],
        ["gammas", "f32", [count, 2]],
        ["farthest", "f32", [count]],
        ["boxes", "f32", [count, 4]],
        ["rects", "u16", [count, 4]],
        ["sh0", "f32", [count, 3]],
        ...(exposures === null ? [] : [["exposures", "f32", [exposures.count, 9]]]),
        ["shN", "u8", [count, coefficients - 1, 3]],
    ];
}

// Kinds of files: the magic, what the header must hold beside, and the sections.
export const SCENE = { magic: "NXWSCENE", check: checkScene, sections: sceneSections };
export const BAKED = { magic: "NXWBAKED", check: checkBaked, sections: bakedSections };

// Bytes from a stream, in pieces of the sizes that are asked for.
class ByteReader {
    constructor(stream, onBytes) {
        this.reader = stream.getReader();
        this.parts = [];
        this.held = 0;
        this.position = 0;
        this.onBytes = onBytes;
        this.received = 0;
    }

    // Nothing is allocated before the bytes have arrived.
    async read(count) {
        while (this.held < count) {
            const { done, value } = await this.reader.read();
            if (done) throw new SceneError("scene file: the file ends before its content does");
            this.parts.push(value);
            this.held += value.length;
            this.received += value.length;
            this.onBytes(this.received);
        }
        const bytes = new Uint8Array(count);
        let filled = 0;
        while (filled < count) {
            const part = this.parts[0];
            const taken = Math.min(part.length, count - filled);
            bytes.set(part.subarray(0, taken), filled);
            filled += taken;
            if (taken === part.length) {
                this.parts.shift();
            } else {
                this.parts[0] = part.subarray(taken);
            }
        }
        this.held -= count;
        this.position += count;
        return bytes;
    }

    async cancel() {
        await this.reader.cancel().catch(() => {});
    }
}

function unpackedSize(entry) {
    return entry.shape.reduce((product, one) => product * one, SIZES[entry.dtype]);
}

async function inflate(bytes, size, name) {
    const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
    const content = new Uint8Array(size);
    let filled = 0;
    try {
        for (;;) {
            const { done, value } = await reader.read();
            if (done) break;
            expect(filled + value.length <= size, `section ${name}: expected ${size} bytes, got more`);
            content.set(value, filled);
            filled += value.length;
        }
    } catch (error) {
        await reader.cancel().catch(() => {});
        throw error instanceof SceneError ? error : new SceneError(`scene file: section ${name}: damaged data`);
    }
    expect(filled === size, `section ${name}: expected ${size} bytes, got ${filled}`);
    return content;
}

export class SceneReader {
    constructor(stream, onBytes = () => {}, kind = SCENE) {
        this.kind = kind;
        this.bytes = new ByteReader(stream, onBytes);
        this.arrays = {};
        this.header = null;
        this.poster = null;
    }

    // Reads and checks the header, and the poster if there is one.
    async readHeader() {
        const start = await this.bytes.read(16);
        expect(String.fromCharCode(...start.subarray(0, 8)) === this.kind.magic, `expected ${this.kind.magic} at the start`);
        const view = new DataView(start.buffer);
        expect(view.getUint32(8, true) === VERSION, `expected format version ${VERSION}, got ${view.getUint32(8, true)}`);
        const length = view.getUint32(12, true);
        expect(length <= LARGEST_HEADER, `expected a header of at most ${LARGEST_HEADER} bytes, got ${length}`);
        let header;
        try {
            header = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(await this.bytes.read(length)));
        } catch (error) {
            throw error instanceof SceneError ? error : new SceneError("scene file: expected a JSON header");
        }
        header = isObject(header) ? { texture: null, exposures: null, radius: null, metres: null, ...header } : header;
        checkHeader(header);
        this.kind.check(header);
        this.base = 16 + length;
        this.entries = [...header.sections];
        if (this.entries[0]?.name === "poster") {
            const entry = this.entries.shift();
            expect(isInteger(entry.bytes, 0, 2 ** 24) && entry.encoding === "raw", "poster: expected at most 16 MiB");
            this.poster = new Blob([await this.content(entry, entry.bytes)], { type: "image/jpeg" });
        }
        const expected = JSON.stringify(this.kind.sections(header));
        const listed = JSON.stringify(this.entries.map((entry) => [entry.name, entry.dtype, entry.shape]));
        expect(listed === expected, "expected the sections that the header describes");
        const unpacked = this.entries.reduce((sum, entry) => sum + unpackedSize(entry), 0);
        const stored = this.entries.reduce((sum, entry) => sum + (isInteger(entry.bytes, 0, 2 ** 40) ? entry.bytes : 0), 0);
        const most = UNPACKED + LARGEST_RATIO * stored;
        expect(unpacked <= most, `expected sections that unpack to at most ${most} bytes, got ${unpacked}`);
        this.header = header;
        return header;
    }

    // Size of the file in bytes.
    get total() {
        return this.base + this.entries.reduce((end, entry) => Math.max(end, entry.offset + entry.bytes), 0);
    }

    async content(entry, size) {
        expect(isInteger(entry.bytes, 0, size), `section ${entry.name}: expected at most ${size} bytes`);
        const skipped = this.base + entry.offset - this.bytes.position;
        expect(isInteger(entry.offset, 0, 2 ** 40) && isInteger(skipped, 0, 64), `section ${entry.name}: wrong offset`);
        await this.bytes.read(skipped);
        return this.bytes.read(entry.bytes);
    }

    // Reads sections up to and including the one with this name.
    async readTo(name) {
        while (this.entries.length > 0 && !(name in this.arrays)) {
            const entry = this.entries.shift();
            const size = unpackedSize(entry);
            expect(size <= LARGEST_SECTION, `section ${entry.name}: expected at most ${LARGEST_SECTION} bytes, got ${size}`);
            let bytes = await this.content(entry, size);
            expect(["raw", "deflate"].includes(entry.encoding), `section ${entry.name}: expected the encoding raw or deflate`);
            if (entry.encoding === "deflate") bytes = await inflate(bytes, size, entry.name);
            expect(bytes.length === size, `section ${entry.name}: expected ${size} bytes, got ${bytes.length}`);
            this.arrays[entry.name] = new ARRAYS[entry.dtype](bytes.buffer, 0, size / SIZES[entry.dtype]);
        }
        return this.arrays[name];
    }

    async cancel() {
        await this.bytes.cancel();
    }
}

export function checkValues(name, values, largest) {
    for (let i = 0; i < values.length; i++) {
        if (!(Math.abs(values[i]) <= largest)) {
            throw new SceneError(`scene file: section ${name}: expected finite values of at most ${largest}`);
        }
    }
    return values;
}

// Surfels as the shaders take them: geometry (N x 12), detail limits (N x 2) or null, SH (N x C x 3).
export function unpackSurfels(header, arrays) {
    const count = header.surfels;
    const geometry = new Float32Array(12 * count);
    const full = header.quality === "full";
    const unpacked = full ? arrays : dequantised(header, arrays);
    for (let i = 0; i < count; i++) {
        const row = 12 * i;
        for (let k = 0; k < 3; k++) geometry[row + k] = unpacked.means[3 * i + k];
        geometry[row + 3] = unpacked.opacities[i];
        for (let k = 0; k < 4; k++) geometry[row + 4 + k] = unpacked.quats[4 * i + k];
        for (let k = 0; k < 2; k++) {
            geometry[row + 8 + k] = unpacked.scales[2 * i + k];
            geometry[row + 10 + k] = unpacked.gammas[2 * i + k];
        }
    }
    checkValues("surfels", geometry, LARGEST_VALUE);
    checkValues("sh", unpacked.sh, LARGEST_VALUE);
    const limits = header.options.detail_limits ? checkValues("limits", unpacked.limits, NEVER * 1.001) : null;
    return { geometry, limits, sh: unpacked.sh };
}

const QUAT_LIMITS = [Math.SQRT1_2, Math.SQRT1_2, Math.sin(Math.PI / 8)];

function dequantised(header, arrays) {
    const count = header.surfels;
    const coefficients = header.sh_coefficients;
    const bands = Math.round(Math.sqrt(coefficients));
    const columns = 7 + bands;
    const means = new Float32Array(3 * count);
    const quats = new Float32Array(4 * count);
    const scales = new Float32Array(2 * count);
    const opacities = new Float32Array(count);
    const gammas = new Float32Array(2 * count);
    const limits = header.options.detail_limits ? new Float32Array(2 * count) : null;
    const sh = new Float32Array(3 * coefficients * count);
    const value = (i, column, code) => {
        const at = 2 * (Math.floor(i / CHUNK) * columns + column);
        return arrays.ranges[at] + arrays.ranges[at + 1] * code;
    };
    for (let i = 0; i < count; i++) {
        for (let k = 0; k < 3; k++) means[3 * i + k] = value(i, k, arrays.means[k * count + i]);
        for (let k = 0; k < 2; k++) {
            scales[2 * i + k] = Math.exp(value(i, 3 + k, arrays.scales[k * count + i]));
            gammas[2 * i + k] = Math.max(Math.exp(value(i, 5 + k, arrays.gammas[k * count + i])), 1);
        }
        opacities[i] = arrays.opacities[i] / 255;
        const code = arrays.quats[i];
        const x = ((code & 2047) / 2047 * 2 - 1) * QUAT_LIMITS[0];
        const y = (((code >>> 11) & 2047) / 2047 * 2 - 1) * QUAT_LIMITS[1];
        const z = ((code >>> 22) / 1023 * 2 - 1) * QUAT_LIMITS[2];
        const w = Math.sqrt(Math.max(1 - x * x - y * y - z * z, 0));
        const length = Math.hypot(w, x, y, z);
        quats.set([w / length, x / length, y / length, z / length], 4 * i);
        if (limits !== null) {
            for (let k = 0; k < 2; k++) {
                const step = arrays.limits[k * count + i];
                const known = Math.exp(arrays.limits_scale[0] + arrays.limits_scale[1] * (step - 1));
                limits[2 * i + k] = step === 65535 ? NEVER : step === 0 ? 0 : known;
            }
        }
        for (let k = 0; k < coefficients; k++) {
            const band = 7 + Math.floor(Math.sqrt(k));
            for (let c = 0; c < 3; c++) {
                sh[3 * (coefficients * i + k) + c] = value(i, band, arrays.sh[(3 * k + c) * count + i]);
            }
        }
    }
    return { means, quats, scales, opacities, gammas, limits, sh };
}

const float = new Float32Array(1);
const bits = new Uint32Array(float.buffer);

// Bits of the half-precision number next to x, ties to even.
export function toHalf(x) {
    float[0] = x;
    const sign = (bits[0] >>> 16) & 0x8000;
    const magnitude = bits[0] & 0x7fffffff;
    if (magnitude >= 0x47800000) return sign | (magnitude > 0x7f800000 ? 0x7e00 : 0x7c00);
    if (magnitude < 0x38800000) {
        // Subnormal: a multiple of 2^-24.
        const steps = Math.abs(x) * 2 ** 24;
        const low = Math.floor(steps);
        const rest = steps - low;
        return sign | (rest > 0.5 || (rest === 0.5 && low % 2 === 1) ? low + 1 : low);
    }
    const rounded = magnitude + 0xfff + ((magnitude >>> 13) & 1);
    return sign | ((rounded - 0x38000000) >>> 13);
}

// The number of half-precision bits.
export function fromHalf(half) {
    const exponent = (half >>> 10) & 31;
    const mantissa = half & 1023;
    const sign = half & 0x8000 ? -1 : 1;
    if (exponent === 0) return sign * mantissa * 2 ** -24;
    if (exponent === 31) return mantissa ? NaN : sign * Infinity;
    return sign * (1 + mantissa / 1024) * 2 ** (exponent - 15);
}

// The grid as bits of half-precision numbers.
export function unpackGrid(header, arrays) {
    if (header.quality === "full") {
        for (const half of arrays.grid) expect((half & 0x7c00) !== 0x7c00, "section grid: expected finite values");
        return arrays.grid;
    }
    const levels = header.texture.levels;
    const size = arrays.grid.length / levels;
    const grid = new Uint16Array(arrays.grid.length);
    const table = new Uint16Array(256);
    for (let level = 0; level < levels; level++) {
        for (let code = 0; code < 256; code++) {
            table[code] = toHalf(Math.fround(arrays.grid_ranges[2 * level] + Math.fround(arrays.grid_ranges[2 * level + 1] * code)));
            expect((table[code] & 0x7c00) !== 0x7c00, "section grid_ranges: expected finite values");
        }
        for (let i = level * size; i < (level + 1) * size; i++) grid[i] = table[arrays.grid[i]];
    }
    return grid;
}

// The MLP's weights, float32, matrix after matrix.
export function unpackWeights(header, arrays) {
    const weights = header.quality === "full" ? arrays.mlp : Float32Array.from(arrays.mlp, fromHalf);
    return checkValues("mlp", weights, 65504);
}
