"""Launches on a GPU by commands that are made once: each has its own arguments, and keeps none of them."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import torch
import warp as wp

from nexwarp.ops._interop import array, launch
from tests.command_kernels import scaled_sum


def run(
    a: torch.Tensor,
    b: torch.Tensor | None,
    shift: tuple[int, int] = (0, 0),
    scale: float = 1.0,
    negate: bool = False,
) -> torch.Tensor:
    out = torch.full_like(a, torch.nan)
    arrays = [array(x, wp.float32) for x in (a, b, out)]
    launch(a, scaled_sum, len(a), [*arrays[:2], wp.vec2i(*shift), scale, negate], [arrays[2]])
    return out


def expected(
    a: torch.Tensor,
    b: torch.Tensor | None,
    shift: tuple[int, int] = (0, 0),
    scale: float = 1.0,
    negate: bool = False,
) -> torch.Tensor:
    x = scale * a + (shift[0] + 10 * shift[1]) + (0.0 if b is None else b)
    return -x if negate else x


def test_each_launch_has_its_own_arguments(device: torch.device) -> None:
    a, b, c = (torch.randint(100, (n,), device=device).float() for n in (1000, 1000, 333))
    calls: list[tuple[torch.Tensor, torch.Tensor | None, tuple[int, int], float, bool]] = [
        (a, b, (1, 2), 2.0, False),
        (a, None, (3, 4), 0.5, True),
        (c, None, (0, 0), 3.0, False),
        (b, a, (5, 6), 2, True),
        (c, c, (-7, 8), -4.0, False),
    ]
    for call in (*calls, *reversed(calls)):
        assert torch.equal(run(*call), expected(*call))


def test_strides_count(device: torch.device) -> None:
    a = torch.arange(40.0, device=device)
    assert torch.equal(run(a[::2], a[1::2]), expected(a[::2], a[1::2]))
    assert torch.equal(run(a[:20], a[20:]), expected(a[:20], a[20:]))


def test_threads_do_not_mix_arguments_up(device: torch.device) -> None:
    def many(seed: int) -> bool:
        a = torch.full((100 + seed,), float(seed), device=device)
        return all(torch.equal(run(a, None, (k, seed)), expected(a, None, (k, seed))) for k in range(50))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(many, range(8)))


def test_nothing_is_kept(device: torch.device) -> None:
    a, b = torch.ones(64, device=device), torch.ones(64, device=device)
    kept = [weakref.ref(x) for x in (a, b)]
    run(a, b)
    del a, b
    gc.collect()
    assert [x() for x in kept] == [None, None]
