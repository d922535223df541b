import json
import shutil
from contextlib import nullcontext

import pytest

from nexwarp.cameras.nerfstudio import load_camera_path
from nexwarp.cli import main as cli
from nexwarp.cli import train
from nexwarp.errors import RunError
from nexwarp.run.folder import delete_files, keep_camera_path, list_files, locked_run
from tests.cli.support import FLAGS, RUN_FILES, read, refused, snapshot


def test_existing_run_is_refused_and_untouched(finished, scene, tmp_path, capsys):
    before = snapshot(finished)
    refused(capsys, ["train", str(tmp_path / "no"), "--run", str(finished), *FLAGS, "--overwrite"], "no such folder")
    command = ["train", str(scene), "--run", str(finished), *FLAGS]
    refused(capsys, command, str(finished), "exists", "--resume or --overwrite")
    refused(capsys, [*command, "--resume", "--overwrite"], "--resume, --overwrite", "at most one")
    other = {"--iterations": "10", "--max-surfels": "99", "--max-hits": "1", "--seed": "5", "--downscale": "2"}
    for flag, value in (other | {"--images": "images_2", "--preset": "paper"}).items():
        refused(capsys, [*command, "--resume", flag, value], flag, "as in the run to resume", f"got {value}")
    assert snapshot(finished) == before


def test_an_option_of_a_resumed_run_counts_if_it_is_its_default(finished, scene, capsys):
    """Typed, it must be that of the run; not typed, the run's holds."""
    config = read(finished, "config.json")
    config["scene"]["downscale"], config["config"]["preset"] = 2, "web"
    (finished / "config.json").write_text(json.dumps(config))
    command = ["train", str(scene), "--run", str(finished), "--device", "cpu", "--resume"]
    refused(capsys, [*command, "--downscale", "1"], "--downscale: expected 2 as in the run to resume, got 1")
    refused(capsys, [*command, "--preset=default"], "--preset: expected web as in the run to resume, got default")
    refused(capsys, [*command, "--downscale", "2"], "checkpoint")  # that of photos of another size
    refused(capsys, command, "checkpoint")


def test_overwrite_keeps_what_a_run_does_not_write(finished, scene, tmp_path, capsys):
    """Foreign files stay wherever they are, and links are not followed."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "0000.png").write_text("a picture")
    (elsewhere / "model.safetensors").write_text("weights")
    foreign = {"notes.txt", "camera_path_0.json", "renders/test/view_000.txt", "checkpoint/notes.txt"}
    foreign |= {"export/surfels.obj", "mine/model.safetensors", "mine/checkpoint/state.json"}
    for name in foreign:
        (finished / name).parent.mkdir(parents=True, exist_ok=True)
        (finished / name).write_text(name)
    for name in ("empty", "ellipse"):
        (finished / "renders" / name).mkdir()
    (finished / "renders" / "ellipse" / "0007.png").touch()
    (finished / "renders" / "spiral").symlink_to(elsewhere)
    (finished / "model.safetensors").unlink()
    (finished / "model.safetensors").symlink_to(elsewhere / "model.safetensors")
    command = ["train", str(scene), "--run", str(finished), *FLAGS, "--iterations", "3", "--checkpoint-every", "1"]
    for _ in range(2):
        capsys.readouterr()
        assert cli.main([*command, "--overwrite"]) == 0
        out = capsys.readouterr().out
        assert f"warning: {finished}: not deleted, as nexwarp did not write it: " in out and " more\n" in out
        left = snapshot(finished)
        assert {f.name for f in (finished / "renders").iterdir()} == {"test", "compare", "empty", "spiral"}
        kept = {f"checkpoint.kept_1/{n[11:]}" if n.startswith("checkpoint/") else n for n in foreign}
        assert {left[name] for name in kept} == {name.encode() for name in foreign}
        assert (finished / "renders" / "spiral").is_symlink()
        assert snapshot(elsewhere) == {"0000.png": b"a picture", "model.safetensors": b"weights"}
    mine = {"notes.txt", "camera_path_0.json", "mine", "checkpoint.kept_1", "export"}
    assert {name.split("/")[0] for name in left} == RUN_FILES | mine


@pytest.mark.parametrize(
    "config",
    ['{"hidden_size": 4096}', "[]", '{"scene": {"path": "demo"', None],
    ids=["another", "list", "damaged", "none"],
)
def test_overwrite_refuses_what_is_no_run(scene, tmp_path, capsys, config):
    precious, file = tmp_path / "precious", tmp_path / "file"
    precious.mkdir()
    if config is not None:
        (precious / "config.json").write_text(config)
    (precious / "model.safetensors").write_text("years of training")
    file.write_text("a file")
    before = snapshot(tmp_path)
    words = ["expected a run folder to overwrite", "config.json", "nothing was deleted"]
    for place in (precious, file):
        refused(capsys, ["train", str(scene), "--run", str(place), *FLAGS, "--overwrite"], str(place), *words)
    assert snapshot(tmp_path) == before


def test_the_lock_is_free_while_a_viewer_shows_the_result(scene, tmp_path, monkeypatch):
    """Others may evaluate the run then; during the training they may not."""
    shown = []

    class Viewer:
        def between_steps(self, *_: object) -> None:
            with pytest.raises(RunError, match="no other process writes"), locked_run(tmp_path / "run"):
                pass

        def finish(self, *_: object) -> None:
            with locked_run(tmp_path / "run"):
                shown.append(True)

    monkeypatch.setattr(train.Train, "_viewer", lambda *_: nullcontext(Viewer()))
    monkeypatch.setattr(train, "show_until_interrupted", lambda *_: None)
    assert cli.main(["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS, "--iterations", "1"]) == 0
    assert shown


def test_all_files_of_a_run_are_known(finished, scene, tmp_path):
    """Whatever a command writes to a run folder, `--overwrite` knows as ours."""
    paths = tmp_path / "tour.json"
    for command in (
        ["train", str(scene), "--run", str(finished), *FLAGS, "--overwrite", "--tensorboard"],
        ["eval", str(finished), "--device", "cpu"],
        ["export", str(finished)],
        ["export", str(finished), "--format", "cameras"],
        ["render", str(finished), "--set", "all", "--buffers", "--device", "cpu"],
        ["render", str(finished), "--path", "ellipse", "--frames", "2", "--buffers", "--device", "cpu"],
        ["render", str(finished), "--path", "interpolate", "--frames", "2", "--device", "cpu"],
        ["render", str(finished), "--path", str(paths), "--device", "cpu"],
    ):
        if str(paths) in command:
            shutil.copy(finished / "export" / "camera_path.json", paths)
        assert cli.main(command) == 0
    keep_camera_path(finished, load_camera_path(finished / "export" / "camera_path.json").cameras)
    (finished / "diverged.json").touch()
    own, foreign = list_files(finished)
    assert foreign == [] and set(own) == snapshot(finished).keys()
    assert {"renders/train/view_001.exr", "renders/path_tour/0000.png", "camera_path_1.json"} <= set(own)
    delete_files(finished, own)
    assert list(finished.iterdir()) == []


def test_a_run_may_not_replace_its_own_scene(scene, tmp_path, capsys):
    folder = tmp_path / "holds"
    shutil.copytree(scene, folder / "scene")
    (folder / "config.json").write_text("{}")
    assert cli.main(["train", str(folder / "scene"), "--run", str(folder), "--overwrite"]) == 2
    assert "--run: expected a folder that does not contain the scene" in capsys.readouterr().err
    assert (folder / "scene" / "images").is_dir()
