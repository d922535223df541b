// What the CPU does with a baked scene: packing, sorting, exposures, picking.

import {gainsOf, positionOf, rayOf} from "nexwarp/program.js";
import {SceneError, checkValues} from "nexwarp/scene.js";

const LARGEST_FLOAT = 3.5e38;
const ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99, TINY = 1e-20;

export class BakedScene {
    constructor(header, arrays) {
        this.header = header;
        this.arrays = arrays;
        this.count = header.surfels;
        for (const [name, array] of Object.entries(arrays)) checkValues(name, array, LARGEST_FLOAT);
        this.coefficients = header.sh_coefficients;
        this.usedCoefficients = Math.min(this.coefficients, (header.options.sh_degree + 1) ** 2);
        this.#pack();
        this.depths = new Float32Array(this.count);
        this.bits = new Uint32Array(this.depths.buffer);
        [this.keys, this.order, this.spare] = [0, 1, 2].map(() => new Uint32Array(this.count));
        this.starts = new Uint32Array(2049); // of the radix sort
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
            if (!inside) throw new SceneError("scene file: section rects: expected texels inside the atlas");
            out.set([left, top, across - 1, along - 1], 20);
            out.set(sh0.subarray(3 * i, 3 * i + 3), 24);
            out.set([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 28);
        }
        const values = this.coefficients - 1;
        this.harmonics = new Uint8Array(4 * values * this.count);
        for (let k = 0; k < values * this.count; ++k) this.harmonics.set(shN.subarray(3 * k, 3 * k + 3), 4 * k);
    }

    // Surfels from far to near, by the depth of their centres: a radix sort of the bits, which are in the order of positive
    // floats, and in the opposite one of negative floats.
    sorted(viewmat) {
        const {means} = this.arrays, {count, depths, bits, keys, starts} = this;
        let {order, spare} = this;
        const [a, b, c, d] = viewmat.slice(8, 12);
        for (let i = 0, j = 0; i < count; ++i, j += 3) {
            depths[i] = a * means[j] + b * means[j + 1] + c * means[j + 2] + d;
            keys[i] = bits[i] >>> 31 ? bits[i] : 0x7fffffff - bits[i];
            order[i] = i;
        }
        for (const shift of [0, 11, 22]) {
            starts.fill(0);
            for (let i = 0; i < count; ++i) ++starts[((keys[i] >>> shift) & 2047) + 1];
            for (let k = 0; k < 2048; ++k) starts[k + 1] += starts[k];
            for (const i of order) spare[starts[(keys[i] >>> shift) & 2047]++] = i;
            [order, spare] = [spare, order];
        }
        return order;
    }

    gains(viewmat) {
        return gainsOf(this.header.exposures, this.arrays.exposures, viewmat);
    }

    // Where a pixel's transmittance falls to one half, or the last hit; null where next to nothing is hit.
    pick(camera, x, y) {
        const world = rayOf(camera, x, y), eye = positionOf(camera.viewmat);
        const order = this.sorted(camera.viewmat), g = this.geometry;
        let transmittance = 1, hit = null;
        for (let k = this.count - 1; k >= 0; --k) {
            const i = order[k], at = 32 * i;
            let facing = 0, distance = 0;
            for (let j = 0; j < 3; ++j) {
                facing += g[at + 28 + j] * world[j];
                distance += g[at + 28 + j] * (g[at + 8 + j] - eye[j]);
            }
            const depth = distance / facing;
            if (!(depth > camera.near)) continue;
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
