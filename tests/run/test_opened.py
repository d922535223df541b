import json
import math
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.paths import surrounding
from nexwarp.cli import main as cli
from nexwarp.io.json_files import read_json
from nexwarp.run.evaluate import METRICS, evaluate
from nexwarp.run.folder import near_depth, open_model
from nexwarp.train.trainer import Trainer
from tests.cli.support import refused
from tests.scenes import make_surfels, make_texture, random_scene
from tests.trainer_support import small

SIZE = ["--size", "32x24", "--device", "cpu"]


@pytest.fixture
def model() -> nw.Model:
    return nw.Model(make_surfels(random_scene(30)), make_texture(), options=nw.RenderOptions(sh_degree=2))


@pytest.mark.parametrize("name", ["folder", "scene.safetensors"])
def test_a_saved_model_opens_everywhere(name, model, tiny_folder, tmp_path, capsys):
    saved = tmp_path / name
    model.save(saved)
    results = tmp_path / "scene" if saved.suffix else saved
    assert cli.main(["info", str(saved)]) == 0
    assert "30" in capsys.readouterr().out and cli.main(["render", str(saved), "--frames", "3", *SIZE]) == 0
    assert [f.name for f in sorted((results / "renders" / "ellipse").iterdir())] == ["0000.png", "0001.png", "0002.png"]
    assert cli.main(["export", str(saved)]) == 0
    assert {f.name for f in (results / "export").iterdir()} == {"surfels.ply", "splats.ply"}
    refused(capsys, ["eval", str(saved)], "give --scene SCENE")
    refused(capsys, ["render", str(saved), "--set", "test"], "expected test views to render, found none")
    assert cli.main(["eval", str(saved), "--scene", str(tiny_folder), "--device", "cpu"]) == 0
    metrics = json.loads((results / "metrics.json").read_text())
    views = nw.load_scene(tiny_folder).test
    assert metrics["psnr"] == pytest.approx(evaluate(nw.load(saved), views)["psnr"])


def test_photos_that_are_met_exactly_leave_no_infinity(model, tiny_folder, tmp_path, monkeypatch, capsys):
    """JSON has none: null stands for it, and is shown as what it is."""
    model.save(tmp_path / "model")
    monkeypatch.setitem(METRICS, "psnr", lambda *_: math.inf)
    assert cli.main(["eval", str(tmp_path / "model"), "--scene", str(tiny_folder), "--device", "cpu"]) == 0
    metrics = read_json(tmp_path / "model" / "metrics.json", finite=True)
    assert metrics["psnr"] is None and {view["psnr"] for view in metrics["views"].values()} == {None}
    assert cli.main(["info", str(tmp_path / "model")]) == 0
    assert capsys.readouterr().out.count("inf dB") == 2


def test_a_trainer_saves_what_the_commands_open(tiny_folder: Path, tmp_path: Path) -> None:
    scene = nw.load_scene(tiny_folder)
    trainer = Trainer(scene, small(iterations=4), "cpu")
    trainer.run(until=2)
    folder = tmp_path / "new" / "folder"
    trainer.save(folder)
    opened = open_model(folder)
    assert torch.equal(opened.model.surfels.means, trainer.surfels.means)
    assert opened.cameras["test"].keys() == {view.name for view in scene.test}
    assert near_depth(opened.model) == pytest.approx(scene.train[0].camera.near)
    assert cli.main(["render", str(folder), "--set", "test", "--device", "cpu"]) == 0
    assert cli.main(["eval", str(folder), "--scene", str(tiny_folder), "--device", "cpu"]) == 0


def test_the_ring_around_a_scene_sees_its_middle() -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)) + torch.tensor([5.0, -3.0, 2.0])
    for camera in surrounding(points, near=0.1):
        middle = points.median(dim=0).values
        pixels, depths = camera.project(middle[None])
        torch.testing.assert_close(pixels[0], torch.tensor([camera.width / 2, camera.height / 2]), atol=1e-2, rtol=0)
        assert depths[0] > (points - middle).norm(dim=1).median()
        inside, _ = camera.project(points)
        seen = (inside >= 0).all(-1) & (inside < torch.tensor([camera.width, camera.height])).all(-1)
        assert seen.float().mean() > 0.8


def test_a_model_beside_a_run_of_its_name_leaves_the_run_alone(model: nw.Model, tmp_path: Path) -> None:
    file = tmp_path / "fox.safetensors"
    model.save(tmp_path / "fox")
    model.save(file)
    opened = open_model(file)
    assert opened.folder == tmp_path / "fox.safetensors.results" and opened.source is None and opened.cameras == {}
