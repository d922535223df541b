"""Fixtures that every test may use."""

import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.data import Scene, write_demo
from nexwarp.kernels import launch
from nexwarp.train import floaters, presets
from tests import background_jobs


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests on CUDA are skipped where there is none; of many tests, those that wait for work beside them come last.

    The forms of `form` are forms of CPU kernels, so that tests on CUDA run once.
    """
    items[:] = [item for item in items if not _twice_on_cuda(item)]
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))
    if len(items) >= background_jobs.MANY:
        items.sort(key=lambda item: background_jobs.key(item) is not None)


def _twice_on_cuda(item: pytest.Item) -> bool:
    parameters = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
    return parameters.get("device") == "cuda" and parameters.get("form") == "scalar"


@pytest.fixture(scope="session", autouse=True)
def begun(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[background_jobs.BackgroundJobs]:
    """Kernels that are not in Warp's cache yet are compiled beside the first tests; then the marked tests' work."""
    items, compilers = request.session.items, [sys.executable, "-m", "tests.compile_ahead"]
    with background_jobs.begun(items, tmp_path_factory.mktemp, compilers) as work:
        yield work


@pytest.fixture
def background_job(request: pytest.FixtureRequest, begun: background_jobs.BackgroundJobs) -> Any:
    """What the work of the test's mark `background_job` gave."""
    job = background_jobs.key(request.node)
    assert job is not None
    return begun.result(job)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Device to run on: the CPU always, CUDA with `-m cuda`."""
    return torch.device(request.param)


@pytest.fixture(params=["simd", "scalar"])
def form(request: pytest.FixtureRequest) -> Iterator[launch.CpuForm]:
    """Both forms of the kernels on a CPU: the one written for CPUs, and the bodies that run on CUDA."""
    with launch.cpu_form(request.param):
        yield request.param


@pytest.fixture(autouse=True)
def seed() -> None:
    """Start every test from the same random state."""
    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def usual_signals() -> Iterator[None]:
    """Signals stop the tests' commands even where pytest itself runs under nohup or in a script's background."""
    usual: dict[str, Any] = {"SIGINT": signal.default_int_handler, "SIGHUP": signal.SIG_DFL, "SIGTERM": signal.SIG_DFL}
    found = {getattr(signal, name): handler for name, handler in usual.items() if hasattr(signal, name)}
    before = {number: signal.signal(number, handler) for number, handler in found.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def one_torch_thread() -> Iterator[None]:
    """Tensors of a small training are tiny, and torch's threads would wait for each other on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def few_looks() -> Iterator[None]:
    """Looks for floaters are few: those at the end of a training take a second, which few tests are about."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(floaters, "PROBES", 6)
        patch.setattr(floaters, "LAST_PROBES", 12)
        yield


@pytest.fixture(scope="module")
def small_preset(request: pytest.FixtureRequest, one_torch_thread: None, few_looks: None) -> Iterator[None]:
    """The module's SMALL as the default preset: the command line has no flags for the texture's shape."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "default", request.module.SMALL)
        yield


@pytest.fixture
def restore_launch_threads() -> Iterator[None]:
    """Whatever a test sets, the passes on a CPU use as many threads as before."""
    before = launch.get_num_threads()
    yield
    launch.set_num_threads(before)


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo, 10 photos of 48x36; not to be changed."""
    return write_demo(tmp_path_factory.mktemp("scenes") / "tiny", width=48, height=36, views=10, points=200)


@pytest.fixture(scope="session")
def tiny_scene(tiny_folder: Path) -> Scene:
    """The same, read."""
    return nw.load_scene(tiny_folder)
