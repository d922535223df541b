import dataclasses
import json
import re
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.data import load_scene
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.scene import SceneSource
from nexwarp.errors import MissingError, SceneError

WIDTH, HEIGHT = 48, 36


def pose(index: int) -> np.ndarray:
    """(3, 4) world to camera on a circle of radius 2 around the origin, looking at it."""
    angle = 0.37 * index
    forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
    rotation = np.stack([np.array([forward[1], -forward[0], 0.0]), np.array([0.0, 0.0, -1.0]), forward])
    return np.concatenate([rotation, rotation @ (2.0 * forward)[:, None]], axis=1)


PINHOLE = (40.0, 43.0, 25.5, 16.25)


def make_scene(
    path: Path, *, model="PINHOLE", params=PINHOLE, names=None, poses=None, points=None, where="sparse/0", text=False
) -> Path:
    """Write a COLMAP scene with random photos: of names, poses (3, 4) world to camera and points (P, 3)."""
    pycolmap = pycolmap_module()
    rng = np.random.default_rng(0)
    names = [f"{index:02d}.png" for index in range(10)] if names is None else names
    points = rng.uniform(-0.4, 0.4, (20, 3)) if points is None else points
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(params), camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for index, name in enumerate(names):
        image = pycolmap.Image(name=name, keypoints=np.ones((len(points), 2)), camera_id=1, image_id=index + 1)
        rigid = pycolmap.Rigid3d(pose(index) if poses is None else poses[index])
        reconstruction.add_image_with_trivial_frame(image, rigid)
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for image in range(min(len(names), 2 + index % 4)):
            track.add_element(image + 1, index)
        identity = reconstruction.add_point3D(point, track, rng.integers(0, 256, 3).astype(np.uint8))
        reconstruction.point3D(identity).error = 0.25 * index
    folder = path / where
    folder.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
    for name in names:
        if ".." not in name:
            write_photo(path / "images" / name, (WIDTH, HEIGHT))
    return path


def write_photo(file: Path, size: tuple[int, int]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(sum(file.name.encode()))
    Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)).save(file)


def project(camera, points: torch.Tensor) -> torch.Tensor:
    """(P, 2) pixel coordinates in float64."""
    viewmat, K = camera.viewmat.double(), camera.K.double()
    pixels = (points.double() @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def views_of(scene):
    return sorted([*scene.train, *scene.test], key=lambda view: view.name)


def test_loads_what_was_written(tmp_path):
    calls: list[tuple[int, int]] = []
    scene = load_scene(make_scene(tmp_path), progress=lambda *call: calls.append(call))
    assert calls == [(done, 10) for done in range(1, 11)] and scene.path == tmp_path
    assert scene.points.dtype == torch.float32 and scene.colors.dtype == torch.uint8
    expected = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3)).astype(np.float32)
    assert np.array_equal(scene.points.numpy(), expected)
    assert scene.track_lengths.tolist() == [2 + index % 4 for index in range(20)]
    assert scene.reprojection_errors.tolist() == [0.25 * index for index in range(20)]
    for index, view in enumerate(views_of(scene)):
        camera = view.camera
        assert view.name == f"{index:02d}.png" and view.mask is None and view.image.dtype == torch.uint8
        np.testing.assert_allclose(camera.viewmat[:3].numpy(), pose(index), atol=1e-6)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 43.0, 25.5, 16.25)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT) and view.image.shape == (HEIGHT, WIDTH, 3)
        assert camera.near == pytest.approx(0.01 * scene.scale)
        photo = np.asarray(Image.open(tmp_path / "images" / view.name))
        assert np.array_equal(view.image.numpy(), photo)


def test_every_eighth_view_by_name_is_for_testing(tmp_path):
    names = [f"{index:02d}.png" for index in (5, 16, 3, 0, 9, 12, 7, 1, 14, 2, 11, 4, 8, 15, 6, 10, 13)]
    scene = load_scene(make_scene(tmp_path, names=names))
    assert [view.name for view in scene.test] == ["00.png", "08.png", "16.png"]
    assert [view.name for view in scene.train] == [f"{index:02d}.png" for index in range(17) if index % 8]
    for view in views_of(scene):  # poses stay with their names
        expected = pose(names.index(view.name))
        np.testing.assert_allclose(view.camera.viewmat[:3].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("names", [["03.png"], ["00.png", "07.png"], ["0[1-4].png", "*8.png"], ["*[1357].png"], []])
def test_excluded_photos_are_left_out_and_the_others_keep_their_part(tmp_path, names):
    """The two sets are those of all photos without the excluded ones, with the same pixels and cameras."""
    path = make_scene(tmp_path)
    every = load_scene(path)
    left = load_scene(path, exclude=names)
    for kept, before in ((left.train, every.train), (left.test, every.test)):
        expected = [view for view in before if not any(fnmatch(view.name, name) for name in names)]
        assert [view.name for view in kept] == [view.name for view in expected]
        for one, other in zip(kept, expected, strict=True):
            assert torch.equal(one.image, other.image) and torch.equal(one.camera.viewmat, other.camera.viewmat)
    source = SceneSource(str(path), exclude=tuple(names))
    assert SceneSource.from_dict(json.loads(json.dumps(dataclasses.asdict(source)))) == source
    assert len(source.photos()) == len(left.train) + len(left.test)


def test_a_name_with_brackets_is_a_name(tmp_path):
    names = ["a1.png", "a[1].png", "left/b.png", "left/c.png"]
    path = make_scene(tmp_path, names=names)
    for pattern, left in {"a[1].png": [0, 2, 3], "left/*": [0, 1], "b*": None, "*b*": [0, 1, 3]}.items():
        if left is None:
            with pytest.raises(SceneError, match="no photo"):
                load_scene(path, exclude=[pattern])
        else:
            views = views_of(load_scene(path, exclude=[pattern]))
            assert [view.name for view in views] == [names[index] for index in left]


@pytest.mark.parametrize(
    ("exclude", "error", "match"),
    [
        (["01.png", "1?.png"], SceneError, r"no photo of .* is named '1\?.png', as 00.png is$"),
        (["01.PNG"], SceneError, "no photo"),
        (["0[1-7].png", "09.png"], SceneError, "expected to leave a training photo of"),
        (["*"], SceneError, "expected to leave a training photo of"),
        ("01.png", TypeError, "exclude: expected tuple or list, got str"),
        ([1], TypeError, "exclude: expected str, got int"),
    ],
)
def test_what_cannot_be_excluded_is_told(tmp_path, exclude, error, match):
    with pytest.raises(error, match=match):
        load_scene(make_scene(tmp_path), exclude=exclude)


def test_scale_is_the_reach_of_the_training_cameras(tmp_path):
    scene = load_scene(make_scene(tmp_path, model="SIMPLE_PINHOLE", params=(41.0, 20.5, 19.75)))
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (41.0, 41.0, 20.5, 19.75)
    centres = torch.stack([view.camera.position for view in scene.train]).double()
    assert scene.scale == pytest.approx(1.1 * (centres - centres.mean(dim=0)).norm(dim=1).max().item(), rel=1e-5)


def test_scale_of_a_turning_camera_is_the_distance_of_the_points(tmp_path):
    centre = np.array([3.0, -1.0, 0.5])
    poses = [np.concatenate([pose(i)[:, :3], -(pose(i)[:, :3] @ centre)[:, None]], axis=1) for i in range(10)]
    scene = load_scene(make_scene(tmp_path, poses=poses))
    distances = (scene.points.double() - torch.from_numpy(centre)).norm(dim=1)
    assert scene.scale == pytest.approx(np.median(distances.numpy()), rel=1e-6)


@pytest.mark.parametrize("downscale", [2, 5])
def test_downscale_scales_pixels_and_keeps_areas(tmp_path, downscale):
    path = make_scene(tmp_path)
    full, small = load_scene(path), load_scene(path, downscale=downscale)
    for one, other in zip(views_of(full), views_of(small), strict=True):
        rows, columns = HEIGHT // downscale, WIDTH // downscale
        assert other.image.shape == (rows, columns, 3) and (other.camera.width, other.camera.height) == (columns, rows)
        torch.testing.assert_close(
            project(other.camera, full.points), project(one.camera, full.points) / downscale, rtol=0, atol=1e-5
        )
        for row, column in ((0, 0), (rows - 1, columns - 1), (3, 4)):
            block = one.image[row * downscale : (row + 1) * downscale, column * downscale : (column + 1) * downscale]
            mean = block.double().mean(dim=(0, 1))
            assert (other.image[row, column].double() - mean).abs().max() <= 0.5


def test_smaller_photos_scale_each_axis_by_its_own_ratio(tmp_path):
    path = make_scene(tmp_path)
    for index in range(10):  # 48 x 36 in quarters, the width rounded up
        write_photo(path / "images_4" / f"{index:02d}.png", (13, 9))
    full, small = load_scene(path), load_scene(path, images="images_4")
    ratio = torch.tensor([13 / WIDTH, 9 / HEIGHT], dtype=torch.float64)
    for one, other in zip(views_of(full), views_of(small), strict=True):
        assert (other.camera.width, other.camera.height) == (13, 9)
        pixels, scaled = project(other.camera, full.points), project(one.camera, full.points) * ratio
        torch.testing.assert_close(pixels, scaled, rtol=0, atol=1e-5)


def damaged(name: str, change=lambda data: data[: len(data) // 2], **options):
    """Maker of a scene in which the bytes of a file are changed, by default cut in half; with None it is removed."""

    def make(path: Path) -> Path:
        file = make_scene(path, **options) / name
        file.unlink() if change is None else file.write_bytes(change(file.read_bytes()))
        return path

    return make


def tall(path: Path) -> Path:
    """A scene whose first photo is higher than wide."""
    write_photo(make_scene(path) / "images" / "00.png", (36, 48))
    return path


def built(**options):
    """Maker of a scene with other options."""
    return lambda path: make_scene(path, **options)


IMAGES = "sparse/0/images.bin"
NOT_A_NUMBER = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]])
UNDECODABLE = "03.png: expected a complete image file, could not decode it"
BAD_SCENES = {
    "no folder": (lambda path: path / "absent", "no such folder, expected a scene: COLMAP, nerfstudio or Blender"),
    "no model": (lambda path: path, "no scene found, expected a COLMAP model .*, transforms.json .*transforms_train"),
    "half a model": (damaged("sparse/0/points3D.bin", None), "incomplete COLMAP model in .*0: points3D.bin not found"),
    "no images in the model": (built(names=[]), "has no registered images"),
    "one image": (built(names=["a.png"]), "at least 2 registered images .* got 1"),
    "points of NaN": (built(points=NOT_A_NUMBER), r"finite 3D points, got \(0.0, nan, 0.0\)"),
    "escaping name": (built(names=["../x.png", "a.png"]), "image name '../x.png' leaves the images folder"),
    "absolute name": (built(names=["C:\\x.png", "a.png"]), "image name .* leaves the images folder"),
    "name of bytes": (damaged(IMAGES, lambda data: data.replace(b"03.png", b"\xff3.png")), r"UTF-8, got b'\\xff3.png'"),
    "name of two lines": (built(names=["a\nb.png", "a.png"]), r"image name 'a\\nb.png' leaves the images folder"),
    "absent photo": (damaged("images/03.png", None), "0: 1 of 10 photos: image not found: 03.png; --skip-missing"),
    "truncated photo": (damaged("images/03.png"), UNDECODABLE),
    "no photo at all": (damaged("images/03.png", lambda data: b"<html>not found</html>"), UNDECODABLE),
    "photos of another shape": (tall, "00.png: expected an image of 48x36 .* got 36x48"),
    "image id beyond 32 bits": (
        damaged("sparse/0/images.txt", lambda data: re.sub(rb"(?m)^1 ", b"18446744073709551617 ", data), text=True),
        "expected id, pose, camera and name of an image, or its keypoints, got '18446744073709551617",
    ),
    "focal length of zero": (built(params=(0.0, 43.0, 25.5, 16.25)), "00.png: .* K: expected focal lengths > 0"),
}


@pytest.mark.parametrize("kind", BAD_SCENES)
def test_bad_scenes_are_told_in_one_line(tmp_path, kind):
    make, message = BAD_SCENES[kind]
    with pytest.raises((ValueError, OSError), match=message) as caught:
        load_scene(make(tmp_path))
    assert isinstance(caught.value, (SceneError, MissingError))
    text = str(caught.value)
    assert "\n" not in text and str(tmp_path) in text
