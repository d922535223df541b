"""The notebooks' code runs as it stands, on a tiny run of the demo."""

import json
from pathlib import Path

import pytest
import torch

from nexwarp import cli, config

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with runs/demo in it, trained for a few steps."""
    folder = tmp_path_factory.mktemp("notebooks")
    flags = ["--iterations", "5", "--max-surfels", "100", "--device", "cpu"]
    assert cli.main(["train", "demo", "--run", str(folder / "runs" / "demo"), *flags]) == 0
    return folder


@pytest.mark.parametrize("notebook", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_runs(notebook: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    cells = json.loads(notebook.read_text())["cells"]
    namespace: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), namespace)
    assert torch.isfinite(namespace["out"].image).all()
    assert config.MIN_SURFELS <= len(namespace["model"].surfels) <= 100
