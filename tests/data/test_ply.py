import struct

import numpy as np
import pytest

from nexwarp.data.ply import BAND_0, read_ply

RNG = np.random.default_rng(5)
POINTS = RNG.normal(size=(40, 3))
COLORS = RNG.integers(0, 256, (40, 3))


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
    cloud = read_ply(tmp_path / "a.ply")
    assert np.array_equal(cloud.positions, np.stack([data[axis].astype(float) for axis in "xyz"], axis=1))
    assert cloud.positions.dtype == np.float64
    assert cloud.colors.dtype == np.uint8 and np.array_equal(cloud.colors, COLORS)


def test_ascii_after_another_element(tmp_path):
    rows = zip(POINTS.tolist(), COLORS.tolist(), strict=True)
    text = "".join(f"{x!r} {y!r} {z!r} {r} {g} {b}\r\n" for (x, y, z), (r, g, b) in rows)
    header = "element camera 2\nproperty float f\n" + vertex(40, "double x", "double y", "double z", *RGB)
    (tmp_path / "a.ply").write_bytes(ply(header, b"1\n2\n" + text.encode() + b"extra\n", "ascii"))
    cloud = read_ply(tmp_path / "a.ply")
    assert np.array_equal(cloud.positions, POINTS) and np.array_equal(cloud.colors, COLORS)


def test_binary_after_another_element(tmp_path):
    header = "element camera 2\nproperty float f\nproperty uchar g\n" + vertex(1, *XYZ)
    (tmp_path / "a.ply").write_bytes(ply(header, 10 * b"\7" + struct.pack("<3f", 1, 2, 3)))
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.positions.tolist() == [[1, 2, 3]] and cloud.colors.tolist() == [[128, 128, 128]]


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        ("f_dc_0 f_dc_1 f_dc_2", (0.0, -0.5 / BAND_0, 0.5 / BAND_0), (128, 0, 255)),
        ("red green blue", (np.nan, np.inf, -np.inf), (128, 255, 0)),
        ("s t u", (1, 2, 3), (128, 128, 128)),
    ],
)
def test_colors_of_floats(tmp_path, names, values, expected):
    header = vertex(1, *XYZ, *(f"float {name}" for name in names.split()))
    body = struct.pack("<6f", 0, 0, 0, *values)
    (tmp_path / "a.ply").write_bytes(ply(header, body))
    assert read_ply(tmp_path / "a.ply").colors.tolist() == [list(expected)]


FACES = "element face 1\nproperty list uchar int i\n"
ONE = struct.pack("<3f", 1, 2, 3)
BAD = {
    "empty": (b"", "does not begin with 'ply'"),
    "no end": (b"ply\nformat ascii 1.0\nelement vertex 1\n", "truncated, the PLY header has no end_header"),
    "no format": (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "a PLY header with a format, found none"),
    "odd format": (b"ply\nformat morse 1.0\nend_header\n", "got the line 'format morse 1.0'"),
    "odd type": (ply(vertex(1, "string x"), b""), "got the line 'property string x'"),
    "endless header": (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 10_000, "a PLY header of at most 65,536 bytes"),
    "no vertices": (ply("element point 1\nproperty float x\n", b"1234"), "an element vertex, found none"),
    "no z": (ply(vertex(1, *XYZ[:2]), ONE), "expected vertices with x, y and z, found no z"),
    "x twice": (ply(vertex(1, "float x", *XYZ), ONE + ONE), "properties of different names"),
    "truncated": (ply(vertex(2, *XYZ), ONE + ONE[:-1]), "truncated, expected 2 of element vertex, got 23 bytes"),
    "ascii beyond the end": (ply(vertex(10**17, *XYZ), b"1 2 3\n", "ascii"), "truncated, expected 100,000,000,000,000"),
    "ascii too short": (ply(vertex(3, *XYZ), b"1 2 3\n1.23456 2 3\n1.2345 2\n", "ascii"), "expected rows of 3 numbers"),
    "ascii of words": (ply(vertex(1, *XYZ), b"one two three\n", "ascii"), "expected rows of 3 numbers"),
    "ascii of four": (ply(vertex(1, *XYZ), b"1 2 3 4\n", "ascii"), r"got \(1, 4\)"),
    "lists": (ply("element vertex 1\nproperty list uchar float x\n", ONE), "without lists first, got its lists"),
    "lists before": (ply(FACES + vertex(1, *XYZ), ONE), "vertices without lists first, got lists of face"),
    "NaN": (ply(vertex(1, *XYZ), struct.pack("<3f", 1, np.nan, 3)), r"finite points, got \(1.0, nan, 3.0\) \(vertex 0"),
    "signalling NaN": (ply(vertex(1, *XYZ), struct.pack("<2fI", 1, 2, 0x7FA00000)), r"points, got \(1.0, 2.0, nan\)"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files_are_told_in_one_line(tmp_path, kind):
    content, message = BAD[kind]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_ply(tmp_path / "a.ply")
    assert "\n" not in str(caught.value) and str(tmp_path / "a.ply") in str(caught.value)
