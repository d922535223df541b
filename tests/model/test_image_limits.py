import gc
import weakref
from functools import partial
from typing import Any
from unittest.mock import Mock

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.errors import NexwarpError, OutOfMemoryError
from nexwarp.kernels import launch as launching
from nexwarp.kernels.types import types
from nexwarp.machine import needed_memory
from nexwarp.model.buffers import render_buffers
from nexwarp.ops import _interop, memory, tiles
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close

GIB = 2**30
CROP = r"render the image in parts \(Camera\.crop\)"
SMALLER = r"render a smaller image, with a lower K, or in parts \(Camera\.crop\)"


def parts(device: torch.device | str = "cpu", **size: int) -> tuple[nw.Surfels, nw.NeuralTexture, nw.Camera]:
    scene = random_scene(12, device=device)
    return make_surfels(scene), make_texture(device=device), make_camera(scene, **size)


def renderings(surfels: nw.Surfels, texture: nw.NeuralTexture | None, camera: nw.Camera, max_hits: int) -> list[Any]:
    """The calls that render, all of the same picture."""
    model = nw.Model(surfels, texture, options=nw.RenderOptions(max_hits=max_hits))
    alone = partial(nw.render, surfels, texture, camera, max_hits)
    return [alone, partial(model.render, camera), partial(render_buffers, model, camera)]


@pytest.fixture
def no_allocation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail the test when a pass begins."""

    def fail(*_: Any, **__: Any) -> None:
        pytest.fail("a pass was launched")

    monkeypatch.setattr(launching, "launch", fail)


@pytest.mark.usefixtures("no_allocation")
@pytest.mark.parametrize("size", [(100_000, 100_000), (2**31, 1), (1, 2**31), (46_341, 46_341), (2**27, 1), (2**40, 2)])
def test_more_pixels_than_int32_counts(size, device):
    surfels, texture, camera = parts(device, width=size[0], height=size[1])
    line = rf"^camera: expected an image of at most 2,147,483,647 pixels, in tiles of 16x16, got {size[0]}x{size[1]}; "
    for textured in (texture, None):
        for call in renderings(surfels, textured, camera, 2):
            with pytest.raises(ValueError, match=line + CROP):
                call()


@pytest.mark.usefixtures("no_allocation")
def test_more_hits_than_int32_counts(device):
    """Without a texture hits are counted; with one, the bytes of a row of its values are."""
    surfels, texture, camera = parts(device, width=40_000, height=40_000)
    with pytest.raises(ValueError, match=r"^max_hits: expected at most 2,147,483,647 hits, .* 40000x40000 times 8; "):
        nw.render(surfels, None, camera, 8)
    if device.type == "cuda":  # a CPU evaluates the texture at a part of the points at a time
        camera = parts(device, width=8192, height=8192)[2]
        texture.half_precision = False
        with pytest.raises(ValueError, match=r"^max_hits: expected at most 536,870,879 hits, .* 8192x8192 times 8; "):
            nw.render(surfels, texture, camera, 8)


def test_rows_that_warp_cannot_address_are_refused():
    wide = torch.empty_strided((2, 4), (2**29, 1))  # of memory that is never touched
    with pytest.raises(ValueError, match=r"^expected a tensor with rows of at most 2,147,483,647 bytes, got \(2, 4\)$"):
        _interop.array(wide, types(_interop.real_of(wide)).real)
    single = torch.empty_strided((1, 4), (2**40, 1))
    assert _interop.array(single, types(_interop.real_of(single)).real) is not None


@pytest.mark.usefixtures("no_allocation")
def test_an_image_that_memory_cannot_hold_is_refused_before_anything_is_allocated(monkeypatch, device):
    surfels, texture, camera = parts(device, width=8192, height=8192)
    monkeypatch.setattr(memory, "available_memory", lambda: 3 * GIB)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: Mock(total_memory=3 * GIB))
    where = "are free" if device.type == "cpu" else "are on the GPU"
    for textured in (texture, None):
        for call in renderings(surfels, textured, camera, 2):
            with pytest.raises(OutOfMemoryError) as caught:
                call()
            text = str(caught.value)
            assert text.startswith("out of memory: an image of 8192x8192 pixels with K = 2 needs at least "), text
            assert f" GiB, of which 3.0 GiB {where}; render a smaller image" in text and "\n" not in text
            assert isinstance(caught.value, MemoryError) and isinstance(caught.value, NexwarpError)


def test_what_is_counted_is_less_than_what_a_rendering_takes(monkeypatch):
    """The bound never refuses what would fit: it is at most what the tensors of a rendering take."""
    asked: list[int] = []
    monkeypatch.setattr(memory, "check_memory", lambda needed, *_: asked.append(needed))
    surfels, texture, camera = parts(width=300, height=200)
    for textured in (texture, None):
        for max_hits in (0, 4):
            with torch.profiler.profile(profile_memory=True) as profile, torch.no_grad():
                nw.render(surfels, textured, camera, max_hits)
            taken = sum(max(event.self_cpu_memory_usage, 0) for event in profile.key_averages())
            assert asked[-1] <= taken, (max_hits, textured is None)
            assert asked[-1] > 300 * 200 * 40


def test_lists_that_memory_cannot_hold(monkeypatch):
    """A few entries stand for a thousand million."""
    surfels, _, camera = parts(width=640, height=480)
    monkeypatch.setattr(memory, "SMALLEST_CHECKED", 100)
    monkeypatch.setattr(memory, "available_memory", lambda: 100)
    monkeypatch.setattr(ops, "check_image", lambda *_, **__: None)
    with pytest.raises(OutOfMemoryError, match=rf"a list of [\d,]+ \(tile, surfel\) entries needs .*{SMALLER}"):
        nw.render(surfels, None, camera)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (RuntimeError("shape mismatch"), "^shape mismatch$"),
        (torch.OutOfMemoryError("Tried to allocate 2 GiB."), f"^out of memory: an image of 23x18 .* 2 GiB; {SMALLER}$"),
    ],
)
def test_what_an_error_leaves_is_freed_without_the_garbage_collector(monkeypatch, error, told):
    """As a CUDA graph of a step that cannot be captured: the step is launched next, and needs the memory."""
    surfels, texture, camera = parts()
    kept: list[weakref.ref[torch.Tensor]] = []

    def fail(centers: torch.Tensor, _: str) -> None:
        kept.append(weakref.ref(centers))
        raise type(error)(*error.args)

    monkeypatch.setattr(tiles, "_depth_order", fail)
    plain = {name: x.detach() for name, x in surfels.activated()._asdict().items()}
    colors = torch.zeros(len(surfels), 3)
    gc.disable()
    try:
        for draw in (
            lambda: nw.render(surfels, texture, camera),
            lambda: nw.rasterize(**plain | {"scales": 2 * plain["scales"]}, colors=colors, camera=camera),
        ):
            with pytest.raises(OutOfMemoryError if needed_memory(error) else RuntimeError, match=told):
                draw()
            assert kept[-1]() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e39])
def test_a_background_must_be_finite(value):
    surfels, texture, camera = parts()
    tensors = [] if value == 1e39 else [torch.tensor([0.0, value, 0.0]).requires_grad_(), torch.tensor(value)]
    for background in (value, (0.0, value, 0.0), [0, 0, value], *tensors):
        for call in (partial(nw.render, surfels, texture), nw.Model(surfels, texture).render):
            with pytest.raises(ValueError, match=r"^background: expected finite values, got "):
                call(camera, background=background)


def test_a_background_may_lie_outside_of_0_to_1():
    surfels, texture, camera = parts()
    dark, bright = (nw.render(surfels, texture, camera, background=color) for color in ((-0.5,) * 3, (1.5,) * 3))
    behind = 2.0 * (1.0 - bright.alpha)[..., None].expand(-1, -1, 3)
    assert_close(bright.image - dark.image, behind, kind="value", name="image")
    assert nw.RenderOptions(background=(-0.5, 0.0, 1.5)).background == (-0.5, 0.0, 1.5)


def moved(camera: nw.Camera, K: torch.Tensor) -> nw.Camera:
    """The camera with a K that its own check does not see."""
    checked = (camera.fx, camera.fy, camera.cx, camera.cy)
    return nw.Camera(camera.viewmat, K, camera.width, camera.height, checked=checked)


def test_tensors_on_the_meta_device_are_named():
    surfels, texture, camera = parts()
    with pytest.raises(ValueError, match=r"^camera\.K: expected a tensor on cpu, got one on meta$"):
        nw.render(surfels, texture, moved(camera, camera.K.to("meta")))
    with pytest.raises(ValueError, match=r"^surfels: expected values on a CPU or a CUDA device, got meta$"):
        nw.render(surfels.to("meta"), texture, camera)


@pytest.mark.cuda
def test_tensors_on_another_device_are_named():
    surfels, texture, camera = parts("cuda")
    with pytest.raises(ValueError, match=r"^K: expected a tensor on cuda:0, got one on cpu$"):
        nw.Camera(camera.viewmat, camera.K.cpu(), camera.width, camera.height)
    with pytest.raises(ValueError, match=r"^camera\.K: expected a tensor on cuda:0, got one on cpu$"):
        nw.render(surfels, texture, moved(camera, camera.K.cpu()))
    with pytest.raises(ValueError, match=r"^camera\.viewmat: expected a tensor on cuda:0, got one on cpu$"):
        nw.render(surfels, texture, camera.to("cpu"))
