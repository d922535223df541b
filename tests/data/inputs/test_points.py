import codecs
from functools import partial

import numpy as np
import pytest

import nexwarp.data.scene
from nexwarp.data import load_scene
from nexwarp.data.random_points import random_points
from tests.data.inputs import room

POINTS = room.wall_points(300)
COLORS = room.paint(POINTS)  # 0 to 255
WORDS = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i2": "short", "i4": "int"}


def ply(
    place="f8", color="u1", white=255, form="binary_little_endian", names=("red", "green", "blue"), end="\n", count=300
):
    """Content of a PLY file with positions and colours of number types; `white` is the value of white."""
    order = ">" if form.endswith("big_endian") else "<"
    fields = [(axis, order + place) for axis in "xyz"] + [(name, order + color) for name in names]
    rows = np.empty(count, fields)
    colors = COLORS[:count] * (white / 255)
    for index, axis in enumerate("xyz"):
        rows[axis] = POINTS[:count, index]
    for index, name in enumerate(names):
        rows[name] = colors[:, index] if color[0] == "f" else np.round(colors[:, index])
    header = ["ply", f"format {form} 1.0", f"element vertex {len(rows)}"]
    header += [f"property {WORDS[kind[1:]]} {name}" for name, kind in fields]
    text = end.join([*header, "end_header", ""]).encode()
    if form == "ascii":
        return text + "".join(" ".join(map(repr, row)) + end for row in rows.tolist()).encode()
    return text + rows.tobytes()


KINDS = {
    "bytes": ply(),
    "float positions": ply("f4"),
    "big-endian": ply(form="binary_big_endian"),
    "big-endian floats": ply("f4", "f4", 1.0, "binary_big_endian"),
    "ascii": ply(form="ascii"),
    "ascii with CR": ply(form="ascii", end="\r\n"),
    "ascii with a BOM": codecs.BOM_UTF8 + ply(form="ascii"),
    "floats to 1": ply(color="f4", white=1.0),
    "doubles to 255": ply(color="f8"),
    "ascii floats to 1": ply(color="f4", white=1.0, form="ascii"),
    "16 bits": ply(color="u2", white=65535),
    "16 bits to 255": ply(color="u2"),
    "signed 16 bits to 255": ply(color="i2"),
    "32 bits": ply(color="u4", white=2**32 - 1),
    "32 bits to 255": ply(color="i4"),
    "32 bits to 65535": ply(color="u4", white=65535),
    "r g b": ply(names=("r", "g", "b")),
    "diffuse": ply(names=("diffuse_red", "diffuse_green", "diffuse_blue")),
    "no colours": ply(names=()),
}


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setattr(nexwarp.data.scene, "random_points", partial(random_points, count=2000))
    return room.write_colmap(tmp_path, room.write_photos(tmp_path / "images"))


def check(scene, colored=True) -> None:
    """Fail unless the points lie on the walls and have their colours, or grey."""
    points = scene.points.double().numpy()
    assert np.abs(np.abs(points / (room.SIZE / 2)).max(axis=1) - 1).max() < 1e-6
    expected = room.paint(points) if colored else 128.0
    assert np.abs(scene.colors.numpy() - expected).max() <= 0.51


@pytest.mark.parametrize("kind", KINDS)
def test_points_of_every_kind(scene, tmp_path, kind):
    (tmp_path / "points.ply").write_bytes(KINDS[kind])
    check(load_scene(scene, points=str(tmp_path / "points.ply")), kind != "no colours")


def test_points_of_a_model_lie_in_ply_too(scene, tmp_path):
    model = scene / "sparse" / "0"
    check(load_scene(scene))
    (model / "points3D.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"points3D\.txt not found; --points FILE\.ply stands in for it"):
        load_scene(scene)
    (tmp_path / "points.ply").write_bytes(KINDS["bytes"])
    check(load_scene(scene, points=str(tmp_path / "points.ply")))
    (model / "points3D.ply").write_bytes(KINDS["bytes"])
    read = load_scene(scene)
    check(read)
    assert read.train[0].points is None and read.track_lengths.eq(0).all()
    (model / "images.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"incomplete COLMAP model in .*: images\.txt not found$"):
        load_scene(scene)


@pytest.mark.parametrize("content", [None, ply(count=0), ply(count=0, form="ascii")])
def test_a_model_of_no_points_starts_from_random_ones(scene, content):
    model = scene / "sparse" / "0"
    (model / "points3D.txt").write_text("# empty\n")
    if content is not None:
        (model / "points3D.txt").rename(model / "points3D.ply")
        (model / "points3D.ply").write_bytes(content)
    read = load_scene(scene)
    assert len(read.points) == 2000 and room.color_error(read) < room.RIGHT
    if content is not None:
        with pytest.raises(ValueError, match=r"points3D\.ply: expected at least one vertex, got none"):
            load_scene(scene, points=str(model / "points3D.ply"))


def test_points_that_no_photo_shows_are_noticed(scene, tmp_path):
    (tmp_path / "points.ply").write_bytes(KINDS["bytes"])
    text = (scene / "sparse" / "0" / "images.txt").read_text().splitlines()
    lines = [" ".join([*line.split()[:5], *["9000"] * 3, *line.split()[8:]]) if line else "" for line in text]
    (scene / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    with pytest.warns(UserWarning, match=r"points\.ply: no photo shows any of its points; are they"):
        load_scene(scene, points=str(tmp_path / "points.ply"))
