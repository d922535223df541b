"""The ranks of a machine hold a scene once: one of them loads it, and the others map its memory."""

import dataclasses
import mmap
import os
from pathlib import Path
from types import ModuleType

import psutil
import pytest
import torch

from nexwarp.data import Scene
from nexwarp.train.ranks.join import Place
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.ranks.shared import _mapped, _moved, _reserved, _tensors, shared_scene
from tests.ranks_support import CPU, run_ranks

MIB = 2**20


def copied(scene: Scene, **changes: object) -> Scene:
    """A scene of its own, as a reader returns it: with lists that are not another's."""
    return dataclasses.replace(scene, train=list(scene.train), test=list(scene.test), **changes)  # type: ignore[arg-type]


def with_everything(scene: Scene) -> Scene:
    """Views with masks, alpha and points, or without them, and a background."""
    first, second, *rest = scene.train
    height, width = first.image.shape[:2]
    first = dataclasses.replace(first, mask=torch.rand(height, width) > 0.5, points=torch.zeros(0, 3))
    alpha = torch.randint(0, 256, (height, width), dtype=torch.uint8)
    second = dataclasses.replace(second, alpha=alpha, points=None)
    return dataclasses.replace(scene, train=[first, second, *rest], background=(0.25, 0.1, 1.0), random_background=True)


def assert_same(found: Scene, expected: Scene) -> None:
    for one, other in zip(_tensors(found), _tensors(expected), strict=True):
        assert one.dtype == other.dtype and torch.equal(one, other)
    for group in ("train", "test"):
        pairs = zip(getattr(found, group), getattr(expected, group), strict=True)
        for view, other in pairs:
            assert view.name == other.name and (view.mask is None) == (other.mask is None)
            size = (view.camera.width, view.camera.height, view.camera.near)
            assert size == (other.camera.width, other.camera.height, other.camera.near)
    for name in ("scale", "path", "background", "random_background"):
        assert getattr(found, name) == getattr(expected, name), name


def test_one_rank_loads_for_all(tiny_scene: Scene, tmp_path: Path) -> None:
    """All have the same scene, in memory that is one machine's, and one alone has decoded it."""
    expected = with_everything(tiny_scene)
    large = torch.arange(64 * MIB, dtype=torch.int32).view(-1, 1024, 1)[:, :, [0, 0, 0]].to(torch.uint8)
    large = large[: 64 * MIB // (3 * 1024)].contiguous()

    def work(ranks: Ranks) -> object:
        calls = []

        def load() -> Scene:
            calls.append(ranks.rank)
            return copied(expected)

        assert_same(shared_scene(load, ranks), expected)
        before = psutil.Process().memory_full_info().uss
        view = dataclasses.replace(expected.train[0], image=large)
        huge = shared_scene(lambda: copied(dataclasses.replace(expected, train=[view])), ranks)
        assert torch.equal(huge.train[0].image, large)
        ranks.barrier()
        grown = psutil.Process().memory_full_info().uss - before
        ranks.barrier()
        return [calls, grown]

    found = run_ranks(3, work, tmp_path / "ranks")
    for rank, told in enumerate(found):
        assert isinstance(told, list)
        assert told[0] == ([0] if rank == 0 else []) and told[1] < 16 * MIB, found


def test_ranks_that_cannot_share_load_for_themselves(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "memfd_create", raising=False)

    def work(ranks: Ranks) -> object:
        calls = []
        assert_same(shared_scene(lambda: calls.append(0) or copied(tiny_scene), ranks), tiny_scene)  # type: ignore[func-returns-value]
        return calls

    assert run_ranks(2, work, tmp_path / "ranks") == [[0], [0]]


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="files in memory are Linux's")
def test_memory_of_another_process_is_not_taken_for_the_scene(tiny_scene: Scene, tmp_path: Path) -> None:
    reserved = _reserved(tiny_scene)
    assert reserved is not None
    number = reserved[0]
    moved, told = _moved(copied(tiny_scene), *reserved)
    assert_same(moved, tiny_scene)
    found = _mapped(told)
    assert found is not None
    assert_same(found, tiny_scene)
    found.train[0].image.zero_()  # a copy of the page
    assert_same(moved, tiny_scene)
    assert _mapped(told | {"token": "00" * 16}) is None
    os.close(number)
    assert_same(moved, tiny_scene)
    assert _mapped(told) is None and _mapped(told | {"file": str(tmp_path / "none")}) is None


def test_a_rank_alone_loads_as_ever(tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine of its own it takes part in what all ranks do: others may share theirs."""
    assert shared_scene(lambda: tiny_scene, Ranks.alone(CPU)) is tiny_scene
    calls: list[object] = []
    ranks = Ranks(Place(1, 2, 0, 1, "", False), CPU, "gloo")
    monkeypatch.setattr(ranks, "gather", lambda told: calls.append(told) or [{}, told])  # type: ignore[func-returns-value]
    monkeypatch.setattr(ranks, "barrier", lambda: calls.append("barrier"))
    assert shared_scene(lambda: tiny_scene, ranks) is tiny_scene
    assert calls == [None, "barrier"]


@pytest.mark.parametrize(("module", "name"), [(os, "memfd_create"), (os, "ftruncate"), (mmap, "mmap")])
def test_where_the_system_gives_no_memory_each_rank_loads(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str
) -> None:
    def refused(*_: object) -> int:
        raise OSError("not permitted")

    before = [view.image for view in tiny_scene.train]
    ranks = Ranks(Place(0, 2, 0, 2, "", False), CPU, "gloo")
    told: list[object] = []
    monkeypatch.setattr(ranks, "gather", lambda x: [told.append(x), x])  # type: ignore[func-returns-value]
    monkeypatch.setattr(ranks, "barrier", lambda: None)
    monkeypatch.setattr(module, name, refused)
    assert shared_scene(lambda: tiny_scene, ranks) is tiny_scene
    assert told == [None] and all(view.image is x for view, x in zip(tiny_scene.train, before, strict=True))
