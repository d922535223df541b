import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
import torch
from PIL import Image

import nexwarp as nw
from nexwarp.cameras.cameras_file import save_cameras
from nexwarp.data import Scene
from nexwarp.train.recipe import LearningRates, TextureConfig
from notebooks.__main__ import FOLDER, NAMES, pictures, sources
from tests.subprocesses import ROOT, run_python

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.fixture(scope="module")
def model(tiny_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with a small model of the demo and its cameras."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    rates = LearningRates(means=(5e-4, 5e-6), scales=2.5e-2, opacities=0.05, sh0=1.25e-2, grid=(2e-2, 2e-4))
    texture = TextureConfig(levels=4, table_size=2**10, width=16)
    config = nw.Config(iterations=100, max_surfels=500, texture=texture, rates=rates)
    nw.train(tiny_scene, config, device="cpu").save(folder)
    sets = {"train": tiny_scene.train, "test": tiny_scene.test}
    save_cameras(folder / "cameras.json", {name: {v.name: v.camera for v in views} for name, views in sets.items()})
    return folder


def run(name: str, *arguments: object) -> str:
    """What an example prints; warnings are errors."""
    done = run_python("-W", "error", ROOT / "examples" / f"{name}.py", *arguments, timeout=300, CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(pattern: str, text: str) -> list[float]:
    """The groups of all matches of a pattern, in order."""
    return [float(x) for match in re.finditer(pattern, text) for x in match.groups()]


def size_of(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short_and_import_the_public_face_alone(path: Path) -> None:
    """They tell how to run them. What users copy is what `nexwarp.__all__` promises, not the package's rooms."""
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") < {"read_model": 230, "tape": 115}.get(path.stem, 60)
    assert f"\npython examples/{path.name} " in text.split('"""')[1]
    assert not re.search(r"^ *(from|import) nexwarp\.", text, re.M)
    assert set(re.findall(r"\bnw\.(\w+)", text)) <= {*nw.__all__, "tape"}


def test_own_textures_are_trained_and_saved(tmp_path: Path) -> None:
    out = run("own_texture", "SurfelFeatures", "--steps", 12, "--out", tmp_path)
    assert out.strip() == str(tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="expected 'SurfelFeatures' to be registered"):
        nw.load(tmp_path)


def test_training_from_tensors_raises_the_psnr(tmp_path: Path) -> None:
    out = run("train_from_tensors", "--steps", 60, "--downscale", 4, "--out", tmp_path)
    steps = numbers(r"step \d+: ([\d.]+) dB", out)
    (test,) = numbers(r"test views: ([\d.]+) dB", out)
    assert steps[-1] > steps[0] + 2.0 and test > steps[0] + 2.0 and len(nw.load(tmp_path).surfels) > 100


def test_the_own_loss_falls() -> None:
    first, first_psnr, last, last_psnr = numbers(r"edge loss ([\d.]+), ([\d.]+) dB", run("own_loss", "--steps", 60))
    assert last < first and last_psnr > first_psnr


def test_the_loss_falls_by_the_tape_alone() -> None:
    first, last = numbers(r"loss ([\d.]+)", run("tape", "--steps", 100))
    assert last < 0.5 * first


def test_the_pose_is_recovered(model: Path) -> None:
    out = run("refine_pose", "--model", model, "--steps", 60)
    errors = numbers(r"pose error ([\d.]+) degrees, ([\d.]+) world units", out)
    assert errors[0] > 1.0 and errors[-2] < errors[0] / 10 and errors[-1] < errors[1] / 5


def test_depth_and_normals_are_those_of_the_rendering(model: Path, tmp_path: Path, tiny_scene: Scene) -> None:
    run("depth_and_normals", "--model", model, "--out", tmp_path)
    camera = tiny_scene.test[0].camera
    with torch.no_grad():
        rendering = nw.load(model).render(camera)
    with np.load(tmp_path / "geometry.npz") as parts:
        assert set(parts) == {"expected_depth", "median_depth", "normals", "alpha"}
        for name, values in parts.items():
            assert torch.equal(torch.from_numpy(values), getattr(rendering, name)), name
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {"image.png", "mask.png", "expected_depth.png", "median_depth.png", "normals.png"}
    assert all(size_of(tmp_path / name) == (camera.width, camera.height) for name in names)


def test_frames_and_a_video_along_a_path_are_written(model: Path, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    run("render_path", "--model", model, "--out", tmp_path / "frames", "--frames", 3)
    frames = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in frames] == [f"frame_{i:04d}.png" for i in range(3)]
    assert {size_of(path) for path in frames} == {(48, 36)}
    run("render_path", "--model", model, "--out", tmp_path / "around.mp4", "--frames", 3, "--height", 72, "--white")
    with av.open(str(tmp_path / "around.mp4")) as video:
        assert [(frame.width, frame.height) for frame in video.decode(video=0)] == [(96, 72)] * 3


def test_a_pixel_is_drawn_without_nexwarp(model: Path) -> None:
    out = run("read_model", "--run", model, "--column", 20, "--row", 10)
    assert re.fullmatch(r"view_000\.png, column 20, row 10: \[ *\d+ +\d+ +\d+\]\n", out), out


def test_a_scene_is_shown_with_viser() -> None:
    pytest.importorskip("viser")
    assert "Server stopped" in run("viser_scene", "--port", 0, "--seconds", 0.5)


def test_a_scene_is_logged_to_rerun(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    run("rerun_scene", "--out", tmp_path / "scene.rrd")
    assert (tmp_path / "scene.rrd").stat().st_size > 10_000


HERE = re.compile(r"/(home|root|tmp|work|Users)/")


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_kept_and_those_of_the_cells(name: str) -> None:
    """`python -m notebooks NAME` makes them anew."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata["sources"] == sources(notebook), "cells were changed after the last execution"
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)) and sum(pictures(notebook)) >= 3
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error" and output.get("name") != "stderr"
        text = output.get("text", "") + output.get("data", {}).get("text/plain", "")
        assert not HERE.search(text), f"a path of one machine: {text}"
