"""Data flows one way: a module may import only from layers below its own. And importing is cheap."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

LAYERS = [
    {"checks", "determinism", "errors"},
    {"kernels"},
    {"camera", "io", "ops", "tape"},
    {"cameras", "data", "representation"},
    {"render"},
    {"model"},
    {"buffers"},
    {"finish"},
    {"train"},
    {"run", "sfm", "viewer"},
    {"cli"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
EXEMPT = {"__init__", "__main__"}
PURE = {
    "math",
    "collections",
    "functools",
    "concurrent",
    "os",
    "typing",
    "dataclasses",
    "types",
    "contextlib",
}
ROOT = Path(__file__).parents[1] / "nexwarp"

TIMED_IMPORT = """
import time, torch
start = time.perf_counter()
import nexwarp
print(time.perf_counter() - start)
"""


def imported_modules(path: Path) -> set[str]:
    """Return every dotted name that a file imports, at any nesting depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_imports_point_downwards() -> None:
    for path in sorted(ROOT.rglob("*.py")):
        here = path.relative_to(ROOT).with_suffix("").parts[0]
        if here in EXEMPT:
            continue
        assert here in RANK, f"{path}: in no layer"
        for dotted in imported_modules(path):
            root, _, rest = dotted.partition(".")
            if root == "nexwarp":
                there = rest.split(".")[0]
                assert there in RANK, f"{path}: imports {dotted}, which is in no layer"
                assert here == there or RANK[there] < RANK[here], f"{path}: imports {dotted}"


def test_kernels_are_pure_warp() -> None:
    for path in sorted((ROOT / "kernels").rglob("*.py")):
        for dotted in imported_modules(path):
            root = dotted.split(".")[0]
            pure = root in PURE | {"__future__", "warp"} or dotted.startswith("nexwarp.kernels")
            assert pure, f"{path}: imports {dotted}"


@pytest.fixture(scope="module")
def fresh_imports(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[float], list[Path]]:
    """Seconds of three imports in fresh processes, and the files they left in an empty Warp cache."""
    cache = tmp_path_factory.mktemp("warp")
    command = [sys.executable, "-c", TIMED_IMPORT]
    environment = os.environ | {"WARP_CACHE_PATH": str(cache)}
    seconds = []
    for _ in range(3):
        run = subprocess.run(command, env=environment, cwd=ROOT.parent, capture_output=True, text=True, check=True)
        seconds.append(float(run.stdout.splitlines()[-1]))
    return seconds, [path for path in cache.rglob("*") if path.is_file()]


def test_import_is_quick(fresh_imports: tuple[list[float], list[Path]]) -> None:
    seconds, _ = fresh_imports
    assert min(seconds) <= 1.5, f"import nexwarp took {seconds} s beyond import torch"


def test_import_compiles_nothing(fresh_imports: tuple[list[float], list[Path]]) -> None:
    _, files = fresh_imports
    assert not files
