"""Data flows one way: a module may import only from layers below its own. And importing is cheap."""

import ast
import re
from pathlib import Path

from tests.subprocesses import run_python

ROOT = Path(__file__).parents[2] / "nexwarp"
# The one list of layers, from the top to the bottom, is in CONTRIBUTING.md.
(BLOCK,) = re.findall(r"```layers\n(.*?)```", (ROOT.parent / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.S)
LAYERS = [line.split() for line in reversed(BLOCK.splitlines())]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
EXEMPT = {"__init__", "__main__"}
PURE = set("warp __future__ ctypes math collections functools concurrent os threading typing dataclasses".split())
PURE |= {"types", "contextlib"}
MOST_ROOMS, MOST_ARROWS = 17, 80  # benchmarks and notebooks are two of the rooms
MOST_OF_TRAINER = 18  # modules of ours that the trainer imports


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


def test_the_list_of_layers_is_that_of_the_rooms() -> None:
    rooms = {path.stem if path.is_file() else path.name for path in ROOT.iterdir() if path.name != "__pycache__"}
    rooms -= EXEMPT | {"py"}
    assert set(RANK) == rooms and len(rooms) + len({"benchmarks", "notebooks"}) <= MOST_ROOMS


def test_imports_point_downwards() -> None:
    arrows = set()
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
                arrows.add((here, there))
    assert len({arrow for arrow in arrows if arrow[0] != arrow[1]}) <= MOST_ARROWS


def test_the_trainer_imports_few_modules() -> None:
    ours = {name for name in imported_modules(ROOT / "train" / "trainer.py") if name.startswith("nexwarp.")}
    files = {name.replace(".", "/") for name in ours}
    modules_of_ours = {name if (ROOT.parent / f"{name}.py").is_file() else name.rpartition("/")[0] for name in files}
    assert len(modules_of_ours) <= MOST_OF_TRAINER, sorted(modules_of_ours)


def test_types_say_something() -> None:
    """Outside kernels: few `Any`, and no SimpleNamespace."""
    rooms = [path for path in ROOT.rglob("*.py") if path.relative_to(ROOT).parts[0] not in ("kernels", "native")]
    nodes = [node for path in rooms for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    names = [node.id for node in nodes if isinstance(node, ast.Name)]
    assert names.count("Any") <= 60 and "SimpleNamespace" not in names


def test_kernels_are_pure_warp() -> None:
    for path in [*(ROOT / "kernels").rglob("*.py"), *(ROOT / "native").rglob("*.py")]:
        for dotted in imported_modules(path):
            pure = dotted.split(".")[0] in PURE or dotted.startswith(("nexwarp.kernels", "nexwarp.native"))
            assert pure, f"{path}: imports {dotted}"


def test_import_is_quick_and_compiles_nothing(tmp_path: Path) -> None:
    program = "import time, torch; start = time.process_time(); import nexwarp; print(time.process_time() - start)"
    seconds: list[float] = []
    while len(seconds) < 3 and not any(taken <= 1.5 for taken in seconds):
        run = run_python("-c", program, WARP_CACHE_PATH=str(tmp_path))
        seconds.append(float(run.stdout.splitlines()[-1]))
    assert min(seconds) <= 1.5, f"import nexwarp took {seconds} s beyond import torch"
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


USES = """
import sys
import nexwarp as nw

from nexwarp.train.recipe import TextureConfig

scene, shape = nw.load_scene(sys.argv[1]), TextureConfig(table_size=2**10)
trainer = nw.Trainer(scene, nw.Config(iterations=2, max_surfels=50, texture=shape), "cpu")
trainer.run()
trainer.finish().save(sys.argv[2])
nw.load(sys.argv[2]).render(scene.test[0].camera)
print([name for name in sys.modules if name.startswith("torch._dynamo") or name.startswith("sympy")])
"""


def test_training_and_loading_import_no_compiler_of_torch(tiny_folder: Path, tmp_path: Path) -> None:
    """It takes 0.6 to 1.2 s, at the start of every command."""
    run = run_python("-c", USES, tiny_folder, tmp_path / "model")
    assert run.stdout.splitlines()[-1:] == ["[]"], run.stdout + run.stderr
