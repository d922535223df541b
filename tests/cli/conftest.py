"""A scene, a finished run of it, and a check of what the command line refuses."""

import shutil
from pathlib import Path

import pytest

from nexwarp.cli import main as cli
from tests.cli.support import FLAGS


@pytest.fixture(scope="module", autouse=True)
def small_runs(small_preset: None) -> None:
    """All runs are short and small."""


@pytest.fixture(scope="module")
def scene(tiny_folder: Path) -> Path:
    return tiny_folder


@pytest.fixture(scope="module")
def trained(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "nested" / "tiny"
    assert cli.main(["train", str(scene), "--run", str(run), *FLAGS]) == 0
    return run


@pytest.fixture
def finished(trained: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be worked on."""
    return Path(shutil.copytree(trained, tmp_path / "run"))
