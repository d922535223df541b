import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

import nexwarp as nw
from tests.scenes import SURFEL_KEYS, make_camera, make_surfels, make_texture, random_scene, rigid
from tests.tolerances import ACTIVATION


def assert_refused(error: type[Exception], argument: str, call: Callable[..., Any], *args: Any, **kw: Any) -> None:
    """Fail unless the call raises `error` and its message contains the word `argument`."""
    with pytest.raises(error) as caught:
        call(*args, **kw)
    message = str(caught.value)
    assert re.search(rf"\b({argument})\b", message), f"{message!r} does not name {argument}"


def changed(tensor: torch.Tensor, index: tuple[int, ...], value: float) -> torch.Tensor:
    tensor = tensor.clone()
    tensor[index] = value
    return tensor


MIRRORED = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))
SHEARED = changed(torch.eye(4), (0, 1), 0.01)
K = torch.tensor([[20.0, 0.0, 8.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])

BAD_CAMERAS = [
    ("viewmat", ValueError, SHEARED),
    ("viewmat", ValueError, MIRRORED),
    ("viewmat", ValueError, changed(torch.eye(4), (3, 0), 0.5)),
    ("viewmat", ValueError, changed(torch.eye(4), (1, 3), float("nan"))),
    ("viewmat", TypeError, torch.eye(4).int()),
    ("viewmat", ValueError, torch.eye(3).tolist()),
    ("viewmat", TypeError, [[1.0, 0.0], [1.0]]),
    ("K", ValueError, changed(K, (0, 1), 0.5)),
    ("K", ValueError, changed(K, (0, 0), -20.0)),
    ("K", ValueError, changed(K, (0, 2), float("nan"))),
    ("K", ValueError, changed(K, (2, 2), 2.0)),
    ("K", TypeError, 20.0),
    ("width", ValueError, 0),
    ("height", ValueError, -1),
    ("near", ValueError, -0.1),
    ("near", ValueError, float("nan")),
]


@pytest.mark.parametrize(("argument", "error", "value"), BAD_CAMERAS)
def test_bad_camera(argument: str, error: type[Exception], value: Any) -> None:
    good: dict[str, Any] = {"viewmat": torch.eye(4), "K": K, "width": 16, "height": 16, "near": 0.01}
    nw.Camera(**good)
    assert_refused(error, argument, nw.Camera, **(good | {argument: value}))


def test_camera_accepts_rounding() -> None:
    """A rotation off by less than 1e-3, a principal point outside the image, near = 0."""
    viewmat = rigid((0.5, 0.1, -0.4, 0.2), (1.0, 2.0, 3.0)).float()
    nw.Camera(changed(viewmat, (0, 0), viewmat[0, 0].item() + 1e-4), K, 16, 16)
    nw.Camera(viewmat, changed(K, (0, 2), -100.0), 16, 16, near=0.0)


@pytest.mark.parametrize("convert", [torch.Tensor.tolist, torch.Tensor.numpy, lambda x: x.double().numpy()])
def test_cameras_take_arrays_and_lists(convert: Callable[[torch.Tensor], Any]) -> None:
    viewmat = rigid((0.5, 0.1, -0.4, 0.2), (1.0, 2.0, 3.0)).float()
    camera, expected = nw.Camera(convert(viewmat), convert(K), 16, 16), nw.Camera(viewmat, K, 16, 16)
    for name in ("viewmat", "K"):
        made = getattr(camera, name)
        assert made.dtype == torch.float32 and torch.equal(made, getattr(expected, name))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (expected.fx, expected.fy, expected.cx, expected.cy)
    made.fill_(0.0)  # a copy: the array of the caller stays
    assert expected.K[0, 0] == 20.0


BAD_SURFELS = [
    ("means", ValueError, lambda means: means[:, :2]),
    ("means", ValueError, lambda means: changed(means, (2, 1), float("nan"))),
    ("quats", ValueError, lambda quats: torch.where(torch.arange(8)[:, None] == 3, 0.0, quats)),
    ("quats", ValueError, lambda quats: changed(quats, (0, 0), float("inf"))),
    ("scales", ValueError, lambda scales: scales[:, :1]),
    ("scales", ValueError, lambda scales: changed(scales, (4, 1), 0.0)),
    ("scales", TypeError, lambda scales: scales.double()),
    ("opacities", ValueError, lambda opacities: changed(opacities, (1,), 1.5)),
    ("gammas", ValueError, lambda gammas: changed(gammas, (5, 0), 0.5)),
    ("sh", ValueError, lambda sh: sh[:, :5]),
    ("sh", ValueError, lambda sh: changed(sh, (7, 15, 2), float("nan"))),
    ("sh", TypeError, lambda sh: sh.half()),
    ("means", ValueError, lambda means: means + torch.zeros(3, requires_grad=True)),  # its graph would be cut
]


@pytest.mark.parametrize(("argument", "error", "spoil"), BAD_SURFELS)
def test_bad_surfels(argument: str, error: type[Exception], spoil: Callable[[Any], Any]) -> None:
    scene = random_scene(8)
    values = {key: scene[key] for key in SURFEL_KEYS}
    nw.Surfels.from_activated(**values)
    assert_refused(error, argument, nw.Surfels.from_activated, **values | {argument: spoil(values[argument])})


def test_surfels_are_fresh_leaves() -> None:
    scene = random_scene(8)
    scene["means"].requires_grad_()
    for name, parameter in make_surfels(scene).named_parameters():
        assert parameter.is_leaf and parameter.requires_grad, name
        assert all(parameter.data_ptr() != scene[key].data_ptr() for key in SURFEL_KEYS if scene[key].numel())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_of_the_ranges(dtype: torch.dtype) -> None:
    scene = random_scene(8, dtype=dtype)
    scene["opacities"][:2] = torch.tensor([0.0, 1.0], dtype=dtype)
    scene["gammas"][:3] = torch.tensor([[1.0, 1.0], [1.0 + 1e-7, 50.0], [1.0, 2.0]], dtype=dtype)
    scene["scales"][:2] = torch.tensor([[1e-30, 1e-7], [1e4, 1e-5]], dtype=dtype)
    surfels = make_surfels(scene)
    for name, parameter in surfels.named_parameters():
        assert parameter.isfinite().all(), name
    for name in ("means", "scales", "opacities", "gammas", "sh"):
        expected = scene[name].double()
        error = (getattr(surfels, name).double() - expected).abs() / expected.abs().clamp_min(1)
        assert error.max() <= ACTIVATION, f"{name}: off by {error.max():.3g}"
    assert (surfels.scales > 0).all()


BAD_TEXTURES = [("levels", 0), ("table_size", 1000), ("features", 3), ("min_resolution", 0.0), ("max_resolution", 1.0)]
BAD_TEXTURES += [("width", 0), ("hidden_layers", -1), ("sh_degree", 4)]


@pytest.mark.parametrize(("argument", "value"), BAD_TEXTURES)
def test_bad_texture(argument: str, value: Any) -> None:
    good: dict[str, Any] = {"levels": 2, "table_size": 2**6, "features": 2}
    good |= {"min_resolution": 2.0, "max_resolution": 8.0}
    nw.NeuralTexture(**good)
    assert_refused(ValueError, argument, nw.NeuralTexture, **(good | {argument: value}))


BAD_RENDERS = [
    ("max_hits", ValueError, -1),
    ("max_hits", TypeError, 1.5),
    ("sh_degree", ValueError, 7),
    ("sh_degree", TypeError, "3"),
    ("background", ValueError, (0.0, 0.0)),
    ("background", (TypeError, ValueError), "black"),
    ("surfels", TypeError, torch.zeros(3, 3)),
    ("texture", TypeError, "texture"),
    ("camera", TypeError, torch.eye(4)),
]


@pytest.mark.parametrize(("argument", "error", "value"), BAD_RENDERS)
def test_bad_render(argument: str, error: type[Exception], value: Any) -> None:
    scene = random_scene(4)
    good = {"surfels": make_surfels(scene), "texture": make_texture(), "camera": make_camera(scene)}
    assert_refused(error, argument, nw.render, **(good | {argument: value}))


def test_render_refuses_to_mix_dtypes() -> None:
    single, double = random_scene(4), random_scene(4, dtype=torch.float64)
    surfels, camera = make_surfels(single), make_camera(single)
    assert_refused(TypeError, "texture", nw.render, surfels, make_texture(dtype=torch.float64), camera)
    assert_refused(TypeError, "camera|viewmat", nw.render, surfels, None, make_camera(double))
    assert_refused(TypeError, "surfels|means", nw.render, surfels.half(), None, camera)
