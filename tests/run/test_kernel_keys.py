"""Keys of kernels, by which Warp finds what it has compiled."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
import warp as wp

from nexwarp.kernels import launch as launching
from nexwarp.train.recipe import PRESETS, Config
from tests.rehearsal import rehearse

CPU = torch.device("cpu")

SETTINGS = PRESETS | {"no texture": Config(max_hits=0), "poses": Config(refine_poses=True)}
SETTINGS |= {"deterministic": Config(deterministic=True)}


@pytest.mark.parametrize("name", SETTINGS)
def test_keys_of_kernels_do_not_depend_on_what_was_compiled_before(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Constants in a loop are known once code is generated; Warp does that before the key if the kernel has some.

    If only a function has some, they are in the key where another kernel with it was compiled before, and not else.
    """
    kernels: dict[str, wp.Kernel] = {}
    launch = launching.launch

    def note(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> None:
        kernels[kernel.key] = kernel
        launch(kernel, *args, **kwargs)

    def late(adjoint: Any) -> Iterator[str]:
        for function in adjoint.get_references()[2]:
            if not function.is_builtin():
                if function.adj.has_unresolved_static_expressions:
                    yield function.key
                yield from late(function.adj)

    monkeypatch.setattr(launching, "launch", note)
    rehearse(SETTINGS[name], CPU)
    assert len(kernels) > 15
    plain = [kernel for kernel in kernels.values() if not kernel.adj.has_unresolved_static_expressions]
    assert not {kernel.key: functions for kernel in plain if (functions := [*late(kernel.adj)])}
