import json

import numpy as np
import pytest
from PIL import Image

from nexwarp.data import load_scene
from tests.data.inputs.support import MASK, assert_same_cameras, edit, file, frame, spoilt, write_mask
from tests.data.test_scene import make_scene
from tests.scene_writers import write_blender, write_nerfstudio


def text(content: str):
    def make(demo, path):
        write_nerfstudio(demo, path)
        (path / "transforms.json").write_text(content)
        return path

    return make


def mask_of(width: int, height: int, value: int = 255):
    def make(demo, path):
        write_nerfstudio(demo, path)
        (path / "masks").mkdir()
        Image.new("L", (width, height), value).save(path / "masks" / "view_003.png")
        return path

    return make


def keys(**changes):
    return spoilt(lambda data: data.update(changes))


DOUBLE = (2 * np.eye(4)).tolist()
SINGULAR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
BAD = {
    "no JSON": (text("{frames: []"), r"transforms.json: expected JSON, could not parse it"),
    "a list": (text("[]"), "expected a JSON object, got list"),
    "NaN": (text('{"frames": [NaN]}'), "NaN is no JSON number"),
    "a number of 5,000 digits": (text('{"frames": [{"w": ' + "9" * 5000 + "}]}"), "could not parse"),
    "no frames": (spoilt(lambda data: data.pop("frames") and None), "frames: expected a list .*, got None"),
    "empty frames": (spoilt(lambda data: data["frames"].clear()), r"frames: expected a list .*, got \[\]"),
    "frame that is none": (spoilt(lambda data: data["frames"].append(7)), r"frames\[10\]: expected a JSON object"),
    "one frame": (spoilt(lambda data: data.update(frames=data["frames"][:1])), "at least 2 registered images"),
    "frame twice": (spoilt(lambda d: d["frames"].append(d["frames"][2])), "each photo once, got view_00.* twice"),
    "no file name": (frame(file_path=None), "frame 3: file_path: expected the name of a file, got None"),
    "no such file": (frame(file_path="images/x.png"), "1 of .* photos: image not found: images/x.png; --skip-missing"),
    "parent": (frame(file_path="images/../../x.png"), "file_path: .* leaves the scene's folder"),
    "absolute": (frame(file_path="/etc/passwd"), "file_path: '/etc/passwd' leaves the scene's folder"),
    "drive": (frame(file_path="C:\\x.png"), "file_path: .* leaves the scene's folder"),
    "backslashes": (frame(file_path="images\\..\\..\\x.png"), "leaves the scene's folder"),
    "zero byte": (frame(file_path="images/\0.png"), "leaves the scene's folder"),
    "no matrix": (frame(transform_matrix=None), "frame 3 .*: transform_matrix: expected a 4x4 matrix .*, got None"),
    "singular matrix": (frame(transform_matrix=SINGULAR), "expected an invertible pose, got the singular"),
    "scaled matrix": (frame(transform_matrix=DOUBLE), "last row 0, 0, 0, 1|singular, sheared, scaled"),
    "singular applied": (keys(applied_transform=SINGULAR), "applied_transform: .* got the singular"),
    "applied scale of 0": (keys(applied_scale=0), "applied_scale: expected a number above 0"),
    "endless applied scale": (keys(applied_scale=1e200), "applied_scale: expected a number above 0, got 1e[+]200"),
    "focal length of 0": (keys(fl_x=0.0), "K: expected focal lengths > 0, got 0"),
    "no focal length": (spoilt(lambda d: [d.pop(k) for k in ("fl_x", "fl_y")] and None), "expected a focal length"),
    "angle of pi": (
        spoilt(lambda d: d.pop("fl_x") and d.update(camera_angle_x=3.2)),
        "camera_angle_x: expected a number above 0 below 3.14159, got 3.2",
    ),
    "text focal length": (keys(fl_x="wide"), "fl_x: expected a number, got 'wide'"),
    "half a pixel": (keys(w=96.5), "w, h: expected whole numbers of pixels"),
    "billions of pixels": (keys(w=10**9), "expected an image size of 1 to 65536"),
    "model of a list": (keys(camera_model=[1]), r"camera_model: .* got \[1\]"),
    "photos of another shape": (keys(w=50, h=72), "expected an image of 50x72 pixels"),
    "unknown test photo": (keys(test_filenames=["images/q.png"]), "test_filenames: .* got q.png"),
    "split that is no list": (keys(train_filenames=3), "train_filenames: expected a list"),
    "no training photo": (keys(train_filenames=[]), "at least one photo"),
    "no such ply": (keys(ply_file_path="q.ply"), "ply_file_path: file not found: .*q.ply"),
    "ply elsewhere": (keys(ply_file_path="../q.ply"), "ply_file_path: .* leaves the scene"),
    "ply that is none": (file("sparse_pc.ply", b"obj"), "expected a PLY file, but it does not begin with 'ply'"),
    "no such mask": (frame(mask_path="masks/q.png"), "frame 3 .*: mask_path: file not found: .*q.png"),
    "mask elsewhere": (frame(mask_path="../q.png"), "mask_path: '../q.png' leaves the scene's folder"),
    "mask that is none": (file("q.png", b"GIF", mask_path="q.png"), "q.png: expected a complete image file"),
    "mask of another size": (mask_of(72, 96), "view_003.png: expected a mask of 96x72 pixels .* got 72x96"),
    "black mask": (mask_of(96, 72, 0), "view_003.png: expected a mask with pixels that count, got none"),
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
    with pytest.raises(ValueError, match=r"expected at most 33,554,432 bytes of JSON, got more"):
        load_scene(path)


def test_unknown_keys_are_named_once(demo, tmp_path):
    def change(data):
        data |= {"aabb_scale": 16, "orientation_override": "none", "offset": [1, 2]}
        data["frames"][0] |= {"sharpness": 12.5, "colmap_im_id": 3, "normal_file_path": "../nowhere"}

    path = edit(write_nerfstudio(demo, tmp_path / "scene"), change)
    with pytest.warns(UserWarning, match=r"keys that are not read: normal_file_path, orientation_override$") as caught:
        scene = load_scene(path)
    assert len(caught) == 1
    assert_same_cameras(scene, load_scene(demo))


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
        ({"masks": 3}, TypeError, "masks: expected str or NoneType, got int"),
        ({"background": "pink"}, ValueError, "background: expected white, black, random or three numbers"),
        ({"background": (0, 0, 2)}, ValueError, "background: expected white, black, random or three numbers"),
        ({"background": 0.5}, ValueError, "background: expected white, black, random or three numbers"),
        ({"points": "absent.ply"}, FileNotFoundError, "absent.ply: no such file"),
        ({"downscale": 0}, ValueError, "downscale: expected at least 1, got 0"),
        ({"downscale": 2.0}, TypeError, "downscale: expected int, got float"),
        ({"images": "i_8"}, FileNotFoundError, r"images: no folder 'i_8' in .* which has images$"),
        ({"points": 3}, TypeError, "points: expected str or PathLike or NoneType, got int"),
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
