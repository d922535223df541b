// The page: chooses a renderer, shows loading, and connects camera, controls and settings.

import {BAKED_FILE, BakedRenderer} from "nexwarp/baked.js";
import {FOV, Pose, basisOf} from "nexwarp/camera.js";
import {Controls} from "nexwarp/controls.js";
import {Notes} from "nexwarp/notes.js";
import {Pacing} from "nexwarp/pacing.js";
import {Renderer, isWeak} from "nexwarp/renderer.js";
import {SceneError} from "nexwarp/scene.js";
import {offerSessions} from "nexwarp/xr.js";

const RENDERERS = {webgpu: [Renderer, "scene.nxw"], baked: [BakedRenderer, BAKED_FILE]};
const LEAST_RATE = 30; // frames a second; below, the baked scene takes over
const CHOICE = "nexwarp renderer"; // under which the browser remembers it
const MODES = {
    image: "image",
    plain: "without texture",
    textured: "texture alone",
    ids: "surfels",
    depth: "depth",
    normals: "normals",
};
const FLIGHT_MILLISECONDS = 700; // from one camera to another
const LINK_MILLISECONDS = 400; // after the last change, before the address follows
const NOTE_MILLISECONDS = 3000; // that a note is shown
const LARGEST_RATIO = 2; // canvas pixels to CSS pixels
const TURN = 0.2; // radians a second, of a page that turns by itself: `?turn` in the address
const EMBED = 'width="960" height="540" style="border:0" allow="fullscreen; clipboard-write; xr-spatial-tracking" loading="lazy"';

const element = id => document.getElementById(id);
const query = new URLSearchParams(location.search);
const still = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

class Viewer {
    #pose = null;

    constructor() {
        this.stage = element("stage");
        this.canvas = element("view");
        this.pacing = new Pacing();
        this.mode = "image";
        this.flying = false;
        this.turning = false;
        this.saving = false; // of a picture
        this.exposure = "photos";
        this.flight = null;
        this.session = null; // of WebXR: the page's own frames rest
        this.frames = 0;
        this.index = 0;
        this.state = "loading"; // "loading", "preview", "ready" or "failed": for tests
    }

    get pose() {
        return this.#pose;
    }

    set pose(pose) {
        this.#pose = pose;
        this.flight = null;
        this.#changed();
    }

    #changed() {
        this.dirty = true;
        this.pacing.touch();
        clearTimeout(this.linking);
        this.linking = setTimeout(() => this.#writeLink(), LINK_MILLISECONDS);
    }

    async start() {
        try {
            await this.#load();
        } catch (error) {
            this.#fail(error);
        }
    }

    // The renderer of the address, or a person's choice; else the exact one where a GPU carries it. Where the first fails,
    // the other is tried.
    async #load() {
        const named = known(query.get("renderer")), chosen = named ?? remembered();
        this.measuring = !chosen;
        const weak = !chosen && (await isWeak());
        if (weak) this.reason = "the default on this kind of device";
        const order = named ? [named] : new Set([chosen ?? (weak ? "baked" : "webgpu"), "webgpu", "baked"]);
        let failure = null;
        for (const kind of order) {
            try {
                await this.use(kind);
                failure = null;
                break;
            } catch (error) {
                if (this.running) throw error;
                if (!failure || !error.missing) failure = error;
            }
        }
        if (failure) throw failure;
        this.#firstPicture();
        this.state = "ready";
        this.pacing.measure(); // anew, since frames before had no texture
        this.dirty = true;
        element("loading").hidden = true;
        this.#announce("The scene is loaded.");
    }

    // Draw with a renderer: at once if there is none yet, else when it has loaded. A canvas that has given a context of one
    // kind gives no other, so each renderer has its own.
    async use(kind) {
        const [Kind, file] = RENDERERS[kind];
        const canvas = this.canvas.cloneNode(true), before = this.running;
        const renderer = await Kind.create(canvas, {
            onProgress: progress => this.#progress(progress),
            onStage: stage => this.#stage(stage),
            onLost: reason => this.#lost(reason),
        });
        if (!before) this.#exchange(renderer, canvas);
        try {
            await renderer.load(file);
        } catch (error) {
            renderer.destroy();
            throw error;
        }
        if (!before) return;
        await this.drawing;
        this.#exchange(renderer, canvas);
        this.#offerModes();
        this.#resize();
    }

    #exchange(renderer, canvas) {
        this.renderer?.destroy();
        this.canvas.replaceWith(canvas);
        Object.assign(this, {renderer, canvas, sized: false, refined: null});
    }

    // A person's choice holds, here and on the next visit; none leaves it to the page.
    async #choose(kind) {
        remember(kind);
        this.measuring = !kind;
        this.reason = "";
        if (kind) await this.use(kind).catch(error => this.note(error.message));
    }

    // Where the first second of frames is too slow, the baked scene takes over, if there is one.
    #measure() {
        const rate = this.pacing.framesPerSecond;
        if (!this.measuring || rate === null || this.state !== "ready") return;
        this.measuring = false;
        if (rate >= LEAST_RATE || this.renderer instanceof BakedRenderer) return;
        this.reason = `since the neural texture had ${rate.toFixed(0)} frames a second`;
        this.use("baked").catch(() => (this.reason = ""));
    }

    #stage(stage) {
        if (stage === "header") this.#showPoster();
        if (stage === "geometry") this.#firstPicture();
        this.dirty = true;
        this.refined = null;
    }

    #progress({bytes, total}) {
        if (!bytes || this.state === "failed") return;
        const size = x => (x / 1e6).toFixed(1);
        element("progress").textContent = total ? `Loading ${size(bytes)} of ${size(total)} MB` : `Loading ${size(bytes)} MB`;
        if (total) element("filled").style.width = `${(100 * bytes) / total}%`;
    }

    #showPoster() {
        const blob = this.renderer?.poster, poster = element("poster");
        if (!blob || this.running) return;
        poster.src = URL.createObjectURL(blob);
        poster.hidden = false;
    }

    // Set the camera and the controls up, once there is something to draw.
    #firstPicture() {
        if (this.running) return;
        this.running = true;
        this.state = "preview";
        const {header} = this.renderer;
        this.cameras = header.cameras;
        this.basis = basisOf(header.up);
        const camera = this.cameras[header.start] ?? null;
        this.start_ = camera ? Pose.of(this.basis, camera, header) : this.#overview(header);
        this.near = camera?.near ?? header.near;
        this.index = header.start;
        this.#pose = this.start_;
        this.#readLink();
        this.controls = new Controls(this.stage, this);
        const lookAt = point => this.#flyTo(this.pose.lookingAt(point));
        this.notes = new Notes(JSON.parse(element("notes").textContent), element("labels"), lookAt);
        this.#settings(header);
        addEventListener("hashchange", () => this.#readLink());
        new ResizeObserver(() => this.#resize()).observe(this.stage);
        this.#resize();
        this.#run();
    }

    // Without cameras: the scene's bounds from the side.
    #overview({bounds: [low, high], center, up}) {
        const size = Math.hypot(...low.map((x, i) => high[i] - x)) || 1;
        const pose = new Pose(basisOf(up), {eye: center, yaw: 0, pitch: -0.3, fov: 50, distance: size});
        return pose.moved(0, 0, -1);
    }

    #settings({exposures}) {
        const mode = element("mode"), camera = element("camera"), renderer = element("renderer");
        this.#offerModes();
        mode.onchange = () => this.setMode(mode.value);
        renderer.value = remembered() ?? "";
        renderer.onchange = () => this.#choose(renderer.value);
        const options = this.cameras.map(({name}, i) => new Option(name, String(i)));
        camera.replaceChildren(...options);
        camera.onchange = () => this.goTo(Number(camera.value));
        for (const id of ["previous", "next"]) element(id).hidden = this.cameras.length < 2;
        const fov = element("fov");
        fov.oninput = () => (this.pose = this.pose.with({fov: Number(fov.value)}));
        element("exposure-label").hidden = !exposures;
        element("exposure").onchange = event => {
            this.exposure = event.target.checked ? "photos" : "mean";
            this.#changed();
        };
        const buttons = {previous: "[", next: "]", home: "Home", fly: "v", link: "l", full: "f", more: ",", help: "?"};
        const inside = {picture: "p", turn: "t"}; // of the settings
        for (const [id, key] of Object.entries({...buttons, ...inside})) element(id).onclick = () => this.act(key);
        element("embed").onclick = () => this.#copyEmbed();
        if (query.has("turn") && !still()) this.#setTurning(true);
        element("full").hidden = !document.fullscreenEnabled;
        offerSessions(this);
    }

    #offerModes() {
        const {modes} = this.renderer;
        element("mode").replaceChildren(...modes.map(name => new Option(MODES[name], name)));
        if (!modes.includes(this.mode)) this.mode = "image";
        element("mode").value = this.mode;
    }

    // What a key or a button does; false for a key without meaning.
    act(key) {
        const actions = {
            "[": () => this.goTo(this.index - 1),
            "]": () => this.goTo(this.index + 1),
            Home: () => this.#flyTo(this.start_, "Back at the start."),
            v: () => this.#setFlying(!this.flying),
            l: () => this.#copyLink(),
            f: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()),
            ",": () => this.#toggleSettings(),
            m: () => this.#nextMode(),
            p: () => this.#savePicture(),
            t: () => this.#setTurning(!this.turning),
            "?": () => element("help-dialog").showModal(),
        };
        if (!Object.hasOwn(actions, key)) return false;
        actions[key]();
        return true;
    }

    goTo(index) {
        const count = this.cameras.length;
        if (!count) return;
        this.index = ((index % count) + count) % count;
        element("camera").value = String(this.index);
        const camera = this.cameras[this.index];
        this.#flyTo(Pose.of(this.basis, camera, this.renderer.header), `Camera ${camera.name}.`);
    }

    setMode(mode) {
        this.mode = mode;
        element("mode").value = mode;
        this.#announce(`Showing ${MODES[mode] ?? mode}.`);
        this.#changed();
    }

    #nextMode() {
        const modes = [...element("mode").options].map(option => option.value);
        this.setMode(modes[(modes.indexOf(this.mode) + 1) % modes.length]);
    }

    #setFlying(flying) {
        this.flying = flying;
        element("fly").setAttribute("aria-pressed", String(flying));
        this.#announce(flying ? "Flying: drag to look around." : "Orbiting: drag to turn the scene.");
    }

    #setTurning(turning) {
        this.turning = turning;
        element("turn").checked = turning;
    }

    #advanceTurn(seconds) {
        if (!this.turning || this.flight || this.controls.busy) return;
        this.#pose = this.#pose.turned(TURN * seconds, 0, false);
        this.#changed();
    }

    #savePicture() {
        this.saving = true; // the next frame, which is of full resolution
        this.dirty = true;
    }

    #toggleSettings() {
        const settings = element("settings");
        settings.hidden = !settings.hidden;
        element("more").setAttribute("aria-expanded", String(!settings.hidden));
    }

    async pickTarget(x, y) {
        const box = this.canvas.getBoundingClientRect(), {width, height} = this.canvas;
        const hit = await this.renderer.pick(((x - box.left) / box.width) * width, ((y - box.top) / box.height) * height);
        if (hit) this.#flyTo(this.pose.lookingAt(hit.position));
    }

    #flyTo(pose, text) {
        if (text) this.#announce(text);
        if (still()) {
            this.pose = pose;
            return;
        }
        this.flight = {from: this.#pose, to: pose, since: performance.now()};
        this.#changed();
    }

    async #copy(text, done, failed) {
        try {
            await navigator.clipboard.writeText(text);
            this.note(done);
        } catch {
            this.note(failed);
        }
    }

    #copyLink() {
        this.#writeLink();
        return this.#copy(location.href, "The link is copied.", "The address of this page is the link.");
    }

    #copyEmbed() {
        this.#writeLink();
        const address = location.href.replaceAll("&", "&amp;").replaceAll('"', "&quot;");
        return this.#copy(`<iframe src="${address}" ${EMBED}></iframe>`, "The HTML is copied.", "The browser did not copy it.");
    }

    #writeLink() {
        const mode = this.mode === "image" ? "" : `&mode=${this.mode}`;
        try {
            history.replaceState(null, "", `#${this.#pose.toFragment()}${mode}`);
        } catch {
            // Some browsers limit how often, or forbid it for files.
        }
    }

    #readLink() {
        const text = location.hash.slice(1), pose = this.#pose.fromFragment(text);
        const mode = new URLSearchParams(text).get("mode") ?? "image";
        if (!pose) return;
        this.pose = pose;
        this.mode = mode;
        this.#offerModes();
    }

    #resize() {
        const ratio = Math.min(devicePixelRatio || 1, LARGEST_RATIO);
        const width = Math.max(Math.round(this.canvas.clientWidth * ratio), 1);
        const height = Math.max(Math.round(this.canvas.clientHeight * ratio), 1);
        if (width === this.canvas.width && height === this.canvas.height && this.sized) return;
        this.sized = true;
        Object.assign(this.canvas, {width, height});
        this.#changed();
    }

    // One frame after another, never two at once; nothing is drawn while nothing changes.
    async #run() {
        let before = performance.now();
        while (this.state !== "failed") {
            const now = await new Promise(done => requestAnimationFrame(done));
            const seconds = Math.min((now - before) / 1000, 0.1);
            before = now;
            this.controls.advance(seconds);
            this.#advanceFlight();
            this.#advanceTurn(seconds);
            if (this.session) continue;
            const refine = this.refined !== "full" && !this.pacing.moving;
            if (!this.dirty && !refine) continue;
            this.dirty = false;
            const options = this.saving ? {resolutionScale: 1} : this.pacing.options;
            this.refined = options.resolutionScale === 1 ? "full" : "coarse";
            this.drawing = this.#draw(options).catch(error => this.#fail(error));
            await this.drawing;
            this.drawing = null;
        }
    }

    async #draw(options) {
        const camera = this.#pose.camera(this.canvas.width, this.canvas.height, this.near);
        const {mode, exposure} = this;
        const {milliseconds} = await this.renderer.render(camera, {...options, mode, exposure});
        this.notes.place(camera);
        if (this.saving) await this.#download();
        if (++this.frames === 1) {
            element("poster").classList.add("gone");
            performance.mark("first picture");
        }
        this.pacing.took(milliseconds, options);
        this.#measure();
        this.#showStatus(options);
    }

    async #download() {
        this.saving = false;
        const {width, height} = this.canvas, page = new OffscreenCanvas(width, height);
        const pixels = Uint8ClampedArray.from(await this.renderer.read("image"), (x, i) => (i % 4 === 3 ? 255 : 255 * x));
        page.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
        const address = URL.createObjectURL(await page.convertToBlob());
        Object.assign(document.createElement("a"), {href: address, download: "nexwarp.png"}).click();
        URL.revokeObjectURL(address);
        this.note("The picture is saved.");
    }

    #advanceFlight() {
        if (!this.flight) return;
        const {from, to, since} = this.flight;
        const t = Math.min((performance.now() - since) / FLIGHT_MILLISECONDS, 1);
        this.#pose = t < 1 ? from.mixed(to, t * t * (3 - 2 * t)) : to;
        if (t >= 1) this.flight = null;
        this.#changed();
    }

    #showStatus({resolutionScale}) {
        const {width, height} = this.canvas, {surfels} = this.renderer;
        const size = `${Math.round(width * resolutionScale)} × ${Math.round(height * resolutionScale)}`;
        const kind = this.renderer instanceof BakedRenderer ? ["baked, WebGL", this.reason] : ["neural, WebGPU"];
        const time = this.pacing.milliseconds.toFixed(0);
        const facts = [`${surfels.toLocaleString("en")} surfels`, size, `${time} ms`, ...kind];
        element("status").textContent = facts.filter(Boolean).join(" · ");
        const fov = Math.round(Math.min(Math.max(this.#pose.fov, FOV[0]), FOV[1]));
        if (document.activeElement !== element("fov")) element("fov").value = String(fov);
    }

    // A line that everybody sees for some seconds.
    note(text) {
        this.#announce(text, true);
    }

    // The session of WebXR is over.
    leave() {
        this.session = null;
        this.#changed();
    }

    #announce(text, visible = false) {
        element("announce").textContent = text;
        element("announce").classList.toggle("unseen", !visible);
        clearTimeout(this.noting);
        if (visible) this.noting = setTimeout(() => element("announce").classList.add("unseen"), NOTE_MILLISECONDS);
    }

    #lost(reason) {
        this.#fail(new SceneError(`The picture stopped. ${reason?.message ?? reason} Reload the page to go on.`));
    }

    #fail(error) {
        if (this.state === "failed") return;
        this.state = "failed";
        element("loading").hidden = true;
        const message = element("message");
        message.hidden = false;
        const known = error instanceof SceneError;
        message.textContent = known ? error.message : `The scene cannot be shown: ${error?.message ?? error}`;
    }
}

const known = kind => (Object.hasOwn(RENDERERS, kind) ? kind : null);

function remembered() {
    try {
        return known(localStorage.getItem(CHOICE));
    } catch {
        return null; // the browser keeps nothing
    }
}

function remember(kind) {
    try {
        localStorage.setItem(CHOICE, kind);
    } catch {
        // It holds until the page is left.
    }
}

const viewer = new Viewer();
globalThis.nexwarp = viewer; // for tests and for the console
viewer.start();
