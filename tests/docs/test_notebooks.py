"""What the notebooks keep is what their code gives; `.ci/run` executes them whole."""

import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from notebooks.__main__ import FOLDER, NAMES, execute, pictures, sources

ROOT = FOLDER.parent
HERE = re.compile(r"/(home|root|tmp|work|Users)/")


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_kept_and_those_of_the_cells(name: str) -> None:
    """`python -m notebooks NAME` makes them anew."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata["sources"] == sources(notebook), "cells were changed after the last execution"
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert sum(pictures(notebook)) >= 3
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error" and output.get("name") != "stderr"
        text = output.get("text", "") + output.get("data", {}).get("text/plain", "")
        assert not HERE.search(text), f"a path of one machine: {text}"


def test_the_first_cell_finds_the_helper_from_any_folder(tmp_path: Path) -> None:
    """It is the same in all notebooks."""
    notebooks = [nbformat.read(FOLDER / f"{name}.ipynb", as_version=4) for name in NAMES]
    (setup,) = {next(cell.source for cell in notebook.cells if cell.cell_type == "code") for notebook in notebooks}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for folder in (tmp_path, ROOT, FOLDER):
        # It is only looked for: an import takes 4 s, and the notebooks import it.
        command = [sys.executable, "-c", f"{setup}\nprint(importlib.util.find_spec('figures').origin)"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert (done.stdout, done.stderr) == (f"{FOLDER / 'figures.py'}\n", ""), folder


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
