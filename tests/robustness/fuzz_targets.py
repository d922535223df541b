"""The readers of nexwarp's input files, each with small valid files to damage."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.cameras.nerfstudio import load_camera_path, save_camera_path, save_transforms
from nexwarp.data import load_scene
from nexwarp.data.images import read_image, read_mask, read_transparent
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.ply import read_ply
from nexwarp.data.scene import SceneSource
from nexwarp.data.sfm.photos import MAKE, MODEL, camera_groups, read_photos
from nexwarp.export.surfels_ply import save_splats_ply
from nexwarp.io.json_files import write_json
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.model import Model
from nexwarp.model.model_file import load, save_model
from nexwarp.run.folder import RunRecord, create_run, read_metrics, read_run
from nexwarp.train.recipe import Config
from tests.robustness.fuzz_inputs import Files
from tests.robustness.fuzz_models import (
    HEIGHT,
    VIEWS,
    WIDTH,
    check_rendering,
    some_cameras,
    some_model,
    some_surfels,
    some_trainer,
    some_viewmats,
)


@dataclass(frozen=True)
class FuzzTarget:
    """A reader of the input in a folder; `make` writes valid inputs, whose files with the ends `fuzzed` are damaged."""

    name: str
    make: Callable[[Path], list[Files]]
    read: Callable[[Path], object]
    fuzzed: tuple[str, ...]

    def write(self, folder: Path, files: Files) -> None:
        """Put an input into a folder, in place of the one before it."""
        there = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        for name in there:
            if name.endswith(self.fuzzed) and name not in files:
                (folder / name).unlink()
        for name, data in files.items():
            if name.endswith(self.fuzzed) or name not in there:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(data)


def _files(folder: Path) -> Files:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _noise(*channels: int, most: int = 256, dtype: type = np.uint8) -> Image.Image:
    return Image.fromarray(np.random.default_rng(0).integers(0, most, (HEIGHT, WIDTH, *channels), dtype=dtype))


def _photos(folder: Path, mode: str = "RGB") -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{index}.png" for index in range(VIEWS)]
    for name in names:
        _noise(len(mode)).save(folder / name)
    return names


def _colmap(text: bool) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        pycolmap = pycolmap_module()
        models = {
            "PINHOLE": [10.0, 11.0, 6.0, 4.5],
            "SIMPLE_RADIAL": [10.0, 6.0, 4.5, 0.05],
            "OPENCV_FISHEYE": [10.0, 11.0, 6.0, 4.5, 0.01, 0.0, 0.0, 0.0],
        }
        inputs = []
        for model, params in models.items():
            path = folder / model
            names = _photos(path / "images")
            scene = pycolmap.Reconstruction()
            camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
            scene.add_camera_with_trivial_rig(camera)
            for index, (name, viewmat) in enumerate(zip(names, some_viewmats(), strict=True)):
                image = pycolmap.Image(name=name, keypoints=np.ones((6, 2)), camera_id=1, image_id=index + 1)
                scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
            for index in range(6):
                track = pycolmap.Track()
                for image_id in range(1, 2 + index % 3):
                    track.add_element(image_id, index)
                scene.add_point3D(0.1 * np.array([index, index % 2, 1.0]), track, np.array([9, 99, 200], np.uint8))
            (path / "sparse/0").mkdir(parents=True)
            (scene.write_text if text else scene.write_binary)(str(path / "sparse/0"))
            inputs.append(_files(path))
        return inputs

    return make


def _ply(folder: Path) -> list[Files]:
    folder.mkdir(parents=True, exist_ok=True)
    rows = [(0.1 * i, 0.2 * i, 1.0, 10 * i, 20, 30) for i in range(6)]
    names = ("x", "y", "z", "red", "green", "blue")
    kinds = {"ascii": ("float",) * 3 + ("uchar",) * 3, "binary_little_endian": ("float",) * 3 + ("uchar",) * 3,
             "binary_big_endian": ("double",) * 3 + ("ushort",) * 3}  # fmt: skip
    inputs = []
    for form, types in kinds.items():
        properties = [f"property {kind} {name}" for kind, name in zip(types, names, strict=True)]
        header = ["ply", f"format {form} 1.0", "comment six points", "element camera 1", "property int id"]
        header += ["element vertex 6", *properties, "element face 0", "property list uchar int vertex_index"]
        head = "\n".join([*header, "end_header", ""]).encode()
        if form == "ascii":
            body = b"7\n" + b"".join(" ".join(map(str, row)).encode() + b"\n" for row in rows)
        else:
            order = "<" if "little" in form else ">"
            codes = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2"}
            dtype = np.dtype([(name, order + codes[kind]) for name, kind in zip(names, types, strict=True)])
            body = np.array([7], f"{order}i4").tobytes() + np.array(rows, dtype).tobytes()
        inputs.append({"points.ply": head + body})
    save_splats_ply(folder / "points.ply", some_surfels())
    return [*inputs, _files(folder)]


def _nerfstudio(folder: Path) -> list[Files]:
    cameras = some_cameras()
    inputs = []
    for kind in ("plain", "full", "fisheye"):
        path = folder / kind
        names = [f"images/{name}" for name in _photos(path / "images", "RGBA")]
        _photos(path / "masks")
        save_transforms(path / "transforms.json", dict(zip(names, cameras, strict=True)))
        data = json.loads((path / "transforms.json").read_text())
        if kind == "fisheye":
            data |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.0, "k3": 0.0, "k4": 0.0}
        if kind == "full":
            data |= {"camera_model": "OPENCV", "k1": 0.01, "p1": 0.001, "ply_file_path": "points.ply"}
            data |= {"applied_transform": np.eye(4)[[0, 2, 1]].tolist(), "applied_scale": 0.5}
            data["applied_transform"][1] = [0.0, 0.0, -1.0, 0.5]
            data |= {"train_filenames": names[:2], "val_filenames": names[2:], "test_filenames": names[2:]}
            for frame, name in zip(data["frames"], names, strict=True):
                frame["mask_path"] = name.replace("images", "masks")
            save_splats_ply(path / "points.ply", some_surfels())
        (path / "transforms.json").write_text(json.dumps(data))
        inputs.append(_files(path))
    return inputs


def _blender(folder: Path) -> list[Files]:
    save_transforms(folder / "all.json", {str(i): camera for i, camera in enumerate(some_cameras())})
    frames = [frame["transform_matrix"] for frame in json.loads((folder / "all.json").read_text())["frames"]]
    for split in ("train", "test"):
        names = _photos(folder / split, "RGBA")
        entries = [
            {"file_path": f"./{split}/{name[:-4]}", "rotation": 0.01, "transform_matrix": matrix}
            for name, matrix in zip(names, frames, strict=True)
        ]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": entries}))
    (folder / "all.json").unlink()
    return [_files(folder)]


def _model(folder: Path) -> list[Files]:
    full = some_model()
    save_model(folder / "a", full)
    save_model(folder / "b", Model(full.surfels, full.texture, options=full.options))
    save_model(folder / "c", full, compact=True)
    _read_model(folder / "a")  # the first reading imports modules and kernels for seconds, which no input must pay for
    return [_files(folder / name) for name in "abc"]


def _read_model(folder: Path) -> None:
    check_rendering(load(folder))


def _checkpoint(folder: Path) -> list[Files]:
    folder.mkdir(parents=True, exist_ok=True)
    _trainer().save(folder)
    check_rendering(_trainer().model())
    return [_files(folder)]


_trainer = functools.cache(some_trainer)  # which takes seconds


def _read_checkpoint(folder: Path) -> None:
    """Restore a checkpoint whose checksums agree, although it is damaged."""
    state, tensors = (folder / "checkpoint" / name for name in ("state.json", "tensors.safetensors"))
    with contextlib.suppress(OSError, ValueError, RecursionError):
        record = json.loads(state.read_bytes())
        if isinstance(record, dict) and "sha256" in record:
            del record["sha256"]
            if "tensors_sha256" in record:
                record["tensors_sha256"] = hashlib.sha256(tensors.read_bytes()).hexdigest()
            digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
            state.write_text(json.dumps(record | {"sha256": digest}))
    restored = _trainer()
    restored.restore(folder)
    check_rendering(restored.model())


def _metrics(folder: Path) -> list[Files]:
    values = {"psnr": 20.5, "ssim": 0.7, "flip": None}
    data = {**values, "views": {"a.png": values}, "convention": "x", "preset": "default", "iterations": 3, "surfels": 5}
    write_json(folder / "metrics.json", data)
    return [_files(folder)]


def _read_cameras(folder: Path) -> None:
    for members in load_cameras(folder / "cameras.json").values():
        for camera in members.values():
            check_rendering(some_model(), camera)


def _read_camera_path(folder: Path) -> None:
    for camera in load_camera_path(folder / "path.json").cameras[:4]:
        check_rendering(some_model(), camera)


def _config(folder: Path) -> list[Files]:
    create_run(folder, RunRecord(SceneSource("demo"), Config()))
    return [_files(folder)]


def _run_cameras(folder: Path) -> list[Files]:
    cameras = {str(i): camera for i, camera in enumerate(some_cameras())}
    save_cameras(folder / "cameras.json", {"train": cameras, "test": cameras})
    return [_files(folder)]


def _camera_path(folder: Path) -> list[Files]:
    cameras = some_cameras()
    save_camera_path(folder / "a" / "path.json", cameras)
    plain = [
        dataclasses.replace(c, K=torch.tensor([[11.0, 0.0, 6.0], [0.0, 11.0, 4.5], [0.0, 0.0, 1.0]])) for c in cameras
    ]
    save_camera_path(folder / "b" / "path.json", plain)
    save_transforms(folder / "c" / "path.json", {str(i): camera for i, camera in enumerate(cameras)})
    return [_files(folder / name) for name in "abc"]


def _images(folder: Path) -> list[Files]:
    folder.mkdir(parents=True, exist_ok=True)
    color, wide = _noise(4), _noise(most=2**16, dtype=np.uint16)
    rgb, grey, palette = (color.convert(mode) for mode in ("RGB", "L", "P"))
    pictures = {
        "rgb.jpg": rgb, "grey.jpg": grey, "cmyk.jpg": color.convert("CMYK"), "rgba.png": color, "grey.png": grey,
        "bits.png": color.convert("1"), "palette.png": palette, "wide.png": wide, "wide.tiff": wide, "rgb.tiff": rgb,
        "palette.gif": palette, "rgba.webp": color, "rgb.bmp": rgb, "rgb.ppm": rgb, "rgba.tga": color, "rgb.jp2": rgb,
    }  # fmt: skip
    inputs = []
    for name, image in pictures.items():
        image.save(folder / name)
        inputs.append({"mask": (folder / name).read_bytes()})
    rgb.save(folder / "packed.tiff", compression="tiff_lzw")
    return [*inputs, {"mask": (folder / "packed.tiff").read_bytes()}]


def _read_images(folder: Path) -> None:
    """Read a file as a mask and as a photo; raise the first reader's error."""
    first = None
    for read in (read_mask, read_image, read_transparent):
        try:
            read(folder / "mask")
        except ValueError as error:
            first = first or error
    if first is not None:
        raise first


def _photo_files(folder: Path) -> list[Files]:
    folder.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[MAKE], exif[MODEL] = "maker", "model"
    exif[274] = 6  # orientation
    exif.get_ifd(34665)[41989] = 35  # focal length of a 35 mm film
    for name in ("a.jpg", "b.jpg"):
        _noise(3).save(folder / name, exif=exif if name == "a.jpg" else Image.Exif())
    return [{"a.jpg": data} for data in _files(folder).values()]


def _exr(folder: Path) -> list[Files]:
    rng = np.random.default_rng(0)
    color = torch.from_numpy(rng.random((HEIGHT, WIDTH, 3), np.float32))
    save_exr(folder / "a" / "a.exr", {"image": color, "ids": color[..., 0].int(), "depth": color[..., 1].contiguous()})
    save_exr(folder / "b" / "a.exr", {"depth": torch.ones(HEIGHT, WIDTH)}, {"near": 0.01})
    return [_files(folder / "a"), _files(folder / "b")]


TARGETS = {
    target.name: target
    for target in (
        FuzzTarget("colmap_binary", _colmap(False), load_scene, (".bin",)),
        FuzzTarget("colmap_text", _colmap(True), load_scene, (".txt",)),
        FuzzTarget("nerfstudio", _nerfstudio, load_scene, ("transforms.json",)),
        FuzzTarget("blender", _blender, lambda folder: load_scene(folder, background="white"), (".json",)),
        FuzzTarget("model", _model, _read_model, (".safetensors",)),
        FuzzTarget("config", _config, read_run, (".json",)),
        FuzzTarget("cameras", _run_cameras, _read_cameras, (".json",)),
        FuzzTarget("checkpoint", _checkpoint, _read_checkpoint, (".json", ".safetensors")),
        FuzzTarget("metrics", _metrics, read_metrics, (".json",)),
        FuzzTarget("camera_path", _camera_path, _read_camera_path, (".json",)),
        FuzzTarget("ply", _ply, lambda folder: read_ply(folder / "points.ply"), (".ply",)),
        FuzzTarget("masks", _images, _read_images, ("mask",)),
        FuzzTarget(
            "photos",
            _photo_files,
            lambda folder: camera_groups(folder, read_photos(folder, ["a.jpg"], 1, lambda _: None), "auto"),
            (".jpg",),
        ),
        FuzzTarget("exr", _exr, lambda folder: load_exr(folder / "a.exr"), (".exr",)),
    )
}
# One thread: a forked process does not inherit its parent's threads.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")
