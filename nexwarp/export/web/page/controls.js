// Mouse, touch and keys: they change a pose through callbacks.

const RADIANS_PER_VIEW = 2.4; // of a drag across the smaller side of the view
const KEY_TURN = 1.6; // radians a second
const KEY_MOVE = 0.7; // distances to the target a second
const FIRST_SECONDS = 0.03; // that a key counts for at once
const TAP_MILLISECONDS = 300, TAP_PIXELS = 12;

const MOVES = {w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0]};
const TURNS = {ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]};
const ZOOMS = {"+": 0.5, "=": 0.5, "-": 2};

// `viewer` has get pose, set pose, flying, act(name), pickTarget(x, y).
export class Controls {
    constructor(stage, viewer) {
        Object.assign(this, {stage, viewer, pointers: new Map(), keys: new Set(), fast: false, lastTap: null});
        const on = (name, act, options) => stage.addEventListener(name, act.bind(this), options);
        on("pointerdown", this.#down);
        on("pointermove", this.#move);
        for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) on(name, this.#up);
        on("wheel", this.#wheel, {passive: false});
        on("contextmenu", event => event.preventDefault());
        addEventListener("keydown", this.#key.bind(this));
        addEventListener("keyup", event => this.keys.delete(nameOf(event)));
        addEventListener("blur", () => this.keys.clear());
    }

    get busy() {
        return this.pointers.size > 0 || this.keys.size > 0;
    }

    get #scale() {
        return RADIANS_PER_VIEW / Math.max(Math.min(this.stage.clientWidth, this.stage.clientHeight), 1);
    }

    #down(event) {
        this.viewer.canvas.focus({preventScroll: true});
        this.stage.setPointerCapture(event.pointerId);
        this.stage.classList.add("dragging");
        const moving = event.button === 2 || event.button === 1 || event.shiftKey;
        this.pointers.set(event.pointerId, {x: event.clientX, y: event.clientY, moving, travelled: 0, since: performance.now()});
    }

    #move(event) {
        const pointer = this.pointers.get(event.pointerId);
        if (!pointer) return;
        const before = this.#spread();
        const dx = event.clientX - pointer.x, dy = event.clientY - pointer.y;
        Object.assign(pointer, {x: event.clientX, y: event.clientY, travelled: pointer.travelled + Math.hypot(dx, dy)});
        const {viewer} = this;
        if (this.pointers.size >= 2) {
            const after = this.#spread();
            viewer.pose = this.#panned(viewer.pose, after.x - before.x, after.y - before.y);
            const factor = before.size > 10 && after.size > 10 ? before.size / after.size : 1;
            viewer.pose = viewer.flying ? viewer.pose.moved(0, 0, 1 - factor) : viewer.pose.zoomed(factor);
        } else if (pointer.moving) {
            viewer.pose = this.#panned(viewer.pose, dx, dy);
        } else {
            const scale = this.#scale * (viewer.flying ? -0.5 : 1);
            viewer.pose = viewer.pose.turned(-dx * scale, -dy * scale, viewer.flying);
        }
    }

    // The scene follows the fingers at the target's depth.
    #panned(pose, dx, dy) {
        const pixel = 1 / pose.focal(Math.max(this.stage.clientWidth, 1), Math.max(this.stage.clientHeight, 1));
        return pose.moved(-dx * pixel, -dy * pixel, 0);
    }

    #spread() {
        const places = [...this.pointers.values()].slice(0, 2);
        if (places.length < 2) return {x: 0, y: 0, size: 0};
        const [a, b] = places;
        return {x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, size: Math.hypot(a.x - b.x, a.y - b.y)};
    }

    #up(event) {
        const pointer = this.pointers.get(event.pointerId);
        if (!this.pointers.delete(event.pointerId)) return;
        if (!this.pointers.size) this.stage.classList.remove("dragging");
        const now = performance.now(), tap = now - pointer.since < TAP_MILLISECONDS && pointer.travelled < TAP_PIXELS;
        if (event.type !== "pointerup" || !tap || pointer.moving) return;
        const last = this.lastTap;
        if (last && now - last.time < TAP_MILLISECONDS && Math.hypot(last.x - pointer.x, last.y - pointer.y) < 2 * TAP_PIXELS) {
            this.viewer.pickTarget(pointer.x, pointer.y);
            this.lastTap = null;
        } else {
            this.lastTap = {x: pointer.x, y: pointer.y, time: now};
        }
    }

    #wheel(event) {
        event.preventDefault();
        const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
        const factor = Math.exp(Math.min(Math.max(pixels, -200), 200) * 0.0015);
        const {viewer} = this;
        viewer.pose = viewer.flying ? viewer.pose.moved(0, 0, 1 - factor) : viewer.pose.zoomed(factor);
    }

    #key(event) {
        const name = nameOf(event);
        if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.("select, input, dialog")) return;
        const onButton = event.target.closest?.("button");
        if (name in MOVES || name in TURNS || name in ZOOMS) {
            this.fast = event.shiftKey;
            if (!this.keys.has(name)) this.#apply(name, FIRST_SECONDS); // also a tap between two slow frames counts
            this.keys.add(name);
            event.preventDefault();
        } else if (!event.repeat && !onButton && this.viewer.act(name)) {
            event.preventDefault();
        }
    }

    // What the keys that are held down do in some seconds.
    advance(seconds) {
        for (const name of this.keys) this.#apply(name, seconds);
    }

    #apply(name, seconds) {
        const {viewer} = this, speed = seconds * (this.fast ? 4 : 1);
        if (name in MOVES) viewer.pose = viewer.pose.moved(...MOVES[name].map(x => x * KEY_MOVE * speed));
        if (name in TURNS) {
            const [yaw, pitch] = TURNS[name].map(x => x * KEY_TURN * seconds);
            // Orbiting, the camera itself goes the way that the arrow points.
            viewer.pose = viewer.flying ? viewer.pose.turned(yaw, pitch, true) : viewer.pose.turned(-yaw, -pitch, false);
        }
        if (name in ZOOMS) viewer.pose = viewer.pose.zoomed(ZOOMS[name] ** speed);
    }
}

function nameOf(event) {
    return event.key.length === 1 ? event.key.toLowerCase() : event.key;
}
