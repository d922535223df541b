"""The notebooks run from clean in their short form, and what they keep is what their code gives."""

import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from notebooks.__main__ import FOLDER, NAMES, execute

ROOT = FOLDER.parent
LARGEST = 3_000_000  # bytes, of the whole folder
HERE = re.compile(r"/(home|root|tmp|work|Users)/")


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def pictures(notebook: nbformat.NotebookNode) -> list[int]:
    """How many pictures each cell gives."""
    return [sum("data" in output for output in cell.outputs) for cell in code_cells(notebook)]


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_short_form_runs_from_clean(name: str, tmp_path: Path) -> None:
    """Its own assertions hold, nothing is warned of, and every figure of the kept form is drawn."""
    command = [sys.executable, "-m", "notebooks", "--short", "--out", str(tmp_path), name]
    done = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=540)
    assert done.returncode == 0, done.stderr
    kept, run = (nbformat.read(where / f"{name}.ipynb", as_version=4) for where in (FOLDER, tmp_path))
    assert [cell.source for cell in kept.cells] == [cell.source for cell in run.cells]
    assert pictures(kept) == pictures(run)
    assert sum(pictures(run)) >= 3


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_kept(name: str) -> None:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error" and output.get("name") != "stderr"
        text = output.get("text", "") + output.get("data", {}).get("text/plain", "")
        assert not HERE.search(text), f"a path of one machine: {text}"


def test_the_first_cell_finds_the_helper_from_any_folder(tmp_path: Path) -> None:
    """It is the same in all notebooks."""
    first = {code_cells(nbformat.read(FOLDER / f"{name}.ipynb", as_version=4))[0].source for name in NAMES}
    (setup,) = first
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for folder in (tmp_path, ROOT, FOLDER):
        # It is only looked for: an import takes 4 s, and the notebooks import it.
        command = [sys.executable, "-c", f"{setup}\nprint(importlib.util.find_spec('figures').origin)"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert (done.stdout, done.stderr) == (f"{FOLDER / 'figures.py'}\n", ""), folder


def test_folder_is_small() -> None:
    assert sum(path.stat().st_size for path in FOLDER.glob("*.ipynb")) < LARGEST


@pytest.mark.parametrize("source", ["assert 1 == 2", "import warnings; warnings.warn('old')"])
def test_failure_or_warning_keeps_the_old_outputs(source: str, tmp_path: Path) -> None:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    notebook.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
    path = tmp_path / "a.ipynb"
    nbformat.write(notebook, path)
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match=r"a\.ipynb"):
        execute(path, path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
