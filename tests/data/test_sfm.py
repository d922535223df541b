import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from scipy.ndimage import map_coordinates

from nexwarp.cameras.paths import look_at
from nexwarp.cli import main as cli
from nexwarp.data import load_scene
from nexwarp.data.capture import Capture
from nexwarp.data.colmap import read_model
from nexwarp.data.images import copy_upright, decodable_formats, is_turned
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm import SfmOptions, process
from nexwarp.data.sfm.photos import InputPhoto, affordable_threads, camera_groups, list_photos
from nexwarp.data.sfm.report import Overlaps, advise, components, left_out
from nexwarp.data.sfm.stages import Stages, exhaustive_pairs, sequential_pairs
from nexwarp.errors import OutOfMemoryError, SceneError, StorageError
from nexwarp.train import recipe
from tests.cli.support import SMALL, refused, snapshot
from tests.subprocesses import environment, run_python

processing = sys.modules["nexwarp.data.sfm.process"]  # the package has a function of that name

WIDTH, HEIGHT, FOCAL, VIEWS = 320, 240, 320.0, 7
PHOTOS = Path(__file__).parent / "photos"
TARGET, UP = torch.tensor([0.0, 0.0, 0.62]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
DISTANCE = 3.15  # of the cameras from what they look at
K1 = -0.12
SPARSE = ("cameras.bin", "images.bin", "points3D.bin")
PINHOLE = SfmOptions(camera_model="simple_pinhole")


@dataclasses.dataclass(frozen=True)
class Arc:
    """Photos of the demo's courtyard: `images` by name, and the world-to-camera matrices of their cameras."""

    images: dict[str, np.ndarray]
    viewmats: dict[str, np.ndarray]


@pytest.fixture(scope="module")
def arc() -> Arc:
    """Views 8 degrees apart, two heights in turn."""
    images, viewmats = {}, {}
    for index, file in enumerate(sorted(PHOTOS.glob("view_*.jpg"))):
        azimuth, elevation = np.radians(-120 + 8 * index), np.radians(14 + 10 * (index % 2))
        outward = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * np.cos(elevation)
        name = f"view {index + 5}.png"  # up to "view 11": sorted as text, they would be in another order
        viewmats[name] = look_at(TARGET + DISTANCE * torch.from_numpy(outward), TARGET, UP).numpy()
        images[name] = np.array(Image.open(file))
    return Arc(images, viewmats)


def write_photos(folder: Path, images: dict[str, np.ndarray]) -> Path:
    for name, image in images.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(folder / name)
    return folder


@pytest.fixture(scope="module")
def photos(arc, tmp_path_factory) -> Path:
    folder = write_photos(tmp_path_factory.mktemp("sfm") / "photos", arc.images)
    (folder / "notes.txt").write_text("not a photo")
    (folder / "._view 5.png").write_bytes(b"what macOS leaves on memory cards")
    return folder


@pytest.fixture(scope="module")
def made(photos) -> Path:
    """A scene made through the command line."""
    scene = photos.parent / "made" / "scene"
    assert cli.main(["sfm", str(photos), str(scene), "--camera-model", "simple_pinhole", "--threads", "1"]) == 0
    return scene


def noise(seed: int) -> np.ndarray:
    """Patches of 4 x 4 pixels: hundreds of features, and none in common with another seed."""
    small = np.random.default_rng(seed).integers(0, 256, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
    return small.repeat(4, axis=0).repeat(4, axis=1)


def assert_cameras_agree(model: Capture, truth: dict[str, np.ndarray], within: float) -> None:
    """Fail unless a similarity takes the cameras to the true ones.

    Centres within this share of their distance from what they see, axes within as many radians.
    """
    ours = np.array([photo.viewmat for photo in model.photos])
    theirs = np.array([truth[photo.name] for photo in model.photos])
    x, y = (-np.einsum("nji,nj->ni", v[:, :3, :3], v[:, :3, 3]) for v in (ours, theirs))
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    U, D, Vt = np.linalg.svd(dy.T @ dx)
    sign = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    R = U @ sign @ Vt
    assert np.linalg.norm(np.trace(np.diag(D) @ sign) / (dx**2).sum() * dx @ R.T - dy, axis=1).max() < within * DISTANCE
    assert np.linalg.norm(ours[:, :3, :3] @ R.T - theirs[:, :3, :3], ord=2, axis=(1, 2)).max() < within


def test_cameras_come_back_and_the_scene_holds_the_photos(made, photos, arc):
    assert list_photos(photos) == (list(arc.images), {}), "in the order in which people number them"
    model = read_model(made, made / "images")
    assert [photo.name for photo in model.photos] == sorted(arc.images)
    assert_cameras_agree(model, arc.viewmats, within=0.01)
    for photo in model.photos:
        assert (photo.lens.width, photo.lens.height) == (WIDTH, HEIGHT) and photo.lens.model == "SIMPLE_PINHOLE"
        assert photo.lens.params[0] == pytest.approx(FOCAL, rel=0.02)
    assert {entry.name for entry in made.iterdir()} == {"images", "sparse", "sfm.json"}
    assert {entry.name for entry in made.parent.iterdir()} == {"scene"}
    scene = load_scene(made)
    assert len(scene.train) + len(scene.test) == VIEWS and len(scene.points) > 200
    for view in [*scene.train, *scene.test]:  # nothing to undistort: the very pixels
        assert np.array_equal(view.image.numpy(), arc.images[view.name])


def test_the_global_mapper_finds_the_cameras_too(photos, arc, tmp_path):
    report = process(photos, tmp_path / "scene", options=dataclasses.replace(PINHOLE, mapper="global"))
    assert report.mapper == "global" and len(report.registered) == VIEWS
    assert_cameras_agree(read_model(tmp_path / "scene", tmp_path / "scene" / "images"), arc.viewmats, within=0.01)


@pytest.mark.parametrize(
    ("mapper", "incremental", "everywhere", "expected"),
    [
        ("auto", [7], None, (7, "incremental")),
        ("auto", [5, 2], [6], (6, "global")),
        ("auto", [2, 5], [5], (5, "incremental")),
        ("auto", [], [4], (4, "global")),
        ("auto", [5], ValueError("mapping: failed"), (5, "incremental")),
        ("incremental", [5], None, (5, "incremental")),
        ("global", None, [4, 6], (6, "global")),
        ("global", None, ValueError("mapping: failed"), "mapping: failed"),
        ("auto", [], [], "no scene could be made"),
    ],
)
def test_the_mapper_that_registers_more_is_taken(mapper, incremental, everywhere, expected, tmp_path, monkeypatch):
    """None is a mapper that is not asked."""

    def answer(found):
        assert found is not None
        if isinstance(found, Exception):
            raise found
        counts = [dict.fromkeys(("num_reg_images.return_value", "num_points3D.return_value"), n) for n in found]
        return {index: Mock(**count) for index, count in enumerate(counts)}

    monkeypatch.setattr(Stages, "_incrementally", lambda self, stage: answer(incremental))
    monkeypatch.setattr(Stages, "_globally", lambda self, stage: answer(everywhere))
    stages, stage = Stages(tmp_path, tmp_path, SfmOptions(mapper=mapper), lambda *_: None), Mock()
    overlaps = Overlaps({str(i): 900 for i in range(7)}, {}, 21, False)
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            stages._map(overlaps, stage)
    else:
        models, used = stages._map(overlaps, stage)
        assert (models[0].num_reg_images(), used) == expected


def test_photos_without_a_scene_are_processed_and_trained(photos, tmp_path, monkeypatch, capsys):
    """Once: a second training takes the scene that is there, unless the photos have changed since."""
    own = Path(shutil.copytree(photos, tmp_path / "yard"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(recipe.PRESETS, "default", SMALL)
    few = ["--iterations", "1", "--max-surfels", "100", "--device", "cpu"]
    assert cli.main(["train", "yard", *few]) == 0
    scene = Path("scenes", "yard")
    assert f"yard: photos without cameras, so {scene} is made first\n" in capsys.readouterr().out
    assert (scene / "sfm.json").is_file() and (tmp_path / "runs" / "yard" / "metrics.json").is_file()
    before = snapshot(scene)
    assert cli.main(["train", str(own), "--run", "second", *few]) == 0
    assert f"the scene {scene} was made of it before\n" in capsys.readouterr().out and snapshot(scene) == before
    (own / "view 5.png").unlink()
    refused(capsys, ["train", "yard", "--run", "third", *few], f"{scene}: expected", "a scene made of yard as it is")
    # Where a scene is asked for, by an option that only scenes have, photos alone are none.
    refused(capsys, ["train", "yard", "--run", "third", *few, "--format", "colmap"], "yard: no COLMAP model found")


def test_distortion_is_found_and_taken_out(arc, tmp_path):
    """Photos bent by a known radial distortion become straight ones with the same cameras."""
    params = [FOCAL, WIDTH / 2, HEIGHT / 2, K1]
    camera = pycolmap_module().Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    straight = camera.cam_from_img(np.stack([x, y], axis=-1).reshape(-1, 2)) * FOCAL
    rows, columns = straight[:, 1] + HEIGHT / 2 - 0.5, straight[:, 0] + WIDTH / 2 - 0.5
    bent = {}
    for name, image in arc.images.items():
        channels = [map_coordinates(image[..., c], [rows, columns], order=1, mode="nearest") for c in range(3)]
        bent[name] = np.stack(channels, axis=-1).reshape(image.shape)
    folder = write_photos(tmp_path / "bent", bent)
    report = process(folder, tmp_path / "scene", options=SfmOptions(camera_model="simple_radial"))
    assert len(report.registered) == VIEWS and report.cameras[0].params[3] == pytest.approx(K1, abs=0.03)
    assert_cameras_agree(read_model(tmp_path / "scene", tmp_path / "scene" / "images"), arc.viewmats, within=0.01)
    shape = load_scene(tmp_path / "scene").train[0].image.shape
    assert shape[:2] != (HEIGHT, WIDTH) and report.sizes == [(shape[1], shape[0])]


def test_folders_exif_and_a_stray_photo(arc, tmp_path, capsys):
    """Folders have cameras of their own, EXIF starts their focal lengths, a photo of something else is left out."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[41989] = 37  # focal length for 35 mm film, whose diagonal is 43.3: 342 pixels
    folder = tmp_path / "photos"
    for index, (name, image) in enumerate(arc.images.items()):
        file = folder / f"camera {index % 2}" / Path(name).with_suffix(".JPG")
        file.parent.mkdir(parents=True, exist_ok=True)
        options: dict[str, Any] = {"exif": exif} if index % 2 else {}
        Image.fromarray(image).save(file, quality=95, **options)
    Image.fromarray(noise(0)).save(folder / "camera 0" / "stray.png")
    command = ["sfm", str(folder), str(tmp_path / "scene"), "--cameras", "folder", "--camera-model", "simple_pinhole"]
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert f"{VIEWS} of {VIEWS + 1} photos" in out and "left out: camera 0/stray.png: overlaps no other photo" in out
    report = json.loads((tmp_path / "scene" / "sfm.json").read_text())
    assert list(report["left_out"]) == ["camera 0/stray.png"]
    assert [camera["exif_focal"] for camera in report["cameras"]] == [False, True]
    assert [camera["photos"] for camera in report["cameras"]] == [4, 3]
    truth = {f"camera {i % 2}/{Path(n).stem}.JPG": v for i, (n, v) in enumerate(arc.viewmats.items())}
    model = read_model(tmp_path / "scene", tmp_path / "scene" / "images")
    assert_cameras_agree(model, truth, within=0.01)
    assert len({photo.lens.params[0] for photo in model.photos}) == 2


TURNED = {6: 1, 8: -1, 3: 2}  # EXIF orientation: quarter turns to the left from upright to stored pixels


def stored(path: Path) -> tuple[np.ndarray, dict[int, Any]]:
    """Pixels of a file and its EXIF tags."""
    with Image.open(path) as image:
        exif = image.getexif()
        return np.asarray(image.convert("RGB")), {**exif, **exif.get_ifd(0x8769)}


def test_photos_turned_by_exif_give_the_cameras_of_upright_ones(made, arc, tmp_path):
    """Two of the photos are stored on their side, one upside down: scene and photos are those of upright files."""
    folder = write_photos(tmp_path / "photos", arc.images)
    for name, orientation in zip(("view 6.png", "view 8.png", "view 10.png"), TURNED, strict=True):
        tags = Image.Exif()
        tags[274] = orientation
        Image.fromarray(np.rot90(arc.images[name], TURNED[orientation])).save(folder / name, exif=tags)
    assert stored(folder / "view 6.png")[0].shape == (WIDTH, HEIGHT, 3)
    process(folder, tmp_path / "scene", options=dataclasses.replace(PINHOLE, threads=1))
    scene = tmp_path / "scene"
    assert not any(file.is_symlink() for file in scene.rglob("*"))
    assert {(scene / "sparse/0" / n).read_bytes() == (made / "sparse/0" / n).read_bytes() for n in SPARSE} == {True}
    for name, image in arc.images.items():
        pixels, exif = stored(scene / "images" / name)
        assert exif.get(274, 1) == 1 and np.array_equal(pixels, image)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_copies_are_those_of_pillow(suffix, orientation, tmp_path):
    exif = Image.Exif()
    exif[274], exif[271] = orientation, "Maker"
    exif.get_ifd(0x8769)[41989] = 37
    file, copy = tmp_path / f"a.{suffix}", tmp_path / ("copy.jpg" if suffix == "webp" else f"copy.{suffix}")
    smooth = np.stack(np.meshgrid(np.arange(0, 160, 4), np.arange(0, 96, 4), [90]), axis=-1)[:, :, 0].astype(np.uint8)
    Image.fromarray(smooth).save(file, exif=exif.tobytes(), quality=95)
    assert is_turned(file) == (orientation != 1)
    pixels = copy_upright(file, copy).numpy()
    with Image.open(file) as image:
        assert np.array_equal(pixels, np.asarray(ImageOps.exif_transpose(image).convert("RGB")))
    written, kept = stored(copy)
    assert np.abs(pixels.astype(int) - written).max() <= (4 if "jpg" in copy.name else 0)
    assert (kept.get(274, 1), kept[271], kept[41989]) == (1, "Maker", 37)


def test_a_folder_of_a_phone(arc, tmp_path, capsys):
    """WebP and AVIF are read; a damaged photo and a raw one are named and left out, unless --strict stops there."""
    folder = write_photos(tmp_path / "photos", arc.images)
    for name, suffix in (("view 5", "webp"), ("view 7", "avif" if "AVIF" in decodable_formats() else "webp")):
        (folder / f"{name}.png").unlink()
        Image.fromarray(arc.images[f"{name}.png"]).save(folder / f"{name}.{suffix}", quality=95)
    (folder / "View 8.HEIC").write_bytes(b"the same photo again")
    damaged = folder / "view 9.png"
    damaged.write_bytes(damaged.read_bytes()[:9000])
    command = ["sfm", str(folder), str(tmp_path / "scene"), "--camera-model", "simple_pinhole", "--cameras", "single"]
    refused(capsys, [*command, "--strict"], "view 9.png: expected a complete image file")
    for name in ("a.dng", "b.dng"):
        (folder / name).write_bytes(b"raw")
    refused(capsys, [*command, "--strict"], "a.dng: .dng: convert to JPEG or PNG first")
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert "skipped 2: 'a.dng', 'b.dng': .dng: convert to JPEG or PNG first\n" in out
    assert "skipped 1: 'view 9.png': expected a complete image file" in out and "6 of 7 photos" in out
    report = json.loads((tmp_path / "scene" / "sfm.json").read_text())
    assert set(report["skipped"]) == {"a.dng", "b.dng", "View 8.HEIC", "view 9.png"}
    jpegs = ("view 5.png", "view 7.png")
    truth = {Path(n).stem + (".jpg" if n in jpegs else ".png"): arc.viewmats[n] for n in arc.images}
    model = read_model(tmp_path / "scene", tmp_path / "scene" / "images")
    assert {photo.name for photo in model.photos} == truth.keys() - {"view 9.png"}
    assert_cameras_agree(model, truth, within=0.02)


@pytest.mark.parametrize(("cameras", "count"), [("single", 2), ("folder", 3)])
def test_portrait_and_landscape_photos_have_a_camera_each(cameras, count):
    shapes = {"a/1.jpg": (40, 30), "a/2.jpg": (30, 40), "b/3.jpg": (40, 30), "a/4.jpg": (30, 40)}
    photos = [InputPhoto(name, size, ("", ""), None) for name, size in shapes.items()]
    groups = camera_groups(Path("photos"), photos, cameras)
    assert len(groups) == count and ["a/2.jpg", "a/4.jpg"] in [[photo.name for photo in group] for group in groups]


def test_pairs_are_compared_once_and_a_walk_is_joined_to_its_start():
    every = exhaustive_pairs(50)
    assert len(every) == len(set(every)) == 50 * 49 // 2 and all(0 <= i < j < 50 for i, j in every)
    pairs = set(sequential_pairs(100, 3))
    assert {(0, 1), (0, 2), (0, 3), (0, 4), (0, 99), (1, 99), (2, 99), (40, 44)} <= pairs
    assert (0, 5) not in pairs and (0, 96) not in pairs and all(i < j for i, j in pairs)
    assert set(sequential_pairs(6, 10)) == set(exhaustive_pairs(6))
    assert components("abcdef", [("a", "b"), ("d", "e"), ("e", "f")]) == [{"d", "e", "f"}, {"a", "b"}, {"c"}]


def overlaps(features: dict[str, int], pairs: list[str], sequential: bool = False) -> Overlaps:
    return Overlaps(features, {(pair[0], pair[1]): 50 for pair in pairs}, 15, sequential)


RICH = dict.fromkeys("abcdef", 4000)
ADVICE = [
    (overlaps(RICH, []), 0, "no two photos overlap"),
    (overlaps(RICH, ["ab", "bc", "de", "ef"]), 3, "groups of 3, 3 that do not overlap: add photos between a and d"),
    (overlaps(RICH, ["ab", "bc", "cd"]), 4, "add photos between those left out and the rest"),
    (overlaps(RICH, ["ab", "bc", "cd", "de", "ef"]), 2, "too little or without depth"),
    (overlaps(RICH, ["ab", "bc", "cd"], sequential=True), 4, "--matching exhaustive"),
    (overlaps(dict.fromkeys("abcdef", 40), []), 0, "6 of 6 photos have fewer than 500 features"),
]


@pytest.mark.parametrize(("found", "registered", "text"), ADVICE)
def test_advice_fits_the_trouble(found, registered, text):
    assert any(text in line for line in advise(found, registered)) and advise(found, len(found.features)) == []


def test_every_photo_left_out_has_its_reason():
    found = overlaps(RICH | {"g": 3, "h": 900}, ["ab", "bc", "ad", "ef", "fh"])
    reasons = left_out(found, "abc", [["a", "b", "c"], ["e", "f", "x"]])
    assert reasons["d"] == "too few points in common with the 1 registered photos that it overlaps"
    assert reasons["e"] == reasons["f"] == "in a separate model of 3 photos" and len(reasons) == 5
    assert reasons["g"].startswith("only 3 features") and reasons["h"] == "overlaps no registered photo"


WALLS = {f"{n}.png": np.full((HEIGHT, WIDTH, 3), 128, np.uint8) for n in "abc"}
STRANGERS = {f"{n}.png": noise(n) for n in range(4)}
SMALL_ONE = {"small.png": noise(0)[::2, ::2]}
# Files of a folder, bytes or pixels, flags, and words of what is told.
BAD_PHOTOS: dict[str, tuple[dict[str, Any] | None, list[str], str]] = {
    "no folder": (None, [], "no such folder, expected one with photos"),
    "no photos": ({"notes.txt": b"none", ".hidden.png": b"x"}, [], "3 photos (.jpg, .jpeg, .png, .tif, .tiff"),
    "other formats": ({"a.heic": b"", "b.HEIC": b"", "c.mp4": b""}, [], "none; 2 .heic: convert to JPEG or PNG first"),
    "no image at all": ({"a.jpg": b"<html>", "b.jpg": b"", "c.jpg": b"x"}, [], "a.jpg: expected a complete image"),
    "photos of nothing in common": (STRANGERS, [], "0 of 4 photos registered, expected at least 3; 0 of"),
    "grey walls": (WALLS, [], "3 of 3 photos have fewer than 500 features"),
    "sizes that differ": (STRANGERS | SMALL_ONE, ["--cameras", "single"], "320x240 (0.png) and 160x120 (small.png)"),
    "no threads": ({}, ["--threads", "0"], "threads: expected at least 1, got 0"),
    "no features": ({}, ["--max-features", "0"], "max_features: expected at least 64, got 0"),
}


@pytest.mark.parametrize("kind", BAD_PHOTOS)
def test_bad_photos_are_told_in_one_line(kind, tmp_path, capsys):
    files, flags, words = BAD_PHOTOS[kind]
    if files is not None:
        (tmp_path / "photos").mkdir()
        for name, content in files.items():
            file = tmp_path / "photos" / name
            file.write_bytes(content) if isinstance(content, bytes) else Image.fromarray(content).save(file)
    before = snapshot(tmp_path)
    refused(capsys, ["sfm", str(tmp_path / "photos"), str(tmp_path / "new" / "scene"), *flags], words)
    assert snapshot(tmp_path) == before and not (tmp_path / "new").exists()


@pytest.mark.parametrize("stage", ["reading", "features", "matching", "mapping"])
def test_an_interrupt_leaves_nothing(stage, photos, tmp_path, monkeypatch):
    seen = []

    def observe(name: str, done: int, total: int) -> None:
        assert 0 <= done <= total
        seen.append(name)
        if name == stage and seen.count(name) == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        process(photos, tmp_path / "new" / "scene", options=PINHOLE, observe=observe)
    assert seen[-1] == stage and not list(tmp_path.iterdir())


def test_what_exists_stays(made, photos, tmp_path, capsys):
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    before = snapshot(made)
    for place in (made, tmp_path / "link"):
        refused(capsys, ["sfm", str(photos), str(place)], f"{place}: expected a new folder, but it exists")
    assert snapshot(made) == before and [entry.name for entry in tmp_path.iterdir()] == ["link"]


# What happens meanwhile. Instead of COLMAP, a process that copies the photos and is quick.

STAND_IN = """
import os, shutil
from nexwarp.data.sfm import stages
from nexwarp.data.sfm.process import work
from nexwarp.data.sfm.report import SfmReport
def run(self, names):
    self.observe("features", 0, 1)
    scene = self.folder / "scene"
    shutil.copytree(self.photos, scene / "images")
    (scene / "sparse").mkdir()
    {fault}
    return SfmReport(1, [], {{}}, 0, 0.0, 0.0, [], [], [], 0, 0, "exhaustive", {{}}, [])
stages.Stages.run = run
work()
"""


@pytest.fixture
def quick(monkeypatch, arc, tmp_path):
    """A function that makes a scene of photos in `tmp_path` with a stand-in for COLMAP, which has a fault."""
    folder = write_photos(tmp_path / "photos", dict(list(arc.images.items())[:3]))

    def make(fault: str = "pass", scene: str = "new/scene", **options: Any) -> None:
        monkeypatch.setattr(processing, "CHILD", (sys.executable, "-c", STAND_IN.format(fault=fault)))
        process(folder, tmp_path / scene, options=PINHOLE, **options)

    return make


@pytest.mark.parametrize("other", ["another process", "a file"])
def test_what_appears_meanwhile_stays(quick, tmp_path, other):
    place, expected = tmp_path / "new" / "scene", dict[str, bytes]()

    def appear(stage: str, done: int, total: int) -> None:
        if other == "a file":
            (place / "images").mkdir(parents=True, exist_ok=True)
            (place / "images" / "precious.txt").write_text("work")
        else:
            quick()
        expected.update(snapshot(place))

    with pytest.raises(FileExistsError, match="scene: appeared while the scene was made; not touching it"):
        quick(observe=appear)
    assert snapshot(place) == expected and [entry.name for entry in (tmp_path / "new").iterdir()] == ["scene"]


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("os.abort()", SceneError, "pycolmap failed: its process ended with signal SIGABRT"),
        ("os.kill(os.getpid(), 9)", SceneError, "signal SIGKILL .* too little memory"),
        ("os.write(2, b'what():  database or disk is full'); os.abort()", StorageError, "No space left on device"),
        ("raise OSError(28, 'No space left on device')", StorageError, "scene: cannot be written .No space left"),
        ("raise RuntimeError('No registered database factory')", ValueError, "pycolmap failed: No registered"),
        ("raise MemoryError", OutOfMemoryError, "MemoryError"),
    ],
)
def test_an_abort_is_one_line_and_leaves_nothing(fault, error, message, quick, tmp_path):
    with pytest.raises(error, match=message) as caught:
        quick(fault)
    assert "\n" not in str(caught.value) and [entry.name for entry in tmp_path.iterdir()] == ["photos"]


def test_a_limit_of_file_sizes_is_one_line_and_leaves_nothing(photos, tmp_path):
    code = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (99999, 99999)); "
    code += "from nexwarp.cli.main import main; sys.exit(main(sys.argv[1:]))"
    done = run_python("-c", code, "process", photos, tmp_path / "scene", timeout=120)
    told = f"nexwarp: error: {tmp_path / 'scene'}: cannot be written (File too large)\n"
    assert (done.returncode, done.stderr) == (2, told) and not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="a process group is ended there")
def test_a_killed_process_leaves_nothing(photos, tmp_path):
    command = [sys.executable, "-m", "nexwarp", "process", str(photos), str(tmp_path / "scene")]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60.0
    while not list(tmp_path.glob(".*/database.db")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.wait()
    while list(tmp_path.iterdir()):
        assert time.monotonic() < deadline, list(tmp_path.rglob("*"))
        time.sleep(0.01)


@pytest.mark.parametrize("name", ["a\x1b[2J.png", "a\nb.png", "b" * 241 + ".png", "c\udcff.png", "link.png"])
def test_names_and_links_that_train_refuses_are_refused(name, tmp_path):
    folder = write_photos(tmp_path / "photos", {f"{i}.png": noise(0)[:8, :8] for i in range(3)})
    Image.fromarray(noise(0)[:8, :8]).save(tmp_path / "outside.png")
    if name == "link.png":
        (folder / name).symlink_to(tmp_path / "outside.png")
    else:
        shutil.copy(tmp_path / "outside.png", folder / name)
    with pytest.raises(ValueError, match=r"photos: photo .*(path|bytes|link)") as caught:
        list_photos(folder)
    assert str(caught.value).isprintable()


def test_memory_of_decoding_is_bounded_by_the_sizes_of_the_photos(tmp_path, monkeypatch):
    """As many threads hold a photo as the memory has room for; the sizes are those of the headers."""
    names = []
    for side in (1000, 12000):
        names.append(f"{side}.png")
        Image.new("1", (side, side)).save(tmp_path / names[-1])
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("nexwarp.data.sfm.photos.available_memory", lambda: 200 * 2**30)
    options = SfmOptions(max_image_size=64)
    assert affordable_threads(tmp_path, names[:1], options) == 64
    assert affordable_threads(tmp_path, names, options) == 1  # 1.6 GiB each
    monkeypatch.setattr("nexwarp.data.sfm.photos.available_memory", lambda: 2**30)
    assert affordable_threads(tmp_path, names[:1], SfmOptions()) == 3  # 240 MB each, with features
    with pytest.raises(OutOfMemoryError, match=r"12000\.png: 144 megapixels need 1\.6 GiB of memory, of .* 1\.0 GiB"):
        affordable_threads(tmp_path, names, options)


@pytest.mark.parametrize("place", ["", "scene", ".."])
def test_photos_and_scene_must_be_apart(place, photos, capsys):
    before = snapshot(photos)
    refused(capsys, ["sfm", str(photos), str(photos / place)], "expected a scene folder apart from the photos")
    assert snapshot(photos) == before
