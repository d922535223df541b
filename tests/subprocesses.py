"""The processes that tests start: of this Python, which imports from this checkout first."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def environment(**changes: str) -> dict[str, str]:
    """The variables of a process, some of them changed."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return os.environ | {"PYTHONPATH": path} | changes


def run_python(*arguments: object, timeout: float | None = None, **changes: str) -> subprocess.CompletedProcess[str]:
    """Run Python to its end; what it prints is kept."""
    words = [sys.executable, *map(str, arguments)]
    return subprocess.run(words, cwd=ROOT, env=environment(**changes), capture_output=True, text=True, timeout=timeout)
