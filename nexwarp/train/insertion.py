"""New surfels at pixels of large error: density control where splits, which stay on existing surfels, cannot reach."""

import math
from collections.abc import Sequence

import torch

from nexwarp.camera import Camera, visible_points
from nexwarp.data import View
from nexwarp.kernels.sh import BAND_0
from nexwarp.model.model import Model
from nexwarp.render import Rendering
from nexwarp.train.initial import INITIAL_RAW_GAMMA
from nexwarp.train.step_losses import SATURATION
from nexwarp.train.views import TrainingViews

VIEWS = 4  # training views that the surfels of a round are placed in
OPACITY = 0.3  # of a new surfel: visible enough to be trained, too little to hide what is behind it
OPAQUE = 0.5  # alpha of a pixel from which the rendering has a depth there; otherwise the nearest point has it
BLUR = 5  # width, in pixels, of the box that averages errors: single pixels are noise
CLEAR = 1e-12  # weight of a pixel without an error: it is never drawn


@torch.no_grad()
def new_surfels(
    model: Model,
    views: TrainingViews,
    scene_views: Sequence[View],
    count: int,
    generator: torch.Generator,
    noise: torch.Generator,
) -> dict[str, torch.Tensor] | None:
    """Place surfels at pixels of training views that are drawn with a probability proportional to their error.

    A new surfel lies at the depth that is rendered there; where little is rendered, at the depth of the nearest point
    that was triangulated from the photo. It takes the orientation and the colour of the heaviest surfel of the pixel,
    corrected by the pixel's error, and is half as wide as surfels that share the image evenly would be.

    Args:
        model: as it is trained now.
        views: training views on the model's device.
        scene_views: the same views, with their points.
        count: how many surfels, at least 1.
        generator: of the choice of views, on the CPU.
        noise: of the choice of pixels, on the model's device.

    Returns:
        Raw parameters by name, at most `count` rows; None where no pixel has both an error and a depth.
    """
    chosen = torch.randperm(len(views), generator=generator)[:VIEWS].tolist()
    parts = []
    for number, index in enumerate(chosen):
        share = (count * (number + 1)) // len(chosen) - (count * number) // len(chosen)
        if share:
            parts.append(_in_view(model, views, index, scene_views[index].points, share, noise))
    found = [part for part in parts if part is not None]
    return {name: torch.cat([part[name] for part in found]) for name in found[0]} if found else None


def _in_view(
    model: Model, views: TrainingViews, index: int, points: torch.Tensor | None, count: int, noise: torch.Generator
) -> dict[str, torch.Tensor] | None:
    """Place surfels in one view; None where none of its pixels has an error and a depth."""
    camera, photo = views.get(index, 1)
    out, exposure = model.render(camera), views.exposure(index, 1)
    missing = photo - (out.image if exposure is None else out.image * exposure)
    if exposure is not None:  # clipped photos have no error where the rendering is brighter
        missing = missing.masked_fill((photo >= SATURATION) & (missing < 0), 0.0)
    mask = views.mask(index, 1)
    errors = missing.abs().mean(-1)
    errors = errors if mask is None else errors * mask
    errors = torch.nn.functional.avg_pool2d(errors[None], BLUR, 1, BLUR // 2)[0]
    pixels = _draw(errors.flatten(), count, noise)
    depths = _depths(out, camera, pixels, points)
    pixels, depths = pixels[depths > 0], depths[depths > 0]
    if len(pixels) == 0:
        return None
    light = torch.ones_like(missing) if exposure is None else exposure.expand_as(missing)
    correction = (missing / light.clamp_min(0.05)).flatten(0, 1)[pixels]
    seen = photo.div(light.clamp_min(0.05)).flatten(0, 1)[pixels]
    return _raw(model, camera, out, pixels, depths, correction, seen)


def _draw(errors: torch.Tensor, count: int, noise: torch.Generator) -> torch.Tensor:
    """Draw pixels (M,) without replacement, with probability proportional to their errors (P,), ascending."""
    keys = torch.empty_like(errors).exponential_(generator=noise) / errors.clamp_min(CLEAR)
    chosen = keys.topk(min(count, len(keys)), largest=False).indices.sort().values
    return chosen[errors[chosen] > CLEAR]


def _depths(out: Rendering, camera: Camera, pixels: torch.Tensor, points: torch.Tensor | None) -> torch.Tensor:
    """Return the z-depths (M,) at which surfels of the pixels lie; 0 where none is known."""
    depths = out.median_depth.flatten()[pixels]
    unknown = out.alpha.flatten()[pixels] < OPAQUE
    depths = depths.masked_fill(unknown, 0.0)
    found = None
    if points is not None and bool(unknown.any()):
        found = visible_points(*camera.project(points.to(camera.device)), camera.width, camera.height)
    if found is not None:
        places, known = found
        empty = unknown.nonzero()[:, 0]
        nearest = torch.cdist(_grid(pixels[empty], camera.width), _grid(places, camera.width)).argmin(1)
        depths[empty] = known[nearest]
    return depths


def _grid(pixels: torch.Tensor, width: int) -> torch.Tensor:
    return torch.stack([pixels % width, pixels // width], dim=1).float() + 0.5


def _raw(
    model: Model,
    camera: Camera,
    out: Rendering,
    pixels: torch.Tensor,
    depths: torch.Tensor,
    correction: torch.Tensor,
    seen: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """Return the raw parameters of surfels at pixels (M,) and z-depths (M,).

    `correction` (M, 3) is what the rendering lacks there, and `seen` (M, 3) the photo, both at the mean exposure.
    """
    surfels = model.surfels
    top = out.ids[..., 0].flatten()[pixels].long()
    hit, parents = top >= 0, top.clamp_min(0)
    on_image = _grid(pixels, camera.width)
    rays = torch.stack(
        [(on_image[:, 0] - camera.cx) / camera.fx, (on_image[:, 1] - camera.cy) / camera.fy, torch.ones_like(depths)], 1
    )
    places = rays * depths[:, None]
    means = (places - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    visible = max(len(out.ids[..., 0].unique()), 1)
    spacing = math.sqrt(camera.width * camera.height / visible)  # pixels
    width = (0.25 * spacing / camera.focal * depths).log()[:, None].repeat(1, 2)
    facing = _facing(camera, len(pixels))
    sh0, shN = surfels.sh0[parents], surfels.shN[parents]
    return {
        "means": means,
        "raw_quats": torch.where(hit[:, None], surfels.raw_quats[parents], facing),
        "log_scales": torch.where(hit[:, None], torch.minimum(surfels.log_scales[parents], width), width),
        "logit_opacities": torch.full_like(depths, math.log(OPACITY / (1 - OPACITY))),
        "raw_gammas": torch.full_like(width, INITIAL_RAW_GAMMA),
        "sh0": torch.where(hit[:, None, None], sh0 + correction[:, None] / BAND_0, (seen[:, None] - 0.5) / BAND_0),
        "shN": shN * hit[:, None, None],
    }


def _facing(camera: Camera, count: int) -> torch.Tensor:
    """Return quaternions (M, 4), wxyz, of surfels that lie in the camera's image plane."""
    r = camera.viewmat[:3, :3].T.double().cpu()  # camera to world
    values, vectors = torch.linalg.eigh(_quaternion_matrix(r))
    return vectors[:, values.argmax()].to(camera.viewmat).repeat(count, 1)


def _quaternion_matrix(r: torch.Tensor) -> torch.Tensor:
    """Return the symmetric matrix (4, 4) whose largest eigenvector is the quaternion wxyz of a rotation (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = r.tolist()
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, yx + xy, xz + zx],
        [xz - zx, yx + xy, yy - xx - zz, zy + yz],
        [yx - xy, xz + zx, zy + yz, zz - xx - yy],
    ]
    return torch.tensor(rows, dtype=r.dtype)
