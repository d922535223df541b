// Draws a baked scene with WebGL2: depth-sorted quads, the surfels' own SH and an atlas of what the texture adds.
// It has the interface of Renderer in renderer.js, for devices without WebGPU.

import {asset} from "nexwarp/assets.js";
import {BakedScene} from "nexwarp/baked_scene.js";
import {depthSpan, positionOf, resized} from "nexwarp/program.js";
import {BAKED, SceneError, SceneReader} from "nexwarp/scene.js";
import {QUADS_FRAGMENT, QUADS_VERTEX, RESOLVE_FRAGMENT, RESOLVE_VERTEX} from "nexwarp/baked_shaders.js";

export const BAKED_FILE = "baked.nxb";
const MODES = ["image", "plain", "ids", "depth", "normals"];
const GEOMETRY_TEXELS = 8; // of a surfel
const SURFELS_PER_ROW = 128;

export class BakedRenderer {
    static async create(canvas, {onProgress = () => {}, onStage = () => {}, onLost = () => {}} = {}) {
        const wanted = {alpha: false, antialias: false, depth: false, powerPreference: "high-performance"};
        const gl = canvas.getContext("webgl2", wanted);
        if (!gl) {
            throw new SceneError("This browser has neither WebGPU nor WebGL2; current Chrome, Edge, Firefox and Safari have.");
        }
        const renderer = new BakedRenderer(canvas, gl, onProgress, onStage);
        canvas.addEventListener("webglcontextlost", event => {
            event.preventDefault();
            if (!renderer.destroyed) onLost(new SceneError("The graphics device was lost."));
        });
        return renderer;
    }

    constructor(canvas, gl, onProgress, onStage) {
        Object.assign(this, {canvas, gl, onProgress, onStage, header: null, poster: null, modes: MODES});
        this.half = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
        this.target = {width: 0, height: 0};
    }

    async load(source = BAKED_FILE) {
        const progress = bytes => this.onProgress({bytes, total: reader.header ? reader.total : null, stage: "geometry"});
        const reader = new SceneReader(await opened(source), progress, BAKED);
        const header = await reader.readHeader();
        await reader.readTo("shN");
        this.scene = new BakedScene(header, reader.arrays);
        this.header = header;
        this.onStage("header");
        this.#upload();
        this.onStage("geometry"); // the surfels' own colours can be drawn
        const image = await this.#atlasImage(header.atlas);
        this.#uploadAtlas(image);
        image.close();
        this.onStage("done");
    }

    async #atlasImage({file, width, height}) {
        const bytes = await new Response(await opened(file)).arrayBuffer();
        const options = {premultiplyAlpha: "none", colorSpaceConversion: "none"};
        const image = await createImageBitmap(new Blob([bytes], {type: "image/webp"}), options).catch(() => {
            throw new SceneError(`${file}: expected a picture, and this browser cannot read it as one`);
        });
        if (image.width !== width || image.height !== height) {
            throw new SceneError(`${file}: expected ${width} x ${height} pixels, got ${image.width} x ${image.height}`);
        }
        return image;
    }

    #upload() {
        const {gl, scene} = this, {atlas} = scene.header;
        const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
        const rows = Math.ceil(scene.count / SURFELS_PER_ROW);
        const sides = [atlas.width, atlas.height, rows, SURFELS_PER_ROW * Math.max(scene.coefficients - 1, GEOMETRY_TEXELS)];
        if (Math.max(...sides) > largest) {
            const needed = Math.max(...sides);
            throw new SceneError(`This device draws textures of at most ${largest} pixels a side; the scene needs ${needed}.`);
        }
        this.quads = this.#program(QUADS_VERTEX, QUADS_FRAGMENT);
        this.resolve = this.#program(RESOLVE_VERTEX, RESOLVE_FRAGMENT);
        const floats = new Float32Array(4 * GEOMETRY_TEXELS * SURFELS_PER_ROW * rows);
        floats.set(scene.geometry);
        this.geometry = this.#texture(gl.RGBA32F, GEOMETRY_TEXELS * SURFELS_PER_ROW, rows, gl.RGBA, gl.FLOAT, floats);
        const width = Math.max(scene.coefficients - 1, 1) * SURFELS_PER_ROW;
        const bytes = new Uint8Array(4 * width * rows);
        bytes.set(scene.harmonics);
        this.harmonics = this.#texture(gl.RGBA8, width, rows, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
        const nothing = Uint8Array.of(128, 128, 128, 255); // is added, until the atlas has arrived
        this.atlas = this.#texture(gl.RGBA8, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, nothing);
        this.ids = gl.createBuffer();
        this.vertices = gl.createVertexArray();
        gl.bindVertexArray(this.vertices);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
        gl.bufferData(gl.ARRAY_BUFFER, 4 * Math.max(scene.count, 1), gl.DYNAMIC_DRAW);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
        gl.vertexAttribDivisor(0, 1);
        gl.bindVertexArray(null);
    }

    #uploadAtlas(image) {
        const {gl} = this;
        gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
        gl.bindTexture(gl.TEXTURE_2D, this.atlas);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
        this.#filter(gl.LINEAR);
        if (gl.getError() === gl.OUT_OF_MEMORY) throw new SceneError("This device has too little graphics memory for the scene.");
    }

    #program(vertex, fragment) {
        const {gl} = this;
        const program = gl.createProgram();
        for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, text);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
        }
        gl.bindAttribLocation(program, 0, "surfel");
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
            throw new SceneError(`This device cannot draw the scene: ${gl.getProgramInfoLog(program)}`.split("\n")[0]);
        }
        const uniforms = {};
        for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
            const {name} = gl.getActiveUniform(program, i);
            uniforms[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
        }
        return {program, uniforms};
    }

    #texture(internal, width, height, format, type, data) {
        const {gl} = this;
        const texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
        this.#filter(gl.NEAREST);
        return texture;
    }

    #filter(kind) {
        const {gl} = this;
        for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, kind);
        for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    }

    #resizeTarget(width, height) {
        const {gl, target} = this;
        if (target.width === width && target.height === height) return;
        gl.deleteTexture(target.texture);
        gl.deleteFramebuffer(target.frame);
        const texture = this.half ? this.#texture(gl.RGBA16F, width, height, gl.RGBA, gl.HALF_FLOAT, null)
            : this.#texture(gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
        this.#filter(gl.LINEAR);
        const frame = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        this.target = {width, height, texture, frame};
    }

    async render(camera, {mode = "image", resolutionScale = 1, exposure = "photos"} = {}) {
        const {gl, scene, canvas} = this;
        const start = performance.now();
        const width = Math.max(Math.round(canvas.width * resolutionScale), 1);
        const height = Math.max(Math.round(canvas.height * resolutionScale), 1);
        this.#resizeTarget(width, height);
        this.last = {camera: resized(camera, width, height), mode, exposure};
        this.#sort(camera.viewmat);
        this.#drawQuads();
        this.#drawResolved(null, canvas);
        await finished(gl);
        return {milliseconds: performance.now() - start, entries: scene.count};
    }

    // Draw cameras into parts (x, y, width, height) of a framebuffer, with one order of the surfels: the eyes of a head.
    // What lies behind the surfels is the background, or nothing.
    renderEyes(eyes, headViewmat, frame, seeThrough) {
        this.#sort(headViewmat);
        for (const {camera, part} of eyes) {
            this.#resizeTarget(part.width, part.height);
            this.last = {camera, mode: "image", exposure: "mean", seeThrough};
            this.#drawQuads();
            this.#drawResolved(frame, part);
        }
    }

    #sort(viewmat) {
        const {gl} = this;
        gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.scene.sorted(viewmat));
    }

    #drawQuads() {
        const {gl, scene, target, last: {camera, mode}} = this;
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
        gl.viewport(0, 0, target.width, target.height);
        gl.disable(gl.DEPTH_TEST);
        gl.disable(gl.CULL_FACE);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT);
        const {program, uniforms} = this.quads;
        gl.useProgram(program);
        [this.geometry, this.harmonics, this.atlas].forEach((texture, unit) => {
            gl.activeTexture(gl.TEXTURE0 + unit);
            gl.bindTexture(gl.TEXTURE_2D, texture);
        });
        gl.uniform1i(uniforms.geometry, 0);
        gl.uniform1i(uniforms.harmonics, 1);
        gl.uniform1i(uniforms.atlas, 2);
        gl.uniformMatrix4fv(uniforms.viewmat, true, camera.viewmat);
        gl.uniform4fv(uniforms.intrinsics, camera.K);
        gl.uniform2f(uniforms.size, target.width, target.height);
        gl.uniform3fv(uniforms.eye, positionOf(camera.viewmat));
        gl.uniform1f(uniforms.near, camera.near);
        gl.uniform1i(uniforms.mode, MODES.indexOf(mode));
        gl.uniform1i(uniforms.coefficients, scene.usedCoefficients);
        gl.uniform1fv(uniforms.bands, scene.header.sh_ranges);
        gl.uniform3f(uniforms.atlasScale, scene.header.atlas.width, scene.header.atlas.height, scene.header.atlas.scale);
        gl.bindVertexArray(this.vertices);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, scene.count);
        gl.bindVertexArray(null);
    }

    #drawResolved(frame, {x = 0, y = 0, width, height}) {
        const {gl, scene, target, last: {camera, mode, exposure, seeThrough = false}} = this;
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
        gl.viewport(x, y, width, height);
        gl.disable(gl.BLEND);
        const {program, uniforms} = this.resolve;
        gl.useProgram(program);
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(gl.TEXTURE_2D, target.texture);
        gl.uniform1i(uniforms.frame, 0);
        gl.uniform1i(uniforms.mode, MODES.indexOf(mode));
        gl.uniform3fv(uniforms.background, scene.header.options.background);
        const lens = exposure === "photos" ? scene.header.exposures : null;
        gl.uniform3fv(uniforms.gains, lens ? scene.gains(camera.viewmat) : [1, 1, 1]);
        gl.uniform3fv(uniforms.falloff, lens ? lens.falloff : [0, 0, 1]);
        gl.uniform4fv(uniforms.intrinsics, camera.K);
        gl.uniform2f(uniforms.size, target.width, target.height);
        gl.uniform4f(uniforms.part, x, y, width, height);
        gl.uniform1f(uniforms.cover, seeThrough ? 0 : 1);
        gl.uniform2fv(uniforms.span, depthSpan(scene.header, camera.viewmat));
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    // The last frame as (height, width, 4) in [0, 1], at the size that it was drawn at.
    async read(name = "image") {
        if (name !== "image") throw new SceneError(`The baked scene has no buffer ${name}`);
        const {gl, target: {width, height}} = this;
        const texture = this.#texture(gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
        const frame = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        this.#drawResolved(frame, {width, height});
        const bytes = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
        gl.deleteFramebuffer(frame);
        gl.deleteTexture(texture);
        const rows = new Float32Array(bytes.length);
        for (let y = 0; y < height; ++y) {
            const row = bytes.subarray(4 * width * (height - 1 - y), 4 * width * (height - y));
            rows.set(Float32Array.from(row, x => x / 255), 4 * width * y);
        }
        return rows;
    }

    async pick(x, y) {
        const {canvas, target, last, scene} = this;
        if (!last) return null;
        return scene.pick(last.camera, (x * target.width) / canvas.width, (y * target.height) / canvas.height);
    }

    get surfels() {
        return this.header?.surfels ?? 0;
    }

    destroy() {
        this.destroyed = true;
        this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    }
}

async function opened(file) {
    try {
        return await asset(file);
    } catch (error) {
        throw Object.assign(new SceneError(error.message), {missing: true});
    }
}

async function finished(gl) {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    for (;;) {
        const state = gl.clientWaitSync(fence, 0, 0);
        if (state !== gl.TIMEOUT_EXPIRED || gl.isContextLost()) break;
        await new Promise(done => setTimeout(done, 1));
    }
    gl.deleteSync(fence);
}
