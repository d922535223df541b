import re

import nbformat
import pytest

from notebooks.__main__ import FOLDER, NAMES, pictures, sources

HERE = re.compile(r"/(home|root|tmp|work|Users)/")


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_kept_and_those_of_the_cells(name: str) -> None:
    """`python -m notebooks NAME` makes them anew."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata["sources"] == sources(notebook), "cells were changed after the last execution"
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)) and sum(pictures(notebook)) >= 3
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error" and output.get("name") != "stderr"
        text = output.get("text", "") + output.get("data", {}).get("text/plain", "")
        assert not HERE.search(text), f"a path of one machine: {text}"
