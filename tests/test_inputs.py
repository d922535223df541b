"""Scenes in every form: one scene is the same in all of them, and bad input is one clear line."""

import json
import shutil
import struct
import warnings
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

import nexwarp.data.memory
import nexwarp.data.scene
import nexwarp.data.views
from benchmarks.inputs import (
    APPLIED,
    BARREL,
    FISHEYE,
    demo_lens,
    reconstruction_of,
    write_blender,
    write_distorted,
    write_nerfstudio,
    write_points,
    write_text,
)
from nexwarp.data import initial_points, load_scene, write_demo
from nexwarp.data.demo_room import LAMP, build_room
from nexwarp.data.lens import Map, pycolmap_module
from nexwarp.data.random_points import random_points
from nexwarp.data.raytrace import render
from nexwarp.data.scene import find_format
from nexwarp.train.presets import preset
from nexwarp.train.trainer import Trainer
from tests.test_scene import make_scene, project, views_of

SIZE = {"width": 96, "height": 72, "views": 10, "points": 300}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("NEXWARP_CACHE", str(folder))
    monkeypatch.setattr(nexwarp.data.scene, "random_points", partial(random_points, count=4000))
    return folder


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return write_demo(tmp_path_factory.mktemp("demo") / "demo", **SIZE)


@pytest.fixture(scope="module")
def distorted(demo, tmp_path_factory):
    folder = tmp_path_factory.mktemp("distorted")
    lenses = {"OPENCV": BARREL, "OPENCV_FISHEYE": FISHEYE}
    return {
        model: write_distorted(demo, folder / model, demo_lens(demo, model, coefficients), samples=3)
        for model, coefficients in lenses.items()
    }


def assert_same_cameras(one, other, photos: bool = True) -> None:
    assert len(one.train) == len(other.train) and len(one.test) == len(other.test)
    for a, b in zip([*one.train, *one.test], [*other.train, *other.test], strict=True):
        assert Path(a.name).name == Path(b.name).name
        torch.testing.assert_close(a.camera.viewmat, b.camera.viewmat, rtol=0, atol=1e-6)
        torch.testing.assert_close(a.camera.K, b.camera.K, rtol=1e-6, atol=0)
        assert (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height)
        assert a.camera.near == pytest.approx(b.camera.near, rel=1e-6)
        assert not photos or torch.equal(a.image, b.image)
    assert one.scale == pytest.approx(other.scale, rel=1e-6)


def psnr(image: torch.Tensor, reference: np.ndarray) -> float:
    return -10 * float(torch.log10(((image.float() - torch.from_numpy(reference).float()) / 255).square().mean()))


# One scene, four formats


def test_every_format_gives_the_same_scene(demo, tmp_path):
    reference = load_scene(demo)
    for write in (write_text, write_nerfstudio):
        scene = load_scene(write(demo, tmp_path / write.__name__))
        assert_same_cameras(scene, reference)
        torch.testing.assert_close(scene.points, reference.points, rtol=0, atol=1e-6)
        assert torch.equal(scene.colors, reference.colors) and scene.background is None
        assert [v.name for v in scene.train] == [v.name for v in reference.train]
    blender = load_scene(write_blender(demo, tmp_path / "blender"))
    assert_same_cameras(blender, reference)
    assert [v.name for v in blender.test] == ["test/view_000.png", "test/view_008.png"]
    assert blender.background is None and blender.train[0].alpha is None, "its photos are opaque"
    assert load_scene(tmp_path / "blender", background="white").background == (1.0, 1.0, 1.0)


def test_training_starts_from_the_same_surfels_in_every_format(demo, tmp_path):
    """What a scene is saved as changes no PSNR: the points kept, the surfels on them and what depths follow agree."""
    config = replace(preset("default"), max_surfels=200)
    reference = load_scene(demo)
    expected = Trainer(reference, config, "cpu")
    dropped = len(reference.points) - len(starting_points(reference))
    assert 0 < dropped < len(reference.points) / 2, "the demo has outliers"
    for write in (write_text, write_nerfstudio, write_blender):
        scene = load_scene(write(demo, tmp_path / write.__name__))
        torch.testing.assert_close(starting_points(scene), starting_points(reference), rtol=0, atol=1e-6)
        trainer = Trainer(scene, config, "cpu")
        for name, raw in expected.surfels.state_dict().items():
            torch.testing.assert_close(trainer.surfels.state_dict()[name], raw, rtol=1e-6, atol=1e-6, msg=name)
        assert trainer.texture.resolutions == pytest.approx(expected.texture.resolutions, rel=1e-6)
        for view, other in zip(scene.train, reference.train, strict=True):
            torch.testing.assert_close(view.points, other.points, rtol=0, atol=1e-6)


def starting_points(scene) -> torch.Tensor:
    known = {"track_lengths": scene.track_lengths, "errors": scene.reprojection_errors}
    return initial_points(scene.points, scene.colors, 10**6, **known).means


def test_observations_go_with_the_frames_that_are_left(demo, tmp_path):
    """A frame taken out of the JSON, or one without a number, gives no other the points that it saw."""
    path = write_nerfstudio(demo, tmp_path / "scene")
    before = {view.name: view.points for view in load_scene(path).train}

    def change(data):
        del data["frames"][2]
        del data["frames"][4]["colmap_im_id"]

    after = {view.name: view.points for view in load_scene(edit(path, change)).train}
    assert [name for name, points in after.items() if points is None] == ["view_005.png"]
    both = {name for name in after if name in before and after[name] is not None}
    assert len(both) == 5 and all(torch.equal(after[name], before[name]) for name in both)


def test_points_beside_a_blender_scene(demo, tmp_path):
    """points3d.ply is taken unless the JSON names others, and may be no link that leads out."""
    path = write_blender(demo, tmp_path / "scene", points=False)
    points, colors = np.random.default_rng(0).normal(size=(20, 3)), np.zeros((20, 3))
    write_points(path / "points3d.ply", points, colors)
    scene = load_scene(path)
    assert np.array_equal(scene.points.numpy(), points.astype(np.float32))
    assert scene.train[0].points is None and scene.track_lengths.eq(0).all()
    write_points(path / "other.ply", 2 * points, colors)
    edit(path, lambda data: data.update(ply_file_path="other.ply"), "transforms_train.json")
    assert np.array_equal(load_scene(path).points.numpy(), (2 * points).astype(np.float32))
    edit(path, lambda data: data.pop("ply_file_path") and None, "transforms_train.json")
    (path / "points3d.ply").rename(tmp_path / "elsewhere.ply")
    (path / "points3d.ply").symlink_to(tmp_path / "elsewhere.ply")
    with pytest.raises(ValueError, match=r"points .points3d.ply.: a link leaves"):
        load_scene(path)


def test_what_nerfstudio_does_not_say_about_points_is_unknown(demo, tmp_path):
    scene = load_scene(write_nerfstudio(demo, tmp_path / "scene", tracks=False))
    assert all(view.points is None for view in scene.train)
    assert scene.track_lengths.eq(0).all() and scene.reprojection_errors.eq(-1).all()
    chosen = initial_points(
        scene.points, scene.colors, 10**6, track_lengths=scene.track_lengths, errors=scene.reprojection_errors
    )
    assert len(chosen.means) == len(scene.points), "no point is dropped for what is not known"


def test_blender_alone_has_an_angle_and_a_centred_square_camera(tmp_path):
    path = make_scene(tmp_path / "colmap", params=(40.0, 40.0, 24.0, 18.0))
    scene = load_scene(write_blender(path, tmp_path / "blender", centred=True))
    assert_same_cameras(scene, load_scene(path))


@pytest.mark.parametrize("scale", [None, 0.25])
def test_applied_transform_and_scale_are_undone(demo, tmp_path, scale):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    applied = np.concatenate([turn, [[0.3], [-0.4], [2.0]]], axis=1)
    path = write_nerfstudio(demo, tmp_path / "scene", applied)
    if scale is not None:

        def change(data):
            data["applied_scale"] = scale
            for frame in data["frames"]:
                for row in frame["transform_matrix"][:3]:
                    row[3] *= scale

        edit(path, change)
        points = reconstruction_of(demo).points3D
        positions = scale * (np.array([points[i].xyz for i in sorted(points)]) @ turn.T + applied[:, 3])
        write_points(path / "sparse_pc.ply", positions, np.array([points[i].color for i in sorted(points)]))
    scene, reference = load_scene(path), load_scene(demo)
    assert_same_cameras(scene, reference)
    torch.testing.assert_close(scene.points, reference.points, rtol=0, atol=1e-5)


def test_points_that_were_left_in_the_original_world_are_noticed(demo, tmp_path):
    path = write_nerfstudio(demo, tmp_path / "scene")
    reference = load_scene(demo)
    write_points(path / "sparse_pc.ply", reference.points.double().numpy(), reference.colors.numpy())
    with pytest.warns(UserWarning, match=r"sparse_pc.ply: its points fit the photos only without applied_transform"):
        scene = load_scene(path)
    torch.testing.assert_close(scene.points, reference.points)


def edit(path: Path, change, name: str = "transforms.json") -> Path:
    data = json.loads((path / name).read_text())
    change(data)
    (path / name).write_text(json.dumps(data))
    return path


def test_a_frames_own_intrinsics_go_before_the_files(demo, tmp_path):
    def change(data):
        for index, frame in enumerate(data["frames"]):
            frame |= {"fl_x": 100.0 + index, "cx": 40.0 + index}
        for key in ("w", "h", "fl_y", "cy"):
            del data[key]
        data["camera_angle_y"] = 0.7

    scene = load_scene(edit(write_nerfstudio(demo, tmp_path / "scene"), change))
    for index, view in enumerate(views_of(scene)):
        fy = 36.0 / np.tan(0.35)
        expected = (100.0 + index, np.float32(fy), 40.0 + index, 36.0)
        assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == pytest.approx(expected)


def test_lists_of_file_names_make_the_split(demo, tmp_path):
    def change(data):
        names = sorted(frame["file_path"] for frame in data["frames"])
        data |= {"train_filenames": names[:4], "val_filenames": names[4:6], "test_filenames": names[6:7]}

    path = edit(write_nerfstudio(demo, tmp_path / "scene"), change)
    scene = load_scene(path)
    assert [v.name for v in scene.train] == [f"view_00{i}.png" for i in range(4)]
    assert [v.name for v in scene.test] == ["view_006.png"]
    edit(path, lambda data: data["test_filenames"].clear())
    assert [v.name for v in load_scene(path).test] == ["view_004.png", "view_005.png"]
    edit(path, lambda data: data.update(val_filenames=data["train_filenames"][:1]))
    with pytest.warns(
        UserWarning, match="1 photos are listed for training and testing; they are used for testing only"
    ):
        scene = load_scene(path)
    assert [v.name for v in scene.test] == ["view_000.png"] and len(scene.train) == 3


def test_another_folder_of_photos_stands_in(demo, tmp_path):
    path = write_nerfstudio(demo, tmp_path / "scene")
    (path / "images_2").mkdir()
    for file in (path / "images").iterdir():
        Image.open(file).resize((48, 36)).save(path / "images_2" / file.name)
    full, half = load_scene(path), load_scene(path, images="images_2")
    for one, other in zip(views_of(full), views_of(half), strict=True):
        assert other.image.shape == (36, 48, 3) and one.name == other.name
        torch.testing.assert_close(project(other.camera, full.points), project(one.camera, full.points) / 2)


def test_blender_validates_on_val_where_there_is_no_test(demo, tmp_path):
    path = write_blender(demo, tmp_path / "scene")
    (path / "transforms_test.json").rename(path / "transforms_val.json")
    assert [v.name for v in load_scene(path).test] == ["test/view_000.png", "test/view_008.png"]
    (path / "transforms_val.json").unlink()
    scene = load_scene(path)
    assert [v.name for v in scene.test] == ["train/view_001.png"] and len(scene.train) == 7


# Lenses


@pytest.mark.parametrize(("model", "least"), [("OPENCV", 29.0), ("OPENCV_FISHEYE", 29.0)])
def test_undistorted_photos_are_pinhole_photos(distorted, model, least):
    """Against ray-traced photos of the undistorted camera; ignoring the lens would cost at least 4 dB."""
    scene = load_scene(distorted[model])
    room = build_room(SIZE["width"])
    for view in (scene.train[0], scene.train[5], scene.test[1]):
        camera = view.camera
        size = (camera.width, camera.height)
        photo = render(room, camera.viewmat.double().numpy(), camera.K.double().numpy(), size, LAMP)
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


# Transparency


@pytest.fixture
def transparent(tmp_path):
    """A Blender scene of a disc: red, half transparent at its rim, nothing around it."""
    path = make_scene(tmp_path / "colmap", params=(40.0, 40.0, 24.0, 18.0), points=np.zeros((1, 3)))
    y, x = np.mgrid[:36, :48]
    radius = np.hypot(x + 0.5 - 24, y + 0.5 - 18)
    alpha = np.where(radius < 8, 255, np.where(radius < 12, 100, 0)).astype(np.uint8)
    rgba = np.zeros((36, 48, 4), np.uint8)
    rgba[..., 0], rgba[..., 1], rgba[..., 3] = 200, 30, alpha
    for file in (path / "images").iterdir():
        Image.fromarray(rgba).save(file)
    return write_blender(path, tmp_path / "blender", centred=True, points=False), rgba


@pytest.mark.parametrize(("given", "color"), [(None, (1, 1, 1)), ("black", (0, 0, 0)), ((0.2, 0.4, 0.6),) * 2])
def test_transparent_photos_lie_on_the_background(transparent, given, color):
    path, rgba = transparent
    scene = load_scene(path, background=given)
    a = rgba[..., 3:].astype(float) / 255
    expected = a * rgba[..., :3] + (1 - a) * 255 * np.array(color)
    assert scene.background == tuple(map(float, color))
    for view in views_of(scene):
        assert np.abs(view.image.numpy() - expected).max() <= 0.5 + 1e-3
        assert np.array_equal(view.alpha.numpy(), rgba[..., 3]) and view.mask is None


def test_another_background_follows_from_alpha(transparent):
    """The formula that View.alpha's description gives, which random backgrounds in training rest on."""
    path, _ = transparent
    white, blue = load_scene(path), load_scene(path, background=(0.0, 0.0, 1.0))
    for one, other in zip(white.train, blue.train, strict=True):
        shift = torch.tensor(blue.background) - torch.tensor(white.background)
        moved = one.image / 255 + (1 - one.alpha[:, :, None] / 255) * shift
        assert (255 * moved - other.image).abs().max() <= 1.0 + 1e-3


def test_random_backgrounds_are_for_training_alone(transparent):
    path, _ = transparent
    white, random = load_scene(path), load_scene(path, background="random")
    assert random.random_background and not white.random_background
    assert random.background == white.background and torch.equal(random.train[0].image, white.train[0].image)


def test_alpha_as_mask(transparent):
    path, rgba = transparent
    scene = load_scene(path, masks="alpha", downscale=2)
    blocks = (rgba[..., 3] >= 128).reshape(18, 2, 24, 2).all(axis=(1, 3))
    for view in views_of(scene):
        assert np.array_equal(view.mask.numpy(), blocks)
        assert view.alpha.shape == (18, 24) and view.image.shape == (18, 24, 3)


def test_other_scenes_drop_alpha_unless_asked(transparent, tmp_path):
    path = tmp_path / "colmap"
    _, rgba = transparent
    scene = load_scene(path)
    assert scene.background is None and scene.train[0].alpha is None
    assert np.array_equal(scene.train[0].image.numpy(), rgba[..., :3])
    scene = load_scene(path, background="white")
    assert scene.background == (1.0, 1.0, 1.0) and np.array_equal(scene.train[0].alpha.numpy(), rgba[..., 3])
    assert scene.train[0].image[0, 0].tolist() == [255, 255, 255]


def test_random_points_lie_where_the_cameras_look(demo, tmp_path, transparent):
    scene = load_scene(write_blender(demo, tmp_path / "opaque", points=False))
    assert len(scene.points) == 4000 and torch.equal(scene.points, load_scene(tmp_path / "opaque").points)
    seen = torch.zeros(len(scene.points))
    for view in scene.train:
        pixels = project(view.camera, scene.points)
        depth = (scene.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3])[:, 2]
        seen += (depth > 0) & (pixels > -0.1).all(dim=1) & (pixels < torch.tensor([96.1, 72.1])).all(dim=1)
    assert seen.min() >= 2
    # The room's points, which the demo has, are among them: some lie near nearly each.
    gaps, _ = cKDTree(scene.points.numpy()).query(load_scene(demo).points.numpy())
    assert np.quantile(gaps, 0.9) < 0.15 * scene.scale
    path, _ = transparent
    hull = load_scene(path)
    for view in hull.train:  # the disc's rim is 12 pixels from the image's centre
        pixels = project(view.camera, hull.points)
        depth = (hull.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3])[:, 2]
        inside = (depth > 0.1) & (pixels > 0).all(dim=1) & (pixels < torch.tensor([48.0, 36.0])).all(dim=1)
        assert (pixels[inside] - torch.tensor([24.0, 18.0])).norm(dim=1).max() < 13 and inside.any()
    assert hull.colors[:, 0].float().min() >= 200 and len(hull.points) > 100


def test_random_points_of_parallel_and_of_blind_cameras(transparent):
    path, _ = transparent
    views = load_scene(path).train
    forward = [type(v)(v.camera, v.image, None, v.name, None) for v in views[:1]] * 3
    cloud = random_points(forward, 2.0, count=500)
    depth = cloud.positions @ views[0].camera.viewmat[2, :3].double().numpy() + views[0].camera.viewmat[2, 3].item()
    assert len(cloud.positions) == 500 and depth.min() >= 1.99 and depth.max() <= 60.1
    blind = [type(v)(v.camera, v.image, None, v.name, torch.zeros(36, 48, dtype=torch.uint8)) for v in views]
    assert len(random_points(blind, 2.0, count=50).positions) == 50


# Masks


def write_mask(file: Path, mask: np.ndarray, mode: str = "L") -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).convert(mode).save(file)


MASK = np.random.default_rng(3).random((36, 48)) < 0.7


@pytest.mark.parametrize("name", ["03.png.png", "03.png", "03.jpg"])
def test_masks_beside_the_photos(tmp_path, name):
    path = make_scene(tmp_path / "scene")
    mask = np.kron(MASK[:9, :12], np.ones((4, 4))) > 0 if name.endswith("jpg") else MASK
    write_mask(path / "masks" / name, mask)
    for view in views_of(load_scene(path)):
        assert (view.mask is None) == (view.name != "03.png")
        assert view.mask is None or np.array_equal(view.mask.numpy(), mask)
    assert all(view.mask is None for view in views_of(load_scene(path, masks=None)))


def test_masks_of_names_with_folders_and_of_another_folder(tmp_path):
    path = make_scene(tmp_path / "scene", names=["left/a.jpg", "right/a.jpg"])
    write_mask(path / "cut" / "right" / "a.png", MASK)
    masks = {view.name: view.mask for view in views_of(load_scene(path, masks="cut"))}
    assert masks["left/a.jpg"] is None and np.array_equal(masks["right/a.jpg"].numpy(), MASK)


def test_masks_of_labels_and_of_all_kinds(tmp_path):
    path = make_scene(tmp_path / "scene")
    (path / "masks").mkdir()
    Image.fromarray(MASK.astype(np.uint8)).save(path / "masks" / "01.png")  # 0 and 1
    write_mask(path / "masks" / "02.png", MASK, "1")
    write_mask(path / "masks" / "03.png", MASK, "RGB")
    write_mask(path / "masks" / "04.png", np.ones((36, 48)))
    Image.fromarray(np.where(MASK, 65535, 0).astype(np.uint16)).save(path / "masks" / "05.png")
    masks = [view.mask for view in views_of(load_scene(path))]
    assert all(np.array_equal(masks[index].numpy(), MASK) for index in (1, 2, 3, 5)) and masks[4] is None


def test_masks_go_with_smaller_photos(tmp_path):
    path = make_scene(tmp_path / "scene")
    coarse = MASK[:18, :24]
    write_mask(path / "masks" / "01.png", np.kron(coarse, np.ones((2, 2))))
    scene = load_scene(path, downscale=2)
    assert np.array_equal(views_of(scene)[1].mask.numpy(), coarse)
    (path / "images_2").mkdir()
    for file in (path / "images").iterdir():
        Image.open(file).resize((24, 18)).save(path / "images_2" / file.name)
    assert np.array_equal(views_of(load_scene(path, images="images_2"))[1].mask.numpy(), coarse)


def test_a_reduced_pixel_counts_where_all_of_it_does(tmp_path):
    path = make_scene(tmp_path / "scene")
    write_mask(path / "masks" / "01.png", MASK)
    expected = MASK.reshape(12, 3, 16, 3).all(axis=(1, 3))
    assert np.array_equal(views_of(load_scene(path, downscale=3))[1].mask.numpy(), expected)


def test_masks_are_undistorted_with_their_photos(demo, distorted, tmp_path, cache):
    """A photo that is white where the mask counts stays so."""
    path = write_nerfstudio(distorted["OPENCV"], tmp_path / "scene")
    mask = np.zeros((72, 96))
    mask[20:50, 30:70] = 1
    write_mask(path / "cut.png", mask)
    Image.fromarray((mask[..., None] * np.full(3, 255)).astype(np.uint8)).save(path / "images" / "view_003.png")
    edit(path, lambda data: [f.update(mask_path="cut.png") for f in data["frames"] if "view_003" in f["file_path"]])
    for _ in range(2):  # the second time from the cache
        view = views_of(load_scene(path))[3]
        white = view.image[:, :, 0] >= 128
        assert view.mask.shape == white.shape and (view.mask != white).float().mean() < 0.01
        assert 0.1 < view.mask.float().mean() < 0.3


# Points of one's own


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_of_a_ply_file(tmp_path, form):
    path = make_scene(tmp_path / "scene")
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(30, 3)), rng.integers(0, 256, (30, 3))
    scene = load_scene(path, points=write_points(tmp_path / "mine.ply", points, colors, form))
    assert np.array_equal(scene.points.numpy(), points.astype(np.float32))
    assert np.array_equal(scene.colors.numpy(), colors)
    assert scene.scale == pytest.approx(load_scene(path).scale)


def test_points_of_one_s_own_make_up_for_none(tmp_path):
    path = make_scene(tmp_path / "scene", points=np.zeros((0, 3)))
    scene = load_scene(path, points=write_points(tmp_path / "mine.ply", np.eye(3), np.eye(3)))
    assert torch.equal(scene.points, torch.eye(3))


def test_huge_clouds_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(nexwarp.data.scene, "MAX_POINTS", 10)
    path = make_scene(tmp_path / "scene")
    scene, again = load_scene(path), load_scene(path)
    assert len(scene.points) == len(scene.colors) == len(scene.track_lengths) == 10
    assert torch.equal(scene.points, again.points)


# Memory, progress, formats


def test_photos_that_do_not_fit_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = make_scene(tmp_path / "scene")
    (path / "images_2").mkdir()
    need = 10 * 48 * 36 * 3
    monkeypatch.setattr(nexwarp.data.memory, "available_memory", lambda: need // 3)
    monkeypatch.setattr(nexwarp.data.views, "read_image", lambda *_: pytest.fail("read"))
    with pytest.raises(ValueError, match=r"10 photos of up to 48x36 .* use downscale=2 \(.*\) or .* \(images_2\)") as e:
        load_scene(path)
    assert "\n" not in str(e.value)
    monkeypatch.setattr(nexwarp.data.memory, "available_memory", lambda: 0)
    with pytest.raises(ValueError, match="use fewer photos"):
        load_scene(path)
    monkeypatch.undo()
    monkeypatch.setattr(nexwarp.data.memory, "available_memory", lambda: need // 3)
    load_scene(path, downscale=2)


def test_a_thousand_photos_of_eight_megapixels_fit_8_gb_at_half_size():
    sizes = [(3264, 2448)] * 1000
    assert nexwarp.data.memory.photos_bytes(sizes, 2, 3) < 0.9 * 7.2e9 < nexwarp.data.memory.photos_bytes(sizes, 1, 3)
    assert nexwarp.data.memory.available_memory() > 2**20


def test_progress_counts_every_photo(tmp_path):
    calls = []
    load_scene(make_scene(tmp_path / "scene"), progress=lambda *call: calls.append(call))
    assert calls == [(done, 10) for done in range(1, 11)]


def test_formats_are_told_apart(demo, tmp_path):
    colmap = make_scene(tmp_path / "colmap")
    assert find_format(demo) == find_format(colmap) == "colmap"
    both = write_nerfstudio(demo, tmp_path / "both")
    assert find_format(both) == "nerfstudio"
    (both / "sparse").mkdir()
    (both / "sparse" / "cameras.txt").write_text("")
    with pytest.raises(ValueError, match=r"got a COLMAP model and transforms.json; choose with format: colmap or nerf"):
        load_scene(both)
    assert len(load_scene(both, format="nerfstudio").train) == 8
    with pytest.raises(FileNotFoundError, match="incomplete COLMAP model"):
        load_scene(both, format="colmap")
    with pytest.raises(ValueError, match="format: expected one of colmap, nerfstudio, blender, got 'obj'"):
        load_scene(both, format="obj")


# Bad input


def spoilt(change):
    """Maker of a nerfstudio scene with a changed transforms.json."""
    return lambda demo, path: edit(write_nerfstudio(demo, path), change)


def text(content: str | bytes):
    def make(demo, path):
        write_nerfstudio(demo, path)
        (path / "transforms.json").write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def frame(**keys):
    return spoilt(lambda data: data["frames"][3].update(keys))


def file(name: str, content: bytes, **keys):
    """Maker of a scene with a file of some bytes, and a frame that may name it."""

    def make(demo, path):
        edit(write_nerfstudio(demo, path), lambda data: data["frames"][3].update(keys))
        (path / name).write_bytes(content)
        return path

    return make


def mask_of(width: int, height: int, value: int = 255):
    def make(demo, path):
        write_nerfstudio(demo, path)
        (path / "masks").mkdir()
        Image.new("L", (width, height), value).save(path / "masks" / "view_003.png")
        return path

    return make


def header_only(width: int, height: int) -> bytes:
    """A PNG that says it is large and holds nothing."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return start + b"\0\0\0\0IDAT" + struct.pack(">I", zlib.crc32(b"IDAT"))


ROWS = np.eye(4).tolist()
SINGULAR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
BAD = {
    "no JSON": (text("{frames: []"), r"transforms.json: expected JSON, could not parse it"),
    "no text": (text(b"\xff\xfe\x00"), "expected JSON"),
    "a list": (text("[]"), "expected a JSON object, got list"),
    "NaN": (text('{"frames": [NaN]}'), "NaN is no JSON number"),
    "too deep": (text('{"frames": ' + "[" * 100_000), "nested too deeply|could not parse"),
    "a number of 5,000 digits": (text('{"frames": [{"w": ' + "9" * 5000 + "}]}"), "could not parse"),
    "no frames": (spoilt(lambda data: data.pop("frames") and None), "frames: expected a list .*, got None"),
    "empty frames": (spoilt(lambda data: data["frames"].clear()), r"frames: expected a list .*, got \[\]"),
    "frame that is none": (spoilt(lambda data: data["frames"].append(7)), "frame 10: expected a JSON object, got 7"),
    "one frame": (spoilt(lambda data: data.update(frames=data["frames"][:1])), "at least 2 registered images"),
    "frame twice": (
        spoilt(lambda data: data["frames"].append(data["frames"][2])),
        "each photo once, got view_00.* twice",
    ),
    "no file name": (frame(file_path=None), "frame 3: file_path: expected the name of a file, got None"),
    "no such file": (frame(file_path="images/x.png"), "frame 3 .images/x.png.: image not found: .*x.png"),
    "parent": (frame(file_path="images/../../x.png"), "file_path: .* leaves the scene's folder"),
    "absolute": (frame(file_path="/etc/passwd"), "file_path: '/etc/passwd' leaves the scene's folder"),
    "drive": (frame(file_path="C:\\x.png"), "file_path: .* leaves the scene's folder"),
    "backslashes": (frame(file_path="images\\..\\..\\x.png"), "leaves the scene's folder"),
    "zero byte": (frame(file_path="images/\0.png"), "leaves the scene's folder"),
    "no matrix": (frame(transform_matrix=None), "frame 3 .*: transform_matrix: expected 4 rows of 4 numbers, got None"),
    "short matrix": (frame(transform_matrix=ROWS[:2]), "expected 4 rows of 4 numbers"),
    "ragged matrix": (frame(transform_matrix=[[1, 2], *ROWS[1:]]), "expected 4 rows of 4 numbers"),
    "text matrix": (frame(transform_matrix=[["1", 0, 0, 0], *ROWS[1:]]), "expected 4 rows of 4 numbers"),
    "infinite matrix": (frame(transform_matrix=[[1e999, 0, 0, 0], *ROWS[1:]]), "Infinity is no JSON|expected finite"),
    "large whole number": (frame(transform_matrix=[[10**400, 0, 0, 0], *ROWS[1:]]), "expected finite numbers"),
    "singular matrix": (frame(transform_matrix=SINGULAR), "got a singular, sheared, scaled or mirroring one"),
    "scaled matrix": (
        frame(transform_matrix=(2 * np.eye(4)).tolist()),
        "last row 0, 0, 0, 1|singular, sheared, scaled",
    ),
    "projective matrix": (frame(transform_matrix=[*ROWS[:3], [0, 0, 1, 1]]), "the last row 0, 0, 0, 1"),
    "singular applied": (
        spoilt(lambda d: d.update(applied_transform=SINGULAR)),
        "applied_transform: .* got a singular",
    ),
    "applied scale of 0": (spoilt(lambda data: data.update(applied_scale=0)), "applied_scale: expected a number > 0"),
    "endless applied scale": (
        spoilt(lambda data: data.update(applied_scale=1e200)),
        "applied_transform: .* got a singular",
    ),
    "focal length of 0": (spoilt(lambda data: data.update(fl_x=0.0)), "K: expected focal lengths > 0, got 0"),
    "no focal length": (spoilt(lambda d: [d.pop(k) for k in ("fl_x", "fl_y")] and None), "expected a focal length"),
    "angle of pi": (
        spoilt(lambda d: d.pop("fl_x") and d.update(camera_angle_x=3.2)),
        "camera_angle_x: expected radians between 0 and pi",
    ),
    "text focal length": (spoilt(lambda data: data.update(fl_x="wide")), "fl_x: expected a number, got 'wide'"),
    "half a pixel": (spoilt(lambda data: data.update(w=96.5)), "w, h: expected whole numbers of pixels"),
    "billions of pixels": (spoilt(lambda data: data.update(w=10**9)), "expected an image size of 1 to 65536"),
    "unknown camera model": (
        spoilt(lambda d: d.update(camera_model="FISHEYE624")),
        "camera_model: .* got 'FISHEYE624'",
    ),
    "model of a list": (spoilt(lambda data: data.update(camera_model=[1])), r"camera_model: .* got \[1\]"),
    "unknown coefficient": (spoilt(lambda data: data.update(p3=0.1)), "lens coefficient p3 is no part of camera model"),
    "photos of another shape": (spoilt(lambda data: data.update(w=50, h=72)), "expected an image of 50x72 pixels"),
    "unknown test photo": (spoilt(lambda d: d.update(test_filenames=["images/q.png"])), "test_filenames: .* got q.png"),
    "split that is no list": (spoilt(lambda d: d.update(train_filenames=3)), "train_filenames: expected a list"),
    "no training photo": (spoilt(lambda data: data.update(train_filenames=[])), "at least one photo"),
    "no such ply": (spoilt(lambda d: d.update(ply_file_path="q.ply")), "ply_file_path: points not found: .*q.ply"),
    "ply elsewhere": (spoilt(lambda d: d.update(ply_file_path="../q.ply")), "ply_file_path: .* leaves the scene"),
    "ply that is none": (file("sparse_pc.ply", b"obj"), "expected a PLY file, but it does not begin with 'ply'"),
    "id of an image": (frame(colmap_im_id="four"), "frame 3: colmap_im_id: expected an image's id, got 'four'"),
    "no such mask": (frame(mask_path="masks/q.png"), "frame 3 .*: mask not found: .*q.png"),
    "mask elsewhere": (frame(mask_path="../q.png"), "mask_path: '../q.png' leaves the scene's folder"),
    "mask that is none": (file("q.png", b"GIF", mask_path="q.png"), "q.png: expected a complete image file"),
    "mask of another size": (mask_of(72, 96), "view_003.png: expected a mask of 96x72 pixels .* got 72x96"),
    "black mask": (mask_of(96, 72, 0), "view_003.png: expected a mask with pixels that count, got none"),
    "bomb": (
        file("images/view_003.png", header_only(60_000, 60_000)),
        "view_003.png: expected .* megapixels, got more",
    ),
    "cut-off photo": (file("images/view_003.png", header_only(96, 72)), "view_003.png: expected a complete image file"),
    "mask bomb": (file("q.png", header_only(60_000, 60_000), mask_path="q.png"), "q.png: expected .* megapixels"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_clear_line(demo, tmp_path, kind):
    make, message = BAD[kind]
    path = make(demo, tmp_path / "scene")
    before = sorted(path.rglob("*"))
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value) and len(str(caught.value)) < 400
    assert sorted(path.rglob("*")) == before


def test_a_json_file_of_any_size_is_not_read(demo, tmp_path):
    path = write_nerfstudio(demo, tmp_path / "scene")
    with (path / "transforms.json").open("r+b") as stream:
        stream.truncate(2**40)  # sparse: it takes no room
    with pytest.raises(ValueError, match=r"expected at most 33,554,432 bytes of JSON, got 1,099,511,627,776"):
        load_scene(path)


def test_unknown_keys_are_ignored(demo, tmp_path):
    def change(data):
        data |= {"aabb_scale": 16, "orientation_override": "none", "offset": [1, 2]}
        data["frames"][0] |= {"sharpness": 12.5, "colmap_im_id": 3, "depth_file_path": "../nowhere"}

    assert_same_cameras(load_scene(edit(write_nerfstudio(demo, tmp_path / "scene"), change)), load_scene(demo))


def test_a_photo_may_not_be_in_both_of_blenders_files(demo, tmp_path):
    path = write_blender(demo, tmp_path / "scene")
    train = json.loads((path / "transforms_train.json").read_text())
    edit(path, lambda data: data["frames"].append(train["frames"][0]), "transforms_test.json")
    with pytest.raises(ValueError, match=r"transforms_test.json: train/view_001.png is in transforms_train.json too"):
        load_scene(path)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"masks": "absent"}, FileNotFoundError, "masks: no folder 'absent' in .*, which has no folder masks"),
        ({"masks": 3}, TypeError, "masks: expected the name of a folder, got int"),
        ({"background": "pink"}, ValueError, "background: expected white, black, random or three numbers"),
        ({"background": (0, 0, 2)}, ValueError, "background: expected white, black, random or three numbers"),
        ({"background": 0.5}, ValueError, "background: expected white, black, random or three numbers"),
        ({"points": "absent.ply"}, FileNotFoundError, "absent.ply: no such file"),
        ({"points": 3}, TypeError, "points: expected the path of a PLY file, got int"),
        ({"images": "images_9"}, FileNotFoundError, "images: no folder 'images_9'"),
    ],
)
def test_bad_arguments(demo, options, error, message):
    with pytest.raises(error, match=message):
        load_scene(demo, **options)


def test_masks_that_no_photo_has(tmp_path):
    path = make_scene(tmp_path / "scene")
    write_mask(path / "masks" / "other.png", MASK)
    with pytest.raises(FileNotFoundError, match=r"masks: none in .* is named after a photo, expected 00.png.png, say"):
        load_scene(path)
    assert len(load_scene(path, masks=None).train) == 8


def test_damaged_json_never_crashes(demo, tmp_path):
    """Cut off or with bytes changed at 120 places: it loads, or says so in a line."""
    path = write_nerfstudio(demo, tmp_path / "scene")
    good = (path / "transforms.json").read_bytes()
    rng = np.random.default_rng(0)
    outcomes = {"loaded": 0, "refused": 0}
    for trial in range(120):
        data = bytearray(good)
        if trial % 3 == 0:
            data = data[: rng.integers(len(data))]
        elif trial % 3 == 1:
            for place in rng.integers(0, len(data), 2):
                data[place] = rng.choice(list(b'0123456789-.eE[]{},:"\xff'))
        else:  # another digit: poses that are none, focal lengths of 0, photos that are not there
            digits = [place for place, byte in enumerate(data) if byte in b"0123456789"]
            data[rng.choice(digits)] = rng.choice(list(b"0123456789"))
        (path / "transforms.json").write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                nexwarp.data.scene._read_capture(path, "images", "nerfstudio")
            outcomes["loaded"] += 1
        except (ValueError, FileNotFoundError) as error:
            assert "\n" not in str(error) and str(path) in str(error)
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 10
    assert APPLIED.shape == (3, 4)
