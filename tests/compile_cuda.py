"""Compiles kernels for CUDA, GPU or not: NVRTC comes with Warp.

python -m tests.compile_cuda 90 usual FOLDER      # prints the size of the machine code by module, as JSON
"""

import importlib
import inspect
import itertools
import json
import pkgutil
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

import nexwarp.kernels
from nexwarp.kernels.types import MAX_HITS, PerReal, types

Values = dict[str, tuple[Any, ...]]

# What the factories in nexwarp.kernels are called with, by the name of their parameters: each of their branches. The
# first values are those that nested branches need.
VALUES: Values = {
    "real": (wp.float32,),
    "storage": (wp.float16,),
    "dtype": (wp.float32, types(wp.float32).vec3, types(wp.float32).vec4),
    "max_hits": (2, 0),
    "features": (2, 8),
    "clamp": (False, True),
    "with_errors": (True, False),
    "fixed_point": (False, True),
    "by_place": (False,),  # True is for CPUs
    "wide": (True, False),
    "outputs": (64,),
    "inputs": (32,),
    "rectified": (False, True),
    "layers": (1, 4),
    "cards": (True, False),
    "cut": (True, False),
    "backward": (False, True),
}
ALL = VALUES | {"max_hits": tuple(range(MAX_HITS + 1)), "features": (1, 2, 4, 8)}
# Their atomics depend on the architecture.
ATOMIC = ("hashgrid", "fused_scatter")


def combinations(names: Iterable[str], values: Values, every: bool) -> Iterator[dict[str, Any]]:
    """Yield every combination of values, or those that differ from the first values in at most one name."""
    lists = {name: values[name] for name in names}
    for chosen in itertools.product(*lists.values()):
        if every or sum(value != all_of[0] for value, all_of in zip(chosen, lists.values(), strict=True)) <= 1:
            yield dict(zip(lists, chosen, strict=True))


def made_by(factory: Any, values: Values, every: bool) -> Iterator[wp.Kernel]:
    """Yield the kernels that a factory makes."""
    for chosen in combinations(inspect.signature(factory).parameters, values, every):
        made = factory(**chosen)
        members = [made] if isinstance(made, wp.Kernel) else vars(made).values()
        yield from (member for member in members if isinstance(member, wp.Kernel))


def kernels(choice: str) -> Iterator[wp.Kernel]:
    """Yield the kernels of the modules of nexwarp.kernels: "all", "usual" (each branch once), "atomic"."""
    for info in pkgutil.iter_modules(nexwarp.kernels.__path__):
        if choice == "atomic" and info.name not in ATOMIC:
            continue
        module = importlib.import_module(f"nexwarp.kernels.{info.name}")
        every = choice == "all"
        values = ALL if every else VALUES
        if info.name.startswith("fused"):
            values = values | {"features": (2, 4)}
        for name, member in vars(module).items():
            if getattr(member, "__module__", None) != module.__name__:
                continue
            if isinstance(member, wp.Kernel):
                yield member
            elif isinstance(member, PerReal) and member.names is not None:
                yield from (member(wp.float32, **chosen) for chosen in combinations(member.names, values, every))
            elif name.endswith(("_kernel", "_kernels")):
                yield from made_by(member, values, every)


def compile_for(arch: int, chosen: list[wp.Kernel], folder: Path) -> dict[str, int]:
    """Return bytes of machine code by module."""

    def compile_one(kernel: wp.Kernel) -> int:
        where = folder / kernel.module.name
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=str(where), strip_hash=True, use_ptx=False)
        return sum(path.stat().st_size for path in where.glob("*.cubin"))

    with ThreadPoolExecutor(2) as pool:
        return dict(zip((kernel.module.name for kernel in chosen), pool.map(compile_one, chosen), strict=True))


if __name__ == "__main__":
    arch, choice, folder = sys.argv[1:]
    wp.config.log_level = wp.LOG_ERROR
    chosen = list({kernel.module.name: kernel for kernel in kernels(choice)}.values())
    print(json.dumps(compile_for(int(arch), chosen, Path(folder))))
