import pytest
import torch

import nexwarp as nw
from tests.narrowing import present
from tests.reference.collect import Shape
from tests.reference.surface import Surface, surface
from tests.render_support import assert_gradients, draw, loss, rigid_gradient, twin, view_of
from tests.scenes import Scene, facing_scene, make_camera, make_surfels, make_texture, named_scene, random_scene
from tests.tolerances import FLIPS, assert_close

DEPTHS = ("expected_depth", "median_depth", "top_depth")
BUFFERS = (*DEPTHS, "normals", "blended_normals")
MAX_HITS = 8
GEOMETRY = ("means", "quats", "scales", "opacities", "gammas")


def facing_quads(*quads: tuple[float, float], device: torch.device, turned: bool = False) -> Scene:
    """Quads (depth, opacity) wider than the image that face the camera; turned ones show their back."""
    scene = facing_scene(*quads, gamma=50.0, size=(12, 9), dtype=torch.float64, device=device)
    return scene | {"quats": scene["quats"].roll(1, dims=1)} if turned else scene


def assert_everywhere(buffer: torch.Tensor, value: float | list[float], name: str) -> None:
    """Fail unless each pixel has the value."""
    expected = torch.tensor(value, dtype=torch.float64, device=buffer.device).expand_as(buffer)
    assert_close(buffer, expected, kind="value", name=name)


@pytest.mark.parametrize("turned", [False, True])
def test_depths_and_normals_of_layers_by_hand(turned: bool, device: torch.device) -> None:
    """Weights 0.3, 0.7 * 0.6 = 0.42 and 0.28 * 0.5 = 0.14; transmittances 0.7, 0.28 and 0.14."""
    out = draw(facing_quads((4.0, 0.5), (2.0, 0.3), (3.0, 0.6), device=device, turned=turned))
    assert_everywhere(out.normals, [0.0, 0.0, -1.0], "normals")
    assert_everywhere(out.expected_depth, (0.3 * 2 + 0.42 * 3 + 0.14 * 4) / 0.86, "expected depth")
    assert_everywhere(out.median_depth, 3.0, "median depth")
    assert_everywhere(out.top_depth, 3.0, "top depth")
    # Where it is mostly transparent, the median is the last hit.
    out = draw(facing_quads((2.0, 0.3), (5.0, 0.2), device=device))
    assert_everywhere(out.median_depth, 5.0, "median depth")
    assert_everywhere(out.top_depth, 2.0, "top depth")


@pytest.mark.parametrize("max_hits", [0, 1, MAX_HITS])
def test_surface_does_not_depend_on_max_hits(max_hits: int, device: torch.device) -> None:
    scene = named_scene("layered", torch.float32, device)
    out, expected = draw(scene, max_hits=max_hits), draw(scene, max_hits=2)
    for name in BUFFERS:
        assert torch.equal(getattr(out, name), getattr(expected, name)), name


def reference(tensors: dict[str, torch.Tensor], camera: nw.Camera) -> Surface:
    """Hand tensors in float64 on the CPU to the reference."""
    return surface(Shape(*(tensors[name] for name in GEOMETRY)), tensors["viewmat"], view_of(camera))


@pytest.mark.parametrize("name", ["random", "layered", "off_centre", "specks"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_surface_agrees_with_the_reference(dtype: torch.dtype, name: str, device: torch.device) -> None:
    """With its gradients to every parameter and the camera; of the random scene in float64 for each buffer, too."""
    scene = named_scene(name, dtype, device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    expected, viewmat = twin(surfels), camera.viewmat.detach().double().cpu().requires_grad_()
    tensors = {key: getattr(expected, key) for key in GEOMETRY} | {"viewmat": viewmat}
    out, right = nw.render(surfels, None, camera), reference(tensors, camera)
    assert right.expected_depth.any() and (name != "specks" or not right.expected_depth.all())
    flips = 0.0 if dtype == torch.float64 else FLIPS
    for buffer in BUFFERS:
        assert_close(getattr(out, buffer), getattr(right, buffer), kind="value", name=buffer, allow_flips=flips)
    leaves = (surfels, camera.viewmat), (expected, viewmat)
    apart = dtype == torch.float64 and name == "random"
    for buffers in (*((buffer,) for buffer in BUFFERS if apart), BUFFERS):
        for module, matrix in leaves:
            module.zero_grad()
            matrix.grad = None
        loss(out, buffers).backward(retain_graph=True)
        loss(right, buffers).backward(retain_graph=True)
        assert_gradients(surfels, expected, dtype)
        turns = rigid_gradient(camera.viewmat), rigid_gradient(viewmat)
        assert_close(*turns, kind="gradient", name=f"viewmat of {buffers}", precision=dtype)


def test_gradients_of_the_reference_agree_with_differences() -> None:
    scene = random_scene(6, seed=3, width=7, height=6, dtype=torch.float64)
    camera = make_camera(scene)
    inputs = [scene[name].clone().requires_grad_() for name in (*GEOMETRY, "viewmat")]

    def buffers(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = reference(dict(zip((*GEOMETRY, "viewmat"), tensors, strict=True)), camera)
        return tuple(getattr(out, name) for name in BUFFERS)

    assert buffers(*inputs)[-1].max() > 0.01 and torch.autograd.gradcheck(buffers, inputs, fast_mode=True)


@pytest.mark.cuda
def test_gradients_repeat_bit_for_bit() -> None:
    """Thousands of overlapping surfels, half precision: with torch's deterministic algorithms all bits repeat."""
    device = torch.device("cuda")
    scene = random_scene(4000, width=400, height=300, device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device, residual=True), make_camera(scene)
    geometry = [x for name, x in surfels.named_parameters() if not name.startswith("sh")]
    found = []
    torch.use_deterministic_algorithms(True)
    try:
        for _ in range(5):
            out = nw.render(surfels, texture, camera)
            request = out.request_splat_error(out.alpha.detach())
            image, parameters = out.image.square().sum(), [*surfels.parameters(), *texture.parameters()]
            grads = torch.autograd.grad(image + out.weights.square().sum(), parameters, retain_graph=True)
            of_surface = torch.autograd.grad(loss(out, BUFFERS), [*geometry, camera.viewmat])
            sums = present(request.sums_after_backward), out.splat_error(out.alpha.detach())
            found.append([*grads, *of_surface, *sums])
    finally:
        torch.use_deterministic_algorithms(False)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


@pytest.mark.cuda
def test_cuda_agrees_with_the_cpu() -> None:
    results = []
    for device in ("cpu", "cuda"):
        scene = random_scene(3000, seed=5, width=200, height=150, device=device)
        surfels = make_surfels(scene)
        out = nw.render(surfels, None, make_camera(scene))
        loss(out, ("expected_depth", "blended_normals")).backward()
        results.append((out, surfels))
    (cpu, one), (cuda, two) = results
    for name in BUFFERS:
        assert_close(getattr(cuda, name), getattr(cpu, name), kind="value", name=name, allow_flips=FLIPS)
    for (name, a), (_, b) in zip(one.named_parameters(), two.named_parameters(), strict=True):
        if a.grad is not None:
            assert_close(present(b.grad), a.grad, kind="gradient", name=name)
