import dataclasses
import functools
import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.cameras.camera import resized
from nexwarp.cameras.cameras_file import save_cameras
from nexwarp.cli import main as cli
from nexwarp.data.scene import SceneSource
from nexwarp.io.pictures import to_uint8
from nexwarp.model.buffers import load_buffers, render_buffers
from nexwarp.model.options import Exposure, RenderChanges
from nexwarp.model.render import Frame, draw
from nexwarp.run.folder import RunRecord, create_run
from tests import render_support
from tests.cli.support import picture
from tests.render_support import BUFFERS
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_equal, assert_finite

FIELDS = (*BUFFERS, "ids")
LAZY = ("expected_depth", "median_depth", "top_depth", "normals")
assert_same = functools.partial(render_support.assert_same, buffers=FIELDS + LAZY)
OPTIONS = nw.RenderOptions(max_hits=3, background=(0.2, 0.5, 0.9), sh_degree=2)
FALLOFF = (-0.3, -0.2, 0.4)


def cameras_of(device: torch.device | str = "cpu") -> list[nw.Camera]:
    """Three cameras of different places and sizes."""
    first = make_camera(random_scene(1, device=device))
    found = [dataclasses.replace(first, viewmat=first.viewmat.detach())]
    for shift, (width, height) in ((0.3, (31, 18)), (-0.5, (23, 40))):
        viewmat = found[0].viewmat.clone()
        viewmat[0, 3] += shift
        found.append(resized(dataclasses.replace(found[0], viewmat=viewmat), width, height))
    return found


def full_model(device: torch.device | str = "cpu", falloff: tuple[float, float, float] | None = FALLOFF) -> nw.Model:
    """A model with all that a model may have; exposures, falloff and detail limits all change its pictures."""
    surfels = make_surfels(random_scene(40, device=device))
    cameras = cameras_of()
    log_gains = torch.tensor([[0.3, 0.0, -0.2], [0.1, 0.2, 0.1], [-0.4, -0.2, 0.1]])
    exposures = nw.Exposures.of(log_gains, cameras, falloff).to(device)
    generator = torch.Generator().manual_seed(5)
    # Around the depths of 2 to 5 that the surfels have.
    depths = 2.5 + torch.rand(2, len(surfels), generator=generator)
    limits = nw.DetailLimits(*(depths / cameras[0].focal * torch.tensor([[1.0], [1.2]])).to(device))
    return nw.Model(surfels, make_texture(device=device), exposures, limits, OPTIONS, {"near": 0.01, "iteration": 7})


def pure(model: nw.Model, camera: nw.Camera, **parts: Any) -> nw.Rendering:
    """The rendering of a model's surfels and texture, with the given parts only."""
    return draw(Frame(model.surfels, model.texture, camera, model.options, model.options.background, **parts))


@pytest.mark.parametrize("saved", ["photos", "mean"])
@pytest.mark.parametrize(
    "flags", [[], ["--buffers"], ["--exposure", "mean"], ["--exposure", "mean", "--buffers"], ["--order", "distance"]]
)
def test_a_rendering_is_the_picture_that_the_command_writes(tmp_path: Path, flags: list[str], saved: Exposure) -> None:
    """To the bit, with exposures, vignetting and detail limits, and the buffers too; by default as the model says."""
    run, cameras = tmp_path / "run", cameras_of()
    create_run(run, RunRecord(SceneSource(str(tmp_path / "scene")), nw.Config()))
    full = full_model()
    full.options = full.options.changed(exposure=saved)
    full.save(run)
    names = [f"{i}.png" for i in range(len(cameras))]
    save_cameras(run / "cameras.json", {"train": {}, "test": dict(zip(names, cameras, strict=True))})
    assert cli.main(["render", str(run), "--set", "test", "--device", "cpu", *flags]) == 0
    model = nw.load(run)
    changes: RenderChanges = {"exposure": "mean"} if "mean" in flags else {}
    if "--order" in flags:
        changes["order"] = "distance"
        assert not torch.equal(model.render(cameras[0], **changes).image, model.render(cameras[0]).image)
    for name, camera in zip(names, cameras, strict=True):
        with torch.no_grad():
            out = model.render(camera, **changes)
        assert torch.equal(picture(run / "renders" / "test" / name), to_uint8(out.image)), name
        assert out.image.std() > 0.05
        if "--buffers" in flags:
            stored = load_buffers(run / "renders" / "test" / f"{Path(name).stem}.exr")
            assert_same(stored, out)


@pytest.mark.parametrize("falloff", [None, FALLOFF])
def test_options_take_the_exposure_and_the_limits_away(falloff, device):
    model, camera = full_model(device, falloff), cameras_of(device)[0]
    exposures, limits = model.exposures, model.detail_limits
    assert_same(model.render(camera), pure(model, camera, exposures=exposures, limits=limits))
    assert_same(model.render(camera, exposure="mean"), pure(model, camera, limits=limits))
    assert_same(model.render(camera, detail_limits=False), pure(model, camera, exposures=exposures))
    bare: RenderChanges = {"exposure": "mean", "detail_limits": False}
    assert_same(model.render(camera, **bare), pure(model, camera))
    changes: list[RenderChanges] = [{}, {"exposure": "mean"}, {"detail_limits": False}, bare]
    images = [model.render(camera, **each).image for each in changes]
    assert all((one - other).abs().max() > 0.01 for one, other in itertools.combinations(images, 2))
    # As options of the model, the same.
    model.options = model.options.changed(**bare)
    assert torch.equal(model.render(camera).image, images[-1])
    assert torch.equal(model.render(camera, exposure="photos", detail_limits=True).image, images[0])


def test_changes_are_options_of_one_rendering(device: torch.device) -> None:
    model, camera = full_model(device), cameras_of(device)[0]
    before = model.options
    out = model.render(camera, max_hits=0, background=(1.0, 0.0, 0.0), sh_degree=0, exposure="mean")
    options = nw.RenderOptions(0, sh_degree=0)
    expected = draw(Frame(model.surfels, None, camera, options, (1.0, 0.0, 0.0), limits=model.detail_limits))
    assert_same(out, expected)
    assert model.options is before
    red = model.render(camera, background=torch.tensor([1.0, 0.0, 0.0], device=device), exposure="mean").image
    assert torch.equal(red, model.render(camera, background=(1.0, 0.0, 0.0), exposure="mean").image)


def test_many_cameras_are_rendered_as_one_is(device: torch.device) -> None:
    model, cameras = full_model(device), cameras_of(device)
    for given in (cameras, tuple(cameras)):
        outs = model.render(given, max_hits=2)
        assert isinstance(outs, list) and len(outs) == len(cameras)
        for out, camera in zip(outs, cameras, strict=True):
            assert_same(out, model.render(camera, max_hits=2))
            assert out.image.shape == (camera.height, camera.width, 3)
    assert model.render([]) == []


def test_the_bare_model_is_its_surfels_alone(device: torch.device) -> None:
    model, camera = full_model(device), cameras_of(device)[0]
    bare = model.bare(max_hits=1)
    assert bare.surfels is model.surfels and bare.options == OPTIONS.changed(max_hits=1)
    assert bare.texture is bare.exposures is bare.detail_limits is None
    assert_same(bare.render(camera), nw.render(model.surfels, None, camera, 1, OPTIONS.background, OPTIONS.sh_degree))


def test_a_camera_elsewhere_is_brought_to_the_model(device: torch.device) -> None:
    model = full_model(device)
    assert_same(model.render(cameras_of()[0]), model.render(cameras_of(device)[0]))


# What rendering leaves as it was


def test_rendering_changes_nothing(device: torch.device) -> None:
    """Parts, parameters and buffers stay, and the same inputs give the same bits."""
    model, cameras = full_model(device), cameras_of(device)
    parts = dict(vars(model)["_modules"])
    before = {name: x.clone() for name, x in model.state_dict().items()}
    first = model.render(cameras)
    render_buffers(model, cameras[0])
    model.render(cameras[1], exposure="mean", detail_limits=False, max_hits=0)
    for one, other in zip(first, model.render(cameras), strict=True):
        assert_same(one, other)
    assert all(vars(model)["_modules"][name] is part for name, part in parts.items())
    assert model.options is OPTIONS and all(parameter.grad is None for parameter in model.parameters())
    assert_equal(model.state_dict(), before)


def test_nothing_is_rendered_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depths and normals take one more walk along the lists that are there, and none where nobody reads them."""
    calls: list[str] = []

    def counting(name: str) -> None:
        original = getattr(ops, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            calls.append(name)
            return original(*arguments, **options)

        monkeypatch.setattr(ops, name, counted)

    stages = ["project", "intersect_tiles", "collect", "compose"]
    for name in (*stages, "surface"):
        counting(name)
    model, camera = full_model(), cameras_of()[0]
    out = model.render(camera)
    assert calls == stages
    for _ in range(2):
        for name in LAZY:
            assert getattr(out, name).abs().max() > 0, name
    assert calls == [*stages, "surface"]
    calls.clear()
    buffers = render_buffers(model, camera)
    assert calls == [*stages, "surface"]
    assert_same(buffers, out, buffers=LAZY)


def test_gradients_are_those_of_the_pure_rendering(device: torch.device) -> None:
    """They reach the camera, the surfels, the texture and the background through exposures and detail limits."""
    camera, found = make_camera(random_scene(1, device=device)), []
    for through_model in (True, False):
        model = full_model(device)
        assert isinstance(model.texture, nw.NeuralTexture)
        model.texture.half_precision = False
        behind = torch.tensor(OPTIONS.background, device=device, requires_grad=True)
        if through_model:
            out = model.render(camera, background=behind)
        else:
            parts = (model.exposures, model.detail_limits)
            out = draw(Frame(model.surfels, model.texture, camera, OPTIONS, behind, *parts))
        leaves: dict[str, torch.Tensor] = {"viewmat": camera.viewmat, "background": behind, "grid": model.texture.grid}
        leaves |= dict(model.surfels.named_parameters())
        gradients = torch.autograd.grad(out.image.square().sum(), list(leaves.values()))
        found.append(dict(zip(leaves, gradients, strict=True)))
    for name, gradient in found[0].items():
        assert_finite(gradient, name)
        assert gradient.abs().max() > 0, name
        if device.type == "cpu":
            assert torch.equal(gradient, found[1][name]), name


def test_state_dicts_hold_exposures_and_limits(device: torch.device) -> None:
    """Loaded into a model with another falloff, which has rendered already, they give the same bits."""
    model, camera = full_model(device), cameras_of(device)[0]
    other = full_model(device, (-0.1, -0.9, 0.2))
    with torch.no_grad():
        for x in (*other.surfels.parameters(), *other.parameters()):
            x.mul_(0.9)
    assert other.exposures is not None and other.detail_limits is not None
    other.exposures.log_gains.mul_(0.5)
    other.detail_limits.farthest.mul_(0.5)
    expected = model.render(camera)
    assert (other.render(camera).image - expected.image).abs().max() > 0.05
    state = {name: x.clone() for name, x in model.state_dict().items()}
    assert {"exposures.falloff", "exposures.log_gains", "detail_limits.nearest", "detail_limits.farthest"} <= set(state)
    other.load_state_dict(state)
    assert_same(other.render(camera), expected)
    even = full_model(device, None)
    other.load_state_dict(even.state_dict())
    assert_same(other.render(camera), even.render(camera))


def test_a_folder_and_a_file_load_the_same(tmp_path: Path) -> None:
    model, camera = full_model(), cameras_of()[0]
    folder = model.save(tmp_path / "new" / "run")
    file = model.save(tmp_path / "mine.safetensors")
    assert folder == tmp_path / "new" / "run" / "model.safetensors" and file == tmp_path / "mine.safetensors"
    assert folder.read_bytes() == file.read_bytes()
    loaded = [nw.load(path) for path in (folder.parent, folder, file, str(file))]
    for each in loaded:
        assert each.options == OPTIONS and each.meta["iteration"] == 7
        assert each.state_dict().keys() == model.state_dict().keys()
        assert_same(each.render(camera), loaded[0].render(camera))
    for name, x in model.state_dict().items():
        assert not name.startswith("texture.") or x.dtype == torch.float32
        exact = x.half().float() if name.startswith("texture.") and name != "texture.resolutions" else x
        assert torch.equal(loaded[0].state_dict()[name], exact), name
    again = nw.load(loaded[0].save(tmp_path / "again.safetensors"))
    assert again.options == OPTIONS and again.meta == loaded[0].meta
    assert_equal(again.state_dict(), loaded[0].state_dict())


def test_models_move_as_a_whole(device: torch.device) -> None:
    model = full_model().to(device)
    assert model.device == model.surfels.device and model.device.type == device.type
    assert {x.device.type for x in model.state_dict().values()} == {device.type}
    double = full_model().to(torch.float64)
    assert {x.dtype for x in double.state_dict().values()} == {torch.float64}
    camera = cameras_of()[0].to(torch.float64)
    image = full_model().render(cameras_of()[0]).image
    torch.testing.assert_close(double.render(camera).image.float(), image, atol=1e-3, rtol=0)


def test_parts_that_do_not_fit_are_named() -> None:
    model = full_model()
    surfels, texture = model.surfels, model.texture
    bad: list[tuple[str, type[Exception], tuple[Any, ...]]] = [
        ("surfels", TypeError, (surfels.state_dict(), texture)),
        ("texture", TypeError, (surfels, surfels)),
        ("exposures", TypeError, (surfels, texture, {"max_hits": 2})),
        ("detail_limits", TypeError, (surfels, texture, None, torch.ones(len(surfels)))),
        ("detail_limits", ValueError, (surfels, texture, None, nw.DetailLimits(torch.ones(3), torch.ones(3)))),
        ("options", TypeError, (surfels, texture, None, None, {"max_hits": 2})),
    ]
    for name, error, arguments in bad:
        with pytest.raises(error, match=rf"^{name}: expected"):
            nw.Model(*arguments)


def test_changes_that_are_no_options_are_named() -> None:
    model, camera = full_model(), cameras_of()[0]
    bad: list[Any] = [(TypeError, {"hits": 2}), (ValueError, {"exposure": "bright"}), (TypeError, {"detail_limits": 1})]
    for error, changes in bad:
        with pytest.raises(error, match=rf"^{next(iter(changes))}: expected"):
            model.render(camera, **changes)
    with pytest.raises(TypeError, match=r"^camera: expected a nexwarp\.Camera"):
        model.render(["camera"])  # type: ignore[list-item]
