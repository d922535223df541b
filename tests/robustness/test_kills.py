"""SIGKILL in a step and in each stage of the finishing; what is resumed ends as if nothing had happened."""

import os
import signal
import sys
from pathlib import Path

import pytest

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.train import recipe
from nexwarp.train.checkpoint import has_checkpoint
from nexwarp.train.finish import FinishObserver
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from tests.scene_writers import expose_photos, write_demo
from tests.subprocesses import run_python

pytestmark = pytest.mark.usefixtures("small_preset")

FLAGS = ["--iterations", "20", "--max-surfels", "100", "--checkpoint-every", "1"]
SMALL = Config(texture=TextureConfig(levels=4, table_size=2**10, width=16), densify=DensifyConfig(every=3))
# When a kill comes: after so many steps, or views of a stage of the finishing, up to all training views.
STAGES = ("training", "smoothing SH", "measuring detail limits")
MOMENTS = [(stage, count) for count in (4, 2, 8) for stage in STAGES]


def main(stage: str, count: int, arguments: list[str]) -> None:
    """The command line, whose default preset is a small one, and which kills itself."""
    recipe.PRESETS["default"] = SMALL
    finish, step = nw.Trainer.finish, nw.Trainer.step

    def die(name: str, done: int) -> None:
        if (name, done) == (stage, count):
            os.kill(os.getpid(), signal.SIGKILL)

    def step_or_die(trainer: nw.Trainer) -> nw.StepReport:
        report = step(trainer)
        die("training", trainer.iteration)
        return report

    def finish_or_die(trainer: nw.Trainer, observe: FinishObserver) -> nw.Model:
        def watch(name: str, done: int, total: int) -> None:
            die(name, done)
            observe(name, done, total)

        return finish(trainer, watch)

    nw.Trainer.finish, nw.Trainer.step = finish_or_die, step_or_die  # type: ignore[method-assign,assignment]
    sys.exit(cli.main(arguments))


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("device", "count"),
    [
        ("cpu", 2),
        pytest.param("cpu", len(MOMENTS), marks=pytest.mark.slow),
        pytest.param("cuda", 5, marks=pytest.mark.cuda),
    ],
)
def test_killed_runs_end_with_the_same_bytes(tmp_path: Path, device: str, count: int) -> None:
    scene = write_demo(tmp_path / "scene", width=48, height=36, views=10, points=200)
    expose_photos(scene)
    flags = ["--device", device, *(["--deterministic"] if device == "cuda" else [])]
    arguments = ["train", str(scene), *FLAGS, *flags]
    assert cli.main([*arguments, "--run", str(tmp_path / "whole")]) == 0
    expected = (tmp_path / "whole" / MODEL_FILE).read_bytes()
    for moment in MOMENTS[:count]:
        run = tmp_path / f"{moment[0]} {moment[1]}"
        call = (*moment, [*arguments, "--run", str(run)])
        done = run_python("-c", f"from tests.robustness.test_kills import main; main(*{call})")
        assert done.returncode == -signal.SIGKILL, (moment, done.stderr)
        assert not (run / MODEL_FILE).exists() and has_checkpoint(run), moment
        assert cli.main(["train", str(scene), "--run", str(run), "--device", device, "--resume"]) == 0, moment
        assert (run / MODEL_FILE).read_bytes() == expected, moment
