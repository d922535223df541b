import dataclasses
import json
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.camera import StagedCamera
from nexwarp.cameras.paths import look_at
from nexwarp.cli import main as cli
from nexwarp.data import Scene, demo_folder
from nexwarp.io.pictures import to_uint8
from nexwarp.model.poses import PoseCorrections, pose_differences, rigid_motion
from nexwarp.run.evaluate import evaluate
from nexwarp.run.fit_poses import fit_poses
from nexwarp.train.initial import initial_poses
from nexwarp.train.optimizer import rate_ends
from nexwarp.train.recipe import DEMO_SETTINGS, DensifyConfig, LearningRates, preset, with_settings
from nexwarp.train.target import with_cameras
from nexwarp.train.trainer import Trainer
from tests import scenes
from tests.cli.support import FLAGS
from tests.tolerances import assert_close
from tests.trainer_support import assert_resumed_alike, small, trained

# Surfels and texture stay as they are.
STILL: dict[str, Any] = {f.name: 0.0 for f in dataclasses.fields(LearningRates)}
STILL |= dict.fromkeys(("means", "grid", "mlp"), (0.0, 0.0))


def disturbed(scene: Scene, degrees: float = 0.5, size: float = 0.01) -> Scene:
    """A scene whose poses are off by an angle about a random axis, and by a share of its size in a random direction."""
    generator = torch.Generator().manual_seed(7)
    views = [*scene.train, *scene.test]
    turns, shifts = torch.nn.functional.normalize(torch.randn(2, len(views), 3, generator=generator), dim=-1)
    twists = torch.cat([turns * degrees * torch.pi / 180, shifts * size], dim=-1)
    moved = moved_by(scene.train, twists, scene.scale) + moved_by(scene.test, twists[len(scene.train) :], scene.scale)
    return dataclasses.replace(scene, train=moved[: len(scene.train)], test=moved[len(scene.train) :])


def moved_by(views: list[nw.View], twists: torch.Tensor, scale: float) -> list[nw.View]:
    poses = PoseCorrections([view.camera for view in views], scale)
    poses.load(twists[: len(views)])
    return with_cameras(views, poses.cameras([view.camera for view in views]))


def poses_of(cameras: list[nw.Camera]) -> torch.Tensor:
    return torch.stack([camera.viewmat for camera in cameras])


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 3.1])
def test_rigid_motion_is_the_exponential_of_its_twist(angle):
    twist = torch.randn(2, 6, dtype=torch.float64)
    twist[:, :3] *= angle / twist[:, :3].norm(dim=-1, keepdim=True)
    generator = torch.zeros(2, 4, 4, dtype=torch.float64)
    generator[:, :3, :3] = torch.linalg.cross(twist[:, None, :3].expand(2, 3, 3), torch.eye(3).double()[None]).mT
    generator[:, :3, 3] = twist[:, 3:]
    assert_close(rigid_motion(twist), torch.linalg.matrix_exp(generator), kind="value", name="motion")
    assert torch.autograd.gradcheck(rigid_motion, twist.requires_grad_())


def test_a_common_motion_and_scale_of_all_cameras_is_no_correction(tiny_scene):
    given = [view.camera for view in tiny_scene.train]
    poses = PoseCorrections(given, tiny_scene.scale)
    assert poses.gauge.shape == (6 * len(given), 7)
    small_motion, scaling = 1e-3 * torch.randn(6, dtype=torch.float64), 1.001
    twists = []
    for camera in given:
        viewmat = camera.viewmat.double()
        moved = viewmat @ rigid_motion(small_motion)  # of the world
        moved[:3, 3] *= scaling
        change = moved @ torch.linalg.inv(viewmat)
        turn = 0.5 * (change[:3, :3] - change[:3, :3].mT)
        twist = torch.stack([turn[2, 1], turn[0, 2], turn[1, 0]])
        # About a pivot ahead, at a z-depth of one scale.
        ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        twists.append(torch.cat([twist, change[:3, 3] / tiny_scene.scale - torch.linalg.cross(ahead, twist)]))
    common = torch.stack(twists).float()
    own = 1e-3 * torch.randn(len(given), 6)
    poses.load(own)
    poses.keep_gauge()
    own = poses.corrections.detach().clone()
    poses.load(own + common)
    poses.keep_gauge()
    assert (poses.corrections - own).norm() < 0.02 * common.norm()  # what is left is of second order
    alone = PoseCorrections(given[:1], tiny_scene.scale)
    alone.load(torch.randn(1, 6))
    alone.keep_gauge()
    assert alone.corrections.abs().max() < 1e-5  # a single camera has no pose of its own to refine


def test_a_corrected_camera_of_a_graph_stays_one(tiny_scene):
    """What a CUDA graph reads lies on the device: its focal length must not become a number."""
    poses = PoseCorrections([view.camera for view in tiny_scene.train], tiny_scene.scale)
    poses.load(0.01 * torch.randn(poses.corrections.shape, generator=torch.Generator().manual_seed(0)))
    first, second = (view.camera for view in tiny_scene.train[:2])
    staged = StagedCamera(first, torch.device("cpu"))
    staged.copy_(second)
    corrected, expected = poses.camera(staged, torch.tensor([1])), poses.camera(second, 1)
    assert torch.equal(corrected.viewmat, expected.viewmat) and not torch.equal(corrected.viewmat, second.viewmat)
    staged.numbers[25] = 7.0
    assert corrected.focal == 7.0


def test_short_runs_take_longer_steps():
    for iterations, expected in ((30_000, (2e-4, 2e-6)), (1_200, (1e-3, 1e-5))):
        assert rate_ends(nw.Config(iterations=iterations), 7.0)["poses"] == pytest.approx(expected)


def test_resuming_a_refinement_changes_nothing(tiny_scene, tmp_path):
    straight = trained(tiny_scene, small(refine_poses=True))
    assert straight.poses is not None and straight.poses.corrections.abs().max() > 1e-4
    assert_resumed_alike(straight, tmp_path)


@pytest.fixture(scope="module")
def model() -> nw.Model:
    """Sharp surfels without a texture: their renderings stand for photos, so that the true poses fit them exactly."""
    scene = scenes.random_scene(80, width=48, height=36)
    scene["gammas"], scene["opacities"] = scene["gammas"] + 4, 0.95 * torch.ones(80)
    surfels = scenes.make_surfels(scene)
    surfels.means.data -= surfels.means.data.mean(0)
    return nw.Model(surfels, None, options=nw.RenderOptions(max_hits=0), meta={"scene_scale": 4.0})


@pytest.fixture(scope="module")
def shown(model: nw.Model) -> Scene:
    """Photos of the model from all around."""
    K = torch.tensor([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]])
    places = torch.nn.functional.normalize(torch.randn(10, 3, generator=torch.Generator().manual_seed(5)), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    cameras = [nw.Camera(look_at(6 * place, torch.zeros(3), up), K, 48, 36) for place in places]
    images = [to_uint8(model.render(camera).image.detach()) for camera in cameras]
    return Scene.from_tensors(
        images, cameras, points=model.surfels.means.detach(), colors=torch.full((80, 3), 0.5), test_every=5
    )


def test_disturbed_poses_come_back_in_training(shown, model):
    """With surfels that are right, the training poses return to the true ones, up to the gauge."""
    config = small(iterations=240, max_hits=0, refine_poses=True, exposures=False, rates=LearningRates(**STILL))
    config = dataclasses.replace(config, densify=DensifyConfig(stop=0), sh_every=1)
    config = dataclasses.replace(config, background=(0.0, 0.0, 0.0))
    # Surfels that stand still hold the gauge at the true one: so no pose is off by what all are off by.
    given = initial_poses(shown, config, torch.device("cpu"))
    assert given is not None
    given.load(0.01 * torch.randn(len(shown.train), 6))
    given.keep_gauge()
    true = [view.camera for view in shown.train]
    wrong = dataclasses.replace(shown, train=with_cameras(shown.train, given.cameras(true)))
    trainer = Trainer(wrong, config, "cpu", surfels=model.surfels)
    before = pose_differences(poses_of(trainer.views.refined_cameras(trainer.poses)), poses_of(true))
    trainer.run()
    after = pose_differences(poses_of(trainer.views.refined_cameras(trainer.poses)), poses_of(true))
    assert before[0].mean() > 0.4 and after[0].mean() < 0.2 * before[0].mean()
    assert after[1].mean() < 0.2 * before[1].mean()


def test_fitted_test_poses_come_back_and_the_model_stays(shown, model):
    before = {name: x.clone() for name, x in model.state_dict().items()}
    wrong = disturbed(shown).test
    fitted, facts = fit_poses(model, wrong)
    true = poses_of([view.camera for view in shown.test])
    angles = [pose_differences(poses_of([v.camera for v in views]), true)[0].mean() for views in (wrong, fitted)]
    assert angles[1] < 0.2 * angles[0] and evaluate(model, fitted)["psnr"] > evaluate(model, wrong)["psnr"] + 6
    assert 0.3 < facts["mean_rotation_degrees"] < 0.7 and facts["steps"] == 80
    assert all(torch.equal(x, before[name]) for name, x in model.state_dict().items())
    assert all(parameter.requires_grad for parameter in model.parameters())


@pytest.mark.usefixtures("small_preset")
def test_the_command_line_refines_and_says_so(tiny_folder, tmp_path):
    run = tmp_path / "run"
    assert cli.main(["train", str(tiny_folder), "--run", str(run), *FLAGS, "--refine-poses"]) == 0
    cameras = json.loads((run / "cameras.json").read_text())
    entries = cameras["train"].values()
    assert all("given_viewmat" in entry and entry["given_viewmat"] != entry["viewmat"] for entry in entries)
    assert not any("given_viewmat" in entry for entry in cameras["test"].values())
    assert "test_poses" not in json.loads((run / "metrics.json").read_text())
    assert cli.main(["eval", str(run), "--refine-poses", "--device", "cpu"]) == 0
    assert json.loads((run / "metrics.json").read_text())["test_poses"]["steps"] > 0
    assert cli.main(["eval", str(run), "--device", "cpu"]) == 0
    assert "test_poses" not in json.loads((run / "metrics.json").read_text())


@pytest.mark.slow
def test_a_disturbed_demo_comes_back():
    """Poses off by 0.5 degrees and 1 % of the scene's size: within 0.3 dB of the undisturbed run."""
    scene = nw.load_scene(demo_folder(), downscale=2)
    wrong, config = disturbed(scene), with_settings(preset("default"), DEMO_SETTINGS | {"iterations": 600})
    plain = nw.train(scene, config, device="cpu")
    refined = nw.train(wrong, dataclasses.replace(config, refine_poses=True), device="cpu")
    expected = evaluate(plain, fit_poses(plain, scene.test)[0])["psnr"]
    assert evaluate(refined, fit_poses(refined, wrong.test)[0])["psnr"] > expected - 0.3
