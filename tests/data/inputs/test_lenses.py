"""Photos of other lenses are undistorted once and kept."""

import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.data import load_scene
from nexwarp.data.lens import Lens, Map, pycolmap_module
from tests.data.inputs.support import SIZE, assert_same_cameras, edit
from tests.data.test_scene import make_scene, views_of
from tests.scene_writers import demo_lens, photograph, write_nerfstudio


def psnr(image: torch.Tensor, reference: np.ndarray) -> float:
    return -10 * float(torch.log10(((image.float() - torch.from_numpy(reference).float()) / 255).square().mean()))


@pytest.mark.parametrize(("model", "least"), [("OPENCV", 29.0), ("OPENCV_FISHEYE", 29.0)])
def test_undistorted_photos_are_pinhole_photos(demo, distorted, model, least):
    """Against photos of the undistorted camera; ignoring the lens would cost at least 4 dB."""
    scene = load_scene(distorted[model])
    for view in (scene.train[0], scene.train[5], scene.test[1]):
        camera = view.camera
        size = (camera.width, camera.height)
        undistorted = Lens("PINHOLE", (camera.fx, camera.fy, camera.cx, camera.cy), *size)
        own = np.array(Image.open(demo / "images" / view.name))
        photo = photograph(own, demo_lens(demo, "PINHOLE", ()), undistorted)
        raw = Image.open(distorted[model] / "images" / view.name).resize(size, Image.Resampling.BICUBIC)
        ignored = psnr(torch.from_numpy(np.array(raw)), photo)
        assert psnr(view.image, photo) > max(least, ignored + 4) and view.mask is None
    assert scene.points.shape == (len(load_scene(distorted[model]).points), 3)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_lens_is_the_same_in_nerfstudios_words(distorted, tmp_path, model):
    scene = load_scene(write_nerfstudio(distorted[model], tmp_path / "scene"))
    assert_same_cameras(scene, load_scene(distorted[model]))


def test_more_coefficients_and_older_words(distorted, tmp_path):
    path = write_nerfstudio(distorted["OPENCV_FISHEYE"], tmp_path / "fisheye")
    edit(path, lambda data: data.pop("camera_model") and data.update(is_fisheye=True))
    assert_same_cameras(load_scene(path), load_scene(distorted["OPENCV_FISHEYE"]))
    path = write_nerfstudio(distorted["OPENCV"], tmp_path / "opencv")
    two = load_scene(path).train[0]
    edit(path, lambda data: data.update(k3=0.5))
    three = load_scene(path).train[0]
    assert not torch.equal(two.camera.K, three.camera.K)
    lens = demo_lens(distorted["OPENCV"], "OPENCV", ())
    full = pycolmap_module().Camera(model="FULL_OPENCV", width=96, height=72, params=[*lens.params, 0.5, 0.0, 0.0, 0.0])
    expected = pycolmap_module().undistort_camera(pycolmap_module().UndistortCameraOptions(), full)
    assert (three.camera.width, three.camera.height) == (expected.width, expected.height)
    assert (three.camera.cx, three.camera.cy) == pytest.approx((expected.params[2], expected.params[3]))


def test_undistorted_photos_are_kept(distorted, cache, monkeypatch):
    first = load_scene(distorted["OPENCV"], downscale=2)
    files = [file for file in cache.rglob("*") if file.is_file()]
    assert len(files) == SIZE["views"] and not any(file.name.startswith(".") for file in files)
    monkeypatch.setattr(Map, "colors", lambda *_: pytest.fail("undistorted again"))
    again = load_scene(distorted["OPENCV"], downscale=2)
    assert_same_cameras(again, first)
    monkeypatch.undo()


def test_a_damaged_cache_is_made_anew(distorted, cache):
    first = load_scene(distorted["OPENCV"])
    files = sorted(file for file in cache.rglob("*.png"))
    files[0].write_bytes(files[0].read_bytes()[:100])
    files[1].write_bytes(b"")
    Image.new("RGB", (3, 3)).save(files[2])
    assert_same_cameras(load_scene(distorted["OPENCV"]), first)
    assert_same_cameras(load_scene(distorted["OPENCV"]), first)


def test_other_pixels_are_other_entries_of_the_cache(distorted, tmp_path, cache):
    path = tmp_path / "scene"
    shutil.copytree(distorted["OPENCV"], path)
    first = load_scene(path)
    photo = path / "images" / "view_003.png"
    Image.fromarray(255 - np.array(Image.open(photo))).save(photo)
    changed = load_scene(path)
    same = [torch.equal(a.image, b.image) for a, b in zip(views_of(first), views_of(changed), strict=True)]
    assert same == [index != 3 for index in range(10)]


def test_a_cache_that_cannot_be_written_costs_one_warning(distorted, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("NEXWARP_CACHE", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="undistorted photos cannot be kept here") as caught:
        scene = load_scene(distorted["OPENCV"])
    assert len(caught) == 1 and len(scene.train) == 8 and (tmp_path / "file").read_text() == "no folder"


def test_a_full_disk_leaves_nothing(distorted, cache, monkeypatch):
    def full(self, stream, *_, **__):
        stream.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.warns(UserWarning, match="No space left on device"):
        load_scene(distorted["OPENCV"])
    assert not [file for file in cache.rglob("*") if file.is_file()]


def test_a_panorama_becomes_six_views(tmp_path):
    path = make_scene(tmp_path / "scene", model="EQUIRECTANGULAR", params=(48.0, 36.0), names=["a.png", "b.png"])
    scene = load_scene(path)
    assert [v.name for v in scene.test] == [
        f"a_{face}.png" for face in ("front", "right", "back", "left", "up", "down")
    ]
    assert len(scene.train) == 6 and all(v.image.shape == (15, 15, 3) for v in scene.train)
    centres = torch.stack([v.camera.position for v in scene.train])
    torch.testing.assert_close(centres, centres[:1].expand(6, 3), rtol=0, atol=1e-6)
    forward = torch.stack([v.camera.viewmat[2, :3] for v in scene.train])
    torch.testing.assert_close(forward.sum(dim=0), torch.zeros(3), rtol=0, atol=1e-6)
