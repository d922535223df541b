"""Points of PLY files: what was written is read, and what is no such file is one clear line."""

import dataclasses
import struct

import numpy as np
import pytest

from nexwarp.data.capture import Cloud
from nexwarp.data.ply import BAND_0, read_ply, write_ply

RNG = np.random.default_rng(5)
POINTS = RNG.normal(size=(40, 3))
COLORS = RNG.integers(0, 256, (40, 3))


def positions_and_colors(path):
    cloud = read_ply(path)
    return cloud.positions, cloud.colors


def ply(elements: str, body: bytes, form: str = "binary_little_endian") -> bytes:
    return f"ply\nformat {form} 1.0\ncomment made by hand\n{elements}end_header\n".encode() + body


def vertex(count: int, *properties: str) -> str:
    return f"element vertex {count}\n" + "".join(f"property {p}\n" for p in properties)


XYZ = ("float x", "float y", "float z")
RGB = ("uchar red", "uchar green", "uchar blue")


@pytest.mark.parametrize("order", ["<", ">"])
def test_properties_in_any_order_and_of_any_kind(tmp_path, order):
    fields = [("nx", "f4"), ("z", "f8"), ("blue", "u1"), ("x", "f4"), ("green", "u1"), ("y", "f8"), ("red", "u1")]
    data = np.zeros(40, [(name, order + kind) for name, kind in fields])
    for index in range(3):
        data["xyz"[index]] = POINTS[:, index]
        data[("red", "green", "blue")[index]] = COLORS[:, index]
    names = {"f4": "float32", "f8": "double", "u1": "uint8"}
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = vertex(40, *(f"{names[kind]} {name}" for name, kind in fields))
    header += "element face 2\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_bytes(ply(header, data.tobytes() + b"\3" + 12 * b"\0" + b"\0", form))
    points, colors = positions_and_colors(tmp_path / "a.ply")
    assert np.array_equal(points, np.stack([data[axis].astype(float) for axis in "xyz"], axis=1))
    assert points.dtype == np.float64 and colors.dtype == np.uint8 and np.array_equal(colors, COLORS)


def test_ascii_after_another_element(tmp_path):
    rows = "".join(
        f"{x!r} {y!r} {z!r} {r} {g} {b}\r\n"
        for (x, y, z), (r, g, b) in zip(POINTS.tolist(), COLORS.tolist(), strict=True)
    )
    header = "element camera 2\nproperty float f\n" + vertex(40, "double x", "double y", "double z", *RGB)
    (tmp_path / "a.ply").write_bytes(ply(header, b"1\n2\n" + rows.encode() + b"extra\n", "ascii"))
    points, colors = positions_and_colors(tmp_path / "a.ply")
    assert np.array_equal(points, POINTS) and np.array_equal(colors, COLORS)


def test_binary_after_another_element(tmp_path):
    header = "element camera 2\nproperty float f\nproperty uchar g\n" + vertex(1, *XYZ)
    (tmp_path / "a.ply").write_bytes(ply(header, 10 * b"\7" + struct.pack("<3f", 1, 2, 3)))
    points, colors = positions_and_colors(tmp_path / "a.ply")
    assert points.tolist() == [[1, 2, 3]] and colors.tolist() == [[128, 128, 128]]


@pytest.mark.parametrize(
    ("kind", "names", "values", "expected"),
    [
        ("f4", "red green blue", (0.0, 0.5, 2.0), (0, 128, 255)),
        ("u2", "diffuse_red diffuse_green diffuse_blue", (0, 32768, 65535), (0, 128, 255)),
        ("u1", "r g b", (1, 2, 3), (1, 2, 3)),
        ("f4", "f_dc_0 f_dc_1 f_dc_2", (0.0, -0.5 / BAND_0, 0.5 / BAND_0), (128, 0, 255)),
        ("f4", "red green blue", (np.nan, np.inf, -np.inf), (128, 255, 0)),
        ("f4", "s t u", (1, 2, 3), (128, 128, 128)),
    ],
)
def test_colors_of_every_kind(tmp_path, kind, names, values, expected):
    word = {"f4": "float", "u2": "ushort", "u1": "uchar"}[kind]
    header = vertex(1, *XYZ, *(f"{word} {name}" for name in names.split()))
    body = struct.pack("<3f", 0, 0, 0) + np.array(values, "<" + kind).tobytes()
    (tmp_path / "a.ply").write_bytes(ply(header, body))
    assert read_ply(tmp_path / "a.ply").colors.tolist() == [list(expected)]


def cloud_with_everything() -> Cloud:
    pairs = sorted({(int(image), int(point)) for image, point in RNG.integers(0, 40, (90, 2))})
    return Cloud(
        POINTS,
        COLORS.astype(np.uint8),
        RNG.integers(0, 9, 40).astype(np.int32),
        np.where(np.arange(40) % 3, RNG.random(40), -1).astype(np.float32),
        np.array(pairs, np.int64),
    )


def assert_same_clouds(one: Cloud, other: Cloud) -> None:
    for field in dataclasses.fields(Cloud):
        mine, yours = getattr(one, field.name), getattr(other, field.name)
        assert (mine is None) == (yours is None), field.name
        assert mine is None or (mine.dtype == yours.dtype and np.array_equal(mine, yours)), field.name


@pytest.mark.parametrize("known", [True, False])
def test_what_is_written_is_read(tmp_path, known):
    cloud = cloud_with_everything() if known else Cloud.of(POINTS, COLORS.astype(np.uint8))
    write_ply(tmp_path / "new" / "a.ply", cloud)
    assert_same_clouds(read_ply(tmp_path / "new" / "a.ply"), cloud)
    plyfile = pytest.importorskip("plyfile", reason="an independent reader of PLY (extra `dev`)")
    data = plyfile.PlyData.read(str(tmp_path / "new" / "a.ply"))
    assert np.array_equal(data["vertex"]["x"], POINTS[:, 0]) and np.array_equal(data["vertex"]["red"], COLORS[:, 0])
    assert ("track_length" in data["vertex"]) == ("observation" in data) == known
    for form in {"text": True, "byte_order": "="}, {"text": False, "byte_order": ">"}:
        data.text, data.byte_order = form["text"], form["byte_order"]
        data.write(str(tmp_path / "b.ply"))
        assert_same_clouds(read_ply(tmp_path / "b.ply"), cloud)


def test_a_signalling_nan_is_refused_without_a_warning(tmp_path):
    """Its conversion to float64 warns; the fuzzer found one."""
    path = tmp_path / "a.ply"
    errors = np.array([1.5, 2.5], np.float32)
    write_ply(path, Cloud(np.eye(2, 3), np.zeros((2, 3), np.uint8), np.ones(2, np.int32), errors))
    content = path.read_bytes()
    assert content.count(errors[:1].tobytes()) == 1
    path.write_bytes(content.replace(errors[:1].tobytes(), struct.pack("<I", 0x7FA00000)))
    with pytest.raises(ValueError, match=r"reprojection_error: expected finite numbers, got nan \(vertex 0\)"):
        read_ply(path)


def test_an_error_is_colmaps_only_beside_a_track_length(tmp_path):
    body = struct.pack("<3f", 0, 0, 0) + struct.pack("<fh", 0.5, 7)
    for names, expected in ((("error", "track_length"), (7, 0.5)), (("error", "other"), (0, -1))):
        kinds = (f"float {names[0]}", f"short {names[1]}")
        (tmp_path / "a.ply").write_bytes(ply(vertex(1, *XYZ, *kinds), body))
        cloud = read_ply(tmp_path / "a.ply")
        assert (cloud.track_lengths[0], cloud.reprojection_errors[0]) == expected
        assert cloud.observations is None


def test_observations_of_others_and_behind_lists_are_left_alone(tmp_path):
    seen = "element observation 1\n" + "property int image_id\nproperty int vertex_index\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    pair = struct.pack("<2i", 3, 0)
    for elements, body, known in (
        (vertex(1, *XYZ) + seen, ONE + pair, True),
        (vertex(1, *XYZ) + "element edge 2\nproperty uchar a\n" + seen, ONE + b"12" + pair, True),
        (vertex(1, *XYZ) + faces + seen, ONE + b"\1" + 4 * b"\0" + pair, False),
        (seen + vertex(1, *XYZ), pair + ONE, False),
        (vertex(1, *XYZ) + seen.replace("image_id", "camera"), ONE + pair, False),
        (vertex(1, *XYZ) + seen.replace("int image_id", "float image_id"), ONE + pair, False),
    ):
        (tmp_path / "a.ply").write_bytes(ply(elements, body))
        cloud = read_ply(tmp_path / "a.ply")
        assert cloud.positions.tolist() == [[1, 2, 3]]
        observations = None if cloud.observations is None else cloud.observations.tolist()
        assert observations == ([[3, 0]] if known else None)


SEEN = vertex(1, "float x", "float y", "float z") + "element observation 1\n"
SEEN += "property int image_id\nproperty int vertex_index\n"
ONE = struct.pack("<3f", 1, 2, 3)
BAD = {
    "empty": (b"", "does not begin with 'ply'"),
    "text": (b"solid cube\n", "does not begin with 'ply'"),
    "no end": (b"ply\nformat ascii 1.0\nelement vertex 1\n", "truncated, the PLY header has no end_header"),
    "no format": (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "a PLY header with a format, found none"),
    "odd format": (b"ply\nformat morse 1.0\nend_header\n", "got the line 'format morse 1.0'"),
    "odd type": (ply(vertex(1, "string x"), b""), "got the line 'property string x'"),
    "property first": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "got the line 'property float x'"),
    "negative count": (ply("element vertex -1\n", b""), "got the line 'element vertex -1'"),
    "endless header": (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 10_000, "a PLY header of at most 65,536 bytes"),
    "endless line": (b"ply\nformat ascii 1.0\ncomment " + b"x" * 200_000, "a PLY header of at most 65,536 bytes"),
    "no vertices": (ply("element point 1\nproperty float x\n", b"1234"), "an element vertex, found none"),
    "zero vertices": (ply(vertex(0, *XYZ), b""), "at least one vertex, got none"),
    "no z": (ply(vertex(1, *XYZ[:2]), ONE), "expected vertices with x, y and z, found no z"),
    "x twice": (ply(vertex(1, "float x", *XYZ), ONE + ONE), "properties of different names"),
    "truncated": (ply(vertex(2, *XYZ), ONE + ONE[:-1]), "truncated, expected 2 of element vertex, got 23 bytes"),
    "more than there is": (ply(vertex(10**17, *XYZ), ONE), "truncated, expected 100,000,000,000,000,000 of element"),
    "ascii beyond the end": (ply(vertex(10**17, *XYZ), b"1 2 3\n", "ascii"), "truncated, expected 100,000,000,000,000"),
    "ascii too short": (
        ply(vertex(3, *XYZ), b"1 2 3\n1.2345678 2 3\n1.2345 2\n", "ascii"),
        "expected rows of 3 numbers",
    ),
    "ascii of words": (ply(vertex(1, *XYZ), b"one two three\n", "ascii"), "expected rows of 3 numbers"),
    "ascii of four": (ply(vertex(1, *XYZ), b"1 2 3 4\n", "ascii"), r"got \(1, 4\)"),
    "ascii of bytes": (ply(vertex(1, *XYZ), b"1 2 \xff\xfe\n", "ascii"), "expected rows of 3 numbers"),
    "lists": (
        ply("element vertex 1\nproperty list uchar float x\n", ONE),
        "vertices without lists first, got its lists",
    ),
    "lists before": (
        ply("element face 1\nproperty list uchar int i\n" + vertex(1, *XYZ), ONE),
        "vertices without lists first, got lists of face",
    ),
    "track of NaN": (
        ply(vertex(1, *XYZ, "float track_length"), ONE + struct.pack("<f", np.nan)),
        "track_length: .* nan",
    ),
    "endless error": (
        ply(vertex(1, *XYZ, "float reprojection_error"), ONE + struct.pack("<f", np.inf)),
        r"reprojection_error: expected finite numbers, got inf \(vertex 0\)",
    ),
    "observation of no point": (ply(SEEN, ONE + struct.pack("<2i", 3, 1)), "vertices from 0 to 0, got .* 1 to 1"),
    "observation of a negative image": (ply(SEEN, ONE + struct.pack("<2i", -3, 0)), "images from 0 .* got images -3"),
    "truncated observations": (ply(SEEN, ONE + b"1234"), "truncated, expected 1 of element observation, got 4 bytes"),
    "NaN": (
        ply(vertex(1, *XYZ), struct.pack("<3f", 1, np.nan, 3)),
        r"finite points, got \(1.0, nan, 3.0\) \(vertex 0\)",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files_are_told_in_one_line(tmp_path, kind):
    content, message = BAD[kind]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_ply(tmp_path / "a.ply")
    assert "\n" not in str(caught.value) and str(tmp_path / "a.ply") in str(caught.value)


def test_damaged_files_never_crash(tmp_path):
    """Cut off or with bytes changed at 300 places: points come back, or one line."""
    rows = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in POINTS)
    write_ply(tmp_path / "a.ply", cloud_with_everything())
    goods = [(tmp_path / "a.ply").read_bytes(), ply(vertex(40, *XYZ), rows.encode(), "ascii")]
    outcomes = {"read": 0, "refused": 0}
    for trial in range(300):
        data = bytearray(goods[trial % 2])
        if trial % 3 == 0:
            data = data[: RNG.integers(len(data))]
        else:
            for place in RNG.integers(0, len(data) if trial % 3 == 1 else 300, 3):
                data[place] = RNG.integers(256)
        (tmp_path / "a.ply").write_bytes(data)
        try:
            points, colors = positions_and_colors(tmp_path / "a.ply")
            assert points.shape == colors.shape and np.isfinite(points).all()
            outcomes["read"] += 1
        except ValueError as error:
            assert "\n" not in str(error)
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 10
