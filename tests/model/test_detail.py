"""Level of detail: the order of surfels, coarse models, and what a part of a model file gives."""

from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import save_cameras
from nexwarp.cli import main as cli
from nexwarp.model.detail import coarse_texture, surfel_count, texture_levels
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.run.opened import open_model
from nexwarp.train.finish.finish import ordered, picture_shares
from tests.cameras.test_paths import ring
from tests.cli.support import refused
from tests.scenes import make_surfels, make_texture, random_scene
from tests.tolerances import assert_close

COUNT = 60


@pytest.fixture
def cameras() -> list[nw.Camera]:
    return [camera.to(torch.float32) for camera in ring(6)]


@pytest.fixture
def model() -> nw.Model:
    scene = random_scene(COUNT)
    scene["means"] = scene["means"] - scene["means"].mean(0)
    limits = DetailLimits(torch.rand(COUNT) * 1e-3, 1.0 + torch.rand(COUNT))
    return nw.Model(make_surfels(scene), make_texture(), detail_limits=limits, meta={"near": 0.01})


def test_the_order_changes_no_picture(model: nw.Model, cameras: list[nw.Camera]) -> None:
    result = ordered(model, cameras)
    for camera in cameras:
        with torch.no_grad():
            assert_close(result.render(camera).image, model.render(camera).image, kind="value", name="detail")
    assert result.meta["ordered"] is True and "ordered" not in model.meta


def test_shares_are_the_blending_weights_of_all_pictures(model: nw.Model, cameras: list[nw.Camera]) -> None:
    shares = picture_shares(model, cameras)
    with torch.no_grad():
        covered = torch.stack([model.bare(max_hits=0).render(camera).alpha.mean() for camera in cameras]).sum()
    assert_close(shares.sum(), covered, kind="value", name="detail")
    after = picture_shares(ordered(model, cameras), cameras)
    assert_close(after, shares.sort(descending=True).values, kind="value", name="detail")
    twice = picture_shares(model, [*cameras, *cameras])
    assert_close(twice, 2 * shares, kind="value", name="detail")


def test_a_coarse_texture_is_one_whose_fine_features_are_zero() -> None:
    texture = make_texture()
    with torch.no_grad():
        texture.grid.uniform_(-1.0, 1.0)
    positions, depths = torch.rand(50, 3), torch.ones(50)
    for levels in range(1, len(texture.resolutions)):
        coarse = coarse_texture(texture, levels)
        with torch.no_grad():
            zeroed = make_texture()
            zeroed.load_state_dict(texture.state_dict())
            zeroed.grid[levels:] = 0.0
            assert_close(
                coarse(positions, depths, 100.0), zeroed(positions, depths, 100.0), kind="value", name="detail"
            )
        assert torch.equal(coarse.resolutions, texture.resolutions[:levels])


def test_a_part_of_a_file_is_the_coarse_model(model: nw.Model, cameras: list[nw.Camera], tmp_path: Path) -> None:
    file = ordered(model, cameras).save(tmp_path / "model.safetensors")
    whole = nw.load(file)
    for detail in (0.01, 0.05, 0.2, 0.77, 1.0):
        part, coarse = nw.load(file, detail=detail), whole.at_detail(detail)
        assert len(part.surfels) == surfel_count(detail, COUNT)
        assert part.state_dict().keys() == coarse.state_dict().keys()
        for name, value in coarse.state_dict().items():
            assert torch.equal(part.state_dict()[name], value), name
        assert part.texture is not None and coarse.texture is not None
        assert part.texture.config == coarse.texture.config
    everything = whole.at_detail(1.0).state_dict()
    assert all(torch.equal(everything[name], value) for name, value in whole.state_dict().items())


def test_detail_grows_with_its_share() -> None:
    details = (0.001, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    for count in (1, 8, 16):
        levels = [texture_levels(detail, count) for detail in details]
        assert levels == sorted(levels) and levels[0] >= 1 and levels[-2:] == [count, count]
    assert [surfel_count(detail, 1000) for detail in (0.001, 0.05, 1.0)] == [1, 50, 1000]


@pytest.mark.parametrize("detail", [0.0, -1.0, 1.5, float("nan"), "much", True])
def test_a_detail_out_of_range_is_refused(detail: float, model: nw.Model, cameras: list[nw.Camera]) -> None:
    with pytest.raises((TypeError, ValueError), match=r"^detail: expected"):
        ordered(model, cameras).at_detail(detail)


def test_models_without_an_order(
    model: nw.Model, cameras: list[nw.Camera], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python says so; the command line orders the surfels by the run's cameras, if it has any."""
    with pytest.raises(ValueError, match="detail: expected a model with surfels in the order"):
        model.at_detail(0.5)
    file = model.save(tmp_path / "run")
    with pytest.raises(ValueError, match="expected surfels in the order of their share"):
        nw.load(file, detail=0.5)
    command = ["render", str(tmp_path / "run"), "--detail", "0.25", "--frames", "2", "--size", "16x12"]
    refused(capsys, [*command, "--device", "cpu"], "expected surfels in the order of their share")
    nw_cameras = {"train": {f"{i}.png": camera for i, camera in enumerate(cameras)}, "test": {}}
    save_cameras(tmp_path / "run" / "cameras.json", nw_cameras)
    assert cli.main([*command, "--device", "cpu"]) == 0
    coarse = open_model(tmp_path / "run").model_at(0.25, torch.device("cpu"))
    expected = ordered(nw.load(file), cameras).at_detail(0.25)
    assert torch.equal(coarse.surfels.means, expected.surfels.means)
    refused(capsys, ["render", str(file), "--detail", "2"], "--detail: expected at least 0.0001 and at most 1, got 2")
