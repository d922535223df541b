import json
import shutil
from pathlib import Path

import pytest

from nexwarp.cli import main as cli
from nexwarp.data import load_scene
from nexwarp.run.folder import read_run
from nexwarp.train.optimizer import set_rates
from nexwarp.train.trainer import Trainer
from tests.cli.support import read


@pytest.fixture(scope="module")
def extended(trained: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 20 iterations, continued to 30."""
    run = Path(shutil.copytree(trained, tmp_path_factory.mktemp("extended") / "run"))
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume", "--iterations", "30"]) == 0
    return run


def test_a_finished_run_goes_on(extended: Path, scene: Path) -> None:
    assert read_run(extended).config.iterations == 30 and read(extended, "metrics.json")["iterations"] == 30
    logged = [json.loads(line)["iteration"] for line in (extended / "metrics.jsonl").read_text().splitlines()]
    assert logged == list(range(1, 31))
    # Finished once more, and as before, by another --resume.
    before = (extended / "model.safetensors").read_bytes()
    assert cli.main(["train", str(scene), "--run", str(extended), "--device", "cpu", "--resume"]) == 0
    assert (extended / "model.safetensors").read_bytes() == before


def test_it_is_said_and_an_interruption_changes_nothing(extended, trained, scene, tmp_path, capsys):
    """Interrupted before its first new checkpoint, an extended run is resumed without --iterations."""
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    command = ["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        assert cli.main([*command, "--iterations", "30"]) == 130
    told = capsys.readouterr().out.replace("\n", " ")
    assert "extended from 20 to 30 iterations: from here on, learning rates" in told and cli.main(command) == 0
    assert "extended" not in capsys.readouterr().out
    assert (run / "model.safetensors").read_bytes() == (extended / "model.safetensors").read_bytes()


def test_its_schedules_are_those_of_the_longer_run(trained: Path, scene: Path) -> None:
    config = read_run(trained).config
    longer = type(config)(**{**vars(config), "iterations": 30})
    trainer = Trainer(load_scene(scene), longer, "cpu")
    with pytest.raises(ValueError, match="its settings are others"):
        trainer.restore(trained)
    trainer.restore(trained, extend=True)
    assert trainer.iteration == 20
    trainer.step()
    rates = [group["lr"] for group in trainer.optimizer.param_groups]
    set_rates(trainer.optimizer, 21, 30)
    assert rates == [group["lr"] for group in trainer.optimizer.param_groups]
    assert trainer.densifier.config == Trainer(load_scene(scene), longer, "cpu").densifier.config
