// Reader of baked scenes (docs/web.md), and what the CPU does with one: sorting, exposures, picking.

import {SceneError} from "nexwarp/scene.js";

const MAGIC = "NXWBAKED";
const VERSION = 1;
const LARGEST_HEADER = 4 << 20;
const LARGEST_FILE = 2 ** 30;
const LARGEST_COUNT = 2 ** 22;
const LARGEST_CAMERAS = 1000;
const LARGEST_SIDE = 16384;
const ARRAYS = {u8: Uint8Array, u16: Uint16Array, f32: Float32Array};
const BUCKETS = 1 << 16; // of the depth sort
const ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99, TINY = 1e-20;

// Section name -> [type, values of each of n surfels or photos].
const SECTIONS = {
    means: ["f32", 3], quats: ["u16", 4], scales: ["f32", 2], opacities: ["f32", 1], gammas: ["f32", 2],
    farthest: ["f32", 1], boxes: ["f32", 4], rects: ["u16", 4], sh0: ["f32", 3],
};

export async function readBaked(stream, onProgress = () => {}) {
    const bytes = await readAll(stream, onProgress);
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const magic = String.fromCharCode(...bytes.subarray(0, 8));
    if (bytes.length < 16 || magic !== MAGIC) throw damaged("expected a baked scene of nexwarp");
    const version = view.getUint32(8, true), length = view.getUint32(12, true);
    if (version !== VERSION) throw damaged(`expected format version ${VERSION}, got ${version}`);
    if (length > LARGEST_HEADER || 16 + length > bytes.length) throw damaged("expected a whole header");
    let header;
    try {
        header = JSON.parse(new TextDecoder("utf-8", {fatal: true}).decode(bytes.subarray(16, 16 + length)));
    } catch {
        throw damaged("expected a JSON header");
    }
    checkHeader(header);
    const arrays = {};
    for (const [name, dtype, count] of sections(header)) {
        const entry = header.sections.find(one => one?.name === name);
        if (!entry) throw damaged(`expected the section ${name}, found none`);
        arrays[name] = await section(bytes.subarray(16 + length), entry, dtype, count);
    }
    return {header, arrays};
}

function sections({surfels, sh_coefficients, exposures}) {
    const list = Object.entries(SECTIONS).map(([name, [dtype, values]]) => [name, dtype, surfels * values]);
    list.push(["shN", "u8", surfels * (sh_coefficients - 1) * 3]);
    if (exposures) list.push(["exposures", "f32", exposures.count * 9]);
    return list;
}

async function readAll(stream, onProgress) {
    const reader = stream.getReader(), parts = [];
    let bytes = 0;
    for (;;) {
        const {done, value} = await reader.read();
        if (done) break;
        parts.push(value);
        bytes += value.length;
        if (bytes > LARGEST_FILE) throw damaged("expected at most 1 GiB");
        onProgress({bytes, total: null, stage: "geometry"});
    }
    const all = new Uint8Array(bytes);
    let at = 0;
    for (const part of parts) {
        all.set(part, at);
        at += part.length;
    }
    return all;
}

async function section(bytes, {name, offset, bytes: stored, encoding}, dtype, count) {
    const Type = ARRAYS[dtype], wanted = count * Type.BYTES_PER_ELEMENT;
    const whole = [offset, stored].every(x => Number.isSafeInteger(x) && x >= 0);
    if (!whole || offset + stored > bytes.length) throw damaged(`section ${name}: expected it inside the file`);
    let content = bytes.slice(offset, offset + stored);
    if (encoding === "deflate") content = await inflated(content, wanted, name);
    else if (encoding !== "raw") throw damaged(`section ${name}: expected the encoding raw or deflate`);
    if (content.length !== wanted) throw damaged(`section ${name}: expected ${wanted} bytes, got ${content.length}`);
    const array = new Type(content.buffer, content.byteOffset, count);
    if (dtype === "f32" && !array.every(Number.isFinite)) throw damaged(`section ${name}: expected finite numbers`);
    return array;
}

// Never unpacks more than `wanted` bytes.
async function inflated(content, wanted, name) {
    const reader = new Blob([content]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
    const out = new Uint8Array(wanted);
    let at = 0;
    for (;;) {
        const {done, value} = await reader.read().catch(() => {
            throw damaged(`section ${name}: expected compressed data`);
        });
        if (done) break;
        if (at + value.length > wanted) {
            reader.cancel();
            throw damaged(`section ${name}: expected ${wanted} bytes, got more`);
        }
        out.set(value, at);
        at += value.length;
    }
    return out.subarray(0, at);
}

function checkHeader(header) {
    const integer = (x, low, high) => Number.isSafeInteger(x) && x >= low && x <= high;
    const numbers = (x, count) => Array.isArray(x) && x.length === count && x.every(Number.isFinite);
    const expect = (good, what) => {
        if (!good) throw damaged(`header: expected ${what}`);
    };
    expect(header && typeof header === "object", "an object");
    expect(integer(header.surfels, 0, LARGEST_COUNT), `at most ${LARGEST_COUNT} surfels`);
    expect([1, 4, 9, 16, 25, 36, 49].includes(header.sh_coefficients), "1, 4, 9, 16, 25, 36 or 49 SH coefficients");
    expect(numbers(header.sh_ranges, Math.max(3, Math.sqrt(header.sh_coefficients) - 1)), "ranges of SH");
    expect(numbers(header.options?.background, 3) && integer(header.options.sh_degree, 0, 6), "the options of the rendering");
    expect(Array.isArray(header.sections) && header.sections.length < 100, "a list of sections");
    const {atlas, exposures, cameras} = header;
    expect(atlas && integer(atlas.width, 1, LARGEST_SIDE) && integer(atlas.height, 1, LARGEST_SIDE), "the size of the atlas");
    expect(Number.isFinite(atlas.scale) && /^[\w-]+\.webp$/.test(atlas.file), "an atlas");
    if (exposures) {
        const triples = ["mean", "falloff", "lowest", "highest"].every(name => numbers(exposures[name], 3));
        expect(integer(exposures.count, 1, 10000) && triples && numbers(exposures.lengths, 2), "exposures");
    }
    expect(Array.isArray(cameras) && cameras.length >= 1 && cameras.length <= LARGEST_CAMERAS, "1 to 1000 cameras");
    for (const camera of cameras) {
        const sizes = integer(camera?.width, 1, 1e6) && integer(camera.height, 1, 1e6) && camera.near >= 0;
        expect(sizes && numbers(camera.viewmat, 16) && numbers(camera.K, 4) && typeof camera.name === "string", "cameras");
    }
    expect(integer(header.start, 0, cameras.length - 1), "the index of the first camera");
    expect(numbers(header.center, 3) && numbers(header.up, 3), "a centre and an upward direction");
    expect(Array.isArray(header.bounds) && header.bounds.every(x => numbers(x, 3)) && header.bounds.length === 2, "bounds");
}

function damaged(what) {
    return new SceneError(`The baked scene is damaged: ${what}.`);
}

export class BakedScene {
    constructor(header, arrays) {
        this.header = header;
        this.arrays = arrays;
        this.count = header.surfels;
        this.coefficients = header.sh_coefficients;
        this.usedCoefficients = Math.min(this.coefficients, (header.options.sh_degree + 1) ** 2);
        this.#pack();
        this.depths = new Float32Array(this.count);
        this.order = new Uint32Array(this.count);
        this.buckets = new Uint32Array(BUCKETS + 1);
    }

    // Eight RGBA texels a surfel: x axis and scale, y axis and scale, centre and opacity, gammas and farthest, box, rect,
    // constant SH, normal.
    #pack() {
        const {means, quats, scales, opacities, gammas, farthest, boxes, rects, sh0, shN} = this.arrays;
        const {width, height} = this.header.atlas;
        this.geometry = new Float32Array(32 * this.count);
        for (let i = 0; i < this.count; ++i) {
            const [w, x, y, z] = unit(quats, i);
            const out = this.geometry.subarray(32 * i, 32 * i + 32);
            out.set([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), scales[2 * i]], 0);
            out.set([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), scales[2 * i + 1]], 4);
            out.set([means[3 * i], means[3 * i + 1], means[3 * i + 2], opacities[i]], 8);
            out.set([gammas[2 * i], gammas[2 * i + 1], farthest[i], 0], 12);
            out.set(boxes.subarray(4 * i, 4 * i + 4), 16);
            const [left, top, across, along] = rects.subarray(4 * i, 4 * i + 4);
            const inside = across && along && left + across <= width && top + along <= height;
            if (!inside) throw damaged("expected texels inside the atlas");
            out.set([left, top, across - 1, along - 1], 20);
            out.set(sh0.subarray(3 * i, 3 * i + 3), 24);
            out.set([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 28);
        }
        const values = this.coefficients - 1;
        this.harmonics = new Uint8Array(4 * values * this.count);
        for (let k = 0; k < values * this.count; ++k) this.harmonics.set(shN.subarray(3 * k, 3 * k + 3), 4 * k);
    }

    // Surfels from far to near, by the depth of their centres.
    sorted(viewmat) {
        const {means} = this.arrays, {count, depths, order, buckets} = this;
        const [a, b, c, d] = viewmat.slice(8, 12);
        let low = Infinity, high = -Infinity;
        for (let i = 0, j = 0; i < count; ++i, j += 3) {
            const depth = a * means[j] + b * means[j + 1] + c * means[j + 2] + d;
            depths[i] = depth;
            low = Math.min(low, depth);
            high = Math.max(high, depth);
        }
        // Equal shares of 1 / depth beyond a tenth of the largest depth would starve what is near: the logarithm is fair.
        const shift = Math.max(high - low, 1e-12) * 1e-3, scale = (BUCKETS - 1) / Math.log((high - low + shift) / shift);
        const place = depth => BUCKETS - 1 - Math.floor(Math.log((depth - low + shift) / shift) * scale);
        buckets.fill(0);
        const keys = (this.keys ??= new Uint32Array(count));
        for (let i = 0; i < count; ++i) ++buckets[(keys[i] = Math.min(Math.max(place(depths[i]), 0), BUCKETS - 1)) + 1];
        for (let k = 0; k < BUCKETS; ++k) buckets[k + 1] += buckets[k];
        for (let i = 0; i < count; ++i) order[buckets[keys[i]]++] = i;
        // Within a bucket, insertion sort: few surfels share one.
        for (let k = 1; k < count; ++k) {
            const i = order[k];
            let j = k - 1;
            while (j >= 0 && k - j < 64 && depths[order[j]] < depths[i]) {
                order[j + 1] = order[j];
                --j;
            }
            order[j + 1] = i;
        }
        return order;
    }

    // Gains of red, green and blue: the Gaussian process of nexwarp.model.exposures.
    gains(m) {
        const {mean, lengths: [turn, length], lowest, highest, count} = this.header.exposures;
        const poses = this.arrays.exposures, logs = [...mean];
        for (let v = 0; v < count; ++v) {
            let square = 0;
            for (let i = 0; i < 3; ++i) {
                const position = -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
                square += (poses[9 * v + i] - position) ** 2 + (turn * (poses[9 * v + 3 + i] - m[8 + i])) ** 2;
            }
            const r = Math.sqrt(3 * square) / length, kernel = (1 + r) * Math.exp(-r);
            for (let i = 0; i < 3; ++i) logs[i] += kernel * poses[9 * v + 6 + i];
        }
        return logs.map((x, i) => Math.exp(Math.min(Math.max(x, lowest[i]), highest[i])));
    }

    // Depths that the depth picture shows from dark to bright.
    depthSpan(eye) {
        const [low, high] = this.header.bounds;
        const middle = low.map((x, i) => (x + high[i]) / 2);
        const radius = Math.hypot(...low.map((x, i) => (high[i] - x) / 2)) || 1;
        const away = Math.hypot(...middle.map((x, i) => x - eye[i]));
        return [Math.max(away - radius, 0), away + radius];
    }

    // Where a pixel's transmittance falls to one half, or the last hit; null where next to nothing is hit.
    pick({viewmat: m, K: [fx, fy, cx, cy], near}, x, y) {
        const ray = [(x - cx) / fx, (y - cy) / fy, 1];
        const world = [0, 1, 2].map(i => m[i] * ray[0] + m[4 + i] * ray[1] + m[8 + i] * ray[2]);
        const eye = [0, 1, 2].map(i => -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]));
        const order = this.sorted(m), g = this.geometry;
        let transmittance = 1, hit = null;
        for (let k = this.count - 1; k >= 0; --k) {
            const i = order[k], at = 32 * i;
            let facing = 0, distance = 0;
            for (let j = 0; j < 3; ++j) {
                facing += g[at + 28 + j] * world[j];
                distance += g[at + 28 + j] * (g[at + 8 + j] - eye[j]);
            }
            const depth = distance / facing;
            if (!(depth > near)) continue;
            let u = 0, v = 0;
            for (let j = 0; j < 3; ++j) {
                const offset = eye[j] + depth * world[j] - g[at + 8 + j];
                u += (offset * g[at + j]) / g[at + 3];
                v += (offset * g[at + 4 + j]) / g[at + 7];
            }
            const exponent = Math.max(u * u, TINY) ** g[at + 12] + Math.max(v * v, TINY) ** g[at + 13];
            const alpha = Math.min(g[at + 11] * Math.exp(-0.5 * exponent), ALPHA_MAX);
            if (alpha < ALPHA_MIN) continue;
            transmittance *= 1 - alpha;
            hit = {depth, position: eye.map((e, j) => e + depth * world[j]), id: i};
            if (transmittance <= 0.5) break;
        }
        return transmittance < 0.9 ? hit : null;
    }
}

function unit(quats, i) {
    const q = Array.from(quats.subarray(4 * i, 4 * i + 4), x => (x / 65535) * 2 - 1);
    const length = Math.hypot(...q) || 1;
    return q.map(x => x / length);
}
