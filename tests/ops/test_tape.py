"""A Warp-only program differentiates a whole render with `tape.backward()`, and agrees with torch's gradients."""

from typing import Any

import pytest
import torch
import warp as wp

import nexwarp as nw
from nexwarp import ops
from nexwarp.kernels.types import types
from nexwarp.ops import tape as passes
from tests.narrowing import present
from tests.scenes import CAMERA_KEYS, SURFEL_KEYS, random_scene
from tests.tolerances import assert_close
from tests.warp_kernels import REAL, matmul, relu, weighted_sum

HITS = 2


def to_warp(tensor: torch.Tensor, dtype: type) -> "wp.array[Any]":
    array = wp.from_torch(tensor.detach().clone().contiguous(), dtype=dtype, requires_grad=True)
    assert isinstance(array, wp.array)
    return array


@pytest.mark.parametrize("residual", [False, True])
def test_tape_and_torch_give_the_same_gradients(residual: bool, device: torch.device) -> None:
    scene = random_scene(dtype=torch.float64, device=device, off_centre=True)
    surfels = nw.Surfels.from_activated(*(scene[key] for key in SURFEL_KEYS))
    viewmat = scene["viewmat"].clone().requires_grad_()
    camera = nw.Camera(**{key: scene[key] for key in CAMERA_KEYS} | {"viewmat": viewmat})
    torch.manual_seed(1)
    texture = nw.NeuralTexture(3, 2**8, min_resolution=1.0, max_resolution=4.0, width=8, residual=residual)
    texture = texture.to(device=device, dtype=torch.float64)
    with torch.no_grad():
        texture.grid.uniform_(-1, 1)
    background = torch.tensor([0.1, 0.5, 0.3], dtype=torch.float64, device=device)
    weights = torch.randn(camera.height, camera.width, 3, dtype=torch.float64).to(device)

    activated = {key: getattr(surfels, key).detach().requires_grad_() for key in SURFEL_KEYS}
    out = nw.render(surfels, texture, camera, HITS, background)
    (out.image * weights).sum().backward()
    # Torch's gradients with respect to the activated values: through the activations, by the chain rule's other side.
    loss, gradients, image = warp_program(activated, texture, viewmat, camera, background, weights)
    for name, value in activated.items():
        value.grad = gradients.pop(name)
    rebuilt = {key: getattr(surfels, key) for key in SURFEL_KEYS}
    named = dict(surfels.named_parameters())
    through = torch.autograd.grad(
        [rebuilt[key] for key in SURFEL_KEYS], list(named.values()), [activated[key].grad for key in SURFEL_KEYS]
    )
    assert_close(image, out.image, kind="value", name="image")
    assert_close(loss, (out.image * weights).sum(), kind="value", name="loss")
    for (name, parameter), gradient in zip(named.items(), through, strict=True):
        assert_close(gradient, present(parameter.grad), kind="gradient", name=name)
    assert_close(gradients["grid"], present(texture.grid.grad), kind="gradient", name="grid")
    for index, matrix in enumerate(texture.mlp.parameters()):
        assert_close(gradients[f"mlp{index}"], present(matrix.grad), kind="gradient", name=f"mlp{index}")
    position = torch.autograd.grad(camera.position, viewmat, gradients["position"])[0]
    assert_close(gradients["viewmat"] + position, present(viewmat.grad), kind="gradient", name="viewmat")


def test_tape_and_torch_give_the_same_gradients_of_a_surface(device: torch.device) -> None:
    scene = random_scene(dtype=torch.float64, device=device, off_centre=True)
    leaves = {key: scene[key].clone().requires_grad_() for key in SURFEL_KEYS[:5]}
    viewmat = scene["viewmat"].clone().requires_grad_()
    camera = nw.Camera(**{key: scene[key] for key in CAMERA_KEYS} | {"viewmat": viewmat})
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    means, quats, scales, opacities, gammas = leaves.values()
    given = (means, quats, scales, opacities, gammas)
    projection = ops.project(*given, torch.zeros_like(means), viewmat)
    tiles = ops.intersect_tiles(given, projection, viewmat, pinhole)
    hits = ops.collect(projection, tiles, pinhole)
    found = ops.surface(projection, tiles, hits, pinhole, viewmat.detach())
    normals = found.blended_normals @ viewmat[:3, :3].detach().T  # back to the camera's frame
    buffers = [found.expected_depth, found.median_depth, found.top_depth, normals]
    cotangents = [torch.randn_like(x) for x in buffers]
    torch.autograd.backward(buffers, cotangents)

    t, tape = types(REAL), wp.Tape()
    shape = (
        to_warp(means, t.vec3),
        to_warp(quats, t.vec4),
        to_warp(scales, t.vec2),
        to_warp(opacities, REAL),
        to_warp(gammas, t.vec2),
    )
    view, colors = to_warp(viewmat[None], t.mat44), to_warp(torch.zeros_like(scene["means"]), t.vec3)
    image = passes.Image((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height), camera.near)
    records, centers, limits = passes.project(tape, *shape, colors, view)
    lists = passes.intersect_tiles(*shape, centers, view, image)
    stops = passes.collect(tape, records, limits, lists, image, HITS).stops
    surface = passes.surface(tape, records, limits, lists, image, stops)
    for buffer, expected in zip(surface, buffers, strict=True):
        assert_close(wp.to_torch(buffer).view_as(expected), expected, kind="value", name="buffer")
    grads = {
        buffer: to_warp(x.view(-1, *x.shape[2:]), buffer.dtype) for buffer, x in zip(surface, cotangents, strict=True)
    }
    tape.backward(grads=grads)
    for array, (name, leaf) in zip(shape, leaves.items(), strict=True):
        assert_close(wp.to_torch(array.grad), present(leaf.grad), kind="gradient", name=name)
    assert_close(wp.to_torch(view.grad)[0], present(viewmat.grad), kind="gradient", name="viewmat")


def launch(tape: wp.Tape, kernel: wp.Kernel, shape: tuple[int, int], inputs: "list[wp.array[Any]]") -> "wp.array[Any]":
    y = wp.zeros(shape, dtype=REAL, device=inputs[0].device, requires_grad=True)
    with tape:
        wp.launch(kernel, shape, inputs=inputs, outputs=[y], device=y.device)
    return y


def warp_program(
    surfels: dict[str, torch.Tensor],
    texture: nw.NeuralTexture,
    viewmat: torch.Tensor,
    camera: nw.Camera,
    background: torch.Tensor,
    weights: torch.Tensor,
) -> tuple[torch.Tensor, dict[str, torch.Tensor], torch.Tensor]:
    """Render with nothing but Warp; return the loss, the gradients by name and the image."""
    t = types(REAL)
    kinds = {"means": t.vec3, "quats": t.vec4, "scales": t.vec2, "opacities": REAL, "gammas": t.vec2, "sh": t.vec3}
    x = {key: to_warp(value, kinds[key]) for key, value in surfels.items()}
    view, position = to_warp(viewmat[None], t.mat44), to_warp(camera.position[None], t.vec3)
    table = to_warp(texture.grid, wp.types.vector(length=texture.grid.shape[2], dtype=REAL))
    matrices = [to_warp(w, REAL) for w in texture.mlp.parameters()]
    image = passes.Image((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height), camera.near)
    focal = to_warp(torch.full((1,), camera.focal, dtype=torch.float64, device=viewmat.device), REAL)

    tape = wp.Tape()
    colors = passes.plain_colors(tape, x["sh"], x["means"], position, 3)
    shape = (x["means"], x["quats"], x["scales"], x["opacities"], x["gammas"])
    records, centers, limits = passes.project(tape, *shape, colors, view)
    lists = passes.intersect_tiles(*shape, centers, view, image)
    hits = passes.collect(tape, records, limits, lists, image, HITS)
    positions, directions = passes.unproject(tape, hits.depths, view, image)
    resolutions = to_warp(texture.resolutions.double(), REAL)
    features = passes.hashgrid(tape, table, positions.flatten(), hits.depths.flatten(), resolutions, focal)
    for index, matrix in enumerate(matrices):
        if index:
            features = launch(tape, relu, features.shape, [features])
        features = launch(tape, matmul, (matrix.shape[0], features.shape[1]), [matrix, features])
    offset = 0.0 if texture.residual else 0.5
    texels = passes.textured_colors(tape, features, directions, 3, offset=offset)
    out, _ = passes.compose(
        tape,
        hits.plain,
        texels.reshape(hits.weights.shape),
        hits.weights,
        hits.alphas,
        to_warp(background[None], t.vec3),
        hits.base if texture.residual else None,
    )
    loss = wp.zeros(1, dtype=REAL, device=out.device, requires_grad=True)
    with tape:
        cotangent = to_warp(weights.view(-1, 3), t.vec3)
        wp.launch(weighted_sum, len(out), inputs=[out, cotangent], outputs=[loss], device=out.device)
    tape.backward(loss)

    arrays = {**x, "viewmat": view, "position": position, "grid": table}
    arrays |= {f"mlp{index}": matrix for index, matrix in enumerate(matrices)}
    gradients = {key: wp.to_torch(value.grad) for key, value in arrays.items()}
    gradients["viewmat"], gradients["position"] = gradients["viewmat"][0], gradients["position"][0]
    picture = wp.to_torch(out).view(camera.height, camera.width, 3)
    return wp.to_torch(loss)[0], gradients, picture
