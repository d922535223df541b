import copy
import dataclasses
import gc
import threading
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.camera import StagedCamera
from nexwarp.errors import OutOfMemoryError
from nexwarp.model import graphs as frames
from nexwarp.model.options import RenderChanges
from nexwarp.model.render import Rendering, draw
from tests.narrowing import neural, present
from tests.render_support import BUFFERS, assert_same, cameras, finished

LATER = ("expected_depth", "median_depth", "top_depth", "normals", "colors")
CUDA = pytest.mark.cuda


def both(model: nw.Model, camera: nw.Camera, **options: Any) -> tuple[Rendering, Rendering]:
    """Render as usual, and kernel by kernel."""
    with torch.no_grad():
        found = model.render(camera, **options)
        with frames.without_graphs():
            expected = model.render(camera, **options)
    return found, expected


def graphs(model: nw.Model) -> frames.FrameGraphs:
    return frames._graphs[model.surfels]


@pytest.fixture
def model() -> nw.Model:
    """After two frames: the next one is a replay."""
    model = finished("cuda")
    for _ in range(2):
        both(model, cameras("cuda")[0])
    assert len(graphs(model).frames) == 1
    return model


def test_a_staged_camera_renders_what_its_camera_does(device: torch.device) -> None:
    model = finished(device)
    exposures = present(model.exposures)
    first, *others = cameras(device)
    staged = StagedCamera(first, device, present(exposures.falloff_of(first)).clone())
    for camera in others:
        staged.copy_(camera)
        present(staged.falloff).copy_(present(exposures.falloff_of(camera)))
        found, expected = (draw(model._frame(c, None, {})) for c in (staged, camera))
        assert_same(found, expected, (*BUFFERS, "ids", "colors"))


def test_a_copy_of_a_frame_shares_no_memory_with_it() -> None:
    """On CUDA the next frame overwrites what a graph has written."""

    def memory(value: object) -> set[int]:
        if isinstance(value, torch.Tensor):
            return {value.untyped_storage().data_ptr()} if value.numel() else set()
        parts = vars(value).values() if dataclasses.is_dataclass(value) else value if isinstance(value, tuple) else ()
        return set().union(*map(memory, parts))

    with torch.no_grad():
        stages = finished("cpu").render(cameras("cpu")[0]).intermediates
    copied = memory(frames._copied(stages, {}))
    assert len(copied) > 10 and not copied & memory(stages)


@CUDA
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"max_hits": 0},
        {"max_hits": 4},
        {"exposure": "mean", "detail_limits": False},
        {"sh_degree": 1, "background": (0.2, 0.5, 0.1)},
        {"background": 0.3},
    ],
    ids=str,
)
@pytest.mark.parametrize("place", ["cuda", "cpu"])
def test_graphs_give_the_bits_of_launches(options: dict[str, Any], place: str) -> None:
    model = finished("cuda")
    with torch.no_grad():
        with frames.without_graphs():
            expected = [model.render(camera, **options) for camera in cameras(place)]
        for _ in range(3):
            for camera, out in zip(cameras(place), expected, strict=True):
                assert_same(model.render(camera, **options), out, (*BUFFERS, "ids", *LATER))
    assert len(graphs(model).frames) == 1
    background = torch.tensor([0.1, 0.2, 0.9], device="cuda")
    found, same = both(model, cameras(place)[1], **(options | {"background": background}))
    assert_same(found, same, (*BUFFERS, *LATER))


def test_an_image_alone_is_that_of_the_rendering(device: torch.device) -> None:
    model, (camera, *_) = finished(device), cameras("cpu")
    for options in ({}, {"max_hits": 0}, {"exposure": "mean", "detail_limits": False, "background": (0.2, 0.5, 0.1)}):
        with torch.no_grad():
            expected = model.render(camera, **options).image
        for _ in range(3):
            image = model.render_image(camera, **options)
            assert torch.equal(image, expected) and not image.requires_grad
    with pytest.raises(TypeError, match=r"camera: expected a nexwarp.Camera, got list"):
        model.render_image([camera])  # type: ignore[arg-type]


@CUDA
def test_images_alone_keep_less_and_leave_other_renderings_alone() -> None:
    camera, sizes = cameras("cuda", 1, width=640, height=480)[0], {}
    for name in ("render", "render_image"):
        model = finished("cuda")
        with torch.no_grad():
            for each in (*cameras("cuda", 2), camera):  # cuBLAS keeps memory from the first capture on
                getattr(model, name)(each)
            gc.collect()
            before = torch.cuda.memory_allocated()
            getattr(model, name)(camera)  # captured
        sizes[name] = torch.cuda.memory_allocated() - before
    assert 640 * 480 * 3 * 4 <= sizes["render_image"] < 0.2 * sizes["render"]
    with torch.no_grad():
        held = [model.render(camera) for _ in range(3)][-1]
        for _ in range(3):
            image = model.render_image(camera)
    assert torch.equal(image, held.image) and len(graphs(model).frames) == 3  # one is of the small cameras
    assert_same(held, both(model, camera)[1], (*BUFFERS, "ids", *LATER))


@CUDA
def test_models_that_share_graphs_take_less_memory_and_keep_their_own_pictures() -> None:
    views, models = cameras("cuda", width=640, height=480), [finished("cuda", seed) for seed in (0, 1, 2)]
    with frames.without_graphs():
        expected = [[model.render_image(camera) for camera in views] for model in models]
    reserved = []
    for shared in (False, True):
        frames.release_graphs()
        if shared:
            frames.share_graphs([model.surfels for model in models])
        torch.cuda.empty_cache()
        before = torch.cuda.memory_reserved()
        for _ in range(3):
            for k, camera in enumerate(views):
                for model, images in zip(models, expected, strict=True):
                    assert torch.equal(model.render_image(camera), images[k])
        torch.cuda.empty_cache()
        reserved.append(torch.cuda.memory_reserved() - before)
    assert len({id(graphs(model)) for model in models}) == 1 and len(graphs(models[0]).frames) == 3
    assert reserved[1] < 0.5 * reserved[0]
    one, other, _ = models
    with torch.no_grad():
        for model in (one, other):
            for _ in range(2):
                model.render(views[0])
        whole = both(one, views[0])[1]
        held = one.render(views[0])
        for camera in views:
            other.render(camera)
            other.render_image(camera)
    assert_same(held, whole, (*BUFFERS, "ids", *LATER))


@CUDA
def test_renderings_outlive_the_next_frames(model: nw.Model) -> None:
    """All graphs share the memory of their temporary buffers, in which another one may have its results."""
    views = [*cameras("cuda", 2), *(cameras("cuda", 1, width=width)[0] for width in (33, 90))]
    options: list[RenderChanges] = [{"max_hits": hits} for hits in (2, 2, 4, 1)]
    with torch.no_grad():
        with frames.without_graphs():
            expected = [model.render(view, **changes) for view, changes in zip(views, options, strict=True)]
        for _ in range(4):
            outs = [model.render(view, **changes) for view, changes in zip(views, options, strict=True)]
    assert all(isinstance(out, frames.CapturedRendering) for out in outs) and len(graphs(model).frames) == 3
    assert "depths" not in vars(outs[-1]), "copied before it was asked for"
    with pytest.raises(AttributeError, match="'CapturedRendering' object has no attribute 'depth'"):
        _ = outs[0].depth  # type: ignore[attr-defined]
    outs.append(copy.deepcopy(outs[-1]))
    for out, same in zip(outs, [*expected, expected[-1]], strict=True):
        assert_same(out, same, (*BUFFERS, "ids", *LATER))


@CUDA
def test_changes_of_the_model_show(model: nw.Model) -> None:
    camera, exposures = cameras("cuda")[1], present(model.exposures)
    changes: list[Callable[[], object]] = [
        lambda: model.surfels.means.data.add_(0.05),
        lambda: neural(model.texture).grid.data.mul_(1.5),
        lambda: [x.add_(0.1) for x in (exposures.log_gains, exposures.mean)],
        lambda: present(model.detail_limits).farthest.mul_(0.5),
        lambda: setattr(model.surfels, "means", torch.nn.Parameter(model.surfels.means + 0.1)),
        lambda: neural(model.texture).half_copy(),
        lambda: neural(model.texture).grid.mul_(1.1),
        lambda: setattr(model.texture, "half_precision", False),
        lambda: exposures.load_state_dict(exposures.state_dict() | {"falloff": torch.tensor([-0.5, 0.0, 0.4])}),
        lambda: model.load_state_dict(finished("cuda", seed=5).state_dict()),
        lambda: setattr(model, "exposures", None),
    ]
    for index, change in enumerate(changes):
        before = both(model, camera)[0].image
        with torch.no_grad():
            change()
        for _ in range(3):
            found, expected = both(model, camera)
            assert_same(found, expected, (*BUFFERS, *LATER))
        assert index == 5 or not torch.equal(before, found.image)  # a copy changes nothing
        assert isinstance(found, frames.CapturedRendering)


@CUDA
def test_lists_that_are_too_short_are_right_and_then_made_longer() -> None:
    """Lists have room for 4,096 entries more than were needed first."""
    model = finished("cuda")
    surfels = model.surfels
    surfels.log_scales.data.fill_(-7.0)
    camera = cameras("cuda", 1, width=320, height=240)[0]
    for _ in range(3):
        assert_same(*both(model, camera))
    (frame,) = graphs(model).frames.values()
    surfels.log_scales.data.fill_(4.0)
    for _ in range(4):
        assert_same(*both(model, camera))
        torch.cuda.synchronize()
    (longer,) = graphs(model).frames.values()
    assert frame.room.entries < int(longer.room.ends[-1]) <= longer.room.entries


@CUDA
def test_what_cannot_be_captured_is_launched(model: nw.Model) -> None:
    camera = cameras("cuda")[0]
    with torch.no_grad():
        assert isinstance(model.render(camera), frames.CapturedRendering)
        with torch.autocast("cuda"):
            assert isinstance(model.render(camera), frames.CapturedRendering)
    out = model.render(camera)
    assert not isinstance(out, frames.CapturedRendering)
    out.image.sum().backward()
    assert present(model.surfels.means.grad).abs().max() > 0
    double = model.double()
    with torch.no_grad():
        moved = nw.Camera(camera.viewmat.double(), camera.K, camera.width, camera.height)
        assert not isinstance(double.render(moved), frames.CapturedRendering)


@CUDA
def test_a_failing_capture_leaves_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    model, camera = finished("cuda"), cameras("cuda")[0]

    def fail(*_: object) -> None:
        raise RuntimeError("no graphs here")

    monkeypatch.setattr(torch.cuda.CUDAGraph, "capture_begin", fail)
    for _ in range(4):
        found, expected = both(model, camera)
        assert not isinstance(found, frames.CapturedRendering)
        assert_same(found, expected)
    monkeypatch.undo()
    assert_same(*both(model, camera))


@CUDA
def test_sizes_and_memory_are_bounded() -> None:
    model = finished("cuda")
    used = []
    for size in (*range(40, 60), *range(40, 60)):
        camera = cameras("cuda", 1, width=size, height=40)[0]
        for _ in range(3):
            assert_same(*both(model, camera))
        held = graphs(model)
        assert len(held.frames) <= frames.MOST_GRAPHS and len(held.seen) <= frames.MOST_SEEN
        used.append(torch.cuda.memory_reserved())
    assert used[-1] <= used[20] + 2**22
    reference = weakref.ref(graphs(model))
    del model, held
    gc.collect()
    assert reference() is None


@CUDA
def test_threads_take_turns() -> None:
    model, views = finished("cuda"), cameras("cuda")
    with torch.no_grad(), frames.without_graphs():
        expected = [model.render(camera) for camera in views]
    torch.cuda.synchronize()  # the threads have streams of their own
    wrong: list[str] = []

    def draw(index: int) -> None:
        try:
            with torch.no_grad(), torch.cuda.stream(torch.cuda.Stream()):
                for _ in range(30):
                    assert_same(model.render(views[index]), expected[index], (*BUFFERS, "ids"))
        except BaseException as error:
            wrong.append(repr(error))

    threads = [threading.Thread(target=draw, args=(i,)) for i in range(len(views))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong, wrong


@CUDA
def test_memory_of_graphs_is_given_back_when_it_is_missing(monkeypatch: pytest.MonkeyPatch, model: nw.Model) -> None:
    """A frame that does not fit is rendered again without the graphs."""
    held = graphs(model)
    camera = cameras("cuda", 1, width=64, height=32)[0]
    original, calls = draw, []

    def scarce(*arguments: Any, **options: Any) -> Rendering:
        calls.append(len(held.frames))
        if held.frames:
            raise OutOfMemoryError.of("an image", "1 GiB")
        return original(*arguments, **options)

    monkeypatch.setattr(frames, "draw", scarce)
    with torch.no_grad():
        out = model.render(camera)
    assert calls == [1, 0] and out.image.isfinite().all()


@CUDA
def test_inference_mode_leaves_graphs_that_others_can_use(model: nw.Model) -> None:
    camera = cameras("cuda")[2]
    with torch.inference_mode():
        outs = [model.render(camera) for _ in range(3)]
        held = model.render(camera)
    for out in (*outs, held):
        assert_same(out, both(model, camera)[1], (*BUFFERS, *LATER))
    assert outs[-1].image.is_inference()
