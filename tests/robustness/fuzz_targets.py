"""The readers of nexwarp's input files, each with small valid files to damage."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.cameras.nerfstudio import load_camera_path, save_camera_path
from nexwarp.data.depth_files import read_depth
from nexwarp.data.images import MAKE, MODEL, read_image, read_mask, read_transparent
from nexwarp.data.ply import read_ply
from nexwarp.data.scene import SceneSource
from nexwarp.data.sfm.photos import camera_groups, read_photos
from nexwarp.export.bake import bake
from nexwarp.export.glb import bake_cards, save_glb
from nexwarp.export.splats import gaussians, save_splats_ply
from nexwarp.export.web.baked import encode_baked
from nexwarp.io.json_files import write_json
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.edit import Edit, checksum, frame_of, kept_surfels, moved_surfels, read_edits, write_edits
from nexwarp.model.model_file import load, save_model
from nexwarp.run.folder import RunRecord, create_run, read_metrics, read_run
from nexwarp.run.photo_table import load_photo_table
from nexwarp.train.recipe import Config, TextureConfig
from tests import scene_writers
from tests.model_file_support import make_model
from tests.robustness.fuzz_inputs import Files
from tests.scene_writers import BARREL, FISHEYE, demo_lens, write_demo, write_distorted, write_nerfstudio, write_points
from tests.scenes import make_camera, make_surfels, random_scene

WIDTH, HEIGHT, VIEWS = 12, 9, 3
TEXTURE = TextureConfig(levels=2, table_size=16, width=8, hidden_layers=1)


@dataclass(frozen=True)
class FuzzTarget:
    """A reader of the input in a folder; `make` writes valid inputs, whose files with the ends `fuzzed` are damaged."""

    name: str
    make: Callable[[Path], list[Files]]
    read: Callable[[Path], object]
    fuzzed: tuple[str, ...]


def write_input(folder: Path, files: Files) -> None:
    """Put an input into a folder, in place of the one before it."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def _files(folder: Path) -> Files:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _noise(*channels: int, most: int = 256, dtype: type = np.uint8) -> Image.Image:
    return Image.fromarray(np.random.default_rng(0).integers(0, most, (HEIGHT, WIDTH, *channels), dtype=dtype))


def _scene(folder: Path) -> Path:
    return write_demo(folder, WIDTH, HEIGHT, VIEWS, points=6)


def _cameras(folder: Path) -> dict[str, nw.Camera]:
    scene = nw.load_scene(_scene(folder))
    return {view.name: view.camera for view in (*scene.train, *scene.test)}


def _colmap(text: bool) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        scenes = [_scene(folder / "pinhole")]
        for model, coefficients in (("OPENCV", BARREL), ("OPENCV_FISHEYE", FISHEYE)):
            scenes.append(write_distorted(scenes[0], folder / model, demo_lens(scenes[0], model, coefficients)))
        if text:
            scenes = [scene_writers.write_text(scene, folder / f"{scene.name} text") for scene in scenes]
        return [_files(scene) for scene in scenes]

    return make


def _ply(folder: Path) -> list[Files]:
    numbers = np.arange(18.0).reshape(6, 3)
    for form in ("ascii", "binary_little_endian", "binary_big_endian"):
        write_points(folder / form, 0.1 * numbers, numbers.astype(np.uint8), form)
    save_splats_ply(folder / "splats", gaussians(make_surfels(random_scene(5))))
    return [{"points.ply": data} for data in _files(folder).values()]


def _nerfstudio(folder: Path) -> list[Files]:
    scene = _scene(folder / "pinhole")
    fisheye = write_distorted(scene, folder / "fisheye", demo_lens(scene, "OPENCV_FISHEYE", FISHEYE))
    plain, full = write_nerfstudio(scene, folder / "plain"), write_nerfstudio(scene, folder / "full")
    shutil.copytree(full / "images", full / "masks")
    data = json.loads((full / "transforms.json").read_text())
    names = [frame["file_path"] for frame in data["frames"]]
    data |= {"k1": 0.01, "p1": 0.001, "applied_scale": 0.5}
    data |= {"train_filenames": names[:2], "val_filenames": names[2:], "test_filenames": names[2:]}
    for frame in data["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
    (full / "transforms.json").write_text(json.dumps(data))
    return [_files(plain), _files(full), _files(write_nerfstudio(fisheye, folder / "wide"))]


def _blender(folder: Path) -> list[Files]:
    return [_files(scene_writers.write_blender(_scene(folder / "colmap"), folder / "blender"))]


def _some_model(folder: Path) -> nw.Model:
    """Return a model with every part that a file can hold."""
    model = make_model(5)
    model.exposures = nw.Exposures.of(0.1 * torch.randn(VIEWS, 3), list(_cameras(folder).values()), (-0.3, -0.2, 0.4))
    model.detail_limits = nw.DetailLimits(torch.full((5,), 0.02), torch.full((5,), 0.2))
    return model


def _model(folder: Path) -> list[Files]:
    full = _some_model(folder / "scene")
    save_model(folder / "a", full)
    save_model(folder / "b", make_model(5))
    save_model(folder / "c", full, compact=True)
    _read_model(folder / "a")  # the first reading imports modules and kernels for seconds, which no input must pay for
    return [_files(folder / name) for name in "abc"]


def _read_model(folder: Path) -> None:
    _check_rendering(load(folder))


@torch.no_grad()
def _check_rendering(model: nw.Model, camera: nw.Camera | None = None) -> None:
    """Raise AssertionError unless a picture of a few pixels is finite, from the camera or one that sees the surfels."""
    out = model.render(dataclasses.replace(camera or make_camera(random_scene(5)), width=4, height=3))
    for name in ("image", "alpha", "depths", "expected_depth", "normals"):
        assert bool(torch.isfinite(getattr(out, name)).all()), f"{name} is not finite"


@functools.cache  # it takes seconds
def _trainer() -> nw.Trainer:
    """Return a trainer after two steps."""
    with tempfile.TemporaryDirectory() as folder:
        scene = nw.load_scene(_scene(Path(folder) / "scene"))
    trainer = nw.Trainer(scene, Config(iterations=4, max_surfels=20, sh_degree=1, texture=TEXTURE), "cpu")
    trainer.run(until=2)
    return trainer


def _checkpoint(folder: Path) -> list[Files]:
    _trainer().save(folder)
    _check_rendering(_trainer().model())
    return [_files(folder)]


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
    _check_rendering(restored.model())


def _metrics(folder: Path) -> list[Files]:
    values = {"psnr": 20.5, "ssim": 0.7, "flip": None}
    data = {**values, "views": {"a.png": values}, "convention": "x", "preset": "default", "iterations": 3, "surfels": 5}
    write_json(folder / "metrics.json", data)
    return [_files(folder)]


def _photo_table(folder: Path) -> list[Files]:
    table = 'photo,split,psnr,sharpness\n"a, b.png",test,inf,0.3\nc/d.png,train,20.125,1e-05\n'
    (folder / "photos.csv").write_text(table)
    return [_files(folder)]


def _edits(folder: Path) -> list[Files]:
    rotation = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    edits = [Edit("box", (-1, -2, -3, 4, 5, 6.5)), Edit("level", (*rotation, 0.0, 1.0, 2.0)), Edit("scale", (2.5,))]
    write_edits(folder, [*edits, Edit("remove", (checksum(make_model(5).surfels), 1, 2)), Edit("sphere", (0, 0, 0, 9))])
    return [_files(folder)]


def _read_edits(folder: Path) -> None:
    edits = read_edits(folder)
    with contextlib.suppress(ValueError):  # nothing is left
        kept_surfels(make_model(5).surfels, edits)
    moved_surfels(make_model(5).surfels, frame_of(edits))


def _read_cameras(folder: Path) -> None:
    for members in load_cameras(folder / "cameras.json").values():
        for camera in members.values():
            _check_rendering(make_model(5), camera)


def _read_camera_path(folder: Path) -> None:
    for camera in load_camera_path(folder / "path.json").cameras[:4]:
        _check_rendering(make_model(5), camera)


def _config(folder: Path) -> list[Files]:
    create_run(folder, RunRecord(SceneSource("demo"), Config()))
    return [_files(folder)]


def _run_cameras(folder: Path) -> list[Files]:
    cameras = _cameras(folder / "scene")
    save_cameras(folder / "cameras.json", {"train": cameras, "test": cameras})
    return [{"cameras.json": (folder / "cameras.json").read_bytes()}]


def _camera_path(folder: Path) -> list[Files]:
    cameras = _cameras(folder / "scene")
    save_camera_path(folder / "a" / "path.json", list(cameras.values()))
    return [_files(folder / "a")]


def _images(folder: Path) -> list[Files]:
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
    exif = Image.Exif()
    exif[MAKE], exif[MODEL] = "maker", "model"
    exif[274] = 6  # orientation
    exif.get_ifd(34665)[41989] = 35  # focal length of a 35 mm film
    for name in ("a.jpg", "b.jpg"):
        _noise(3).save(folder / name, exif=exif if name == "a.jpg" else Image.Exif())
    return [{"a.jpg": data} for data in _files(folder).values()]


def _baked(folder: Path) -> list[Files]:
    model, named = _some_model(folder / "scene"), _cameras(folder / "views")
    views = list(named.values())
    save_glb(folder / "scene.glb", bake_cards(model, views, "blend", steps=1), views)
    _read_baked(folder)
    page = encode_baked(bake(model, views, steps=1), model, named)
    return [page, {"scene.glb": (folder / "scene.glb").read_bytes()}]


def _read_baked(folder: Path) -> None:
    scene = nw.load_baked(folder / "scene.glb" if (folder / "scene.glb").is_file() else folder)
    camera = dataclasses.replace(make_camera(random_scene(5)), width=4, height=3)
    assert bool(torch.isfinite(scene.render(camera)).all()), "the image is not finite"


def _exr(folder: Path) -> list[Files]:
    color = torch.from_numpy(np.random.default_rng(0).random((HEIGHT, WIDTH, 3), np.float32))
    save_exr(folder / "a" / "a.exr", {"image": color, "ids": color[..., 0].int(), "depth": color[..., 1].contiguous()})
    save_exr(folder / "b" / "a.exr", {"depth": torch.ones(HEIGHT, WIDTH)}, {"near": 0.01})
    return [_files(folder / "a"), _files(folder / "b")]


def _depths(folder: Path) -> list[Files]:
    values = 1 + np.random.default_rng(0).random((HEIGHT, WIDTH), np.float32)
    Image.fromarray((1000 * values).astype(np.uint16)).save(folder / "a.png")
    np.save(folder / "a.npy", values)
    save_exr(folder / "a.exr", {"depth": torch.from_numpy(values)})
    (folder / "a.bin").write_bytes(f"{WIDTH}&{HEIGHT}&1&".encode() + values.tobytes())
    return [{name: data} for name, data in _files(folder).items()]


def _read_depths(folder: Path) -> None:
    (file,) = folder.iterdir()
    depth = read_depth(file)
    assert bool(torch.isfinite(depth).all()) and bool((depth >= 0).all())


def _read_photos(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as prepared:
        camera_groups(folder, read_photos(folder, ["a.jpg"], 1, lambda _: None, Path(prepared))[0], "auto")


def _linear(folder: Path) -> list[Files]:
    save_exr(folder / "a.exr", {"image": torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))})
    _noise(3).save(folder / "a.png")
    return [{name: data} for name, data in _files(folder).items()]


def _read_linear(folder: Path) -> None:
    (file,) = folder.iterdir()
    assert read_image(file, 1.0).dtype == torch.uint8


TARGETS = {
    target.name: target
    for target in (
        FuzzTarget("colmap_binary", _colmap(False), nw.load_scene, (".bin",)),
        FuzzTarget("colmap_text", _colmap(True), nw.load_scene, (".txt",)),
        FuzzTarget("nerfstudio", _nerfstudio, nw.load_scene, ("transforms.json",)),
        FuzzTarget("blender", _blender, lambda folder: nw.load_scene(folder, background="white"), (".json",)),
        FuzzTarget("model", _model, _read_model, (".safetensors",)),
        FuzzTarget("config", _config, read_run, (".json",)),
        FuzzTarget("cameras", _run_cameras, _read_cameras, (".json",)),
        FuzzTarget("checkpoint", _checkpoint, _read_checkpoint, (".json", ".safetensors")),
        FuzzTarget("metrics", _metrics, read_metrics, (".json",)),
        FuzzTarget("photo_table", _photo_table, lambda folder: load_photo_table(folder / "photos.csv"), (".csv",)),
        FuzzTarget("edits", _edits, _read_edits, (".json",)),
        FuzzTarget("camera_path", _camera_path, _read_camera_path, (".json",)),
        FuzzTarget("ply", _ply, lambda folder: read_ply(folder / "points.ply"), (".ply",)),
        FuzzTarget("masks", _images, _read_images, ("mask",)),
        FuzzTarget("photos", _photo_files, _read_photos, (".jpg",)),
        FuzzTarget("baked", _baked, _read_baked, (".nxb", ".glb")),
        FuzzTarget("depths", _depths, _read_depths, (".png", ".npy", ".exr", ".bin")),
        FuzzTarget("linear", _linear, _read_linear, (".exr", ".png")),
        FuzzTarget("exr", _exr, lambda folder: load_exr(folder / "a.exr"), (".exr",)),
    )
}
# One thread: a forked process does not inherit its parent's threads.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")
