"""Baking: evaluate the texture at the texels, then fit texels and SH to the model's own renderings."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError
from nexwarp.export.bake.baked import Baked, mean_colors, sample
from nexwarp.export.bake.layout import Layout, lay_out
from nexwarp.export.bake.observe import Observations, axes, hits_of, observe, untextured
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture

WINDOW = 256  # largest width and height that one step renders
PASSES = 2.0  # over the views' pixels
FEWEST_STEPS, MOST_STEPS = 70, 800
RATES = {"atlas": 0.02, "sh0": 5e-3, "shN": 2e-3}
LAST_RATE = 0.1  # relative to the first


def bake(model: Model, cameras: Sequence[Camera], *, steps: int | None = None) -> Baked:
    """Bake a model's texture into an atlas whose texels are about a pixel of the closest of the given views.

    The number of steps of the fit follows from that of the views' pixels unless it is given.
    """
    seen = observe(model, cameras)
    layout = lay_out(seen.boxes, seen.boxes[:, 2] > seen.boxes[:, 0], seen.pixels)
    atlas = evaluate(model, seen, layout)
    if steps is None:
        windows = sum(camera.width * camera.height for camera in cameras) / WINDOW**2
        steps = min(max(round(PASSES * windows), FEWEST_STEPS), MOST_STEPS)
    return fit(Baked(model, model.surfels, seen, layout, atlas), cameras, steps)


@torch.no_grad()
def evaluate(model: Model, seen: Observations, layout: Layout) -> torch.Tensor:
    """Return an atlas (height, width, 3) of the texture at the texels, seen from the surfels' mean directions.

    What is added to a plain colour is weighted by the fraction of the surfel that is textured.
    """
    atlas = model.surfels.means.new_zeros(layout.height, layout.width, 3)
    texture = model.texture
    if texture is None or model.options.max_hits == 0:
        return atlas
    if not isinstance(texture, NeuralTexture):
        raise FormatError(f"texture: expected a nexwarp.NeuralTexture to bake, got {type(texture).__name__}")
    surfels, degree = model.surfels, model.options.sh_degree
    plain = None if texture.residual else mean_colors(surfels, seen, degree)
    # A pixel of the closest view, in world units: levels of finer cells fade as they do there.
    sizes = (surfels.scales / seen.pixels.clamp_min(1e-12)).amin(1)
    for places, ids, local in layout.centres():
        offsets = (local * surfels.scales[ids]).unbind(1)
        sides = axes(surfels)
        points = surfels.means[ids] + sum(x[:, None] * axis[ids] for x, axis in zip(offsets, sides, strict=True))
        colors = texture.evaluate(
            points[:, None],
            sizes[ids, None],
            seen.directions[ids],
            1.0,
            sh_degree=degree,
            clamp=model.options.clamp_texture,
        )[:, 0]
        if plain is not None:
            colors = colors - plain[ids]
        atlas[places[:, 1], places[:, 0]] = seen.textured[ids, None] * colors
    return atlas


def fit(baked: Baked, cameras: Sequence[Camera], steps: int) -> Baked:
    """Fit atlas and SH to the model's renderings by least squares: Adam, a window of one view a step."""
    model, degree = baked.model, baked.model.options.sh_degree
    state = {name: x.detach().clone() for name, x in baked.surfels.state_dict().items()}
    trained = {"atlas": baked.atlas.clone(), "sh0": state["sh0"], "shN": state["shN"]}
    groups = [{"params": [x.requires_grad_()], "lr": RATES[name]} for name, x in trained.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, LAST_RATE ** (1 / max(steps, 1)))
    bare = untextured(model)
    order = torch.Generator().manual_seed(0)
    views: list[int] = []
    for _ in range(steps):
        views = views or torch.randperm(len(cameras), generator=order).tolist()
        camera = _window(cameras[views.pop()].to(model.device), order)
        target = model.render_image(camera, exposure="mean")
        hits = hits_of(bare, camera)
        plain = ops.plain_colors((trained["sh0"], trained["shN"]), state["means"], camera.position.to(target), degree)
        added = sample(trained["atlas"], baked.layout.texels(hits.ids, hits.local))
        colors = (plain.index_select(0, hits.ids) + added).clamp_min(0)
        with torch.no_grad():  # further hits in their plain colours, and the background
            others = hits.rendering.image - hits.blended(hits.plain_colors())
        loss = (others + hits.blended(colors) - target).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
    state |= {name: trained[name].detach() for name in ("sh0", "shN")}
    return replace(baked, surfels=Surfels(state), atlas=trained["atlas"].detach())


def _window(camera: Camera, generator: torch.Generator) -> Camera:
    """Return the camera of a random window of an image."""
    width, height = min(camera.width, WINDOW), min(camera.height, WINDOW)
    left = int(torch.randint(camera.width - width + 1, (1,), generator=generator))
    top = int(torch.randint(camera.height - height + 1, (1,), generator=generator))
    return camera.crop(left, top, width, height)
