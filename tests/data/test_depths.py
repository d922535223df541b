import dataclasses
import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.data.capture import Cloud
from nexwarp.data.depth_files import read_depth
from nexwarp.data.depth_fit import Fit, _error, fit_depths
from nexwarp.errors import MissingError, SceneError
from nexwarp.io.pictures import save_exr
from tests.narrowing import present
from tests.scene_writers import BARREL, demo_lens, write_demo, write_distorted, write_nerfstudio

WIDTH, HEIGHT = 24, 18
VALUES = np.array([[1.5, 0.0, 2.0], [0.25, 60.0, 7.125]], np.float32)  # exact in half precision


def write_colmap(path: Path, values: np.ndarray) -> None:
    height, width = values.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + struct.pack(f"<{values.size}f", *values.flatten()))


def write_png(path: Path, values: np.ndarray) -> None:
    Image.fromarray((1000 * values).astype(np.uint16)).save(path)


WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    "a.png": write_png,
    "a.exr": lambda path, values: save_exr(path, {"depth": torch.from_numpy(np.float32(values))}),
    "a.npy": np.save,
    "a.jpg.geometric.bin": write_colmap,
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_hold_the_numbers_that_were_written(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name, VALUES)
    depth = read_depth(tmp_path / name)
    assert depth.dtype == torch.float16 and torch.equal(depth.float(), torch.from_numpy(VALUES))


def test_other_arrays_and_unknown_depths(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES[None].astype(np.float64))
    np.save(tmp_path / "b.npy", (4 * VALUES[..., None]).astype(np.int32))
    assert torch.equal(read_depth(tmp_path / "a.npy").float(), torch.from_numpy(VALUES))
    assert torch.equal(read_depth(tmp_path / "b.npy").float(), torch.from_numpy(4 * VALUES).int().float())
    np.save(tmp_path / "c.npy", np.array([[np.inf, -2.0, 1e10], [0.0, 65504.0, 3.0]]))
    assert read_depth(tmp_path / "c.npy").tolist() == [[0, 0, 0], [0, 65504, 3]]


BAD: dict[str, tuple[str, Any, str]] = {
    "colour": ("a.png", lambda p: Image.new("RGB", (4, 3)).save(p), "expected one channel of 8 or 16 bits, got"),
    "three channels": ("a.exr", lambda p: save_exr(p, {"image": torch.ones(3, 4, 3)}), "expected one channel, got 3"),
    "two maps": ("a.npy", lambda p: np.save(p, np.ones((2, 3, 4))), r"expected shape \(H, W\), got \(2, 3, 4\)"),
    "objects": ("a.npy", lambda p: np.save(p, np.array([[{}]])), "expected an array of numbers, could not read it"),
    "NaN": ("a.npy", lambda p: np.save(p, np.array([[1.0, np.nan]] * 2)), "0 where they are unknown, got NaN"),
    "zeros": ("a.png", lambda p: write_png(p, 0 * VALUES), "expected depths above 0, up to 65,504, got none"),
    "no file of ours": ("a.txt", lambda p: p.write_text("text"), "expected a depth map: .png, .exr, .npy or COLMAP's"),
    "two of COLMAP": ("a.bin", lambda p: p.write_bytes(b"1&1&2&" + bytes(8)), "expected 1 channel of 1x1 float32"),
}


@pytest.mark.parametrize("case", [*BAD, *(f"cut {name}" for name in WRITERS)])
def test_other_files_are_refused_in_one_line(tmp_path: Path, case: str) -> None:
    name, write, message = BAD.get(case, (case.removeprefix("cut "), None, "expected"))
    if write is None:
        WRITERS[name](tmp_path / name, VALUES)
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[: (tmp_path / name).stat().st_size // 2])
    else:
        write(tmp_path / name)
    with pytest.raises(ValueError, match=message) as caught:
        read_depth(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)


# Their way to the pixels of a view


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene of four photos, three of them for training: view_001 to view_003."""
    return write_demo(tmp_path / "scene", WIDTH, HEIGHT, 4, points=300)


def rendered(scene: nw.Scene) -> dict[str, np.ndarray]:
    """Smooth depth maps that a plane before each camera could have."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return {view.name: 2.0 + 0.05 * columns + 0.02 * rows for view in (*scene.train, *scene.test)}


def write_maps(folder: Path, maps: dict[str, np.ndarray], end: str = ".npy") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in maps.items():
        WRITERS[f"a{end}"](folder / f"{Path(name).stem}{end}", values)


def load_unfitted(folder: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> nw.Scene:
    """A scene with the maps that its loader gives to be fitted."""
    fit = Mock(side_effect=lambda views, *_: views)
    monkeypatch.setattr("nexwarp.data.scene.fit_depths", fit)
    scene = nw.load_scene(folder, **options)
    fit.assert_called_once()
    return scene


def test_training_photos_have_their_maps(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = rendered(nw.load_scene(folder))
    del maps["view_002.png"]
    write_maps(folder / "depths", maps)
    scene = load_unfitted(folder, monkeypatch)
    for view in scene.train:
        if view.name == "view_002.png":
            assert view.depth is None
        else:
            assert torch.equal(present(view.depth), torch.from_numpy(maps[view.name]).half())
    assert all(view.depth is None for view in scene.test)


@pytest.mark.parametrize("downscale", [1, 2, 3])
@pytest.mark.parametrize("factor", [1, 2, 3])
def test_maps_are_never_mixed(folder: Path, monkeypatch: pytest.MonkeyPatch, downscale: int, factor: int) -> None:
    """A pixel has the value of the map where its centre lies, at an edge too."""
    size = WIDTH // factor, HEIGHT // factor
    values = np.where(np.random.default_rng(0).random(size[::-1]) < 0.5, 1.5, 7.0) + np.arange(size[0]) / 64
    write_maps(folder / "depths", {f"view_00{index}.png": values for index in range(4)})
    for view in load_unfitted(folder, monkeypatch, downscale=downscale).train:
        depth = present(view.depth)
        assert depth.shape == view.image.shape[:2]
        rows, columns = ((downscale * np.arange(side) + downscale // 2) // factor for side in depth.shape)
        assert torch.equal(depth, torch.from_numpy(values[rows][:, columns]).half())


def test_maps_go_through_the_lens_as_photos_do(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A map of twice the size that holds its own columns tells where the lens has put each pixel."""
    lens = demo_lens(folder, "OPENCV", BARREL)
    bent = write_distorted(folder, folder.parent / "bent", lens)
    columns = np.tile(np.arange(1, 2 * WIDTH + 1, dtype=np.float32), (2 * HEIGHT, 1))
    write_maps(bent / "depths", {f"view_00{index}.png": columns for index in range(4)})
    for view in load_unfitted(bent, monkeypatch).train:
        camera, depth = view.camera, present(view.depth).numpy()
        x = (np.arange(camera.width) + 0.5 - float(camera.cx)) / float(camera.fx)
        y = (np.arange(camera.height) + 0.5 - float(camera.cy)) / float(camera.fy)
        rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
        column = 2 * lens.project(rays.reshape(-1, 3))[:, 0].reshape(depth.shape)
        assert np.abs(depth - 0.5 - column)[depth > 0].max() <= 0.5 + 1e-3
        assert np.array_equal(depth, np.round(depth)), "columns are mixed"
        assert np.array_equal(depth > 0, np.ones_like(depth) if view.mask is None else view.mask.numpy())


def test_names_and_shapes(folder: Path) -> None:
    maps = rendered(nw.load_scene(folder))
    write_maps(folder / "depths", {"other.png": VALUES})
    with pytest.raises(MissingError, match=r"depths: none is named after a photo, expected view_000\.png, say"):
        nw.load_scene(folder)
    write_maps(folder / "depths", maps)
    with pytest.warns(UserWarning, match=r"1 of 5 depth maps fit no photo: other\.npy"):
        nw.load_scene(folder)
    (folder / "depths" / "other.npy").unlink()
    write_maps(folder / "depths", {"view_001.png": np.ones((HEIGHT, HEIGHT))})
    with pytest.raises(SceneError, match=r"view_001\.npy: expected a depth map of 24x18 pixels .*, got 18x18"):
        nw.load_scene(folder)


def test_colmaps_own_maps(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The geometric ones rather than the photometric ones, and depths/ rather than both."""
    maps = rendered(nw.load_scene(folder))
    stereo = folder / "stereo" / "depth_maps"
    stereo.mkdir(parents=True)
    for name, values in maps.items():
        write_colmap(stereo / f"{name}.photometric.bin", values + 1)
    write_colmap(stereo / "view_001.png.geometric.bin", maps["view_001.png"])
    for view in load_unfitted(folder, monkeypatch).train:
        expected = maps[view.name] + (view.name != "view_001.png")
        assert torch.equal(present(view.depth), torch.from_numpy(expected).half())
    write_maps(folder / "depths", maps)
    for view in load_unfitted(folder, monkeypatch).train:
        assert torch.equal(present(view.depth), torch.from_numpy(maps[view.name]).half())


def test_maps_that_transforms_json_names(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = rendered(nw.load_scene(folder))
    scene = write_nerfstudio(folder, folder.parent / "json")
    write_maps(scene / "metres", maps, ".png")
    data = json.loads((scene / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["depth_file_path"] = f"metres/{Path(frame['file_path']).name}"
    (scene / "transforms.json").write_text(json.dumps(data))
    for view in load_unfitted(scene, monkeypatch).train:
        assert (present(view.depth) - torch.from_numpy(maps[view.name])).abs().max() < 2e-3
    shutil.rmtree(scene / "metres")
    with pytest.raises(MissingError, match=r"depth_file_path: file not found: .*metres"):
        nw.load_scene(scene)


def seen(values: np.ndarray | None, depths: np.ndarray, points: int = 60, seed: int = 0) -> nw.View:
    """A view with a map of `values`, and with points of which a tenth lie far off its `depths`."""
    rng = np.random.default_rng(seed)
    camera = nw.Camera(torch.eye(4), torch.tensor([[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]), WIDTH, HEIGHT)
    rows, columns = rng.integers(0, HEIGHT, points), rng.integers(0, WIDTH, points)
    z = depths[rows, columns] * np.where(np.arange(points) % 10, 1.0 + 0.01 * rng.standard_normal(points), 3.0)
    positions = np.stack([(columns + 0.5 - 12) / 20 * z, (rows + 0.5 - 9) / 20 * z, z], axis=1)
    depth = None if values is None else torch.from_numpy(values).half()
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return nw.View(camera, image, None, f"{seed}", points=torch.from_numpy(positions).float(), depth=depth)


def truths(count: int) -> list[np.ndarray]:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return [np.where(columns < 10 + k, 2.0 + 0.03 * rows, 4.0 + 0.05 * columns) for k in range(count)]


MAPS: dict[str, Any] = {
    "metres": lambda z, k: z,
    "another unit": lambda z, k: 3.7 * z,
    "a unit a photo": lambda z, k: (1 + k) * z,
    "depth up to scale and shift": lambda z, k: (z - 1.2 - 0.1 * k) / (3 + k),
    "inverse depth up to scale and shift": lambda z, k: (1 + k) * (1 / z - 0.05),
}


@pytest.mark.parametrize("kind", MAPS)
def test_scale_and_shift_are_absorbed(kind: str) -> None:
    depths = truths(4)
    views = [seen(MAPS[kind](z, k), z, seed=k) for k, z in enumerate(depths)]
    for view, z in zip(fit_depths(views, None, Path("scene")), depths, strict=True):
        fitted = present(view.depth)
        assert fitted.dtype == torch.float16 and (fitted.float() / torch.from_numpy(z) - 1).abs().max() < 0.02


def test_larger_values_of_depth_maps_are_never_nearer() -> None:
    """A falling line fits the depths of a small range as well as their inverses do, but not beyond."""
    depths = np.linspace(2.0, 2.2, 50)
    values = 1 / depths
    falling = Fit(*np.polyfit(values, depths, 1).tolist())
    assert falling.scale < 0 and _error(falling, values, depths) == np.inf
    assert _error(Fit(1.0, inverse=True), values, depths) < 1e-3


def test_a_photo_of_few_points_has_the_scale_of_the_others() -> None:
    depths = truths(4)
    views = [seen(2 * z, z, points=3 if k == 1 else 60, seed=k) for k, z in enumerate(depths)]
    fitted = fit_depths(views, None, Path("scene"))
    assert (present(fitted[1].depth).float() / torch.from_numpy(depths[1]) - 1).abs().max() < 0.02
    shifted = [dataclasses.replace(x, depth=(present(x.depth) / 2 - 1).half()) for x in views]
    with pytest.warns(UserWarning, match="scene: 1 of 4 depth maps do not fit the points and are left out"):
        fitted = fit_depths(shifted, None, Path("scene"))
    assert [view.depth is None for view in fitted] == [False, True, False, False]


def test_maps_that_say_nothing_are_left_out() -> None:
    depths = truths(3)
    noise = np.exp(2 * np.random.default_rng(0).standard_normal((HEIGHT, WIDTH)))
    views = [seen(noise if k == 1 else z, z, seed=k) for k, z in enumerate(depths)]
    with pytest.warns(UserWarning, match="1 of 3 depth maps"):
        assert fit_depths(views, None, Path("scene"))[1].depth is None


def test_points_without_tracks_serve_too_and_without_points_values_are_depths() -> None:
    """Points behind the surface, which the photo does not see, are outliers."""
    (z,) = truths(1)
    view = seen(5 * z, z, points=400)
    cloud = Cloud.of(present(view.points).double().numpy(), np.zeros((400, 3), np.uint8))
    alone = dataclasses.replace(view, points=None)
    (fitted,) = fit_depths([alone], cloud, Path("scene"))
    assert (present(fitted.depth).float() / torch.from_numpy(z) - 1).abs().max() < 0.02
    assert fit_depths([alone], None, Path("scene")) == [alone]
