"""Automatic exposure: gains that follow what cameras see are predicted by it, others are left to the poses."""

import functools
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.camera import Camera
from nexwarp.data import write_demo
from nexwarp.model import exposures as exposures_module
from nexwarp.model.exposures import Exposures
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.finish import auto_exposure
from nexwarp.train.finish.auto_exposure import PLACES, brightness, predict, with_auto_exposure
from nexwarp.train.trainer import Trainer
from tests.exposed import with_exposures
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
OPTIONS = nw.RenderOptions(max_hits=2, background=(0.2, 0.5, 0.9), sh_degree=3)


def looking(x: float, y: float = 0.0) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([float(x), float(y), 0.0])
    return Camera(viewmat, K, 64, 48)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("slopes", [-0.8 * torch.eye(3).double(), torch.full((3, 3), -0.25).double()])
def test_gains_that_follow_the_brightness_are_predicted(slopes: torch.Tensor) -> None:
    """White balance, each channel by its own; and one exposure for all. Poses tell nothing of it."""
    cameras = [looking(x) for x in np.linspace(0, 4, 40)]
    others = [looking(x) for x in np.linspace(0.05, 3.95, 25)]
    seen, there = 0.2 * random(40, 3), 0.2 * random(25, 3, seed=1)
    gains = (seen - seen.mean(0)) @ slopes + 0.002 * random(40, 3, seed=2)
    expected = (there - seen.mean(0)) @ slopes
    found = predict(gains, cameras, seen, others, lambda: there)
    assert found is not None and found.shape == (25, 3)
    inside = (expected > gains.amin(0)) & (expected < gains.amax(0))
    assert inside.double().mean() > 0.8
    assert ((found - expected)[inside]).abs().max() < 0.03 < expected.abs().max()
    assert (found >= gains.amin(0) - 1e-6).all() and (found <= gains.amax(0) + 1e-6).all()
    alone = Exposures.of(gains, cameras)
    by_pose = torch.stack([alone.gains(camera).double().log() for camera in others])
    assert (found - expected)[inside].square().mean() < 0.05 * (by_pose - expected)[inside].square().mean()


def test_gains_that_do_not_are_left_to_the_poses() -> None:
    """Nothing is metered where poses tell as much, where nothing tells any, and where photos are too few to tell."""

    def never() -> torch.Tensor:
        raise AssertionError("metered for nothing")

    cameras = [looking(x) for x in np.linspace(0, 4, 40)]
    course = 0.2 * torch.linspace(0, 6, 40).double().sin()[:, None].expand(40, 3)
    assert predict(course, cameras, 0.2 * random(40, 3), cameras[:2], never) is None
    for seed in range(8):
        assert (
            predict(0.1 * random(40, 3, seed=seed), cameras, 0.2 * random(40, 3, seed=99), cameras[:2], never) is None
        )
    for count in (1, 2, 3, 4):
        seen = 0.2 * random(count, 3)
        assert predict(0.1 * random(count, 3, seed=5), cameras[:count], seen, cameras[:2], never) is None
    assert predict(torch.zeros(40, 3), cameras, 0.2 * random(40, 3), cameras[:2], never) is None


def test_what_goes_wrong_with_all_channels_tells_no_more_than_one() -> None:
    """Errors that the channels share are no evidence for metering, nor, mostly, are those that the scene has learnt."""
    cameras = [looking(x) for x in np.linspace(0, 4, 28)]
    others, metered_anyway = cameras[:2], {"unrelated": 0, "learnt": 0}
    for seed in range(40):
        gains = 0.1 * random(28, 1, seed=seed) + 0.02 * random(28, 3, seed=1000 + seed)
        seen = 0.2 * random(28, 1, seed=500 + seed) + 0.05 * random(28, 3, seed=700 + seed)
        for kind, light in (("unrelated", seen), ("learnt", seen - gains)):
            found = predict(gains, cameras, light, others, functools.partial(torch.clone, light[:2]))
            metered_anyway[kind] += found is not None
    assert metered_anyway["unrelated"] == 0
    assert metered_anyway["learnt"] <= 4


def test_brightness_is_that_of_light(device: torch.device) -> None:
    """Of a mean over light, not over sRGB; at the mean exposure, whatever exposures the model has."""
    scene = random_scene(40, device=device)
    exposures = Exposures.of(torch.full((1, 3), 0.5), [looking(0.0)]).to(device)
    model = nw.Model(make_surfels(scene), make_texture(device=device), exposures, options=OPTIONS)
    away = Camera(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), K, 64, 480)  # nothing is there
    camera = make_camera(scene)
    found = brightness(model, [away, camera])
    assert model.exposures is exposures and model.options is OPTIONS
    torch.testing.assert_close(found[0], torch.tensor(OPTIONS.background).double().log(), atol=1e-6, rtol=0)
    image = nw.Model(model.surfels, model.texture, options=OPTIONS).render(camera).image
    image = image.detach().cpu().double().clamp(0, 1)
    expected = image.pow(2.2).mean((0, 1)).log() / 2.2
    torch.testing.assert_close(found[1], expected, atol=1e-5, rtol=0)


@pytest.fixture
def walls(device: torch.device) -> tuple[nw.Model, list[Camera]]:
    """Grey quads of brightness that changes along x, and cameras that go along with gaps; each sees a few."""
    count = 24
    generator = torch.Generator().manual_seed(4)
    greys = 0.15 + 0.7 * torch.rand(count, generator=generator)
    means = torch.stack([torch.linspace(-2, 10, count), torch.zeros(count), torch.full((count,), 2.0)], dim=1)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    sh = ((greys - 0.5) / 0.28209479177387814)[:, None, None].expand(count, 1, 3)
    shape = (means, quats, torch.tensor([0.26, 3.0]).expand(count, 2), torch.full((count,), 0.98))
    surfels = nw.Surfels.from_activated(*shape, torch.full((count, 2), 20.0), sh).to(device)
    places = torch.linspace(0, 8, 49)
    model = nw.Model(surfels, None, options=OPTIONS)
    return model, [looking(x) for i, x in enumerate(places.tolist()) if i % 8 not in (3, 4, 5)]


def test_cameras_between_get_the_gains_that_they_would_have_set(
    walls: tuple[nw.Model, list[Camera]], device: torch.device
) -> None:
    """Where photos leave gaps, exposures that were metered there are several times closer than the poses' alone."""
    model, cameras = walls

    def own(each: list[Camera]) -> torch.Tensor:
        return -0.7 * (brightness(model, each) - offset)

    offset = brightness(model, cameras).mean(0)
    gains = own(cameras)
    assert gains.std() > 0.05
    exposures = Exposures.of(gains, cameras, (-0.1, -0.2, 0.3)).to(device)
    found = with_auto_exposure(exposures, model, cameras)
    assert PLACES <= len(found.log_gains) - len(cameras) < PLACES + len(cameras)
    assert torch.equal(found.falloff, exposures.falloff.cpu())
    torch.testing.assert_close(found.log_gains[: len(cameras)].double(), gains, atol=1e-6, rtol=0)
    gaps = [looking(x) for x in torch.linspace(0, 8, 49).tolist() if looking(x).position[0] not in positions(cameras)]
    expected = own(gaps).clamp(gains.amin(0), gains.amax(0))

    def error(each: Exposures) -> float:
        there = torch.stack([each.cpu().gains(camera).double().log() for camera in gaps])
        return (there - expected).square().mean().sqrt().item()

    assert error(found) < 0.4 * error(exposures)
    again = with_auto_exposure(exposures.to(device), model, cameras)
    for name, tensor in again.tensors().items():
        torch.testing.assert_close(tensor, found.tensors()[name], atol=1e-4, rtol=0)


@pytest.fixture
def followed(walls: tuple[nw.Model, list[Camera]]) -> tuple[nw.Model, list[Camera], torch.Tensor]:
    """The walls, the cameras, and log gains that follow what those see."""
    seen = brightness(*walls)
    return *walls, -0.7 * (seen - seen.mean(0))


def positions(cameras: list[Camera]) -> list[float]:
    return [camera.position[0].item() for camera in cameras]


def test_exposures_that_brightness_does_not_tell_stay(walls: tuple[nw.Model, list[Camera]]) -> None:
    model, cameras = walls
    course = 0.2 * torch.linspace(0, 3, len(cameras)).double().sin()[:, None].expand(len(cameras), 3)
    exposures = Exposures.of(course, cameras)
    assert with_auto_exposure(exposures, model, cameras) is exposures


def test_many_photos_leave_room_for_few_places(
    followed: tuple[nw.Model, list[Camera], torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No more than 1,000 count in all; places are spread over the capture, or there are none."""
    model, cameras, gains = followed
    monkeypatch.setattr(auto_exposure, "PLACES", 15)
    for room, count in ((16, 16), (20, 16), (31, 31), (15, 11)):
        monkeypatch.setattr(auto_exposure, "MOST_PHOTOS", len(cameras) + room)
        found = with_auto_exposure(Exposures.of(gains, cameras), model, cameras)
        places = found.positions[len(cameras) :, 0]
        assert len(places) == count
        assert places.min() < 1 and places.max() > 7 and places.sort().values.diff().max() < 2
    monkeypatch.setattr(auto_exposure, "MOST_PHOTOS", len(cameras) + 14)
    exposures = Exposures.of(gains, cameras)
    assert with_auto_exposure(exposures, model, cameras) is exposures


def test_of_very_many_photos_each_keeps_its_own_gains(
    followed: tuple[nw.Model, list[Camera], torch.Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras are thinned as their gains were."""
    model, cameras, gains = followed
    for module in (auto_exposure, exposures_module):
        monkeypatch.setattr(module, "MOST_PHOTOS", 26)
    monkeypatch.setattr(auto_exposure, "PLACES", 5)
    exposures = Exposures.of(gains, cameras)
    assert len(exposures.log_gains) == 16
    found = with_auto_exposure(exposures, model, cameras)
    assert 16 < len(found.log_gains) <= 26
    torch.testing.assert_close(found.log_gains[:16].double(), gains[::2], atol=1e-6, rtol=0)
    torch.testing.assert_close(found.positions[:16], exposures.positions)


def test_a_finished_model_can_go_on_training(tmp_path: Path) -> None:
    """Finishing changes nothing of the training: steps are those of a training that was never finished."""
    scene = with_exposures(nw.load_scene(write_demo(tmp_path / "demo", width=24, height=18, views=12, points=60)))
    texture = TextureConfig(levels=2, table_size=2**6, width=16, hidden_layers=1)
    config = Config(iterations=20, max_surfels=40, texture=texture)
    one, other = (Trainer(scene, config, "cpu") for _ in range(2))
    for trainer in (one, other):
        trainer.run(until=10)
    seen: dict[str, list[tuple[int, int]]] = {}
    model = one.finish(lambda stage, done, total: seen.setdefault(stage, []).append((done, total)))
    assert list(seen) == ["smoothing SH", "measuring detail limits", "predicting auto exposure", "ordering surfels"]
    views = len(scene.train)
    for stage, counts in seen.items():
        assert [done for done, _ in counts] == [*range(1, len(counts) + 1)], stage
        assert {total for _, total in counts} == {views if stage != "predicting auto exposure" else counts[0][1]}, stage
    assert len(seen["smoothing SH"]) == len(seen["measuring detail limits"]) == views
    assert len(seen["predicting auto exposure"]) in (views, seen["predicting auto exposure"][0][1])
    assert seen["predicting auto exposure"][0][1] >= views + PLACES
    assert model.detail_limits is not None and model.exposures is not None
    for trainer in (one, other):
        trainer.run()
    for (name, mine), theirs in zip(one.surfels.named_parameters(), other.surfels.parameters(), strict=True):
        assert torch.equal(mine, theirs), name
