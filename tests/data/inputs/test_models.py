import re
import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import torch

from nexwarp.data import Scene, load_scene
from nexwarp.data.lens import pycolmap_module
from tests.data.test_scene import make_scene, views_of

KEYPOINTS = re.compile(rb"(?m)^(?:[-+.0-9e]+ [-+.0-9e]+ -?[0-9]+ ?)*\n")


def edited(part: str, change):
    """Writer of a text model of which one file is changed."""

    def write(path: Path) -> Path:
        file = make_scene(path, text=True) / "sparse/0" / f"{part}.txt"
        content = change(file.read_bytes())
        assert content != file.read_bytes()
        file.write_bytes(content)
        return path

    return write


def floats(data: bytes) -> bytes:
    """All integers as numpy.savetxt writes them."""
    return re.sub(rb"(?m)(?<=[ ])(\d+)(?= )|^(\d+)(?= )", lambda m: b"%.18e" % float(m[0]), data)


def windows(data: bytes) -> bytes:
    return b"\xef\xbb\xbf" + data.replace(b"\n", b" \t\r\n")


def larger_model_second(path: Path) -> Path:
    make_scene(path, where="sparse/10")
    return make_scene(path, where="sparse/9", names=[f"{index:02d}.png" for index in range(3)])


def windows_names(path: Path) -> Path:
    names = [f"a\\{index:02d}.png" for index in range(10)]
    make_scene(path, names=names)
    (path / "images/a").mkdir()
    for name in names:
        (path / "images" / name).rename(path / "images" / name.replace("\\", "/"))
    return path


def other_unicode_form(path: Path) -> Path:
    names = [unicodedata.normalize("NFD", f"\u00e9{index}/\u00fc.png") for index in range(10)]
    make_scene(path, names=names)
    shutil.move(path / "images", path / "old")
    for name in names:
        file = path / "images" / unicodedata.normalize("NFC", name)
        file.parent.mkdir(parents=True)
        (path / "old" / name).rename(file)
    return path


MODELS = {
    "no lines of keypoints": edited("images", lambda data: re.sub(rb"(?m)^(?!#).*(?<!\.png)\n", b"", data)),
    "blank lines of keypoints": edited("images", lambda data: KEYPOINTS.sub(b"\n", data)),
    "blank lines everywhere": edited("images", lambda data: data.replace(b"\n", b"\n\n")),
    "comments between": edited("images", lambda data: data.replace(b".png\n", b".png\n # keypoints\n")),
    "BOM and CRLF, images": edited("images", windows),
    "BOM and CRLF, cameras": edited("cameras", windows),
    "BOM and CRLF, points": edited("points3D", windows),
    "floats, cameras": edited("cameras", floats),
    "floats, images": edited("images", floats),
    "floats, points": edited("points3D", floats),
    "the larger model is not the first": larger_model_second,
    "names with backslashes": windows_names,
    "names in another Unicode form": other_unicode_form,
    "absolute names": lambda path: make_scene(path, names=[str(path / f"images/{i:02d}.png") for i in range(10)]),
    "text in sparse": lambda path: make_scene(path, where="sparse", text=True),
    "text in the scene's folder": lambda path: make_scene(path, where=".", text=True),
    "binary in the scene's folder": lambda path: make_scene(path, where="."),
}  # fmt: skip


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_in_other_words_is_the_same(tmp_path, kind):
    reference, scene = load_scene(make_scene(tmp_path / "reference")), load_scene(MODELS[kind](tmp_path / "scene"))
    assert len(scene.train) == 8 and len(scene.test) == 2
    for view, expected in zip(views_of(scene), views_of(reference), strict=True):
        torch.testing.assert_close(view.camera.viewmat, expected.camera.viewmat, rtol=0, atol=1e-6)
        assert torch.equal(view.camera.K, expected.camera.K)
    assert torch.equal(scene.points, reference.points) and torch.equal(scene.colors, reference.colors)
    assert torch.equal(scene.track_lengths, reference.track_lengths)
    assert torch.equal(scene.reprojection_errors, reference.reprojection_errors)


@pytest.mark.parametrize(
    ("part", "change", "line"),
    [
        ("images", lambda data: data.replace(b"\n3 ", b"\n3. x "), "3. x "),
        ("cameras", lambda data: data.replace(b"PINHOLE 48 ", b"PINHOLE 48.5 "), "1 PINHOLE 48.5"),
    ],
)
def test_a_line_that_is_none_is_named(tmp_path, part, change, line):
    path = make_scene(tmp_path, text=True)
    file = path / "sparse/0" / f"{part}.txt"
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(
        ValueError, match=rf"{part}.txt: not a readable COLMAP model: line \d+: expected .* got '{line}"
    ):
        load_scene(path)


def test_photos_that_the_model_lacks_are_named(tmp_path):
    path = make_scene(tmp_path)
    for name in ("x.JPG", "y.png"):
        shutil.copy(path / "images/00.png", path / "images" / name)
    with pytest.warns(UserWarning, match=r"images: 2 of 12 photos are not used, as .*sparse/0 .*: x.JPG, y.png"):
        load_scene(path)


def test_points_of_images_that_were_deleted_keep_the_rest(tmp_path):
    path = make_scene(tmp_path, text=True)
    reference = load_scene(path)
    file = path / "sparse/0/images.txt"
    file.write_bytes(re.sub(rb"(?m)^2 .*\.png\n.*\n", b"", file.read_bytes()))
    (path / "images/01.png").unlink()
    with pytest.warns(UserWarning, match="20 observations of points are of 1 images .* such as id 2; left out"):
        scene = load_scene(path)
    assert np.array_equal(scene.track_lengths, reference.track_lengths - 1) and len(views_of(scene)) == 9


@pytest.mark.parametrize("arrays", [False, True])
def test_a_reconstruction_in_memory_is_the_scene_of_its_files(tmp_path, arrays):
    path = make_scene(tmp_path)
    reference = load_scene(path)
    photos = {view.name: view.image.numpy() for view in views_of(reference)}
    reconstruction = pycolmap_module().Reconstruction(str(path / "sparse/0"))
    scene = Scene.from_pycolmap(reconstruction, photos if arrays else path / "images")
    for one, other in zip(views_of(scene), views_of(reference), strict=True):
        assert one.image.equal(other.image) and one.camera.viewmat.equal(other.camera.viewmat)
        assert one.points.equal(other.points) and one.camera.K.equal(other.camera.K)
    assert scene.points.equal(reference.points) and scene.path == Path("memory")
    with pytest.raises(FileNotFoundError, match="images: expected the folder of the photos, found none at"):
        Scene.from_pycolmap(reconstruction, tmp_path / "absent")
    with pytest.raises(TypeError, match=r"reconstruction: expected a pycolmap.Reconstruction, got str"):
        Scene.from_pycolmap("sparse/0", path / "images")  # type: ignore[arg-type]


def test_views_are_what_a_data_loader_collates(tmp_path):
    scene = load_scene(make_scene(tmp_path))
    batch = next(iter(torch.utils.data.DataLoader(scene.train, batch_size=3)))  # type: ignore[arg-type]
    assert batch["name"] == [view.name for view in scene.train[:3]] and batch["mask"].all()
    for index, view in enumerate(scene.train[:3]):
        assert batch["image"][index].equal(view.image) and batch["viewmat"][index].equal(view.camera.viewmat)
        assert batch["K"][index].equal(view.camera.K) and batch["width"][index] == view.camera.width
