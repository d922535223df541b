"""Environments of the processes that tests start."""

import os
from pathlib import Path


def python_path(root: Path) -> dict[str, str]:
    """Return the variable that lets a process import from a checkout first, then from wherever this one may."""
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))}
