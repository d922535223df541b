"""The benchmark of what a finished model has beside what was trained."""

from pathlib import Path

import pytest
import torch

import nexwarp as nw
from benchmarks import finished_model as looks
from nexwarp.data import Scene, write_demo
from nexwarp.run.evaluate import evaluate
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.trainer import Trainer


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return nw.load_scene(write_demo(tmp_path / "demo", width=48, height=36, views=12, points=200))


def trained(scene: Scene, **settings: float) -> nw.Model:
    texture = TextureConfig(levels=4, table_size=2**10, width=16, hidden_layers=1)
    trainer = Trainer(scene, Config(iterations=60, max_surfels=200, texture=texture, **settings), "cpu")
    trainer.run()
    return trainer.finish()


@pytest.mark.usefixtures("one_torch_thread", "few_looks")
def test_the_benchmark_finishes_a_model_as_training_does(scene: Scene) -> None:
    """Its figures at full size are those of the trained model; smaller pictures differ by what it is about."""
    model = trained(scene)
    expected = evaluate(model.surfels, model.texture, scene.test, options=model.render_options)["psnr"]
    kept = {name: getattr(model.surfels, name).clone() for name in ("footprints", "far_footprints", "shN")}
    found = looks.compare(model, scene)
    assert list(found) == ["before", "far looks", "finished", "finished, full size reduced"]
    assert found["finished"][0][0] == pytest.approx(expected, abs=1e-3)
    for name, values in kept.items():
        assert torch.equal(getattr(model.surfels, name), values), name
    assert found["finished, full size reduced"][0] == found["finished"][0]
    assert found["far looks"][0][0] == pytest.approx(found["before"][0][0], abs=0.05)
    assert found["far looks"][2][0] != found["before"][2][0]
    assert all(len(figures) == len(looks.FACTORS) for figures in found.values())


@pytest.mark.usefixtures("one_torch_thread", "few_looks")
def test_colours_that_are_as_learnt_are_made_smooth(scene: Scene, tmp_path: Path) -> None:
    smooth, learnt = trained(scene), trained(scene, smooth_sh=0.0)
    assert not torch.equal(smooth.surfels.shN, learnt.surfels.shN)
    found = looks.compare(learnt, scene)
    assert list(found)[2] == "smooth SH"
    assert torch.equal(smooth.surfels.shN, learnt.surfels.shN) and torch.equal(smooth.surfels.sh0, learnt.surfels.sh0)
    looks.picture(learnt, scene, tmp_path / "pictures")
    assert len(list((tmp_path / "pictures").glob("*.png"))) == len(scene.test)
    again = looks.compare(smooth, scene)
    assert again["finished"] == found["finished"] and again["far looks"] == found["smooth SH"]
