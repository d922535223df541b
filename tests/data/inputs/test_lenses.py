"""Photos of other lenses are undistorted."""

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.data import load_scene
from nexwarp.data.lens import Lens, pycolmap_module
from tests.data.inputs.support import assert_same_cameras, edit
from tests.data.test_scene import make_scene
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
