import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp import Model, Scene, Trainer
from nexwarp.cli import main as cli
from nexwarp.errors import CheckpointError
from nexwarp.model.exposures import Exposures
from nexwarp.train.checkpoint import CHECKPOINTS
from tests.cli.support import refused
from tests.ranks_support import alone_as
from tests.trainer_support import assert_resumed_alike, small

CPU = torch.device("cpu")
# Colours of a skybox are of the photos.
CONFIG = small(max_surfels=60, exposures=False, background=(0.5, 0.4, 0.3), skybox=0)


@pytest.fixture(scope="module")
def teachers(tiny_scene: Scene) -> list[Model]:
    return [nw.train(tiny_scene, dataclasses.replace(CONFIG, seed=seed), device=CPU) for seed in (1, 2)]


def test_every_other_step_has_a_teachers_picture(tiny_scene: Scene, teachers: list[Model]) -> None:
    config = dataclasses.replace(CONFIG, iterations=4 * len(tiny_scene.train))
    student = Trainer(tiny_scene, config, CPU, teachers=teachers)
    views, shown = {view.camera.viewmat: view.image / 255 for view in tiny_scene.train}, set()
    for number in range(1, config.iterations + 1):
        target = student._next_target()
        assert student.iteration == number
        photos = [photo for viewmat, photo in views.items() if torch.equal(viewmat, target.camera.viewmat)]
        if number % 2 == 1 or number == config.iterations:  # the log's lines are of these
            assert len(photos) == 1 and torch.allclose(target.photo, photos[0])
            continue
        pictures = [m.render(target.camera, background=target.background, exposure="mean").image for m in teachers]
        alike = [torch.equal(picture, target.photo) for picture in pictures]
        assert not photos and sum(alike) == 1
        shown.add(alike.index(True))
    assert shown == {0, 1}


def test_a_picture_is_at_the_mean_exposure_on_the_steps_background(tiny_scene: Scene, teachers: list[Model]) -> None:
    exposures = Exposures.of(
        torch.linspace(-0.7, 0.7, 3 * len(tiny_scene.train)).view(-1, 3), [view.camera for view in tiny_scene.train]
    )
    m = teachers[0]
    options = dataclasses.replace(m.options, background=(1.0, 0.0, 1.0))
    other = nw.Model(m.surfels, m.texture, exposures, m.detail_limits, options)
    scene = dataclasses.replace(tiny_scene, random_background=True)
    student, behind = Trainer(scene, CONFIG, CPU, teachers=[other]), []
    for _ in range(4):
        _, target = student._next_target(), student._next_target()
        assert torch.equal(target.photo, m.render(target.camera, background=target.background).image)
        assert not torch.equal(target.photo, other.render(target.camera, background=target.background).image)
        behind.append(torch.as_tensor(target.background))
    assert not torch.equal(behind[0], behind[1])


def test_photos_and_cameras_near_each_have_their_turn_once_in_a_round(tiny_scene: Scene, teachers: list[Model]) -> None:
    """Two numbers of a round, one for a photo and one for a teacher, for each view."""
    views = len(tiny_scene.train)
    student = Trainer(tiny_scene, dataclasses.replace(CONFIG, iterations=999), CPU, teachers=teachers)
    orders = set()
    for round_ in range(3):
        numbers = range(2 * views * round_ + 1, 2 * views * (round_ + 1) + 1)
        chosen = [student.targets.next_view(number) for number in numbers]
        assert sorted(chosen[0::2]) == sorted(chosen[1::2]) == [*range(views)]
        orders.add(tuple(chosen[1::2]))
    assert len(orders) == 3


def test_ranks_share_the_turns_of_one_process(tiny_scene: Scene, teachers: list[Model]) -> None:
    """Whatever their number: the target of each number is that of a training on one GPU, but for random numbers."""
    alone = Trainer(tiny_scene, CONFIG, CPU, teachers=teachers)
    expected = [alone._next_target() for _ in range(12)]
    for size in (2, 3):
        trainers = [alone_as(rank, size, tiny_scene, CONFIG, teachers) for rank in range(size)]
        found = [trainer._next_target() for _ in range(12 // size) for trainer in trainers]
        for mine, theirs in zip(found, expected, strict=True):
            assert torch.equal(mine.camera.viewmat, theirs.camera.viewmat) and torch.equal(mine.photo, theirs.photo)


@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_what_belongs_to_a_photo_does_not_count(tiny_scene: Scene, teachers: list[Model], mode: str) -> None:
    """Its gains, its points and its mask; the teacher's picture has none of them."""
    masks = [torch.ones(view.image.shape[:2], dtype=torch.bool) for view in tiny_scene.train]
    for mask in masks:
        mask[0] = False
    views = [dataclasses.replace(view, mask=mask) for view, mask in zip(tiny_scene.train, masks, strict=True)]
    config = dataclasses.replace(CONFIG, mask_mode=mode)
    student = Trainer(dataclasses.replace(tiny_scene, train=views), config, CPU, teachers=teachers)
    student.views.gains = torch.full((len(views), 3), 1.5)
    for _ in range(5):
        of_photo, taught = student._next_target(), student._next_target()
        assert (of_photo.counts is not None) == (mode == "ignore") and (of_photo.empty is None) == (mode == "ignore")
        assert of_photo.exposure is not None and bool((of_photo.exposure == 1.5).all())
        assert of_photo.expected is not None and bool(of_photo.expected.any())
        assert taught.counts is None and taught.empty is None
        assert taught.exposure is not None and bool((taught.exposure == 1).all())
        assert taught.expected is not None and not taught.expected.any()


def test_a_resumed_student_has_the_bits_of_an_uninterrupted_one(tiny_scene, teachers, tmp_path):
    whole, alone = Trainer(tiny_scene, CONFIG, CPU, teachers=teachers), Trainer(tiny_scene, CONFIG, CPU)
    for trainer in (whole, alone):
        trainer.run()
    assert_resumed_alike(whole, tmp_path, teachers=teachers)
    assert not torch.equal(whole.surfels.sh0, alone.surfels.sh0)


@pytest.mark.parametrize("kind", ["none", "fewer", "swapped", "bare"])
def test_a_checkpoint_of_other_teachers_is_refused(tiny_scene, teachers, tmp_path, kind):
    first, second = teachers
    others = {"none": [], "fewer": [first], "swapped": [second, first], "bare": [first.bare(), second]}[kind]
    begun = Trainer(tiny_scene, CONFIG, CPU, teachers=teachers)
    begun.run(until=3)
    begun.save_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match="learned from other teachers"):
        Trainer(tiny_scene, CONFIG, CPU, teachers=others).restore(tmp_path)


def test_teachers_of_another_scene_are_refused(tiny_scene: Scene, teachers: list[Model]) -> None:
    for factor in (0.99, 2):
        other = dataclasses.replace(tiny_scene, scale=factor * tiny_scene.scale)
        with pytest.raises(ValueError, match=r"teachers\[0\]: expected a model of .* whose scale is"):
            nw.train(other, CONFIG, device=CPU, teachers=teachers)


def test_the_command_learns_from_runs(tiny_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    few = ["--iterations", "10", "--max-surfels", "60", "--device", "cpu", "--set", "texture.table_size=1024"]

    def train(run: str, *options: str) -> list[str]:
        return ["train", str(tiny_folder), "--run", run, *few, *options]

    for run, seed in (("a", "1"), ("b", "2")):
        assert cli.main(train(run, "--seed", seed)) == 0
    both = ["--teacher", "a", "--teacher", "b"]
    assert cli.main(train("c", *both)) == 0 and json.loads(Path("c/metrics.json").read_text())["teachers"] == 2
    assert json.loads(Path("c/config.json").read_text())["teachers"] == [str(tmp_path / "a"), str(tmp_path / "b")]
    assert not any("teachers" in json.loads(Path(f"a/{name}.json").read_text()) for name in ("metrics", "config"))
    # A run resumes with its teachers, before its first checkpoint too.
    model = Path("c/model.safetensors").read_bytes()
    for name in CHECKPOINTS:
        shutil.rmtree(Path("c", name), ignore_errors=True)
    Path("c/model.safetensors").unlink()
    assert cli.main(train("c", "--resume")) == 0 and Path("c/model.safetensors").read_bytes() == model
    shutil.move("b", "moved")
    assert cli.main(train("c", "--resume", "--teacher", "a", "--teacher", "moved")) == 0
    assert cli.main(train("c", "--resume")) == 0  # it has noted where they lie
    shutil.move("moved", "b")
    for options, message in (
        (["--teacher", "none"], "none: expected a model file, or a run folder"),
        ([*both, "--refine-poses"], "--teacher: expected poses that stay as given"),
        (["--teacher", "d/model.safetensors"], "--teacher: expected another run than d"),
    ):
        refused(capsys, train("d", *options), message)
        assert not Path("d").exists()
    refused(capsys, train("a", "--overwrite", "--teacher", "a"), "--teacher: expected another run than a")
    assert Path("a/model.safetensors").is_file()
