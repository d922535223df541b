"""Launches on a GPU by commands that are made once: each has its own arguments, and keeps none of them."""

import gc
import threading
import weakref
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import torch
import warp as wp

from nexwarp.kernels.launch import _loading as loading
from nexwarp.ops._interop import array, launch
from tests.warp_kernels import scaled_sum


class Call(NamedTuple):
    """Arguments of `scaled_sum`."""

    a: torch.Tensor
    b: torch.Tensor | None = None
    shift: tuple[int, int] = (0, 0)
    scale: float = 1.0
    negate: bool = False

    def run(self) -> torch.Tensor:
        out = torch.full_like(self.a, torch.nan)
        arrays = [array(x, wp.float32) for x in (self.a, self.b, out)]
        launch(self.a, scaled_sum, len(out), [*arrays[:2], wp.vec2i(*self.shift), self.scale, self.negate], arrays[2:])
        return out

    def right(self) -> bool:
        x = self.scale * self.a + (self.shift[0] + 10 * self.shift[1]) + (0.0 if self.b is None else self.b)
        return torch.equal(self.run(), -x if self.negate else x)


def test_each_launch_has_its_own_arguments(device: torch.device) -> None:
    a, b, c = (torch.randint(100, (n,), device=device).float() for n in (1000, 1000, 333))
    even, odd = torch.arange(40.0, device=device).view(-1, 2).unbind(-1)  # strided
    calls = [Call(a, b, (1, 2), 2.0), Call(a, None, (3, 4), 0.5, True), Call(c, None, (0, 0), 3.0)]
    calls += [Call(even, odd), Call(b, a, (5, 6), 2, True), Call(c, c, (-7, 8), -4.0)]
    assert all(call.right() for call in (*calls, *reversed(calls)))


def test_threads_do_not_mix_arguments_up(device: torch.device) -> None:
    def many(seed: int) -> bool:
        a = torch.full((100 + seed,), float(seed), device=device)
        return all(Call(a, None, (k, seed)).right() for k in range(50))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(many, range(8)))


def test_nothing_is_kept(device: torch.device) -> None:
    a, b = torch.ones(64, device=device), torch.ones(64, device=device)
    kept = [weakref.ref(x) for x in (a, b)]
    Call(a, b).run()
    del a, b
    gc.collect()
    assert [x() for x in kept] == [None, None]


def test_a_launch_waits_for_a_load_that_has_begun_and_cancels_another() -> None:
    begun, waiting = Future[None](), Future[None]()
    begun.set_running_or_notify_cancel()
    timer = threading.Timer(0.2, begun.set_result, [None])
    for future in (waiting, begun):
        loading[scaled_sum.module] = future
        if future is begun:
            timer.start()
        assert Call(torch.ones(4)).right() and future.done() and scaled_sum.module not in loading
    assert waiting.cancelled()
