// The camera of the page: a pose given by eye, yaw, pitch and roll about the scene's upward direction.

const TAU = 2 * Math.PI;
const STEEPEST = TAU / 4 - 0.01;
export const FOV = [15, 110]; // vertical, degrees
const NARROWEST = 0.4; // share of the focal length that is left in a narrow window

export const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => {
    const length = Math.hypot(...a);
    return length > 1e-12 ? a.map(x => x / length) : [0, 0, 1];
};
const mixed = (a, b, t) => a + (b - a) * t;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// World directions that angles are measured in: up, and two across it.
export function basisOf(up) {
    const u = unit(up);
    const smallest = u.map(Math.abs).indexOf(Math.min(...u.map(Math.abs)));
    const east = unit(cross([0, 1, 2].map(i => Number(i === smallest)), u));
    return {up: u, east, north: cross(u, east)};
}

export class Pose {
    constructor(basis, {eye, yaw, pitch, roll = 0, fov, distance, offset = [0, 0], aspect = 1, shape = 1}) {
        Object.assign(this, {basis, eye, yaw, pitch, roll, fov, distance, offset, aspect, shape});
    }

    // The pose of a camera of the scene; `distance` from the eye to the point to orbit around, `shape` that of the part
    // of the photo that a window has to show: all of its height, and its width as far as the subject reaches.
    static of(basis, {viewmat: m, K: [fx, fy, cx, cy], width, height}, {center, radius}) {
        const eye = [0, 1, 2].map(i => -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]));
        const forward = m.slice(8, 11), right = m.slice(0, 3);
        const pitch = Math.asin(clamp(dot(forward, basis.up), -1, 1));
        const yaw = Math.atan2(dot(forward, basis.north), dot(forward, basis.east));
        const level = new Pose(basis, {eye, yaw, pitch}).axes();
        const roll = Math.atan2(dot(right, level.down), dot(right, level.right));
        const ahead = dot(add(center, eye, -1), forward);
        const distance = ahead > 1e-6 ? ahead : Math.max(Math.hypot(...add(center, eye, -1)), 1e-3);
        const fov = (2 * Math.atan(height / 2 / fy) * 360) / TAU;
        const offset = [(cx - width / 2) / height, (cy - height / 2) / height];
        const photo = width / height, subject = (radius ?? Infinity) / distance / (height / 2 / fy);
        const shape = clamp(subject, Math.min(photo, 1), photo);
        return new Pose(basis, {eye, yaw, pitch, roll, fov, distance, offset, aspect: fx / fy, shape});
    }

    axes() {
        const {up, east, north} = this.basis;
        const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
        const forward = [0, 1, 2].map(i => cp * (cy * east[i] + sy * north[i]) + sp * up[i]);
        // The horizontal direction follows from the yaw alone, also where the view is straight up or down.
        const level = [0, 1, 2].map(i => sy * east[i] - cy * north[i]);
        const below = cross(forward, level);
        const [sr, cr] = [Math.sin(this.roll || 0), Math.cos(this.roll || 0)];
        const right = level.map((x, i) => cr * x + sr * below[i]);
        return {forward, right, down: cross(forward, right)};
    }

    get target() {
        return add(this.eye, this.axes().forward, this.distance);
    }

    with(changes) {
        return new Pose(this.basis, {...this, ...changes});
    }

    // Turn by angles in radians, around the target or in place.
    turned(yaw, pitch, inPlace) {
        const next = this.with({yaw: (this.yaw + yaw) % TAU, pitch: clamp(this.pitch + pitch, -STEEPEST, STEEPEST), roll: 0});
        return inPlace ? next : next.with({eye: add(this.target, next.axes().forward, -this.distance)});
    }

    // Move along the camera's axes, in units of the distance to the target.
    moved(right, down, forward) {
        const axes = this.axes(), s = this.distance;
        let eye = add(this.eye, axes.right, right * s);
        eye = add(add(eye, axes.down, down * s), axes.forward, forward * s);
        return this.with({eye});
    }

    zoomed(factor) {
        const distance = Math.max(this.distance * factor, 1e-4);
        return this.with({eye: add(this.target, this.axes().forward, -distance), distance});
    }

    // Look at another point from here, which becomes the point to orbit around.
    lookingAt(point) {
        const away = add(point, this.eye, -1), distance = Math.hypot(...away);
        if (distance < 1e-6) return this;
        const forward = away.map(x => x / distance), {up, east, north} = this.basis;
        const pitch = clamp(Math.asin(clamp(dot(forward, up), -1, 1)), -STEEPEST, STEEPEST);
        return this.with({yaw: Math.atan2(dot(forward, north), dot(forward, east)), pitch, roll: 0, distance});
    }

    // Between this pose and another one, at t in [0, 1].
    mixed(other, t) {
        const turn = ((other.yaw - this.yaw + 1.5 * TAU) % TAU) - TAU / 2;
        const names = ["pitch", "roll", "fov", "distance", "aspect", "shape"];
        const numbers = Object.fromEntries(names.map(name => [name, mixed(this[name], other[name], t)]));
        const eye = this.eye.map((x, i) => mixed(x, other.eye[i], t));
        const offset = this.offset.map((x, i) => mixed(x, other.offset[i], t));
        return new Pose(this.basis, {...numbers, eye, offset, yaw: this.yaw + turn * t});
    }

    // Vertical focal length in pixels. A narrow window, such as a phone's, shows the subject from side to side, and more
    // above and below than the scene's cameras did.
    focal(width, height) {
        const narrow = Math.min(width / height / this.shape, 1);
        return (height / 2 / Math.tan((this.fov * TAU) / 720)) * Math.max(narrow, NARROWEST);
    }

    // The camera of an image of width x height pixels, as renderers take it.
    camera(width, height, near) {
        const {forward, right, down} = this.axes();
        const viewmat = [right, down, forward].flatMap(axis => [...axis, -dot(axis, this.eye)]);
        const fy = this.focal(width, height);
        const K = [fy * this.aspect, fy, width / 2 + this.offset[0] * height, height / 2 + this.offset[1] * height];
        return {viewmat: [...viewmat, 0, 0, 0, 1], K, width, height, near};
    }

    // As the fragment of an address, and back; null where it holds no pose.
    toFragment() {
        const short = x => Number(x.toPrecision(5));
        const parts = {
            eye: this.eye.map(short),
            look: [this.yaw, this.pitch, this.roll].map(short),
            d: [short(this.distance)],
            fov: [short(this.fov)],
        };
        return Object.entries(parts).map(([name, values]) => `${name}=${values.join(",")}`).join("&");
    }

    fromFragment(text) {
        const fields = new URLSearchParams(text);
        const numbers = (name, count) => {
            const values = (fields.get(name) ?? "").split(",").map(Number);
            return values.length === count && values.every(x => Number.isFinite(x) && Math.abs(x) < 1e9) ? values : null;
        };
        const eye = numbers("eye", 3), look = numbers("look", 3), d = numbers("d", 1), fov = numbers("fov", 1);
        if (!eye || !look || !d || !fov || !(d[0] > 0)) return null;
        const [yaw, pitch, roll] = look;
        const level = clamp(pitch, -TAU / 4, TAU / 4);
        return this.with({eye, yaw: yaw % TAU, pitch: level, roll, distance: d[0], fov: clamp(fov[0], ...FOV)});
    }
}
