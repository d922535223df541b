import dataclasses
import itertools
import json
import os
import signal
import time
from pathlib import Path
from typing import cast

import pytest
import safetensors.torch
import torch

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.cli import session
from nexwarp.errors import RankError, SceneError, SettingError
from nexwarp.machine import derived_seed
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.train.checkpoint import has_checkpoint
from nexwarp.train.parallel import MOST_CAPTURED_BYTES, ParallelTrainer, scale_for_batch, sums_beside
from nexwarp.train.ranks.ranks import WAIT_VARIABLE, Ranks, check_count
from nexwarp.train.recipe import Config, DensifyConfig
from tests import ranks_support
from tests.cli.support import refused
from tests.ranks_support import CPU, alone_as, digest, kept_gradients, printed, run_ranks, start_ranks, wait
from tests.scenes import make_surfels, random_scene
from tests.tolerances import assert_close
from tests.trainer_support import OFTEN, TEXTURE, small

pytestmark = pytest.mark.usefixtures("small_preset")

# The command line has no flags for the texture's shape. All ranks estimate exposures alike, and that would take most of
# the time of so short a training.
SMALL = Config(exposures=False, texture=TEXTURE, densify=OFTEN)
TRAIN = ["--iterations", "24", "--max-surfels", "100", "--device", "cpu"]
SHORT = small(iterations=24)
OFTEN_SAVED = [*TRAIN, "--checkpoint-every", "2"]


def test_an_incomplete_last_step_is_the_mean_of_its_views(scene: nw.Scene, tmp_path: Path) -> None:
    """Of 5 views, 3 ranks render 3, then 2: the third one repeats a view with weight 0."""

    def work(ranks: Ranks) -> object:
        trainer = ParallelTrainer(scene, small(iterations=5), CPU, ranks)
        shares = []
        while trainer.iteration < 5:
            shares.append((trainer.step().views, trainer.share))
        return shares

    assert run_ranks(3, work, tmp_path) == [[[3, 1 / 3], [2, 1 / 2]]] * 2 + [[[3, 1 / 3], [2, 0.0]]]


@pytest.mark.parametrize(
    ("size", "steps"), [(2, 200), (3, 60), pytest.param(3, 200, marks=pytest.mark.slow)], ids=["2", "3", "3 for long"]
)
def test_ranks_train_one_model(scene: nw.Scene, tmp_path: Path, size: int, steps: int) -> None:
    """One fork of the ranks for the laws of a whole training: a process costs more than a law."""

    def work(ranks: Ranks) -> object:
        first = ParallelTrainer(scene, SHORT, CPU, ranks)
        with kept_gradients(first) as gradients:
            first.step()
        if ranks.first:
            safetensors.torch.save_file(gradients[0], tmp_path / "gradients.safetensors")
        seldom = DensifyConfig(every=1000, start=1000)
        replica = ParallelTrainer(scene, small(iterations=steps * size, max_surfels=200, densify=seldom), CPU, ranks)
        seen: list[int] = []
        replica.run(lambda step: seen.append(step.iteration))
        # Straight to the end, and resumed in the middle.
        straight = ParallelTrainer(scene, SHORT, CPU, ranks)
        straight.run()
        halfway = ParallelTrainer(scene, SHORT, CPU, ranks)
        halfway.run(until=12)
        halfway.save(tmp_path / "run")
        resumed = ParallelTrainer(scene, SHORT, CPU, ranks)
        torch.manual_seed(99)
        ranks.barrier()
        resumed.restore(tmp_path / "run")
        resumed.run()
        digests = {"replica": digest(replica), "straight": digest(straight), "resumed": digest(resumed)}
        return digests | {"surfels": len(replica.surfels), "steps": len(seen), "last": seen[-1]}

    (tmp_path / "run").mkdir()
    found = run_ranks(size, work, tmp_path / "ranks")
    first = found[0]
    assert isinstance(first, dict) and all(other == first for other in found)
    assert first["steps"] == steps and first["last"] == steps * size and first["surfels"] > 120
    assert first["straight"] == first["resumed"]
    # The gradient is the mean of those of the ranks' views.
    told = safetensors.torch.load_file(tmp_path / "gradients.safetensors")
    alone = []
    for rank in range(size):
        one = alone_as(rank, size, scene, SHORT)
        with kept_gradients(one) as gradients:
            one.step()
        alone.append(gradients[0])
    for name, value in told.items():
        # Each alone has weighted its loss by 1 / size.
        assert_close(value, torch.stack([each[name] for each in alone]).sum(0), kind="gradient", name=name)
    # One process goes on from the checkpoint of several.
    trainer = nw.Trainer(scene, SHORT, CPU)
    trainer.restore(tmp_path / "run")
    assert trainer.iteration == 12
    trainer.run()
    assert trainer.iteration == 24


def test_each_epoch_sees_each_view_once(scene: nw.Scene) -> None:
    """Whatever the number of ranks, views come in one order, with random numbers of their own."""
    views = len(scene.train)
    taken: dict[int, list[int]] = {}
    for size in (2, 3):
        trainers = [alone_as(rank, size, scene, small(iterations=3 * views)) for rank in range(size)]
        for trainer in trainers:
            trainer.targets.make = lambda index, *_: index  # type: ignore[method-assign]
        while trainers[0].iteration < 3 * views:
            first = trainers[0].iteration
            chosen = [cast(int, trainer._next_target()) for trainer in trainers]
            for offset in range(trainers[0].views_a_step):
                taken.setdefault(first + offset, []).append(chosen[offset])
        assert sum([trainer.share for trainer in trainers]) == pytest.approx(1.0) and trainers[0].iteration == 3 * views
    order = [taken[number] for number in sorted(taken)]
    assert sorted(taken) == list(range(3 * views))
    assert all(len(set(each)) == 1 for each in order)  # all sizes agree
    epochs = [[each[0] for each in order[start : start + views]] for start in range(0, 3 * views, views)]
    assert all(sorted(epoch) == list(range(views)) for epoch in epochs) and epochs[0] != epochs[1] != epochs[2]
    assert len({derived_seed(0, n, k) for n in range(1000) for k in range(2)}) == 2000


def test_rates_follow_the_square_root_of_the_batch(scene: nw.Scene) -> None:
    one = nw.Trainer(scene, SHORT, CPU)
    four = nw.Trainer(scene, SHORT, CPU)
    scale_for_batch(four.optimizer, 4)
    for before, after in zip(one.optimizer.param_groups, four.optimizer.param_groups, strict=True):
        assert after["ends"] == pytest.approx(tuple(2 * rate for rate in before["ends"]))
        assert after["betas"] == pytest.approx((0.9**4, 0.999**4))


def test_ranks_that_do_not_fit_are_refused_alike(scene: nw.Scene, tmp_path: Path) -> None:
    few = dataclasses.replace(scene, train=scene.train[:1])
    view = scene.train[3]
    other = dataclasses.replace(scene, train=[*scene.train[:3], dataclasses.replace(view, image=255 - view.image)])
    same = dataclasses.replace(scene, train=scene.train[:4])

    def work(ranks: Ranks) -> object:
        told = []
        given = (few, small(), 0), (other if ranks.rank == 1 else same, small(), 0)
        for one, config, version in (*given, (same, small(seed=ranks.rank), 0), (same, small(), ranks.rank)):
            try:
                ranks.check_same({"torch": "1", "nexwarp": f"version {version}"})
                ParallelTrainer(one, config, CPU, ranks)
                told.append("nothing")
            except (RankError, SceneError) as error:
                told.append(str(error))
        return told

    first, second = run_ranks(2, work, tmp_path / "ranks")
    assert isinstance(first, list) and first == second
    assert first[0] == f"{scene.path}: expected at most as many ranks as training views, 1, got 2"
    assert first[1].startswith("rank 1: expected the same scene as rank 0, ")
    assert first[2].startswith("rank 1: expected the same settings as rank 0, ")
    assert first[3] == "rank 1: expected the same nexwarp as rank 0, version 0, got version 1"


def test_a_missing_rank_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (ranks_support.environment(0, 3, ranks_support.free_port()) | {WAIT_VARIABLE: "0.3"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(RankError, match=r"expected 3 ranks to join at 127\.0\.0\.1:\d+ within 0 s \("):
        Ranks.join(CPU)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_gpus_that_are_not_there_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    check_count(3, "cpu")
    with pytest.raises(SettingError, match="--gpus: expected at least 1, got 0"):
        check_count(0, "cpu")
    message = "--gpus: expected at most 0, as many as GPUs on this machine, got 4; --device cpu trains on CPUs instead"
    refused(capsys, ["train", "demo", "--gpus", "4"], message)


def test_a_killed_rank_ends_all_and_the_run_resumes(tiny_folder: Path, tmp_path: Path) -> None:
    """The other ends within 10 s, with one line; the resumed run has the bytes of a whole one."""

    def train(run: Path, *more: str) -> list[str]:
        return ["train", str(tiny_folder), "--run", str(run), *more]

    whole, run = tmp_path / "whole", tmp_path / "run"
    assert wait(start_ranks(2, lambda _: cli.main(train(whole, *OFTEN_SAVED)), tmp_path / "a")) == [0, 0]
    assert printed(tmp_path / "a") == [] and len(printed(tmp_path / "a", "out")) > 5
    processes = start_ranks(2, lambda _: cli.main(train(run, *OFTEN_SAVED)), tmp_path / "b")
    until = time.monotonic() + 60
    while not has_checkpoint(run) and time.monotonic() < until:
        time.sleep(0.005)
    assert processes[1].pid is not None
    os.kill(processes[1].pid, signal.SIGKILL)
    killed = time.monotonic()
    assert wait(processes) == [3, -signal.SIGKILL] and time.monotonic() - killed < 10
    (line,) = printed(tmp_path / "b")
    expected = "rank 0: the connection to another rank is lost; --resume continues from the last checkpoint"
    assert line == f"nexwarp: error: {expected}" and not (run / MODEL_FILE).exists()
    resumed = start_ranks(2, lambda _: cli.main(train(run, "--device", "cpu", "--resume")), tmp_path / "c")
    assert wait(resumed) == [0, 0] and printed(tmp_path / "c") == []
    assert (run / MODEL_FILE).read_bytes() == (whole / MODEL_FILE).read_bytes()


def test_ranks_save_by_the_clock_of_the_first(tiny_folder: Path, tmp_path: Path) -> None:
    """Looking at the clock takes 20 s on it: the tenths that it saves are every second one. The other's is faster."""

    def work(rank: int) -> int:
        saved: list[int] = []
        save = nw.Trainer.save_checkpoint

        def note(trainer: nw.Trainer, run: Path) -> None:
            saved.append(trainer.iteration)
            (tmp_path / f"{rank}.json").write_text(json.dumps(saved))
            save(trainer, run)

        patch = pytest.MonkeyPatch()  # of a process that ends
        patch.setattr(nw.Trainer, "save_checkpoint", note)
        patch.setattr(session, "monotonic", itertools.count(step=(20, 1000)[rank]).__next__)
        return cli.main(["train", str(tiny_folder), "--run", str(tmp_path / "run"), *TRAIN])

    assert wait(start_ranks(2, work, tmp_path / "ranks")) == [0, 0], printed(tmp_path / "ranks")
    saved = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    assert saved == [[4, 8, 12, 16, 20, 24]] * 2


def test_many_gradients_are_summed_after_the_graph() -> None:
    """61 numbers a surfel less its error are 60; the grid counts only where hits are textured."""
    surfels, texture = make_surfels(random_scene(3)), nw.NeuralTexture(levels=2, table_size=2**10, features=4)
    ours = sum(x.numel() for x in texture.parameters())
    most = (MOST_CAPTURED_BYTES // 4 - ours) // 60
    for count, beside in ((most, False), (most + 1, True)):
        config = Config(max_surfels=count)
        assert sums_beside("nccl", surfels, texture, config) is beside and sums_beside("gloo", surfels, texture, config)
    assert not sums_beside("nccl", surfels, texture, Config(max_surfels=most + 1, max_hits=0))
