"""The benchmark of the stages that turn trained surfels into a finished model."""

from pathlib import Path

import pytest
import torch

import nexwarp as nw
from benchmarks import finished_model
from nexwarp.data import Scene, write_demo
from nexwarp.run.evaluate import evaluate
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.trainer import Trainer


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return nw.load_scene(write_demo(tmp_path / "demo", width=48, height=36, views=12, points=200))


def trained(scene: Scene, smooth_sh: float = Config().smooth_sh) -> nw.Model:
    texture = TextureConfig(levels=4, table_size=2**10, width=16, hidden_layers=1)
    trainer = Trainer(scene, Config(iterations=60, max_surfels=200, texture=texture, smooth_sh=smooth_sh), "cpu")
    trainer.run()
    return trainer.finish()


@pytest.mark.usefixtures("one_torch_thread", "few_places")
def test_the_benchmark_finishes_a_model_as_training_does(scene: Scene) -> None:
    """Its figures at full size are those of the trained model; the stages change the smaller renderings."""
    model = trained(scene)
    assert model.detail_limits is not None
    expected = evaluate(model, scene.test)["psnr"]
    nearest, farthest = model.detail_limits.nearest.clone(), model.detail_limits.farthest.clone()
    shN = model.surfels.shN.detach().clone()
    found = finished_model.compare(model, scene)
    assert list(found) == [
        "nearest limits",
        "detail limits",
        "auto exposure",
        "auto exposure, full size reduced",
    ]
    assert found["auto exposure"][0][0] == pytest.approx(expected, abs=1e-3)
    assert torch.equal(model.detail_limits.nearest, nearest) and torch.equal(model.detail_limits.farthest, farthest)
    assert torch.equal(model.surfels.shN, shN)
    assert found["auto exposure, full size reduced"][0] == found["auto exposure"][0]
    assert found["detail limits"][0][0] == pytest.approx(found["nearest limits"][0][0], abs=0.05)
    assert found["detail limits"][2][0] != found["nearest limits"][2][0]
    assert all(len(figures) == len(finished_model.FACTORS) for figures in found.values())


@pytest.mark.usefixtures("one_torch_thread", "few_places")
def test_sh_that_are_not_smooth_are_smoothed(scene: Scene, tmp_path: Path) -> None:
    smooth, rough = trained(scene), trained(scene, smooth_sh=0.0)
    assert not torch.equal(smooth.surfels.shN, rough.surfels.shN)
    found = finished_model.compare(rough, scene)
    assert list(found)[2] == "smooth SH"
    assert torch.equal(smooth.surfels.shN, rough.surfels.shN) and torch.equal(smooth.surfels.sh0, rough.surfels.sh0)
    finished_model.save_pictures(rough, scene, tmp_path / "pictures")
    assert len(list((tmp_path / "pictures").glob("*.png"))) == len(scene.test)
    again = finished_model.compare(smooth, scene)
    assert again["auto exposure"] == found["auto exposure"] and again["detail limits"] == found["smooth SH"]
