"""Train nexels without torch's autograd: `wp.Tape` differentiates from the raw parameters to the loss.

python examples/tape.py --steps 100
"""

import argparse
from collections.abc import Mapping
from typing import Any, TypeAlias

import torch
import warp as wp
from warp.optim import Adam

import nexwarp as nw
from nexwarp import tape as stages

Array: TypeAlias = "wp.array[Any]"
VECTORS = ("means", "raw_quats", "log_scales", "raw_gammas", "sh0", "shN", "grid")
RATE = 0.01


@wp.kernel
def squared_error(image: wp.array[wp.vec3], photo: wp.array[wp.vec3], loss: wp.array[float]):
    """Mean of (image - photo)^2."""
    error = image[wp.tid()] - photo[wp.tid()]
    wp.atomic_add(loss, 0, wp.dot(error, error) / float(3 * image.shape[0]))  # type: ignore[call-overload]


def array(x: torch.Tensor, axes: int = 0) -> Array:
    """Copy a tensor to an array, with gradients, of scalars or of what its last axes hold: vectors or matrices."""
    wp.init()
    dtype = wp.dtype_from_torch(x.dtype)
    if axes == 1:
        dtype = wp.types.vector(length=x.shape[-1], dtype=dtype)
    elif axes == 2:
        dtype = wp.types.matrix(shape=x.shape[-2:], dtype=dtype)
    copy = wp.from_torch(x.detach().clone(), dtype=dtype, requires_grad=True)
    assert isinstance(copy, wp.array)
    return copy


def parameters_of(surfels: nw.Surfels, texture: nw.NeuralTexture) -> dict[str, Array]:
    """Copy all parameters by name; the matrices of the MLP are mlp0, mlp1 ..."""
    x = dict(surfels.named_parameters()) | {"grid": texture.grid}
    x |= {f"mlp{i}": matrix for i, matrix in enumerate(texture.mlp.parameters())}
    return {name: array(parameter, int(name in VECTORS)) for name, parameter in x.items()}


def draw(tape: wp.Tape, x: Mapping[str, Array], resolutions: Array, camera: nw.Camera, viewmat: Array) -> Array:
    """Image (H * W) vec3 before a black background, as `nw.render` draws it."""
    image = stages.Image((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height), camera.near)
    shape = stages.activate(tape, x["raw_quats"], x["log_scales"], x["logit_opacities"], x["raw_gammas"])
    colors = stages.plain_colors(tape, (x["sh0"], x["shN"]), x["means"], viewmat, degree=3)
    records, centers, limits = stages.project(tape, x["means"], *shape, colors, viewmat)
    lists = stages.intersect_tiles(x["means"], *shape, centers, viewmat, image)
    hits = stages.collect(tape, records, limits, lists, image, max_hits=2)
    positions, directions = stages.unproject(tape, hits.depths, viewmat, image)
    features = stages.hashgrid(tape, x["grid"], positions, hits.depths, resolutions, image)
    coefficients = stages.mlp(tape, [x[name] for name in x if name.startswith("mlp")], features)
    texels = stages.textured_colors(tape, coefficients, directions, degree=3)
    background = wp.zeros(1, dtype=directions.dtype, device=directions.device)
    return stages.compose(tape, hits.plain, texels, hits.weights, hits.alphas, background)[0]


def scalars(x: Array) -> Array:
    """View the memory of an array of float32 vectors as scalars, which is what Warp's Adam takes."""
    return wp.array(ptr=x.ptr, dtype=float, shape=(x.capacity // 4,), device=x.device)


def train(x: Mapping[str, Array], resolutions: Array, views: list[nw.View], steps: int) -> list[float]:
    """Train on views in turn, whose cameras are on the device of the parameters; return the losses."""
    grads = [scalars(parameter.grad) for parameter in x.values()]
    optimizer, losses = Adam([scalars(parameter) for parameter in x.values()], lr=RATE), []
    device = wp.device_to_torch(resolutions.device)
    photos = [array(view.image.to(device).reshape(-1, 3) / 255.0, 1) for view in views]
    for step in range(steps):
        camera, photo = views[step % len(views)].camera, photos[step % len(views)]
        tape, loss = wp.Tape(), wp.zeros(1, dtype=float, requires_grad=True, device=photo.device)
        image = draw(tape, x, resolutions, camera, array(camera.viewmat[None], 2))
        with tape:
            wp.launch(squared_error, image.shape, [image, photo], [loss], device=photo.device)
        tape.backward(loss)
        optimizer.step(grads)
        tape.zero()
        losses.append(loss.numpy()[0].item())
    return losses


def start(scene: nw.Scene) -> tuple[nw.Surfels, nw.NeuralTexture]:
    """Small round surfels at some of the scene's points, and a texture of random weights."""
    means = scene.points[:: max(len(scene.points) // 200, 1)]
    count = len(means)
    ones = torch.ones(count)
    sh = torch.zeros(count, 16, 3)
    quats, scales = torch.randn(count, 4), 0.03 * scene.scale * torch.ones(count, 2)
    surfels = nw.Surfels.from_activated(means, quats, scales, 0.5 * ones, torch.full((count, 2), 1.5), sh)
    return surfels, nw.NeuralTexture(levels=4, table_size=2**10, width=16, min_resolution=4.0, max_resolution=32.0)


def main() -> None:
    """Train, and tell how the loss falls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    scene = nw.load_scene("demo", downscale=4)
    torch.manual_seed(0)
    surfels, texture = start(scene)
    losses = train(parameters_of(surfels, texture), array(texture.resolutions), scene.train, args.steps)
    for name, part in (("first", losses[: args.steps // 10]), ("last", losses[-(args.steps // 10) :])):
        print(f"{name} tenth of the steps: loss {sum(part) / len(part):.4f}")


if __name__ == "__main__":
    main()
