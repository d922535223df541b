import json
import shutil
import struct
import time
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp.data.scene
import nexwarp.data.views
import nexwarp.machine
from nexwarp.data import load_scene
from nexwarp.data.colmap import read_model
from nexwarp.data.images import read_image, read_mask
from nexwarp.data.lens import pycolmap_module
from nexwarp.io import json_files
from nexwarp.io.files import one_line
from nexwarp.io.json_files import parse_json
from nexwarp.model.model_file import load, save_model
from tests.data.inputs import room
from tests.data.test_scene import HEIGHT, WIDTH, make_scene, pose
from tests.model_file_support import make_model, rewrite

CAMERA_SIZE = 8 + 8  # where width and height lie in cameras.bin, after the count, id and model


def refused(path: Path, match: str, error: type[Exception] = ValueError, **options: Any) -> None:
    with pytest.raises(error, match=match) as caught:
        load_scene(path, **options)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def overwrite(file: Path, offset: int, data: bytes) -> None:
    content = bytearray(file.read_bytes())
    content[offset : offset + len(data)] = data
    file.write_bytes(content)


FINITE_POSE = r"00\.png: expected a finite pose with a rotation, got"
USABLE = r"00\.png: the COLMAP camera of this image is not usable: camera model PINHOLE: expected"
SIZES = [(0, 36), (48, 0), (48 * 2**30, 36 * 2**30), (2**64 - 1, 1)]
DAMAGED = [
    *(("cameras", CAMERA_SIZE, struct.pack("<QQ", *size), rf"00\.png: .* got {size[0]}x{size[1]}") for size in SIZES),
    ("images", 8 + 4, struct.pack("<4d", 0, 0, 0, 0), FINITE_POSE),
    ("images", 8 + 60, struct.pack("<I", 5), r"00\.png: expected a camera of the model, got id 5"),
    ("images", 8, struct.pack("<I", 2), r"images\.bin: damaged, expected each id once, got 2 twice"),
    ("points3D", 8 + 35, struct.pack("<d", float("nan")), r"finite reprojection errors, got nan \(point id \d+\)"),
]
for number in (float("nan"), float("inf"), 1e300):
    DAMAGED.append(("images", 8 + 4 + 32, struct.pack("<d", number), FINITE_POSE))
    DAMAGED.append(("cameras", CAMERA_SIZE + 16, struct.pack("<d", number), USABLE))


@pytest.mark.parametrize(("name", "offset", "data", "match"), DAMAGED)
def test_numbers_that_no_model_has(tmp_path, name, offset, data, match):
    path = make_scene(tmp_path)
    overwrite(path / f"sparse/0/{name}.bin", offset, data)
    refused(path, match)


def test_photos_come_once(tmp_path):
    for again in ("a.png", "./a.png"):
        path = make_scene(tmp_path / str(len(again)), names=["a.png", "b.png", again])
        refused(path, "expected each photo once, got a.png twice")
    scene = load_scene(make_scene(tmp_path / "c", names=["x/./a.png", "x//b.png"]))
    assert [view.name for view in scene.test + scene.train] == ["x/a.png", "x/b.png"]


@pytest.mark.parametrize("name", ["x" * 300, "y/" * 600 + "a.png"])
def test_names_of_absurd_length(tmp_path, name):
    path = make_scene(tmp_path, names=["a.png", "b.png"])
    file = path / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes().replace(b"a.png\0", name.encode() + b"\0"))
    refused(path, r"image name '[xy/]+\.\.\.: expected at most 240 bytes a part and 1024 in all")


def test_links_stay_in_the_scene(tmp_path):
    outside = tmp_path / "private.png"
    Image.new("RGB", (WIDTH, HEIGHT)).save(outside)
    path = make_scene(tmp_path / "scene")
    (path / "images/03.png").unlink()
    (path / "images/03.png").symlink_to(outside)
    refused(path, r"image name '03\.png': a link leaves .*images, expected a file in it; --follow-links allows it")
    assert "03.png" in {view.name for view in load_scene(path, follow_links=True).train}
    (path / "images/03.png").unlink()
    (path / "images/03.png").symlink_to("04.png")
    load_scene(path)
    # The folder itself is the user's to choose, and may lie on another disk.
    (path / "images").rename(tmp_path / "elsewhere")
    (path / "images").symlink_to(tmp_path / "elsewhere")
    load_scene(path)


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
def test_links_of_transforms_stay_in_the_scene(tmp_path, key):
    path = tmp_path / "scene"
    data = room.transforms([f"images/{name}" for name in room.write_photos(path / "images")])
    frames = data["frames"]
    (tmp_path / "private").write_bytes((path / "images/0.png").read_bytes())
    (path / "link.png").symlink_to(tmp_path / "private")
    (data if key == "ply_file_path" else frames[1])[key] = "link.png"
    (path / "transforms.json").write_text(json.dumps(data))
    refused(path, rf"{key}.* 'link.png': a link leaves .*, expected a file in it; --follow-links allows it")
    if key == "file_path":  # the link leads to a picture
        (path / "images/1.png").unlink()
        assert len(load_scene(path, follow_links=True).train) == 5


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio"])
def test_missing_photos_are_all_named_at_once(tmp_path, kind):
    path = make_scene(tmp_path)
    if kind == "nerfstudio":
        size: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "cx": None, "cy": None}
        room.write_transforms(path, room.transforms([f"images/{i:02d}.png" for i in range(10)], **size))
        shutil.rmtree(path / "sparse")
    for name in ("03.png", "07.png"):
        (path / "images" / name).unlink()
    named = r"2 of 10 photos: image not found: (images/)?03\.png, (images/)?07\.png"
    with pytest.raises(FileNotFoundError, match=rf"{named}; --skip-missing goes on without them$"):
        load_scene(path)
    with pytest.warns(UserWarning, match=rf"{named}; going on without them$"):
        scene = load_scene(path, skip_missing=True)
    names = {view.name for view in scene.train + scene.test}
    assert names == {f"{index:02d}.png" for index in range(10)} - {"03.png", "07.png"}
    for file in sorted((path / "images").iterdir())[1:]:
        file.unlink()
    with pytest.raises(FileNotFoundError, match="9 of 10 photos"):
        load_scene(path, skip_missing=True)


@pytest.mark.parametrize(("name", "whole"), [("images/03.png", "camera"), ("masks/03.png.png", "photo")])
def test_a_huge_picture_of_a_small_camera_is_not_decoded(tmp_path, monkeypatch, name, whole):
    path = make_scene(tmp_path)
    (path / name).parent.mkdir(exist_ok=True)
    Image.new("1", (1200 * 10, 900 * 10)).save(path / name)
    assert (path / name).stat().st_size < 20_000
    monkeypatch.setattr(Image.Image, "load", None)
    refused(path, rf"{name}: expected an image of at most 16 times the size of its {whole}, 48x36, got 12000x9000")


def test_images_of_more_pixels_than_their_file_holds(tmp_path):
    file = tmp_path / "a.png"
    for side, match in ((9_000, "9000x9000 pixels are more than a file"), (60_000, "at most 178 megapixels, got more")):
        Image.new("L", (16, 16)).save(file)
        header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
        overwrite(file, 12, header + struct.pack(">I", zlib.crc32(header)))
        with pytest.raises(ValueError, match=match):
            read_mask(file)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_counts_are_checked_before_they_are_believed(tmp_path, name):
    path = make_scene(tmp_path)
    file = path / f"sparse/0/{name}.bin"
    good = file.read_bytes()
    for count in (2**20, 2**40, 2**64 - 1):
        overwrite(file, 0, struct.pack("<Q", count))
        refused(path, rf"{name}\.bin: (truncated or damaged, expected more records than|expected at most)")
    for size in range(0, len(good), max(len(good) // 40, 1)):
        file.write_bytes(good[:size])
        refused(path, rf"{name}\.bin: truncated or damaged")
    file.write_bytes(good + b"\0")
    refused(path, rf"{name}\.bin: damaged, expected {len(good):,} bytes as its counts say, got {len(good) + 1:,}")


def test_poses_of_a_rig_are_those_of_pycolmap(tmp_path):
    pycolmap = pycolmap_module()
    rng = np.random.default_rng(1)
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    params = [40.0, 43.0, 25.5, 16.0]
    for index in (1, 2):
        model.add_camera(pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=index))
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    offset = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=3)), rng.normal(size=3))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), offset)
    model.add_rig(rig)
    for index in range(3):
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(pose(index))
        images = []
        for camera in (1, 2):
            image = pycolmap.Image(name=f"{camera}/{index}.png", camera_id=camera, image_id=2 * index + camera)
            image.frame_id = index + 1
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(index + 1)
    for kind, write in (("binary", model.write_binary), ("text", model.write_text)):
        folder = tmp_path / kind
        folder.mkdir()
        write(str(folder))
        photos = read_model(folder, folder).photos
        assert len(photos) == 6
        for photo in photos:
            expected = model.find_image_with_name(photo.name).cam_from_world().matrix()
            np.testing.assert_allclose(photo.viewmat[:3], expected, atol=1e-12)


def test_many_points_load_in_little_memory(tmp_path):
    path = make_scene(tmp_path, names=["a.png", "b.png"])
    count = 200_000
    record = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8"),
                       ("track", "<u4", 4)])  # fmt: skip
    records = np.zeros(count, record)
    records["id"] = np.arange(count)
    records["xyz"] = np.random.default_rng(0).normal(size=(count, 3))
    records["length"], records["track"] = 2, (1, 0, 2, 0)
    (path / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", count) + records.tobytes())
    tracemalloc.start()
    cloud = read_model(path, path / "images").cloud
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert cloud is not None and len(cloud.positions) == count and peak < 250 * count, peak


def test_too_many_points(tmp_path, monkeypatch):
    monkeypatch.setattr("nexwarp.data.colmap.MAX_POINTS", 19)
    refused(make_scene(tmp_path / "a"), r"points3D\.bin: expected at most 19 points, got 20")
    refused(make_scene(tmp_path / "b", text=True), r"points3D\.txt: expected at most 19 points, got 20")


@pytest.mark.parametrize(
    "changes",
    [{"levels": 64, "table_size": 2**30, "features": 8}, {"width": 4096, "hidden_layers": 64}],
    ids=["tables", "matrices"],
)
def test_a_models_tables_are_checked_before_they_are_allocated(tmp_path, changes):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda tensors, meta: meta["texture"].update(changes))
    with pytest.raises(ValueError, match=r"expected the tensors of a nexwarp model \(.*expected"):
        load(file)


def test_json_is_bounded(monkeypatch):
    assert parse_json("x", b'{"a": [1, "[[[\\"[[["]}') == {"a": [1, '[[["[[[']}
    assert parse_json("x", b"[" * 64 + b"]" * 64) is not None
    for text in (b"[" * 65 + b"]" * 65, b"[" * 10**6, b'{"a":' * 10**5, b'["", ' * 65):
        with pytest.raises(ValueError, match="x: expected JSON of at most 64 levels, got one nested too deeply"):
            parse_json("x", text)
    with pytest.raises(ValueError, match="x: expected JSON, could not parse it"):
        parse_json("x", b'["' + b'\\"' * 10**6)  # no end to the text: found in one look at it
    with pytest.raises(ValueError, match="NaN is no JSON number"):
        parse_json("x", b"[NaN]", finite=True)
    monkeypatch.setattr(json_files, "MAX_BYTES", 10)
    with pytest.raises(ValueError, match="x: expected at most 10 bytes of JSON, got more"):
        parse_json("x", b" " * 11)


def test_what_files_say_is_told_on_one_line():
    assert one_line("a\nb\tc") == "a b c" and one_line("\x00\ud800é") == "\\x00\\ud800é"
    assert len(one_line("x" * 10**6)) == 300


def test_a_jpeg_that_is_read_byte_by_byte_is_refused_at_once(tmp_path):
    """Between markers PIL reads single bytes: 30 MB took a minute before there was a limit."""
    photo = tmp_path / "a.jpg"
    photo.write_bytes(b"\xff\xd8\xff\xe0\x00\x04\x00\x00" + bytes(30_000_000))
    begun = time.process_time()
    with pytest.raises(ValueError, match=r"could not decode it: its content needs more than 1,000,000 reads$"):
        read_image(photo)
    assert time.process_time() - begun < 5.0


def test_huge_clouds_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(nexwarp.data.scene, "MAX_POINTS", 10)
    path = make_scene(tmp_path / "scene")
    scene, again = load_scene(path), load_scene(path)
    assert len(scene.points) == len(scene.colors) == len(scene.track_lengths) == 10
    assert torch.equal(scene.points, again.points)


def test_photos_that_do_not_fit_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = make_scene(tmp_path / "scene")
    (path / "images_2").mkdir()
    need = 10 * 48 * 36 * 3
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: need // 3)
    monkeypatch.setattr(nexwarp.data.views, "read_transparent", lambda *_: pytest.fail("read"))
    with pytest.raises(ValueError, match=r"10 photos of up to 48x36 .* use downscale=2 \(.*\) or .* \(images_2\)") as e:
        load_scene(path)
    assert "\n" not in str(e.value)
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: 0)
    with pytest.raises(ValueError, match="use fewer photos"):
        load_scene(path)
    monkeypatch.undo()
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: need // 3)
    load_scene(path, downscale=2)
    # A thousand photos of eight megapixels fit 8 GB at half size.
    sizes = [(3264, 2448)] * 1000
    assert nexwarp.data.scene.photos_bytes(sizes, 2, 3) < 0.9 * 7.2e9 < nexwarp.data.scene.photos_bytes(sizes, 1, 3)
    assert nexwarp.machine.available_memory() > 2**20
