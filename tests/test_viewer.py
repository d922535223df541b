"""The viewer: its pictures, its pace, its paths, what it refuses, what it costs a training, and a browser's view."""

import copy
import io
import json
import math
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data import write_demo
from nexwarp.representation.detail_limits import DetailLimits
from nexwarp.representation.exposures import Exposures
from nexwarp.run.folder import keep_camera_path
from nexwarp.train import presets
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.trainer import Trainer
from nexwarp.viewer import Viewer
from nexwarp.viewer.camera_path import OPENGL, Keyframe, interpolate, path_json
from nexwarp.viewer.modes import BY_SLOT, COUNTED, MODES, TEXTURED, Settings, draw
from nexwarp.viewer.pacing import SMALLEST, Pace, Share
from nexwarp.viewer.server import may_connect
from nexwarp.viewer.world import Viewpoint, World, camera_to_world, vertical_fov
from tests.scenes import intrinsics, make_camera, make_surfels, make_texture, random_scene, rigid

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_looks")

OPTIONS = nw.RenderOptions(background=(0.1, 0.2, 0.3))
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def model() -> nw.Model:
    return nw.Model(make_surfels(random_scene(60, width=64, height=48)), make_texture(), options=OPTIONS)


@pytest.fixture(scope="module")
def camera() -> nw.Camera:
    scene = random_scene(1)
    return make_camera(scene | {"K": intrinsics(48.0, 48.0, 32.0, 24.0).float(), "width": 64, "height": 48})


def ring(count: int = 6) -> dict[str, dict[str, nw.Camera]]:
    """Cameras around the random scene, turned and off the origin."""
    cameras = {}
    for i in range(count):
        viewmat = rigid((0.9, 0.2, -0.3 + 0.1 * i, 0.1), (0.3 - 0.2 * i, -0.2, 0.5)).float()
        cameras[f"{i}.png"] = nw.Camera(viewmat, intrinsics(50.0, 50.0, 32.0, 24.0).float(), 64, 48)
    return {"train": cameras}


# Pictures


def eight_bit(x: torch.Tensor) -> np.ndarray:
    return (x.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


@pytest.mark.parametrize("mode", ["image", "plain", "textured"])
def test_colour_modes_are_the_buffers(model, camera, mode):
    with torch.no_grad():
        out = model.render(camera, max_hits=3, sh_degree=1)
    picture = draw(model, [camera], Settings(mode, max_hits=3, sh_degree=1))
    assert picture.span is None
    np.testing.assert_array_equal(picture.pixels, eight_bit(getattr(out, mode)))


@pytest.mark.parametrize("falloff", [None, (-0.2, -0.1, 0.3)])
def test_colours_are_at_the_exposure_of_the_photos_or_the_mean(camera, falloff):
    model = nw.Model(make_surfels(random_scene(60, width=64, height=48)), make_texture(), options=OPTIONS)
    mean = {mode: draw(model, [camera], Settings(mode)).pixels for mode in MODES}
    model.exposures = Exposures.of(torch.tensor([[0.4, 0.0, -0.5]]), [camera], falloff)
    for mode in MODES:
        exposed = draw(model, [camera], Settings(mode)).pixels
        assert np.array_equal(exposed, mean[mode]) == (mode not in ("image", "plain", "textured")), mode
        again = draw(model, [camera], Settings(mode, photo_exposure=False)).pixels
        np.testing.assert_allclose(again.astype(int), mean[mode].astype(int), atol=1, err_msg=mode)


def test_buffer_modes_tell_what_the_buffers_hold(model, camera):
    with torch.no_grad():
        out = model.bare(max_hits=8).render(camera)
    pictures = {mode: draw(model, [camera], Settings(mode, slot=2)) for mode in MODES}
    there = (out.ids[..., 1] >= 0).numpy()
    assert 0.1 < there.mean() < 0.99
    for mode in BY_SLOT:
        lit = pictures[mode].pixels.any(axis=2)
        np.testing.assert_array_equal(lit, there, err_msg=mode)
    ids = out.ids[..., 1].numpy()[there]
    colours = {i: {tuple(c) for c in pictures["ids"].pixels[there][ids == i]} for i in np.unique(ids)}
    assert all(len(c) == 1 for c in colours.values()), "one surfel, one colour"
    assert len(set.union(*colours.values())) == len(colours), "two surfels, two colours"
    # Scales: equal values have equal colours, and more is more of green, which viridis never takes back.
    for mode, values in (("depth", out.depths[..., 1]), ("weights", out.weights[..., 1]), ("alpha", out.alpha)):
        where = there if mode != "alpha" else np.ones_like(there)
        order = np.argsort(values.numpy()[where], kind="stable")
        assert (np.diff(pictures[mode].pixels[where][order][:, 1].astype(int)) >= 0).all(), mode
    low, high = pictures["depth"].span
    assert float(out.depths[..., 1].numpy()[there].min()) <= low < high <= float(out.depths.max())
    count = (out.weights >= COUNTED).sum(dim=2).numpy()
    shades = {n: {tuple(c) for c in pictures["hit count"].pixels[count == n]} for n in np.unique(count)}
    assert all(len(s) == 1 for s in shades.values()) and len(set.union(*shades.values())) == len(shades) > 3


def test_normals_face_the_camera_and_belong_to_their_surfel(camera):
    quat = torch.tensor([[0.6, 0.5, -0.2, 0.4]])
    x, y, z, w = (quat[0, [1, 2, 3, 0]] / quat.norm()).tolist()
    normal = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    to_world = camera_to_world(camera)
    centre = to_world[:3, 3] + 3.0 * to_world[:3, 2]
    one = torch.ones(1)
    surfels = nw.Surfels.from_activated(
        torch.tensor(centre[None]).float(),
        quat,
        2 * torch.ones(1, 2),
        0.9 * one,
        torch.ones(1, 2),
        torch.zeros(1, 1, 3),
    )
    picture = draw(nw.Model(surfels, None, options=OPTIONS), [camera], Settings("normal"))
    seen = picture.pixels[24, 32] / 255.0 * 2.0 - 1.0
    expected = normal if normal @ (centre - to_world[:3, 3]) < 0 else -normal
    np.testing.assert_allclose(seen, expected, atol=1.01 / 127)


@pytest.mark.parametrize("mode", MODES)
def test_bands_make_the_same_picture(model, camera, mode):
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 64, 48)
    like = model.surfels.means
    whole, parts = here.bands(1.0, 0.01, like), here.bands(1.0, 0.01, like, count=3)
    assert [(c.height, c.cy) for c in parts] == [(16, 24.0), (16, 8.0), (16, -8.0)] and whole[0].height == 48
    one, many = (draw(model, bands, Settings(mode)).pixels.astype(int) for bands in (whole, parts))
    assert (abs(one - many) <= 1).mean() > 0.995 and one.std() > 1


def test_every_mode_looks_the_same_everywhere(model, camera, device):
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 64, 48)
    for mode in MODES:
        one, other = (
            draw(shown, here.bands(1.0, 0.01, shown.surfels.means, count=2), Settings(mode))
            for shown in (copy.deepcopy(model).to(d) for d in (torch.device("cpu"), device))
        )
        assert (np.abs(one.pixels.astype(int) - other.pixels) <= 2).mean() > 0.99, mode
        assert one.span is None or np.allclose(one.span, other.span, rtol=1e-4)


def test_a_stale_picture_is_given_up(model, camera):
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 64, 48)
    bands, asked = here.bands(1.0, 0.01, model.surfels.means, count=3), []
    assert draw(model, bands, Settings(), stale=lambda: asked.append(1) or len(asked) == 2) is None
    assert len(asked) == 2


def test_photo_detail_limits_the_texture_alone(model, camera):
    """Not the surfels, which are as wide as the picture's own pixels show them."""
    farthest = torch.full((len(model.surfels),), 3.5 / (3 * camera.focal))
    limits = DetailLimits(torch.zeros_like(farthest), farthest)
    model = nw.Model(model.surfels, model.texture, detail_limits=limits, options=OPTIONS)
    here = Viewpoint(camera_to_world(camera), vertical_fov(camera), 256, 192)
    free, limited = (here.bands(1.0, 0.01, model.surfels.means, focal_limit=f) for f in (math.inf, camera.focal))
    assert limited[0].focal == pytest.approx(camera.focal) and free[0].focal == pytest.approx(4 * camera.focal)
    one, other = (draw(model, bands, Settings("image")).pixels for bands in (free, limited))
    assert (one != other).any()
    for mode in ("plain", "ids", "depth"):
        one, other = (draw(model, bands, Settings(mode)).pixels for bands in (free, limited))
        np.testing.assert_array_equal(one, other)


def test_no_surfels_and_no_texture_can_be_looked_at(camera, model):
    none = make_surfels({k: v[:0] if torch.is_tensor(v) and v.ndim else v for k, v in random_scene(3).items()})
    for mode in MODES:
        pixels = draw(nw.Model(none, None, options=OPTIONS), [camera], Settings(mode)).pixels
        assert pixels.shape == (48, 64, 3) and (mode in ("image", "alpha") or not pixels.any())
    assert draw(model.bare(), [camera], Settings(max_hits=0)).pixels.any()
    assert set(TEXTURED) == {"image", "textured"}


def test_settings_take_what_can_be_meant():
    settings = Settings().changed(max_hits=99, sh_degree=-5, slot=0)
    assert (settings.max_hits, settings.sh_degree, settings.slot) == (8, 0, 1)
    for bad in (
        {"mode": "rm -rf"},
        {"max_hits": "2"},
        {"max_hits": 2.5},
        {"slot": True},
        {"as_trained": 1},
        {"photo_exposure": "no"},
    ):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Settings().changed(**bad)


# Pace


def test_the_share_of_time_is_kept_whatever_pictures_cost():
    generator = np.random.default_rng(0)
    for share in (0.05, 0.2, 0.5):
        budget, now, spent = Share(share), 0.0, 0.0
        while now < 500.0:
            if budget.due(now):
                cost = generator.uniform(0.01, 0.5)
                now, spent = now + cost, spent + cost
                budget.spend(now, cost)
            now += 0.03
        assert 0.5 * share < spent / now <= share + 0.01
    with pytest.raises(ValueError, match="share"):
        Share(0.2).set(math.nan)


def test_pictures_are_sized_to_come_in_time():
    pace = Pace()
    assert pace.scale("a", 1280, 800, 0.1) == 0.25
    pace.observe("a", 1000, 2.0)  # compiles
    pace.observe("a", 1000, 0.001)
    for limit in (0.03, 0.1, 0.5, 2.0):
        scale = pace.scale("a", 1280, 800, limit)
        assert pace.seconds("a", 1280 * 800 * scale**2) <= limit
        assert scale == 1.0 or pace.seconds("a", 1280 * 800 * scale**2 * 2) > limit
    assert min(1280, 800) * pace.scale("a", 1280, 800, 1e-9) == pytest.approx(SMALLEST)
    assert pace.bands("a", 1e6) == 5 and pace.bands("b", 1e6) == 1


# Cameras and paths


def test_the_browsers_frame_there_and_back():
    cameras = list(ring()["train"].values())
    world = World.around(cameras, torch.zeros(0, 3))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(world.to_scene(world.to_browser(points)), points, atol=1e-12)
    centres = world.to_browser(np.stack([camera_to_world(c)[:3, 3] for c in cameras]))
    assert np.linalg.norm(centres, axis=1).max() == pytest.approx(3.0)
    assert all(camera_to_world(c)[:3, 1] @ world.up < 0 for c in cameras), "image down is not up"
    lone = World.around(cameras[:1], torch.randn(50, 3))
    assert np.isfinite(lone.focus).all() and lone.unit > 0
    assert World.around([], torch.zeros(0, 3)).unit == 1.0


def test_a_browsers_camera_is_the_scenes():
    camera = ring()["train"]["3.png"]
    world = World.around(list(ring()["train"].values()), torch.zeros(0, 3))
    pose = camera_to_world(camera)
    w = np.sqrt(1 + np.trace(pose[:3, :3])) / 2
    v = np.array([pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]]) / (4 * w)
    here = Viewpoint.of((w, *v), world.to_browser(pose[:3, 3]), vertical_fov(camera), 64, 48, world)
    (back,) = here.bands(1.0, camera.near, torch.zeros(1))
    torch.testing.assert_close(back.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.K, camera.K, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"wxyz": (0, 0, 0, 0)},
        {"wxyz": (1, 0, 0)},
        {"position": (math.nan, 0, 0)},
        {"position": (1e30, 0, 0)},
        {"fov": 0.0},
        {"fov": math.pi},
        {"fov": math.inf},
        {"width": 0},
        {"height": 10**9},
    ],
)
def test_what_is_no_camera_is_refused(wrong):
    good = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 1.0, "width": 64, "height": 48}
    world = World.around([], torch.zeros(0, 3))
    Viewpoint.of(**good, world=world)
    with pytest.raises(ValueError, match="camera"):
        Viewpoint.of(**(good | wrong), world=world)


def keyframes(count: int = 4) -> list[Keyframe]:
    cameras = ring(count)["train"].values()
    return [Keyframe(camera_to_world(camera), 0.6 + 0.1 * i) for i, camera in enumerate(cameras)]


@pytest.mark.parametrize("closed", [False, True])
def test_a_path_meets_its_keyframes_smoothly(closed):
    keys = keyframes()
    count = 40 * len(keys) if closed else 40 * (len(keys) - 1) + 1
    path = interpolate(keys, count, closed)
    assert len(path) == count
    for key, frame in zip(keys, path[::40], strict=True):
        np.testing.assert_allclose(frame.pose, key.pose, atol=1e-6)
        assert frame.fov == pytest.approx(key.fov)
    poses = np.stack([frame.pose for frame in path])
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), (count, 3, 3)),
        atol=1e-9,
        rtol=0,
    )
    loop = np.concatenate([poses, poses[:3]]) if closed else poses
    steps, turns = np.diff(loop, axis=0), np.diff(loop, n=2, axis=0)
    # No jump in speed anywhere, the seam included: second differences are a frame's share of first ones.
    assert np.abs(turns).max() < 0.25 * np.abs(steps).max()


def test_path_files_hold_what_nerfstudio_reads():
    keys = keyframes(3)
    data = json.loads(path_json(keys, 640, 480, 24, 2.0))
    assert {k: data[k] for k in data if k != "camera_path"} == {
        "render_width": 640,
        "render_height": 480,
        "fps": 24,
        "seconds": 2.0,
    }
    assert len(data["camera_path"]) == 48
    for key, frame in ((keys[0], data["camera_path"][0]), (keys[-1], data["camera_path"][-1])):
        pose = np.array(frame["camera_to_world"]).reshape(4, 4)
        np.testing.assert_allclose(pose @ OPENGL, key.pose, atol=1e-6)
        np.testing.assert_allclose(pose[:3, 1], -key.pose[:3, 1], atol=1e-6)  # up is up
        assert frame["fov"] == pytest.approx(math.degrees(key.fov)) and frame["aspect"] == pytest.approx(4 / 3)


def test_paths_that_cannot_be(tmp_path):
    for arguments, word in (
        ((keyframes(1), 64, 48, 30, 1.0), "two"),
        ((keyframes(2), 0, 48, 30, 1.0), "width"),
        ((keyframes(2), 64, 48, 30, math.nan), "seconds"),
        ((keyframes(2), 64, 48, 120, 1e6), "20,000"),
    ):
        with pytest.raises(ValueError, match=word):
            path_json(*arguments)
    same = [keyframes(1)[0]] * 3
    assert np.ptp([frame.pose for frame in interpolate(same, 9)], axis=0).max() < 1e-9
    assert keep_camera_path(tmp_path, b"1").endswith("camera_path_1.json")
    assert keep_camera_path(tmp_path, b"2").endswith("camera_path_2.json")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera_path_1.json", "camera_path_2.json"]


# Who may look


def test_only_the_servers_own_pages_may_connect():
    own = "127.0.0.1:8080"
    assert may_connect("127.0.0.1", f"http://{own}", own) and may_connect("127.0.0.1", None, own)
    assert may_connect("127.0.0.1", "http://localhost:9000", "localhost:9000"), "through a tunnel"
    for origin, asked in (
        ("http://evil.example", own),
        ("http://evil.example:8080", "evil.example:8080"),  # a name that leads here
        ("http://localhost:3000", own),
        ("null", own),
    ):
        assert not may_connect("127.0.0.1", origin, asked)
    assert may_connect("0.0.0.0", "http://lab.example", "10.0.0.7:8080")


def refused(capsys: pytest.CaptureFixture, arguments: list[str], *words: str) -> None:
    """The command fails with one line that holds the words."""
    assert cli.main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and all(word in lines[0] for word in words), lines


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A tiny finished run."""
    folder = tmp_path_factory.mktemp("viewer")
    scene = write_demo(folder / "tiny", width=48, height=36, views=10, points=200)
    small = Config(texture=TextureConfig(levels=4, table_size=2**10, width=16), densify=DensifyConfig(every=3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "default", small)
        flags = ["--iterations", "20", "--max-surfels", "100", "--device", "cpu"]
        assert cli.main(["train", str(scene), "--run", str(folder / "run"), *flags]) == 0
    return folder / "run"


def test_one_line_for_what_cannot_be_shown(run, tmp_path, capsys, monkeypatch):
    capsys.readouterr()
    refused(capsys, ["view", str(tmp_path / "none")], str(tmp_path / "none"), "expected a run folder")
    shutil.copytree(run, tmp_path / "early")
    (tmp_path / "early" / "model.safetensors").unlink()
    refused(capsys, ["view", str(tmp_path / "early")], "model.safetensors")
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        refused(capsys, ["view", str(run), "--port", port], "--port", port, "in use", "another")
        new = ["train", str(run.parent / "tiny"), "--run", str(tmp_path / "new"), "--view", "--port", port]
        refused(capsys, new, "--port", "in use")
    assert not (tmp_path / "new").exists()
    refused(capsys, ["view", str(run), "--port", "70000"], "--port", "65535", "70000")
    refused(capsys, ["view", str(run), "--host", "203.0.113.1"], "--host", "203.0.113.1")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    refused(capsys, ["view", str(run)], "viser", "pip install 'nexwarp[viewer]'")


# A server and its clients


class Client:
    """What a browser says and hears, without the browser."""

    def __init__(self, viewer: Viewer, **arguments: Any) -> None:
        import viser
        from websockets.sync.client import connect

        protocol = f"viser-v{viser.__version__}"
        url = viewer.url.replace("http", "ws")
        self.socket = connect(
            url, subprotocols=[protocol], compression=None, max_size=None, max_queue=None, **arguments
        )

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, kind: str, **values: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def look(self, **changes: Any) -> None:
        values = {"wxyz": (1, 0, 0, 0), "position": (0, 0, -4), "fov": 0.8, "image_width": 96, "image_height": 72}
        values |= {"near": 0.01, "far": 1000.0, "look_at": (0, 0, 0), "up_direction": (0, -1, 0)}
        self.send("ViewerCameraMessage", **(values | changes))

    def hear(self, seconds: float = 20.0) -> Iterator[dict[str, Any]]:
        """Messages as they come; TimeoutError after some time."""
        import msgspec
        import zstandard

        end = time.monotonic() + seconds
        while True:
            raw = self.socket.recv(timeout=max(end - time.monotonic(), 0.01))
            length = int.from_bytes(raw[8:16], "little")
            data = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))
            yield from data["messages"]

    def picture(self) -> np.ndarray:
        """The next picture."""
        for message in self.hear():
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                return np.asarray(Image.open(io.BytesIO(message["rgb_data"])))
        raise AssertionError

    def control(self, label: str) -> str:
        """Identifier of a control; panels are sent first."""
        for message in self.hear():
            if message.get("props", {}).get("label") == label:
                return message["uuid"]
        raise AssertionError


@contextmanager
def serving(model: nw.Model, **arguments: Any) -> Iterator[Viewer]:
    """A viewer that draws on a thread of its own."""
    pytest.importorskip("viser")
    over = threading.Event()
    with Viewer(lambda: model, ring(), near=0.01, port=0, **arguments) as viewer:
        thread = threading.Thread(target=viewer.show, args=(over.is_set,))
        thread.start()
        try:
            yield viewer
        finally:
            over.set()
            thread.join()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_clients_look_for_themselves_and_come_and_go(model, tmp_path):
    with serving(model, save_path=lambda content: keep_camera_path(tmp_path, content)) as viewer:
        with Client(viewer) as one, Client(viewer) as two:
            one.look()
            two.look()
            mode = two.control("Show")
            wait_for(lambda: len(viewer.sessions) == 2)
            sessions = list(viewer.sessions.values())
            two.send("GuiUpdateMessage", uuid=mode, updates={"value": "alpha"})
            wait_for(lambda: {s.settings.mode for s in sessions} == {"image", "alpha"})
            wait_for(lambda: all(s.drawn_scale == 1.0 and s.drawn_version == s.version for s in sessions))
            assert {s.viewpoint.width for s in sessions} == {96}
            wait_for(lambda: len(viewer.thumbnails) == 6)
        wait_for(lambda: not viewer.sessions)
        with Client(viewer) as late:  # finds everything as the first did
            late.look(position=(0, 0, -3))
            assert late.picture().ndim == 3


def test_nonsense_is_dropped_and_hurts_nobody(model, capfd):
    with serving(model) as viewer, Client(viewer) as good, Client(viewer) as bad:
        good.look()
        bad.look()
        wait_for(lambda: len(viewer.sessions) == 2)
        session = viewer.sessions[max(viewer.sessions)]
        slider = session.panel.max_hits
        uuid = slider._impl.uuid
        wait_for(lambda: session.drawn_version == session.version)
        version = session.version
        for value in ("many", None, [1, 2], math.nan, {"a": 1}):
            bad.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"removed": True})
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"update_cb": None})
        bad.send("GuiUpdateMessage", uuid="of an older page", updates={"value": 3})
        bad.send("ShareUrlRequest")
        click = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "screen_pos": (0, 0), "modifier": None}
        bad.send("SceneNodeClickMessage", name="/cameras/none", instance_index=None, **click)
        for wrong in ({"fov": math.nan}, {"wxyz": (0, 0, 0, 0)}, {"image_height": 0}, {"image_width": 10**9}):
            bad.look(**wrong)
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"value": 99})
        wait_for(lambda: session.settings.max_hits == 8)
        assert slider.value == 8 and not slider._impl.removed and session.version == version + 1
        assert session.viewpoint.width == 96 and math.isfinite(session.viewpoint.fov)
        bad.socket.send(b"\xc1 no message at all")
        wait_for(lambda: len(viewer.sessions) == 1)  # it is shown out
        good.look(position=(0.5, 0, -3))
        assert good.picture().ndim == 3
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err, out + err


def test_pages_of_other_servers_are_refused(model):
    from websockets.exceptions import ConnectionClosed

    with serving(model) as viewer, Client(viewer, origin="http://evil.example") as foreign:
        with pytest.raises(ConnectionClosed):
            foreign.look()
            foreign.picture()
        assert not viewer.sessions
        with Client(viewer, origin=viewer.url) as own:
            own.look()
            assert own.picture().ndim == 3


def test_a_picture_that_fails_is_told_and_the_rest_goes_on(model, monkeypatch):
    from nexwarp.viewer import viewer as module

    def fail(*arguments: Any, **options: Any) -> Any:
        if arguments[2].mode == "normal":
            raise RuntimeError("out of memory")
        return draw(*arguments, **options)

    monkeypatch.setattr(module, "draw", fail)
    with serving(model) as viewer, Client(viewer) as client:
        client.look()
        wait_for(lambda: len(viewer.sessions) == 1)
        (session,) = viewer.sessions.values()
        session.change(mode="normal")
        note = next(m for m in client.hear() if m["type"] == "NotificationShowMessage")
        assert "out of memory" in str(note)
        session.change(mode="image")
        wait_for(lambda: session.drawn_version == session.version and session.drawn_scale == 1.0)


# Training


def trainer_of(run: Path, **changes: Any) -> Trainer:
    settings = {"iterations": 12, "max_surfels": 120, "densify": DensifyConfig(every=3)} | changes
    texture = TextureConfig(levels=4, table_size=2**10, width=16)
    return Trainer(nw.load_scene(run.parent / "tiny"), Config(**settings, texture=texture), "cpu")


def test_looking_changes_nothing_about_a_training(run):
    pytest.importorskip("viser")
    alone, watched = trainer_of(run), trainer_of(run)
    alone.run()
    described: list[int] = []
    scene = watched.scene
    trainer = watched = trainer_of(run)
    with (
        Viewer(
            trainer.model,
            {"train": {view.name: view.camera for view in scene.train}},
            near=0.01,
            port=0,
            photos={f"train/{view.name}": lambda view=view: view.image for view in scene.train},
            total=12,
        ) as viewer,
        Client(viewer) as client,
    ):
        client.look()
        wait_for(lambda: len(viewer.sessions) == 1)
        viewer.share.share = 0.9
        (session,) = viewer.sessions.values()
        drawn = []

        def observe(step: Any) -> None:
            session.changed_at = -math.inf  # still
            viewer.between_steps(step.iteration, lambda: described.append(step.iteration) or "fine")
            drawn.append(session.drawn_step)
            if step.iteration == 6:  # paused by somebody, resumed while it waits
                viewer._toggle_pause()
                threading.Timer(0.3, viewer._toggle_pause).start()

        watched.run(observe)
        assert len(set(drawn)) > 2 and described, "pictures came while it trained"
        assert session.frustums and len(viewer.thumbnails) == len(scene.train)
        finished = watched.finish()
        viewer.finish("done", lambda: finished)
        asked: list[nw.Model] = []
        shown = viewer.model
        viewer.model = lambda: asked.append(shown()) or shown()
        start = time.perf_counter()
        viewer.show(
            lambda: (bool(asked) and session.drawn_version == session.version) or time.perf_counter() > start + 20
        )
        assert asked and asked[-1] is finished and finished.surfels is not watched.surfels
    for (name, a), (_, b) in zip(alone._named_parameters(), watched._named_parameters(), strict=True):
        assert torch.equal(a, b), name


def test_nobody_looking_costs_nothing_and_a_pause_ends_when_asked(run):
    pytest.importorskip("viser")
    with Viewer(lambda: TINY, ring(), near=0.01, port=0, total=10, photos={}) as viewer:
        start = time.perf_counter()
        for i in range(1000):
            viewer.between_steps(i, lambda: pytest.fail("asked although nobody looks"))
        assert time.perf_counter() - start < 0.05, "less than 50 microseconds a step"
        viewer._toggle_pause()
        asked: list[int] = []
        viewer.between_steps(1, lambda: "paused", stop=lambda: asked.append(1) or len(asked) > 2)
        assert len(asked) == 3


TINY = nw.Model(make_surfels(random_scene(4)), make_texture(), options=OPTIONS)


# A browser


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.timeout(180)
def test_in_a_browser(model, tmp_path):
    api = pytest.importorskip("playwright.sync_api")
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    errors: list[str] = []
    with (
        serving(model, save_path=lambda content: keep_camera_path(tmp_path, content)) as viewer,
        api.sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 900, "height": 700})
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(viewer.url)
        page.get_by_text("nexwarp · nexwarp").wait_for()
        wait_for(lambda: len(viewer.sessions) == 1)
        (session,) = viewer.sessions.values()

        def settled() -> np.ndarray:
            """The picture as the browser shows it, left of the panel, once it is at its finest."""
            wait_for(lambda: session.drawn_version == session.version and session.drawn_scale == 1.0)
            page.wait_for_timeout(500)
            shot = page.screenshot(clip={"x": 20, "y": 250, "width": 450, "height": 430})
            return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

        def differ(a: np.ndarray, b: np.ndarray) -> float:
            return float(np.abs(a - b).mean())

        image = settled()
        assert image.std() > 10, "a frame has arrived"
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="ids", exact=True).click()
        wait_for(lambda: session.settings.mode == "ids")
        assert differ(settled(), image) > 10, "the mode changes the picture"
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="image", exact=True).click()
        wait_for(lambda: session.settings.mode == "image")
        again = settled()
        assert differ(again, image) < 2, "and back"
        slider = page.get_by_role("slider", name="K").or_(page.get_by_role("slider").nth(0))
        slider.first.focus()
        page.keyboard.press("Home")
        wait_for(lambda: session.settings.max_hits == 0)
        assert differ(settled(), again) > 1, "the slider changes the picture"

        page.mouse.move(200, 450)
        page.mouse.down()
        page.mouse.move(320, 430, steps=5)
        page.mouse.up()
        settled()
        assert not np.allclose(session.viewpoint.pose, session.home.pose, atol=1e-3), "dragging moves the camera"
        page.get_by_role("tab", name="Record").click()
        page.get_by_role("button", name="Add this view").click()
        wait_for(lambda: len(session.keyframes) == 1)
        session.jump("train/4.png")
        wait_for(
            lambda: np.allclose(session.viewpoint.pose, camera_to_world(session.cameras["train/4.png"]), atol=1e-3)
        )
        page.get_by_role("button", name="Add this view").click()
        wait_for(lambda: len(session.keyframes) == 2)
        with page.expect_download() as path:
            page.get_by_role("button", name="Save path").click()
        saved = json.loads(Path(path.value.path()).read_text())
        assert len(saved["camera_path"]) == 180 and (saved["render_width"], saved["render_height"]) == (64, 48)
        assert json.loads((tmp_path / "camera_path_1.json").read_text()) == saved
        with page.expect_download() as shot:
            page.get_by_role("button", name="Save screenshot").click()
        with Image.open(shot.value.path()) as png:
            assert png.format == "PNG" and png.height == 1080
            assert png.width == pytest.approx(1080 * session.viewpoint.width / session.viewpoint.height, abs=1)
        browser.close()
        wait_for(lambda: not viewer.sessions)
    assert not errors, errors
