// The resolution of the picture follows the time that frames take: coarse while moving, full at rest.

const MOVING_MILLISECONDS = 28; // wanted time of a frame while moving
const COARSEST = 0.2;
const REST_MILLISECONDS = 180; // without a change, before the picture is refined
const MEASURED_MILLISECONDS = 1000, MEASURED_FRAMES = 10; // both, before the frame rate is known
const REDUCED = 0.7; // below this resolution, the texture is evaluated more coarsely first

export class Pacing {
    constructor() {
        this.scale = 0.5; // until frames have been timed
        this.milliseconds = null;
        this.changed = -Infinity;
        this.measure();
    }

    // Measure the frame rate anew.
    measure() {
        this.times = []; // of frames while moving, as at half the resolution
        this.measured = 0; // milliseconds of these
    }

    // Note that the camera or the mode has changed.
    touch() {
        this.changed = performance.now();
    }

    get moving() {
        return performance.now() - this.changed < REST_MILLISECONDS;
    }

    // What renderers take for the next frame.
    get options() {
        if (!this.moving) return {resolutionScale: 1};
        const slow = this.scale < REDUCED;
        return {resolutionScale: this.scale, textureScale: slow ? 0.5 : 1, leastWeight: slow ? 1 / 64 : 0};
    }

    // At half the resolution while moving, by the median of the first second of frames; null before.
    get framesPerSecond() {
        if (this.measured < MEASURED_MILLISECONDS || this.times.length < MEASURED_FRAMES) return null;
        return 1000 / this.times.sort((a, b) => a - b)[Math.floor(this.times.length / 2)];
    }

    // Learn from a frame. The time is about proportional to the number of pixels, with a part that is not.
    took(milliseconds, {resolutionScale, textureScale}) {
        this.milliseconds = this.milliseconds === null ? milliseconds : 0.7 * this.milliseconds + 0.3 * milliseconds;
        const moving = textureScale !== undefined;
        if (moving && this.framesPerSecond === null) {
            this.times.push(milliseconds * (0.5 / resolutionScale) ** 2);
            this.measured += milliseconds;
        }
        const wanted = resolutionScale * Math.sqrt(MOVING_MILLISECONDS / Math.max(milliseconds, 1));
        const step = Math.min(Math.max(wanted / this.scale, 0.6), 1.25);
        this.scale = Math.min(Math.max(this.scale * step ** 0.5, COARSEST), 1);
    }
}
