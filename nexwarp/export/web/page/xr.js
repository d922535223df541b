// The scene in a headset, or in the room before a phone's camera, through WebXR: the baked scene, one picture an eye.

import {BakedRenderer} from "nexwarp/baked.js";
import {add} from "nexwarp/camera.js";

const SESSIONS = {vr: "immersive-vr", ar: "immersive-ar"};
const DISTANCE = 2; // metres from the first camera to its subject, where the scene's scale is not known

// Show a button for each kind of session that this device has.
export async function offerSessions(viewer) {
    for (const [id, kind] of Object.entries(SESSIONS)) {
        const button = document.getElementById(id);
        const act = () => (viewer.session ? viewer.session.end() : enter(viewer, kind));
        button.onclick = () => act().catch(error => viewer.note(error.message));
        button.hidden = !(await navigator.xr?.isSessionSupported(kind).catch(() => false));
    }
}

async function enter(viewer, kind) {
    const session = await navigator.xr.requestSession(kind); // first of all, since it needs the click
    viewer.session = session;
    session.addEventListener("end", () => viewer.leave());
    try {
        if (!(viewer.renderer instanceof BakedRenderer)) await viewer.use("baked");
        const {gl} = viewer.renderer;
        await gl.makeXRCompatible();
        const baseLayer = new XRWebGLLayer(session, gl, {antialias: false, depth: false, stencil: false});
        session.updateRenderState({baseLayer});
        const space = await session.requestReferenceSpace("local");
        const place = placeOf(viewer);
        const draw = (time, frame) => {
            session.requestAnimationFrame(draw);
            const head = frame.getViewerPose(space);
            if (head) drawEyes(viewer, head, baseLayer, place, kind === SESSIONS.ar);
        };
        session.requestAnimationFrame(draw);
    } catch (error) {
        await session.end().catch(() => {});
        throw error;
    }
}

// Where the origin of the room lies in the scene: at the page's camera, upright. Its axes point right, up and back.
function placeOf({pose, start_: start, renderer: {header}}) {
    const {right, down, forward} = pose.with({pitch: 0, roll: 0}).axes();
    const axes = [right, down.map(x => -x), forward.map(x => -x)];
    return {eye: pose.eye, axes, metres: header.metres ?? DISTANCE / start.distance};
}

function drawEyes({renderer, near}, head, layer, place, seeThrough) {
    const eyes = head.views.map(view => {
        view.requestViewportScale?.(view.recommendedViewportScale); // fewer pixels where the device is too slow
        const part = layer.getViewport(view), {width, height} = part, p = view.projectionMatrix;
        const K = [(p[0] * width) / 2, (p[5] * height) / 2, ((1 - p[8]) * width) / 2, ((1 + p[9]) * height) / 2];
        return {part, camera: {viewmat: viewmatOf(view.transform, place), K, width, height, near}};
    });
    renderer.renderEyes(eyes, viewmatOf(head.transform, place), layer.framebuffer, seeThrough);
}

// World to camera, by rows, of a transform in the room, whose matrix is by columns and looks back along z.
function viewmatOf({inverse: {matrix: m}}, {eye, axes, metres}) {
    const rows = [1, -1, -1].map((sign, i) => {
        const row = axes.reduce((sum, axis, k) => add(sum, axis, sign * m[4 * k + i]), [0, 0, 0]);
        return [...row, (sign * m[12 + i]) / metres - row.reduce((sum, x, k) => sum + x * eye[k], 0)];
    });
    return [...rows.flat(), 0, 0, 0, 1];
}
