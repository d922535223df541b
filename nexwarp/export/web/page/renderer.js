// The WebGPU renderer: the passes of nexwarp/kernels in WGSL.

import { assetText, asset } from "nexwarp/assets.js";
import { FRAME_BYTES, MODES, SCAN_BLOCK, SHARING, SORT_BLOCK, TILE } from "nexwarp/program.js";
import { constantsOf, depthSpan, frameValues, isUniform, packedMatrices } from "nexwarp/program.js";
import { positionOf, rayOf, resized, sourceOf } from "nexwarp/program.js";
import { SceneError, SceneReader, toHalf, unpackGrid, unpackSurfels, unpackWeights } from "nexwarp/scene.js";

const SHADERS = ["common", "project", "scan", "sort", "lists", "collect", "shade", "compose", "blit"];
const FIRST_ENTRIES = 2 ** 18;
const MOST_ENTRIES = 2 ** 28;
const SPARE = 1.5;
const MOST_GROUPS = 65535;
const SOFTWARE = /swiftshader|llvmpipe|basic render/i; // adapters that are no GPU
const INTEGRATED = /\b(intel|qualcomm|arm|img-tec|samsung|broadcom)\b/i;

// Bindings of the entry points: index to the buffer's name.
const BINDINGS = {
    project: ["frame", "geometry", "seen", "sh", "records", "polygons", "keys", "order"],
    count: { 0: "frame", 1: "order", 2: "polygons", 3: "starts" },
    emit: { 0: "frame", 1: "order", 2: "polygons", 3: "starts", 4: "tiles", 5: "surfels", 6: "start_sums" },
    offsets: { 0: "frame", 4: "tiles", 6: "start_sums", 7: "tile_starts" },
    collect: ["frame", "records", "surfels", "tile_starts", "colors", "ids", "depths", "weights"],
    shade: ["frame", "seen", "ids", "depths", "weights", "grid", "mlp", "texels", "levels"],
    compose: ["frame", "records", "colors", "ids", "depths", "weights", "texels", "image"],
};
// Entry points of the shaders.
const ENTRIES = [
    ["project", "project"],
    ["scan", "reduce"],
    ["scan", "middle"],
    ["scan", "spread"],
    ["sort", "histogram"],
    ["sort", "scatter"],
    ["lists", "count"],
    ["lists", "emit"],
    ["lists", "offsets"],
    ["collect", "collect"],
    ["compose", "compose"],
];

function grouped(threads, size = 256) {
    const count = Math.max(Math.ceil(threads / size), 1);
    const rows = Math.ceil(count / MOST_GROUPS);
    return [Math.ceil(count / rows), rows];
}

// WebGPU, but on a phone, a GPU that shares the CPU's memory, or the CPU: the baked scene is faster there.
export async function isWeak() {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" }).catch(() => null);
    const phone = matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) < 600;
    return Boolean(adapter) && (phone || isSoftware(adapter.info) || INTEGRATED.test(nameOf(adapter.info)));
}

function nameOf({ vendor, architecture, description } = {}) {
    return [vendor, architecture, description].filter(Boolean).join(" ");
}

function isSoftware(info) {
    return info?.isFallbackAdapter === true || SOFTWARE.test(nameOf(info));
}

async function openDevice() {
    if (!("gpu" in navigator) || navigator.gpu === undefined) {
        throw new SceneError("This browser has no WebGPU. Recent versions of Chrome, Edge, Safari and Firefox have it.");
    }
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (adapter === null) throw new SceneError("This browser has WebGPU, but found no GPU that it can use.");
    const limits = {};
    for (const name of ["maxBufferSize", "maxStorageBufferBindingSize"]) limits[name] = adapter.limits[name];
    const requiredFeatures = adapter.features.has("shader-f16") ? ["shader-f16"] : [];
    return { adapter, device: await adapter.requestDevice({ requiredFeatures, requiredLimits: limits }) };
}

export class Renderer {
    // Opens a GPU. Throws SceneError, with a line for people, where there is none.
    static async create(canvas, { onProgress = () => {}, onStage = () => {}, onLost = () => {}, half = true } = {}) {
        const { adapter, device } = await openDevice();
        const software = isSoftware(device.adapterInfo ?? adapter.info);
        const renderer = new Renderer();
        Object.assign(renderer, { device, canvas, onProgress, onStage, software, modes: MODES });
        Object.assign(renderer, { buffers: {}, pipelines: {}, plans: new Map(), capacity: FIRST_ENTRIES, size: null });
        Object.assign(renderer, { chain: Promise.resolve(), destroyed: false });
        renderer.half = half && device.features.has("shader-f16");
        device.lost.then((lost) => {
            if (!renderer.destroyed) {
                renderer.destroyed = true;
                onLost(new SceneError(`The GPU was lost: ${lost.message || lost.reason}`));
            }
        });
        // Software adapters cannot show a canvas in every configuration of a browser: their pictures are copied to it.
        renderer.context = canvas.getContext(software ? "2d" : "webgpu");
        if (renderer.context === null) throw new SceneError("This browser gives the canvas no WebGPU context.");
        if (!software) {
            renderer.format = navigator.gpu.getPreferredCanvasFormat();
            renderer.context.configure({ device, format: renderer.format, alphaMode: "opaque" });
        }
        return renderer;
    }

    // Loads a scene; the picture without texture can be rendered from the stage "geometry" on.
    async load(source) {
        const stream = typeof source === "string" ? await asset(source) : source;
        let stage = "header";
        const reader = new SceneReader(stream, (bytes) => {
            this.onProgress({ bytes, total: reader.header ? reader.total : 0, stage });
        });
        const next = (name) => {
            stage = name;
            this.onStage(name);
        };
        try {
            const header = await reader.readHeader();
            this.header = header;
            this.poster = reader.poster;
            this.checkLimits(header);
            next("header");
            await Promise.all([reader.readTo(header.exposures ? "exposures" : "sh"), this.compile()]);
            this.uploadSurfels(reader.arrays);
            next("geometry");
            if (header.texture !== null && header.options.max_hits > 0) {
                await Promise.all([reader.readTo("grid"), this.compileShade()]);
                this.uploadTexture(reader.arrays);
                next("grid");
            }
            next("done");
        } catch (error) {
            await reader.cancel();
            if (error instanceof RangeError) throw new SceneError("This device has too little memory for the scene.");
            throw error;
        }
    }

    // Throws SceneError if a buffer of the scene is beyond the device's limits.
    checkLimits(header) {
        const texture = header.texture;
        const sizes = {
            surfels: 64 * header.surfels,
            "SH coefficients": 12 * header.surfels * header.sh_coefficients,
            "texture grid": texture === null ? 0 : 2 * texture.levels * texture.table_size * texture.features,
        };
        for (const [name, size] of Object.entries(sizes)) this.checkSize(name, size);
    }

    checkSize(name, size) {
        const limits = this.device.limits;
        const most = Math.min(limits.maxBufferSize, limits.maxStorageBufferBindingSize);
        if (size > most) {
            throw new SceneError(`This GPU is too small: ${name} needs ${size} bytes in one buffer, it allows ${most}.`);
        }
    }

    makeBuffer(name, size, uniform = false) {
        const bytes = Math.max(Math.ceil(size / 16) * 16, 16);
        this.checkSize(name, bytes);
        if (this.buffers[name]) this.buffers[name].destroy();
        const kind = uniform ? GPUBufferUsage.UNIFORM : GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC;
        this.buffers[name] = this.device.createBuffer({ label: name, size: bytes, usage: kind | GPUBufferUsage.COPY_DST });
        return this.buffers[name];
    }

    upload(name, array, uniform = false) {
        const buffer = this.makeBuffer(name, array.byteLength, uniform);
        let data = array;
        if (array.byteLength % 4 !== 0) {
            data = new Uint8Array(Math.ceil(array.byteLength / 4) * 4);
            data.set(new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
        }
        this.device.queue.writeBuffer(buffer, 0, data.buffer, data.byteOffset, data.byteLength);
    }

    async pipeline(name, entry) {
        const texture = this.header.texture;
        const features = texture === null ? 2 : texture.features;
        const code = sourceOf(name, this.constants, this.texts, features, this.half);
        const module = this.device.createShaderModule({ label: name, code });
        const compute = { module, entryPoint: entry };
        this.pipelines[entry] = await this.device.createComputePipelineAsync({ label: entry, layout: "auto", compute });
    }

    async compile() {
        const texture = this.header.texture;
        const names = [...SHADERS, ...(texture === null ? [] : [`features${texture.features}`])];
        const texts = await Promise.all(names.map((name) => assetText(`shaders/${name}.wgsl`)));
        this.texts = Object.fromEntries(names.map((name, i) => [name, texts[i]]));
        this.constants = constantsOf(this.header);
        await Promise.all(ENTRIES.map(([name, entry]) => this.pipeline(name, entry)));
        if (!this.software) {
            const module = this.device.createShaderModule({ label: "blit", code: this.texts.blit });
            this.blit = await this.device.createRenderPipelineAsync({
                layout: "auto",
                vertex: { module, entryPoint: "corner" },
                fragment: { module, entryPoint: "show", targets: [{ format: this.format }] },
            });
        }
    }

    compileShade() {
        return this.pipeline("shade", "shade");
    }

    uploadSurfels(arrays) {
        const { geometry, limits, sh } = unpackSurfels(this.header, arrays);
        const count = this.header.surfels;
        this.poses = arrays.exposures ?? null;
        this.upload("geometry", geometry);
        this.upload("seen", limits ?? new Float32Array(4));
        this.upload("sh", sh);
        this.makeBuffer("frame", FRAME_BYTES, true);
        this.makeBuffer("records", 64 * count);
        this.makeBuffer("polygons", 64 * count);
        this.makeBuffer("starts", 4 * count * SHARING);
        this.makeBuffer("start_sums", 4 * (this.constants.TOTAL + 1));
        this.upload("surfel count", Uint32Array.of(count));
        for (const name of ["keys", "order", "keys2", "order2"]) this.makeBuffer(name, 4 * count);
        this.staging = this.device.createBuffer({ size: 16, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    }

    uploadTexture(arrays) {
        const texture = this.header.texture;
        const packed = packedMatrices(texture, unpackWeights(this.header, arrays));
        this.upload("grid", unpackGrid(this.header, arrays));
        const uniform = isUniform(this.constants, this.half);
        this.upload("mlp", this.half ? Uint16Array.from(packed, toHalf) : packed, uniform);
        const levels = new Float32Array(64);
        levels.set(texture.resolutions);
        this.upload("levels", levels, true);
        this.textured = true;
        this.plans.clear();
    }

    // Renders a frame and shows it in the canvas. Resolves when the GPU has finished it.
    render(camera, options = {}) {
        const frame = this.chain.then(() => this.renderNow(camera, options));
        this.chain = frame.catch(() => {});
        return frame;
    }

    async renderNow(camera, options) {
        if (this.destroyed || !this.buffers.records) {
            throw new SceneError("The renderer has no scene, or has been closed.");
        }
        const { mode = "image", resolutionScale = 1, textureScale = 1, leastWeight = 0, exposure = "photos" } = options;
        if (!MODES.includes(mode)) throw new SceneError(`mode: expected one of ${MODES.join(", ")}, got ${mode}`);
        const start = performance.now();
        this.camera = camera; // of `pick`
        const width = Math.max(Math.round(this.canvas.width * resolutionScale), 1);
        const height = Math.max(Math.round(this.canvas.height * resolutionScale), 1);
        const view = resized(camera, width, height);
        const step = Math.min(Math.max(Math.round(1 / textureScale), 1), 4);
        const textured = this.textured === true;
        const depths = depthSpan(this.header, view.viewmat);
        this.makeImageBuffers(width, height);
        for (;;) {
            this.makeLists();
            const settings = { mode, leastWeight, exposure, depths, step, textured, capacity: this.capacity };
            this.device.queue.writeBuffer(this.buffers.frame, 0, frameValues(this.header, this.poses, view, settings));
            const entries = await this.submit(width, height, step);
            if (entries <= this.capacity) {
                if (this.software) await this.copy(width, height);
                return { milliseconds: performance.now() - start, entries };
            }
            if (entries > MOST_ENTRIES) {
                throw new SceneError(`This view needs ${entries} entries of tile lists; ${MOST_ENTRIES} are the most.`);
            }
            this.capacity = Math.ceil(entries * SPARE);
        }
    }

    // Submits the passes of a frame; returns the number of entries that the tile lists needed.
    async submit(width, height, step) {
        const key = `${width} ${height} ${step} ${this.capacity}`;
        if (!this.plans.has(key)) this.plans.set(key, this.plan(width, height, step));
        const encoder = this.device.createCommandEncoder();
        const pass = encoder.beginComputePass();
        for (const [pipeline, bindings, groups] of this.plans.get(key)) {
            pass.setPipeline(pipeline);
            pass.setBindGroup(0, bindings);
            pass.dispatchWorkgroups(...groups);
        }
        pass.end();
        if (!this.software) this.show(encoder, width, height);
        encoder.copyBufferToBuffer(this.buffers.start_sums, 4 * this.constants.TOTAL, this.staging, 0, 4);
        this.device.queue.submit([encoder.finish()]);
        await this.staging.mapAsync(GPUMapMode.READ, 0, 4);
        const entries = new Uint32Array(this.staging.getMappedRange(0, 4))[0];
        this.staging.unmap();
        return entries;
    }

    makeImageBuffers(width, height) {
        if (this.size !== null && this.size[0] === width && this.size[1] === height) return;
        this.plans.clear();
        this.size = null;
        const pixels = width * height;
        const slots = Math.max(this.header.options.max_hits, 1);
        const sizes = { colors: 16, ids: 4 * slots, depths: 4 * slots, weights: 4 * slots, texels: 16 * slots, image: 16 };
        for (const [name, size] of Object.entries(sizes)) {
            this.checkSize(`a picture of ${width} x ${height} pixels`, size * pixels);
        }
        for (const [name, size] of Object.entries(sizes)) this.makeBuffer(name, size * pixels);
        this.makeBuffer("tile_starts", 4 * (Math.ceil(width / TILE) * Math.ceil(height / TILE) + 1));
        this.makeBuffer("blit", 16, true);
        this.size = [width, height];
    }

    makeLists() {
        if (this.lists === this.capacity) return;
        this.plans.clear();
        for (const name of ["tiles", "surfels", "tiles2", "surfels2"]) this.makeBuffer(name, 4 * this.capacity);
        this.lists = this.capacity;
    }

    plan(width, height, step) {
        const count = this.header.surfels;
        const [columns, rows] = [Math.ceil(width / TILE), Math.ceil(height / TILE)];
        const total = this.constants.TOTAL;
        const bits = columns * rows < 2 ** 16 ? 16 : 32;
        const passes = [
            this.bound("project", BINDINGS.project, grouped(count)),
            ...this.sort(["keys", "order"], ["keys2", "order2"], 32, count, "surfel count", 0),
            this.bound("count", BINDINGS.count, grouped(count * SHARING)),
            ...this.scan("starts", "start_sums", count * SHARING),
            this.bound("emit", BINDINGS.emit, grouped(count * SHARING)),
            ...this.sort(["tiles", "surfels"], ["tiles2", "surfels2"], bits, this.capacity, "start_sums", total),
            this.bound("offsets", BINDINGS.offsets, grouped(columns * rows + 1)),
            this.bound("collect", BINDINGS.collect, [columns, rows]),
        ];
        if (this.textured) {
            passes.push(this.bound("shade", BINDINGS.shade, [Math.ceil(width / step / 8), Math.ceil(height / step / 8)]));
        }
        passes.push(this.bound("compose", BINDINGS.compose, [Math.ceil(width / 8), Math.ceil(height / 8)]));
        return passes;
    }

    bound(entry, names, groups) {
        const entries = Object.entries(names).map(([index, name]) => ({
            binding: Number(index),
            resource: { buffer: this.buffers[name] },
        }));
        const pipeline = this.pipelines[entry];
        return [pipeline, this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }), groups];
    }

    // Name of a uniform buffer of four words, made once.
    words(...values) {
        const name = `uniform ${values}`;
        if (!this.buffers[name]) this.upload(name, Uint32Array.from(values), true);
        return name;
    }

    scan(data, sums, count) {
        const blocks = Math.ceil(count / SCAN_BLOCK);
        const uniform = this.words(count, blocks, 0, 0);
        const groups = grouped(blocks, 1);
        return [
            this.bound("reduce", [uniform, data, sums], groups),
            this.bound("middle", { 0: uniform, 2: sums }, [1, 1]),
            this.bound("spread", [uniform, data, sums], groups),
        ];
    }

    sort(pair, spare, bits, count, totals, total) {
        const blocks = Math.max(Math.ceil(count / SORT_BLOCK), 1);
        const [counts, sums] = [`counts ${count}`, `count sums ${count}`];
        if (!this.buffers[counts]) {
            this.makeBuffer(counts, 4 * 256 * blocks);
            this.makeBuffer(sums, 4 * (Math.ceil((256 * blocks) / SCAN_BLOCK) + 1));
        }
        const groups = grouped(blocks, 1);
        const passes = [];
        let [before, after] = [pair, spare];
        for (let shift = 0; shift < bits; shift += 8) {
            const uniform = this.words(shift, blocks, count, total);
            passes.push(
                this.bound("histogram", { 0: uniform, 1: totals, 2: before[0], 4: counts }, groups),
                ...this.scan(counts, sums, 256 * blocks),
                this.bound("scatter", [uniform, totals, ...before, counts, ...after], groups),
            );
            [before, after] = [after, before];
        }
        return passes;
    }

    show(encoder, width, height) {
        this.device.queue.writeBuffer(this.buffers.blit, 0, Uint32Array.of(width, height, this.canvas.width, this.canvas.height));
        const view = this.context.getCurrentTexture().createView();
        const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
        const [pipeline, bindings] = [this.blit, { blit: 0, image: 1 }];
        const entries = Object.entries(bindings).map(([name, binding]) => ({ binding, resource: { buffer: this.buffers[name] } }));
        pass.setPipeline(pipeline);
        pass.setBindGroup(0, this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }));
        pass.draw(3);
        pass.end();
    }

    // Copies the picture to the canvas.
    async copy(width, height) {
        const image = new Float32Array(await this.readBuffer("image", 0, 16 * width * height));
        const pixels = Uint8ClampedArray.from(image, (x) => 255 * x);
        const picture = new OffscreenCanvas(width, height);
        picture.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
        this.context.drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
    }

    async readBuffer(name, offset, size) {
        const staging = this.device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
        const encoder = this.device.createCommandEncoder();
        encoder.copyBufferToBuffer(this.buffers[name], offset, staging, 0, size);
        this.device.queue.submit([encoder.finish()]);
        await staging.mapAsync(GPUMapMode.READ);
        const content = staging.getMappedRange().slice(0);
        staging.destroy();
        return content;
    }

    // A buffer of the last frame: "image" (h, w, 4), "colors" (h, w, 4), plain colour and alpha; "ids", "depths" and
    // "weights" (h, w, K).
    async read(name) {
        await this.chain;
        const width = ["image", "colors"].includes(name) ? 4 : this.header.options.max_hits;
        const content = await this.readBuffer(name, 0, 4 * width * this.size[0] * this.size[1]);
        return name === "ids" ? new Int32Array(content) : new Float32Array(content);
    }

    // What the last frame shows at a pixel of the canvas: {id, depth, position}, or null.
    async pick(x, y) {
        await this.chain;
        const hits = this.header.options.max_hits;
        if (this.size === null || hits === 0) return null;
        const [width, height] = this.size;
        const column = Math.min(Math.max(Math.floor((x * width) / this.canvas.width), 0), width - 1);
        const row = Math.min(Math.max(Math.floor((y * height) / this.canvas.height), 0), height - 1);
        const offset = 4 * hits * (row * width + column);
        const id = new Int32Array(await this.readBuffer("ids", offset, 4))[0];
        const depth = new Float32Array(await this.readBuffer("depths", offset, 4))[0];
        if (id < 0) return null;
        const view = resized(this.camera, width, height);
        const ray = rayOf(view, column + 0.5, row + 0.5);
        const position = positionOf(view.viewmat).map((x, k) => x + depth * ray[k]);
        return { id, depth, position };
    }

    get surfels() {
        return this.header?.surfels ?? 0;
    }

    destroy() {
        this.destroyed = true;
        for (const buffer of Object.values(this.buffers)) buffer.destroy();
        this.buffers = {};
        this.plans.clear();
        this.context.unconfigure?.();
        this.device.destroy();
    }
}
