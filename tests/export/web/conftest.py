import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.export.bake import bake
from nexwarp.export.web.export import Page
from tests.export.web import support
from tests.export.web.support import CHROMIUM, FLAGS, WEBGPU, PageTab


@pytest.fixture(scope="module")
def cameras() -> dict[str, nw.Camera]:
    return support.ring()


@pytest.fixture(scope="module")
def model(cameras) -> nw.Model:
    """A small model with everything that a page has to show: exposures, vignetting, detail limits."""
    return support.ring_model(cameras, 40, nw.DetailLimits(torch.full((40,), 0.01), torch.full((40,), 0.04)))


@pytest.fixture(scope="module")
def site(model, cameras, tmp_path_factory) -> dict[str, bytes]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nexwarp.export.web.export.bake", functools.partial(bake, steps=10))
        return support.exported(model, cameras, tmp_path_factory.mktemp("site"), page=Page(title="Two & <three>"))


@pytest.fixture(scope="module")
def launch_browser() -> Iterator[Callable[[bool], Any]]:
    """What launches a browser with WebGPU, or one without, once for the tests of a file."""
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:

        @functools.cache
        def launched(webgpu: bool) -> Any:
            flags = [*FLAGS, *(WEBGPU if webgpu else ())]
            return playwright.chromium.launch(executable_path=CHROMIUM, args=flags)

        yield launched


@pytest.fixture
def open_tab(site, launch_browser) -> Iterator[Callable[..., PageTab]]:
    """What opens a tab of a browser that has WebGPU or not; of a size, or with further options of a context."""
    with contextlib.ExitStack() as tabs:

        def opened(width: int = 200, height: int = 150, *, webgpu: bool = False, **options: Any) -> PageTab:
            tab = PageTab(launch_browser(webgpu), site, viewport={"width": width, "height": height}, **options)
            tabs.callback(tab.context.close)
            return tab

        yield opened


@pytest.fixture
def tab(open_tab) -> PageTab:
    return open_tab()
