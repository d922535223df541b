import torch
import warp as wp

import nexwarp as nw
from examples import tape as example
from nexwarp import ops
from nexwarp.model.surfels import PARAMETERS
from nexwarp.ops import tape as passes
from tests.narrowing import present
from tests.scenes import SURFEL_KEYS, make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close
from tests.warp_kernels import REAL, weighted_sum

HITS = 2


def test_tape_and_torch_give_the_same_gradients_of_a_nexel(device: torch.device) -> None:
    """From the raw parameters to the loss: of every parameter, weight and the camera's pose."""
    scene = random_scene(dtype=torch.float64, device=device, off_centre=True)
    surfels, texture = make_surfels(scene), make_texture(dtype=torch.float64, device=device)
    texture.half_precision = False
    camera = make_camera(scene)
    x = example.parameters_of(surfels, texture)
    view, resolutions = example.array(camera.viewmat[None], 2), example.array(texture.resolutions.double())
    tape, loss = wp.Tape(), wp.zeros(1, dtype=REAL, device=view.device, requires_grad=True)
    image = example.draw(tape, x, resolutions, camera, view)
    weights = torch.randn(camera.height, camera.width, 3, dtype=torch.float64).to(device)
    with tape:
        cotangent = example.array(weights.view(-1, 3), 1)
        wp.launch(weighted_sum, len(image), inputs=[image, cotangent], outputs=[loss], device=image.device)
    tape.backward(loss)

    out = nw.render(surfels, texture, camera, HITS)
    (out.image * weights).sum().backward()
    assert_close(wp.to_torch(image).view_as(out.image), out.image, kind="value", name="image")
    parameters = dict(surfels.named_parameters()) | {"grid": texture.grid}
    parameters |= {f"mlp{i}": matrix for i, matrix in enumerate(texture.mlp.parameters())}
    assert x.keys() == parameters.keys() >= set(PARAMETERS)
    for name, parameter in parameters.items():
        assert present(parameter.grad).abs().max() > 0, name
        assert_close(wp.to_torch(x[name].grad), present(parameter.grad), kind="gradient", name=name)
    assert_close(wp.to_torch(view.grad)[0], present(camera.viewmat.grad), kind="gradient", name="viewmat")


def test_residual_colors_are_composed_with_the_plain_ones(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = ((7, 3), (14, 3), (7, 2), (7,), (1, 3), (7, 3))
    tensors = [torch.rand(*shape, generator=generator, dtype=torch.float64).to(device) for shape in shapes]
    leaves = [x.requires_grad_() for x in tensors]
    plain, colors, weights, alphas, background, base = leaves
    slots = (colors.view(1, 7, 2, 3), weights[None])
    expected, _ = ops.compose(plain[None], *slots, alphas[None], background[0], base[None])
    expected.square().sum().backward()
    arrays = [example.array(x, int(x.shape[-1] == 3)) for x in leaves]
    tape = wp.Tape()
    image, _ = passes.compose(tape, *arrays)
    tape.backward(grads={image: example.array(2 * expected[0], 1)})
    for array, leaf in zip(arrays, leaves, strict=True):
        assert_close(wp.to_torch(array.grad), present(leaf.grad), kind="gradient", name="compose")


def test_tape_and_torch_give_the_same_gradients_of_a_surface(device: torch.device) -> None:
    scene = random_scene(dtype=torch.float64, device=device, off_centre=True)
    leaves = {key: scene[key].clone().requires_grad_() for key in SURFEL_KEYS[:5]}
    camera = make_camera(scene)
    pinhole = ops.Pinhole(camera.K, camera.width, camera.height, camera.near)
    means, quats, scales, opacities, gammas = leaves.values()
    given = (means, quats, scales, opacities, gammas)
    projection = ops.project(*given, torch.zeros_like(means), camera.viewmat)
    tiles = ops.intersect_tiles(given, projection, camera.viewmat, pinhole)
    found = ops.surface(projection, ops.collect(projection, tiles, pinhole), camera.viewmat.detach())
    normals = found.blended_normals @ camera.viewmat[:3, :3].detach().T  # back to the camera's frame
    buffers = [found.expected_depth, found.median_depth, found.top_depth, normals]
    cotangents = [torch.randn_like(x) for x in buffers]
    torch.autograd.backward(buffers, cotangents)

    tape = wp.Tape()
    shape = [example.array(x, x.ndim - 1) for x in given]
    m, q, s, o, g = shape
    view, colors = example.array(camera.viewmat[None], 2), example.array(torch.zeros_like(scene["means"]), 1)
    image = passes.Image((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height), camera.near)
    records, centers, limits = passes.project(tape, m, q, s, o, g, colors, view)
    lists = passes.intersect_tiles(m, q, s, o, g, centers, view, image)
    stops = passes.collect(tape, records, limits, lists, image, HITS).stops
    surface = passes.surface(tape, records, limits, lists, image, stops)
    for buffer, expected in zip(surface, buffers, strict=True):
        assert_close(wp.to_torch(buffer).view_as(expected), expected, kind="value", name="buffer")
    grads = {buffer: example.array(x.flatten(0, 1), x.ndim - 2) for buffer, x in zip(surface, cotangents, strict=True)}
    tape.backward(grads=grads)
    for array, (name, leaf) in zip(shape, leaves.items(), strict=True):
        assert_close(wp.to_torch(array.grad), present(leaf.grad), kind="gradient", name=name)
    assert_close(wp.to_torch(view.grad)[0], present(camera.viewmat.grad), kind="gradient", name="viewmat")
