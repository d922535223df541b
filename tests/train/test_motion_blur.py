"""Learned motion blur: the mean light of an exposure, its gradients, and that motions and sharpness come back."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from benchmarks.motion_blur import blurred_demo, motion_errors
from nexwarp.cli import main as cli
from nexwarp.data import Scene
from nexwarp.errors import CheckpointError
from nexwarp.io.pictures import to_uint8
from nexwarp.model.poses import PoseCorrections
from nexwarp.run.evaluate import evaluate
from nexwarp.train import presets
from nexwarp.train.config import Config, LearningRates
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.motion_blur import decoded, encoded, mean_light, moments, render_target
from nexwarp.train.parallel import ParallelTrainer
from nexwarp.train.presets import DEMO_SETTINGS, preset
from nexwarp.train.schedules import make_optimizer
from nexwarp.train.settings import with_settings
from nexwarp.train.step_losses import step_losses
from nexwarp.train.target import Target
from nexwarp.train.trainer import Trainer
from tests import scenes
from tests.cli.support import FLAGS, SMALL
from tests.narrowing import present
from tests.ranks_support import CPU, digest, run_ranks
from tests.run.test_poses import STILL, model, shown  # noqa: F401  # fixtures
from tests.tolerances import assert_close
from tests.trainer_support import assert_resumed_alike, small, trained

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_places")


def motions_of(trainer: Trainer) -> torch.nn.Parameter:
    return present(present(trainer.poses).motions)


def test_light_is_encoded_as_srgb_says():
    values = torch.linspace(-0.5, 1.5, 401, dtype=torch.float64)
    assert_close(encoded(decoded(values)), values, kind="value", name="there and back")
    assert (decoded(values).diff() > 0).all()
    # IEC 61966-2-1: a byte of 188 is half the light of white.
    assert decoded(torch.tensor(188 / 255)).item() == pytest.approx(0.5, abs=0.003)
    assert torch.autograd.gradcheck(decoded, torch.tensor([-0.2, 0.0, 0.02, 0.3, 1.2]).double().requires_grad_())
    assert torch.autograd.gradcheck(encoded, torch.tensor([-0.2, 0.0, 0.002, 0.3, 1.2]).double().requires_grad_())
    black, white = torch.zeros(2, 2, 3), torch.ones(2, 2, 3)
    assert mean_light([black, white, white, black])[0, 0, 0].item() == pytest.approx(188 / 255, abs=0.002)


def exposed(count: int, device: torch.device) -> tuple[nw.Model, Target, PoseCorrections]:
    """A model, a target and a camera that moves by some pixels."""
    dtype = torch.float64
    scene = scenes.random_scene(40, width=32, height=24, dtype=dtype, device=device)
    texture = scenes.make_texture(dtype=dtype, device=device)
    texture.half_precision = False
    drawn = nw.Model(scenes.make_surfels(scene), texture)
    given = scenes.make_camera(scene)
    camera = nw.Camera(given.viewmat.detach(), given.K, given.width, given.height, given.near)
    motions = torch.tensor([[1.4, -1.9, 1.2, 0.5, -0.7, 1.0]])
    poses = PoseCorrections([camera], 2.0, [3.0], motions=motions).to(device, dtype)
    photo = torch.rand(24, 32, 3, dtype=dtype, generator=torch.Generator().manual_seed(2))
    view = torch.tensor([0], device=device)
    return drawn, Target(camera, photo.to(device), (0.2, 0.3, 0.4), view=view), poses


def test_an_exposure_is_the_mean_light_over_its_moments(device: torch.device):
    """From poses at the middles of equal parts of the twist's time, and the same for the motion reversed."""
    drawn, target, poses = exposed(5, device)
    motions = present(poses.motions)
    with torch.no_grad():
        middle, taken = render_target(drawn, target, poses, 5)
        ahead = torch.eye(4, dtype=torch.float64)
        ahead[2, 3] = 3.0
        pixel = poses.pixels[0].item()
        assert pixel == pytest.approx(1 / target.camera.focal)
        w, v = pixel * motions[0, :3].cpu(), 3.0 * pixel * motions[0, 3:].cpu()
        generator = torch.zeros(4, 4, dtype=torch.float64)
        generator[:3, :3] = torch.tensor([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        generator[:3, 3] = v
        images = []
        for index in range(5):
            motion = ahead @ torch.linalg.matrix_exp((index - 2) / 5 * generator) @ torch.linalg.inv(ahead)
            camera = dataclasses.replace(target.camera, viewmat=motion.to(device) @ target.camera.viewmat)
            images.append(drawn.render(camera, background=target.background).image)
        assert_close(taken.image, mean_light(images), kind="value", name="image")
        assert_close(middle.image, images[2], kind="value", name="middle")
        assert (taken.image - middle.image).abs().mean() > 0.003
        motions.neg_()
        assert_close(render_target(drawn, target, poses, 5)[1].image, taken.image, kind="value", name="reversed")
    assert moments(3) == pytest.approx([-1 / 3, 0, 1 / 3])


def test_gradients_of_motions_and_poses_are_those_of_differences(device: torch.device):
    drawn, target, poses = exposed(3, device)
    weights = torch.randn(2, 24, 32, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    weights = weights.to(device)

    def value() -> torch.Tensor:
        moved = dataclasses.replace(target, camera=poses.camera(target.camera, present(target.view)))
        taken = render_target(drawn, moved, poses, 3)[1]
        return (weights[0] * taken.image).sum() + (weights[1] * taken.textured).sum()

    value().backward()
    for parameter in (present(poses.motions), poses.corrections):
        slopes, step = [], 1e-8
        for k in range(6):
            ends = []
            for sign in (1, -1):
                with torch.no_grad():
                    parameter[0, k] += sign * step
                    ends.append(value().item())
                    parameter[0, k] -= sign * step
            slopes.append((ends[0] - ends[1]) / (2 * step))
        # Steps are small enough that no hit crosses a cut-off between the two ends.
        assert_close(present(parameter.grad)[0].float().cpu(), torch.tensor(slopes), kind="gradient", name="slopes")


def test_without_motion_it_is_the_sharp_training(tiny_scene: Scene):
    """Losses and gradients of a step; motions then have no first derivative."""
    found = []
    for count in (1, 3):
        trainer = Trainer(tiny_scene, small(refine_poses=True, blur_poses=count), "cpu")
        if count > 1:
            motions_of(trainer).data.zero_()
        target = trainer._next_target()
        target = dataclasses.replace(target, camera=present(trainer.poses).camera(target.camera, present(target.view)))
        taken = render_target(trainer.model(), target, trainer.poses, count)[1]
        given = (taken, target, trainer.surfels, trainer.texture, trainer.config)
        losses = step_losses(*given, poses=trainer.poses)
        torch.stack(list(losses.values())).sum().backward()
        found.append((losses, {name: x.grad for name, x in trainer._named_parameters() if x.grad is not None}))
    (sharp, expected), (losses, gradients) = found
    assert losses.keys() == sharp.keys()
    for name, term in losses.items():
        assert term.item() == pytest.approx(sharp[name].item(), rel=1e-5, abs=1e-9)
    still = gradients.pop("poses.motions")
    assert gradients.keys() == expected.keys()
    for name, gradient in gradients.items():
        assert_close(gradient, expected[name], kind="gradient", name=name)
    assert still.norm() < 1e-3 * expected["poses.corrections"].norm()


@pytest.mark.parametrize("refine", [False, True])
def test_resuming_a_blurred_training_changes_nothing(tiny_scene: Scene, tmp_path: Path, refine: bool):
    config = small(refine_poses=refine, blur_poses=3)
    straight = trained(tiny_scene, config)
    start = motions_of(Trainer(tiny_scene, config, "cpu"))
    assert (motions_of(straight) - start).abs().amin(1).max() > 1e-4
    assert (present(straight.poses).corrections.abs().max() > 1e-4) == refine
    first = assert_resumed_alike(tiny_scene, config, straight, tmp_path)
    # A checkpoint without motions is named, and so is one of other settings.
    snapshot = first.snapshot()
    del snapshot.tensors["poses.motions"]
    first._write(tmp_path, snapshot)
    with pytest.raises(CheckpointError, match="motions: expected those of the exposures, got None"):
        Trainer(tiny_scene, config, "cpu").restore(tmp_path)
    with pytest.raises(CheckpointError, match="its settings are others"):
        Trainer(tiny_scene, dataclasses.replace(config, blur_poses=1), "cpu").restore(tmp_path)


def test_ranks_learn_the_same_motions(tiny_scene: Scene, tmp_path: Path):
    config = small(iterations=8, refine_poses=True, blur_poses=3)

    def work(ranks: Any) -> object:
        trainer = ParallelTrainer(tiny_scene, config, CPU, ranks)
        before = motions_of(trainer).detach().clone()
        trainer.run()
        moved = (motions_of(trainer) - before).detach().abs().amax(1) > 1e-5
        return {"digest": digest(trainer), "moved": int(moved.sum())}

    found = run_ranks(2, work, tmp_path)
    assert found[0] == found[1]
    assert isinstance(found[0], dict) and found[0]["moved"] == 8  # each step moves the cameras of two views


def test_motions_come_back_in_training(shown: Scene, model: nw.Model):  # noqa: F811
    """With surfels that are right, motions of about 5 pixels are found but for their direction in time."""
    config = small(iterations=200, max_hits=0, blur_poses=5, exposures=False, sh_every=1, background=(0.0, 0.0, 0.0))
    config = dataclasses.replace(config, rates=LearningRates(**STILL))
    config = dataclasses.replace(config, densify=DensifyConfig(stop=0))
    cameras = [view.camera for view in shown.train]
    ways = torch.nn.functional.normalize(
        torch.randn(len(cameras), 3, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    true = torch.cat([5 * ways, torch.zeros_like(ways)], -1)
    pivots = present(Trainer(shown, config, "cpu").poses).pivots.tolist()
    moving = PoseCorrections(cameras, shown.scale, pivots, motions=true)
    views = []
    with torch.no_grad():
        for index, view in enumerate(shown.train):
            images = [model.render(moving.moment(view.camera, index, time)).image for time in moments(15)]
            views.append(dataclasses.replace(view, image=to_uint8(mean_light(images))))
    trainer = Trainer(dataclasses.replace(shown, train=views), config, "cpu")
    trainer.surfels = nw.Surfels({name: x.clone() for name, x in model.surfels.state_dict().items()})
    trainer.optimizer = make_optimizer(trainer.surfels, trainer.texture, config, shown.scale, poses=trainer.poses)
    trainer.densifier.errors = torch.zeros(len(trainer.surfels))
    before = motion_errors(motions_of(trainer).detach(), true)
    trainer.run()
    after = motion_errors(motions_of(trainer).detach(), true)
    assert before.median() > 0.7 and after.median() < 0.25
    assert present(trainer.poses).corrections.abs().max() == 0


def test_the_command_line_keeps_the_ends_of_exposures(tiny_folder, tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "default", SMALL)
    run = tmp_path / "run"
    assert cli.main(["train", str(tiny_folder), "--run", str(run), *FLAGS, "--set", "blur_poses=3"]) == 0
    cameras = json.loads((run / "cameras.json").read_text())
    for entry in cameras["train"].values():
        assert "given_viewmat" not in entry
        back = torch.linalg.inv(torch.tensor(entry["viewmat"]))
        start, end = (torch.tensor(entry[f"exposure_{name}"]) @ back for name in ("start", "end"))
        assert (start - end).abs().max() > 1e-4
        assert (start @ end - torch.eye(4)).abs().max() < 1e-4  # one undoes the other
    assert not any("exposure_start" in entry for entry in cameras["test"].values())
    assert nw.load_cameras(run)["train"].keys() == cameras["train"].keys()


@pytest.mark.parametrize("value", [0, 2, 33, 2.5])
def test_bad_numbers_of_poses_are_named(value: float):
    with pytest.raises(ValueError, match="blur_poses: expected"):
        with_settings(Config(), {"blur_poses": value})


@pytest.mark.slow
def test_a_blurred_demo_comes_back_sharper():
    """Photos blurred over 5 pixels: learned motions regain a part of what the blur costs on sharp test views."""
    scene, true = blurred_demo(5.5, 1.0, downscale=2)
    config = with_settings(preset("default"), DEMO_SETTINGS | {"iterations": 600})
    off = evaluate(nw.train(scene, config, device="cpu"), scene.test)["psnr"]
    trainer = Trainer(scene, dataclasses.replace(config, blur_poses=3), "cpu")
    trainer.run()
    on = evaluate(trainer.finish(), scene.test)["psnr"]
    assert on > off + 0.4, (on, off)
    assert motion_errors(motions_of(trainer).detach(), true).median() < 0.5
