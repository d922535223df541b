"""SIGKILL at random moments and in each stage of the finishing; what is resumed ends as if nothing had happened."""

import math
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nexwarp.cli import main as cli
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.run.folder import CONFIG_FILE
from nexwarp.train import recipe
from nexwarp.train.checkpoint import has_checkpoint
from nexwarp.train.finish.finish import FinishObserver
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from tests.scene_writers import expose_photos, write_demo
from tests.subprocesses import python_path

ROOT = Path(__file__).parents[2]
FLAGS = ["--iterations", "20", "--max-surfels", "100", "--checkpoint-every", "1"]
# Stages of the finishing, and numbers of views after which a kill comes; the last is that of all training views.
STAGES = ("smoothing SH", "measuring detail limits", "ordering surfels")
VIEWS = (1, 4, 8)
KILL_AT = "NEXWARP_TEST_KILL_AT"  # of a subprocess: "views stage"

SMALL = Config(texture=TextureConfig(levels=4, table_size=2**10, width=16), densify=DensifyConfig(every=3))

Moment = float | tuple[str, int]  # a share of the training's time, or a stage and how many views of it are done


def main() -> None:
    """The command line, whose default preset is a small one; it may kill itself in a stage of the finishing."""
    recipe.PRESETS["default"] = SMALL
    if KILL_AT in os.environ:
        count, stage = os.environ[KILL_AT].split(" ", 1)
        finish = Trainer.finish

        def finish_or_die(trainer: Trainer, observe: FinishObserver) -> Model:
            def watch(name: str, done: int, total: int) -> None:
                if (name, done) == (stage, int(count)):
                    os.kill(os.getpid(), signal.SIGKILL)
                observe(name, done, total)

            return finish(trainer, watch)

        Trainer.finish = finish_or_die  # type: ignore[method-assign,assignment]
    sys.exit(cli.main())


@pytest.fixture(autouse=True)
def small_preset(monkeypatch):
    monkeypatch.setitem(recipe.PRESETS, "default", SMALL)


def moments(count: int) -> list[Moment]:
    """When to kill: in the stages of the finishing in turns, at most once each, and at random moments."""
    generator = random.Random(0)
    stages = [(stage, views) for views in VIEWS for stage in STAGES][: (count + 1) // 2]
    return [*stages, *(generator.uniform(0.0, 1.0) for _ in range(count - len(stages)))]


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("device", "count"),
    [
        ("cpu", 2),
        pytest.param("cpu", 20, marks=pytest.mark.slow),
        pytest.param("cuda", 5, marks=pytest.mark.cuda),
    ],
)
def test_killed_runs_end_with_the_same_bytes(tmp_path: Path, device: str, count: int) -> None:
    scene = write_demo(tmp_path / "scene", width=48, height=36, views=10, points=200)
    expose_photos(scene)
    flags = ["--device", device, *(["--deterministic"] if device == "cuda" else [])]
    arguments = ["train", str(scene), *FLAGS, *flags]
    command = [sys.executable, "-c", "from tests.robustness.test_kills import main; main()", *arguments]
    silent = subprocess.DEVNULL
    begun = time.perf_counter()
    assert cli.main([*arguments, "--run", str(tmp_path / "whole")]) == 0
    expected, length = (tmp_path / "whole" / MODEL_FILE).read_bytes(), time.perf_counter() - begun
    in_stages = 0
    for number, moment in enumerate(moments(count)):
        run, environment, seconds = tmp_path / f"run{number}", os.environ | python_path(ROOT), math.inf
        if isinstance(moment, tuple):
            environment[KILL_AT] = f"{moment[1]} {moment[0]}"
        else:
            seconds = moment * length
        process = subprocess.Popen([*command, "--run", str(run)], env=environment, stdout=silent, stderr=silent)
        while not (run / CONFIG_FILE).is_file():
            assert process.poll() is None, "the training ended by itself"
            time.sleep(0.002)
        begun = time.perf_counter()
        while process.poll() is None and time.perf_counter() - begun < seconds:
            time.sleep(0.002)
        process.kill()
        process.wait()
        if isinstance(moment, tuple):
            assert process.returncode == -signal.SIGKILL, moment
            assert not (run / MODEL_FILE).exists() and has_checkpoint(run), moment
            in_stages += 1
        assert cli.main(["train", str(scene), "--run", str(run), "--device", device, "--resume"]) == 0, moment
        assert (run / MODEL_FILE).read_bytes() == expected, moment
    assert in_stages == min((count + 1) // 2, len(STAGES) * len(VIEWS))
