"""The benchmark of distillation: what its student learns from."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from benchmarks.distillation import Student, main, train_teachers
from benchmarks.quality.jobs import TrainingJob, config_of
from benchmarks.quality.rows import DEFAULT
from benchmarks.quality.scenes import scene_of
from nexwarp import Config, Model, Scene, Trainer
from nexwarp.run.evaluate import METRICS
from nexwarp.train.config import TextureConfig

pytestmark = pytest.mark.usefixtures("one_torch_thread")

CPU = torch.device("cpu")
CONFIG = Config(
    iterations=12,
    max_surfels=60,
    exposures=False,
    background=(0.5, 0.4, 0.3),
    skybox=0,  # its colours are of the photos
    texture=TextureConfig(levels=4, table_size=1024),
)


@pytest.fixture(scope="module")
def teachers(tiny_scene: Scene) -> list[Model]:
    found = []
    for seed in (1, 2):
        trainer = Trainer(tiny_scene, dataclasses.replace(CONFIG, seed=seed), CPU)
        trainer.run()
        found.append(trainer.finish())
    return found


def trained(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Train; return all learned tensors."""
    trainer.run()
    return trainer.surfels.state_dict() | {f"texture.{k}": x for k, x in trainer.texture.state_dict().items()}


def test_without_a_share_it_is_the_training(tiny_scene: Scene, teachers: list[Model]) -> None:
    student = trained(Student(tiny_scene, CONFIG, CPU, teachers=teachers, share=0.0))
    alone = trained(Trainer(tiny_scene, CONFIG, CPU))
    assert all(torch.equal(x, student[name]) for name, x in alone.items())


def test_a_student_of_teachers_alone_does_not_see_photos(tiny_scene: Scene, teachers: list[Model]) -> None:
    views = [dataclasses.replace(view, image=torch.zeros_like(view.image)) for view in tiny_scene.train]
    black = dataclasses.replace(tiny_scene, train=views)
    one, other = (trained(Student(scene, CONFIG, CPU, teachers=teachers, share=1.0)) for scene in (tiny_scene, black))
    assert all(torch.equal(x, other[name]) for name, x in one.items())
    assert not torch.equal(one["sh0"], trained(Trainer(tiny_scene, CONFIG, CPU))["sh0"])


def test_its_targets_are_a_teachers_pictures_at_the_mean_exposure(tiny_scene: Scene, teachers: list[Model]) -> None:
    student = Student(tiny_scene, CONFIG, CPU, teachers=teachers, share=1.0)
    shown = set()
    for _ in range(12):
        target = student._next_target()
        pictures = [m.render(target.camera, background=target.background, exposure="mean").image for m in teachers]
        same = [torch.equal(picture, target.photo) for picture in pictures]
        assert sum(same) == 1
        assert not any(torch.equal(target.camera.viewmat, view.camera.viewmat) for view in tiny_scene.train)
        shown.add(same.index(True))
    assert shown == {0, 1} and student.iteration == 12


def test_what_belongs_to_a_photo_does_not_count(tiny_scene: Scene, teachers: list[Model]) -> None:
    """Its gains, its points and its mask; the teacher's picture has none of them."""
    masks = [torch.ones(view.image.shape[:2], dtype=torch.bool) for view in tiny_scene.train]
    for mask in masks:
        mask[0] = False
    views = [dataclasses.replace(view, mask=mask) for view, mask in zip(tiny_scene.train, masks, strict=True)]
    scene = dataclasses.replace(tiny_scene, train=views)
    student = Student(scene, CONFIG, CPU, teachers=teachers, share=1.0)
    gains = torch.full((len(views), 3), 1.5)
    student.views.gains = gains
    of_photo = student.targets.make(0, 1, [])
    assert of_photo.counts is not None and of_photo.exposure is not None and bool((of_photo.exposure == 1.5).all())
    assert of_photo.expected is not None and bool(of_photo.expected.any())
    for _ in range(len(views)):
        target = student._next_target()
        assert target.counts is None and target.empty is None
        assert target.exposure is not None and bool((target.exposure == 1).all())
        assert target.expected is not None and not target.expected.any()


def test_each_view_has_its_turn_once_in_a_round(tiny_scene: Scene, teachers: list[Model]) -> None:
    student, views = Student(tiny_scene, CONFIG, CPU, teachers=teachers, share=1.0), len(tiny_scene.train)
    for _ in range(3):
        assert sorted(student._next_camera()[0] for _ in range(views)) == [*range(views)]


def test_the_share_is_that_of_the_steps(tiny_scene: Scene, teachers: list[Model]) -> None:
    """300 steps of a share of 0.3: 90 on the mean, with a standard deviation of 8."""
    student = Student(tiny_scene, CONFIG, CPU, teachers=teachers, share=0.3)
    cameras = [view.camera.viewmat for view in tiny_scene.train]
    drawn = [student._next_target().camera.viewmat for _ in range(300)]
    assert 66 <= sum(not any(torch.equal(x, own) for own in cameras) for x in drawn) <= 114


def test_learned_poses_are_refused(tiny_scene: Scene, teachers: list[Model]) -> None:
    with pytest.raises(ValueError, match="expected fixed poses"):
        Student(tiny_scene, dataclasses.replace(CONFIG, refine_poses=True), CPU, teachers=teachers, share=0.5)


def test_teachers_have_seeds_of_their_own(tiny_folder: Path) -> None:
    """And are trained as any model of that seed."""
    job = TrainingJob(tiny_folder.name, "", "mine", 60, 3, 12)
    found, seconds = train_teachers(job, tiny_folder.parent, 2, 8)
    for number, teacher in enumerate(found, 1):
        one = dataclasses.replace(job, seed=300 + number, iterations=8)
        trainer = Trainer(scene_of(one, tiny_folder.parent), config_of(one, DEFAULT), CPU)
        trainer.run()
        assert torch.equal(trainer.finish().surfels.means, teacher.surfels.means)
    assert seconds > 0


@pytest.mark.parametrize(("count", "share", "message"), [(0, 0.5, "teachers: "), (1, 1.5, "share: ")])
def test_bad_arguments_are_told(
    tiny_scene: Scene, teachers: list[Model], count: int, share: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Student(tiny_scene, CONFIG, CPU, teachers=teachers[:count], share=share)


def test_a_line_names_teachers_and_share(tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METRICS, "lpips", lambda *_: None)  # it warns where its weights are not
    out = tmp_path / "out.jsonl"
    command = [str(out), "--scenes", tiny_folder.name, "--data", str(tiny_folder.parent), "--variant", ""]
    command += ["--teachers", "2", "--teacher-iterations", "8", "--iterations", "10", "--size", "60", "--seed", "3"]
    assert main([*command, "--share", "0.25"]) == 0
    line = json.loads(out.read_text())
    assert (line["row"], line["iterations"], line["seed"]) == ("2 teachers of 8, 0.25", 10, 3)
    with pytest.raises(ValueError, match="share: "):  # before anything is trained
        main([*command, "--share", "1.5"])
    assert line["share"] == 0.25 and line["teachers"]["count"] == 2 and line["teachers"]["seconds"] > 0
