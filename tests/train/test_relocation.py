"""Relocation: the surfels that the training views need least make room for others, at set times."""

import dataclasses
from pathlib import Path

import pytest
import torch

from nexwarp.cameras.camera import Camera, reduced
from nexwarp.data import Scene
from nexwarp.model.render import render
from nexwarp.train import densify
from nexwarp.train.densify import DensityControl, least_contributing
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config, DensifyConfig
from nexwarp.train.trainer import Trainer
from tests.ranks_support import run_ranks
from tests.scenes import make_surfels, random_scene
from tests.trainer_support import OFTEN, small

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene


def test_what_no_image_shows_goes_first(scene: Scene) -> None:
    """Surfels outside of all images and behind opaque ones; what is removed is nowhere more than what stays is."""
    trainer = Trainer(scene, small(iterations=30), "cpu")
    surfels = trainer.surfels
    hidden = torch.arange(0, len(surfels), 7)
    with torch.no_grad():
        surfels.means[hidden[::2]] += 1e4
        surfels.logit_opacities[hidden[1::2]] = -20.0
    cameras = [view.camera for view in scene.train]
    share = len(hidden) / len(surfels) + 1e-6
    chosen = least_contributing(trainer.model(), cameras, share)
    assert torch.equal(chosen.nonzero()[:, 0], hidden)
    chosen = least_contributing(trainer.model(), cameras, 0.5)
    assert chosen.sum() == len(surfels) // 2 and chosen[hidden].all()
    most = torch.zeros(len(surfels))
    for camera in cameras:  # at full size, a sum of weights is that of half the size but for aliasing
        out = render(surfels, None, camera)
        most = torch.maximum(most, out.splat_error(torch.full_like(out.alpha, 1 / out.alpha.numel())))
    assert most[chosen].mean() < 0.2 * most[~chosen].mean()
    assert not least_contributing(trainer.model(), cameras, 0.0).any()


def test_ranks_share_the_views(scene: Scene, tmp_path: Path) -> None:
    """Each renders some of them, and all choose what one process would."""
    model = Trainer(scene, small(iterations=30), "cpu").model()
    cameras = [view.camera for view in scene.train]
    rendered: list[int] = []

    def noted(camera: Camera, height: int) -> Camera:
        rendered.append(height)
        return reduced(camera, height)

    def work(ranks: Ranks) -> object:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(densify, "reduced", noted)
            mine = cameras[ranks.rank :: ranks.size]
            return least_contributing(model, mine, 0.3, ranks.largest).tolist(), len(rendered)

    found = run_ranks(3, work, tmp_path)
    expected = least_contributing(model, cameras, 0.3)
    counts = [len(cameras[rank::3]) for rank in range(3)]
    assert found == [[expected.tolist(), count] for count in counts] and 0 < expected.sum() < len(expected)


def test_rounds_at_the_budget_relocate_in_the_first_part_of_density_control() -> None:
    surfels = make_surfels(random_scene(100))
    schedule = DensifyConfig(start=1, stop=1000, every=5, relocate=0.1)
    config = Config(max_surfels=100, densify=schedule)
    densifier = DensityControl(surfels, config)
    due = [i for i in range(1, 1001) if densifier.due(i) and densifier.relocates(i)]
    assert due == list(range(50, 600, 50))
    assert DensityControl(surfels, dataclasses.replace(config, max_surfels=102)).relocates(50)
    assert not DensityControl(surfels, dataclasses.replace(config, max_surfels=103)).relocates(50)
    never = dataclasses.replace(config, densify=dataclasses.replace(schedule, relocate=0.0))
    assert not DensityControl(surfels, never).relocates(50)
    with pytest.raises(ValueError, match=r"relocate: expected at least 0 and at most 0\.5, got 0\.6"):
        DensifyConfig(relocate=0.6)


def test_others_take_their_place(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    removed = []

    def first(model, cameras, share, _):
        removed.append((trainer.iteration, len(model.surfels), len(cameras), share))
        return torch.arange(len(model.surfels)) < share * len(model.surfels)

    monkeypatch.setattr(densify, "least_contributing", first)
    config = small(iterations=120, densify=dataclasses.replace(OFTEN, relocate=0.2, prune_opacity=0.0, fraction=0.2))
    budget = 50
    trainer = Trainer(scene, dataclasses.replace(config, max_surfels=budget), "cpu")
    counts: dict[int, int] = {}
    trainer.run(observe=lambda progress: counts.update({progress.iteration: progress.surfels}))
    assert [iteration for iteration, *_ in removed] == [30]
    assert all(before[1:] == (budget, len(scene.train), 0.2) for before in removed)
    assert counts[30] == counts[33] == budget, "as many are split as were removed"
