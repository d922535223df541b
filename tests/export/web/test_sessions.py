"""WebXR: what a headset's two eyes see of the baked scene, with a stand-in for the browser's `navigator.xr`."""

import dataclasses

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE
from tests.export.web import support
from tests.export.web.support import CHROMIUM, FINISHED, POSE, PageTab, psnr

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"), pytest.mark.timeout(300)]
SIZE = (96, 80)  # of an eye, pixels
HEADSET = """kinds => {
    const session = Object.assign(new EventTarget(), {
        updateRenderState({baseLayer}) { this.layer = baseLayer; },
        async requestReferenceSpace(kind) { return kind; },
        requestAnimationFrame(draw) { this.draw = draw; },
        async end() { this.dispatchEvent(new Event("end")); },
    });
    const xr = {
        session,
        async isSessionSupported(kind) { return kinds.includes(kind); },
        async requestSession(kind) { this.kind = kind; return session; },
    };
    Object.defineProperty(navigator, "xr", {value: xr});
    WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
    window.XRWebGLLayer = class {
        constructor(session, gl) {
            const texture = gl.createTexture();
            gl.bindTexture(gl.TEXTURE_2D, texture);
            gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 2 * WIDTH, HEIGHT);
            this.framebuffer = gl.createFramebuffer();
            gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
            gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        }
        getViewport(view) { return {x: view.index * WIDTH, y: 0, width: WIDTH, height: HEIGHT}; }
    };
}""".replace("WIDTH", str(SIZE[0])).replace("HEIGHT", str(SIZE[1]))
DRAW_EYES = """([eyes, head]) => {
    const {session} = navigator.xr, {gl} = nexwarp.renderer, {draw} = session;
    const transform = matrix => ({inverse: {matrix: Float32Array.from(matrix)}});
    const views = eyes.map(([projection, view], index) => (
        {index, projectionMatrix: Float32Array.from(projection), transform: transform(view)}));
    session.draw = null;
    draw(0, {getViewerPose: space => space === "local" ? {views, transform: transform(head)} : null});
    gl.bindFramebuffer(gl.FRAMEBUFFER, session.layer.framebuffer);
    const bytes = new Uint8Array(4 * 2 * WIDTH * HEIGHT);
    gl.readPixels(0, 0, 2 * WIDTH, HEIGHT, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return [Array.from(bytes), session.draw !== null];
}""".replace("WIDTH", str(SIZE[0])).replace("HEIGHT", str(SIZE[1]))
DRAW = """async camera => {
    Object.assign(nexwarp.canvas, {width: camera.width, height: camera.height});
    await nexwarp.renderer.render(camera, {exposure: "mean"});
    return Array.from(await nexwarp.renderer.read());
}"""


def eye_pose(across: float, turned: float) -> np.ndarray:
    """Where an eye is in the room (4, 4), metres, y up: to the side of the head, a step ahead, the head turned."""
    head = np.eye(4)
    head[:3, :3] = [[np.cos(turned), 0, np.sin(turned)], [0, 1, 0], [-np.sin(turned), 0, np.cos(turned)]]
    head[:3, 3] = [0.1, -0.05, -0.2]
    shift = np.eye(4)
    shift[0, 3] = across
    return head @ shift


def projection_of(left: float, right: float, down: float, up: float) -> np.ndarray:
    """OpenGL's projection matrix (4, 4) of the tangents at the picture's sides."""
    near, far = 0.1, 1000.0
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2 / (right - left), (right + left) / (right - left)
    matrix[1, 1], matrix[1, 2] = 2 / (up - down), (up + down) / (up - down)
    matrix[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    matrix[3, 2] = -1
    return matrix


def camera_of(pose: np.ndarray, sides: tuple[float, float, float, float], room: np.ndarray, near: float) -> nw.Camera:
    """The camera of an eye in the scene, where a point of the room lies at `room` (4, 4) times it."""
    back = room @ pose
    axes = back[:3, :3] / np.linalg.norm(back[:3, 0])
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ back[:3, 3]
    left, right, down, up = sides
    fx, fy = SIZE[0] / (right - left), SIZE[1] / (up - down)
    K = torch.tensor([[fx, 0, -left * fx], [0, fy, up * fy], [0, 0, 1]]).float()
    return nw.Camera(torch.from_numpy(viewmat).float(), K, *SIZE, near=near)


def room_of(tab: PageTab, metres: float) -> np.ndarray:
    """Room to scene (4, 4): the head starts at the page's camera, upright, and looks where it looks."""
    eye, forward, up = tab.value("[nexwarp.pose.eye, nexwarp.pose.axes().forward, nexwarp.renderer.header.up]")
    up = np.array(up) / np.linalg.norm(up)
    ahead = np.array(forward) - up * (forward @ up)
    ahead /= np.linalg.norm(ahead)
    room = np.eye(4)
    room[:3, :3] = np.stack([np.cross(ahead, up), up, -ahead], axis=1) / metres
    room[:3, 3] = eye
    return room


@pytest.mark.parametrize("kind", ["vr", "ar"])
def test_both_eyes_see_the_scene_from_where_they_are(open_tab, site, tmp_path, kind):
    for name in (BAKED_FILE, ATLAS_FILE):
        (tmp_path / name).write_bytes(site[name])
    scene = dataclasses.replace(nw.load_baked(tmp_path), exposures=None)
    tab = open_tab(webgpu=kind == "vr", device_scale_factor=1)
    tab.page.add_init_script(f"({HEADSET})(['immersive-{kind}'])")
    tab.open(f"?renderer={'webgpu' if kind == 'vr' else 'baked'}")
    assert tab.page.is_visible(f"#{kind}") and not tab.page.is_visible("#ar" if kind == "vr" else "#vr")
    before = tab.value(POSE)
    tab.page.click(f"#{kind}")
    tab.wait("Boolean(navigator.xr.session.draw)")
    assert tab.value("navigator.xr.kind") == f"immersive-{kind}"

    near, distance = tab.value("[nexwarp.near, nexwarp.start_.distance]")
    room = room_of(tab, metres=2 / distance)
    sides = ((-0.9, 0.7, -0.8, 0.6), (-0.7, 0.9, -0.8, 0.6))
    poses = [eye_pose(across, turned=0.15) for across in (-0.032, 0.032)]
    eyes = [
        [projection_of(*tangents).T.ravel().tolist(), np.linalg.inv(pose).T.ravel().tolist()]
        for tangents, pose in zip(sides, poses, strict=True)
    ]
    head = np.linalg.inv(eye_pose(0.0, turned=0.15)).T.ravel().tolist()
    pixels, goes_on = tab.value(DRAW_EYES, [eyes, head])
    assert goes_on
    both = np.array(pixels, np.float32).reshape(SIZE[1], 2 * SIZE[0], 4)[::-1] / 255
    cameras = [camera_of(pose, tangents, room, near) for tangents, pose in zip(sides, poses, strict=True)]
    for camera, shown in zip(cameras, np.split(both, 2, axis=1), strict=True):
        page = torch.tensor(tab.value(DRAW, support.entry_of(camera))).reshape(SIZE[1], SIZE[0], 4)[..., :3]
        color, alpha = torch.from_numpy(shown[..., :3].copy()), shown[..., 3]
        with torch.no_grad():
            expected = scene.render(camera).clamp(0, 1)
            alone = scene.render(camera, background=(0.0, 0.0, 0.0)).clamp(0, 1)
        assert psnr(page, expected) > 46 and expected.std() > 0.05
        if kind == "vr":
            assert psnr(color, page) > 46 and (alpha == 1).all()
        else:
            assert psnr(color, alone) > 46 and alpha.min() == 0 and alpha.max() > 0.9, "the room shows between surfels"
    assert np.abs(both[:, : SIZE[0]] - both[:, SIZE[0] :]).mean() > 0.01, "the eyes differ"

    # The session ends: the page goes on where it was.
    tab.page.click(f"#{kind}")
    tab.wait(f"{FINISHED} && nexwarp.session === null")
    assert tab.value(POSE) == before and tab.picture().std() > 0.05 and not tab.errors


def test_no_button_without_a_headset_and_one_line_where_it_fails(open_tab):
    tab = open_tab()
    tab.open("?renderer=baked")
    assert not tab.page.is_visible("#vr") and not tab.page.is_visible("#ar")
    tab.page.add_init_script(f"({HEADSET})(['immersive-vr'])")
    tab.page.add_init_script("navigator.xr.session.requestReferenceSpace = () => Promise.reject(new Error('no space'))")
    tab.open("?renderer=baked")
    tab.page.click("#vr")
    tab.wait("document.getElementById('announce').textContent === 'no space' && nexwarp.session === null")
    tab.value("nexwarp.pose = nexwarp.pose.turned(0.1, 0, false)")
    tab.wait(FINISHED)
    assert tab.picture().std() > 0.05 and not tab.errors
