"""Which folders may become a run, and what of a run is never overwritten unasked."""

import os
import shutil

import pytest

from nexwarp.cli import main as cli
from tests.cli.support import FLAGS, RUN_FILES, read, refused, snapshot

pytestmark = pytest.mark.usefixtures("small_preset")


def test_existing_run_is_refused_and_untouched(finished, scene, capsys):
    before = snapshot(finished)
    command = ["train", str(scene), "--run", str(finished), *FLAGS]
    refused(capsys, command, str(finished), "exists", "--resume or --overwrite")
    refused(capsys, [*command, "--resume", "--overwrite"], "--resume, --overwrite", "at most one")
    for flag, value in (
        ("--iterations", "40"),
        ("--max-surfels", "99"),
        ("--max-hits", "1"),
        ("--seed", "5"),
        ("--downscale", "2"),
        ("--images", "images_2"),
        ("--preset", "paper"),
    ):
        refused(capsys, [*command, "--resume", flag, value], flag, "as in the run to resume", f"got {value}")
    assert snapshot(finished) == before


def test_bad_input_does_not_overwrite(finished, tmp_path, capsys):
    before = snapshot(finished)
    refused(capsys, ["train", str(tmp_path / "no"), "--run", str(finished), *FLAGS, "--overwrite"], "no such folder")
    assert snapshot(finished) == before


def test_overwrite_replaces_a_run(finished, scene):
    (finished / "renders" / "old.png").touch()
    command = ["train", str(scene), "--run", str(finished), *FLAGS, "--iterations", "1", "--overwrite"]
    assert cli.main(command) == 0
    assert {f.name for f in finished.iterdir()} == RUN_FILES - {"checkpoint.old"} and not (
        finished / "renders" / "old.png"
    ).exists()
    assert read(finished, "metrics.json")["iterations"] == 1


def test_overwrite_refuses_what_is_no_run(scene, tmp_path, capsys):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.tex").write_text("years of work")
    file = tmp_path / "file"
    file.write_text("a file")
    for place in (precious, file):
        command = ["train", str(scene), "--run", str(place), *FLAGS, "--overwrite"]
        refused(capsys, command, str(place), "expected a run folder to overwrite", "config.json")
    assert snapshot(precious) == {"thesis.tex": b"years of work"} and file.read_text() == "a file"


def test_an_empty_folder_may_become_a_run(scene, tmp_path):
    (tmp_path / "run").mkdir()
    assert cli.main(["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS, "--iterations", "1"]) == 0


@pytest.mark.parametrize("command", ["eval", "render", "info"])
def test_no_run_there(command, tmp_path, capsys):
    refused(capsys, [command, str(tmp_path / "no")], str(tmp_path / "no"), "a run folder")
    assert os.listdir(tmp_path) == []


def test_a_run_may_not_replace_its_own_scene(scene, tmp_path, capsys):
    folder = tmp_path / "holds"
    shutil.copytree(scene, folder / "scene")
    (folder / "config.json").write_text("{}")
    assert cli.main(["train", str(folder / "scene"), "--run", str(folder), "--overwrite"]) == 2
    assert "--run: expected a folder that does not contain the scene" in capsys.readouterr().err
    assert (folder / "scene" / "images").is_dir()
