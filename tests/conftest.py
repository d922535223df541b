"""Fixtures that every test may use, and how a run is divided between processes."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch reads it: the cores are shared by processes, not by threads
    os.environ.setdefault("OMP_NUM_THREADS", "1")

os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # before torch reads it, for the ranks that tests fork

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.data import Scene
from nexwarp.kernels import launch
from nexwarp.machine import deterministic
from nexwarp.train import recipe
from tests.cli.support import SMALL
from tests.scene_writers import write_demo

MOST_WORKERS = 4  # each takes 1 to 2 GB


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A whole run uses up to four processes; some files, and tests on a GPU with its memory, are for one."""
    named, marks = config.getoption("file_or_dir"), config.getoption("markexpr")
    if named or ("cuda" in marks and "not cuda" not in marks):
        return 0
    return min(os.cpu_count() or 1, MOST_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests on CUDA where there is none; long tests come first, so that no worker ends long after others."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Device to run on: the CPU always, CUDA with `-m cuda`."""
    return torch.device(request.param)


@pytest.fixture(autouse=True)
def seed() -> None:
    """Start every test from the same random state."""
    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def usual_signals() -> Iterator[None]:
    """Signals stop the tests' commands even where pytest itself runs under nohup or in a script's background."""
    usual: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Tensors of a small training are tiny, and torch's threads would wait for each other on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def small_preset(request: pytest.FixtureRequest, one_torch_thread: None) -> Iterator[None]:
    """The module's SMALL, or that of the commands' tests, as the default preset."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(recipe.PRESETS, "default", getattr(request.module, "SMALL", SMALL))
        yield


@pytest.fixture
def fixed_order(device: torch.device) -> Iterator[None]:
    """On CUDA without atomics, whose order differs from one launch to the next."""
    with deterministic(device.type == "cuda"):
        yield


@pytest.fixture
def restore_threads() -> Iterator[None]:
    """Whatever a test sets, the passes on a CPU and torch use as many threads as before."""
    kernels, others = launch.get_num_threads(), torch.get_num_threads()
    yield
    launch.set_num_threads(kernels)
    torch.set_num_threads(others)


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo, 10 photos of 48x36; not to be changed."""
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=48, height=36, views=10, points=200)


@pytest.fixture(scope="session")
def tiny_scene(tiny_folder: Path) -> Scene:
    """The same, read."""
    return nw.load_scene(tiny_folder)


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    """The scene of most trainings."""
    return tiny_scene
