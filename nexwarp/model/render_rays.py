"""Rendering for cameras that are no pinholes: the stages of `render`, with rays instead of an image plane."""

from dataclasses import dataclass

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.cameras.ray_camera import RayCamera
from nexwarp.errors import check_tensors
from nexwarp.model.detail_limits import DetailLimits, limited_depths
from nexwarp.model.exposures import Exposures
from nexwarp.model.options import RenderOptions
from nexwarp.model.surfels import Activated, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.ops.rays import RayHits, collect_rays, intersect_rays, ray_records, reaches_of

# Parallel rays see plain colours as a camera does at this many times the scene's extent.
FAR_AWAY = 1e4


@dataclass(frozen=True)
class RayRendering:
    """The buffers of a rendering by a `RayCamera`; as those of `Rendering`, but not differentiable.

    Depths are in units of the pixels' rays: distances for panoramas and fisheye lenses, else z-depths; world units.

    Attributes:
        image, plain, textured: (H, W, 3), as in `Rendering`.
        ids, depths, weights: (H, W, K), as in `Rendering`.
        alpha: (H, W) 1 - final transmittance; 0 where a pixel has no ray.
        expected_depth, median_depth, top_depth: (H, W), as in `Rendering`.
        normals: (H, W, 3) unit, world frame.
    """

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor
    expected_depth: torch.Tensor
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor


@torch.no_grad()
def render_rays(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: RayCamera,
    options: RenderOptions,
    background: torch.Tensor,
    exposures: Exposures | None = None,
    detail_limits: DetailLimits | None = None,
) -> RayRendering:
    """Render surfels from a camera with any rays. The lens's falloff is that of pinhole photos, and not applied.

    Args:
        surfels: the N surfels.
        texture: the neural texture; None leaves all hits their plain colours.
        camera: the camera, on the surfels' device.
        options: of the rendering; `low_pass` must be False. Their order does not change that of panoramas and fisheye
            lenses, which is by distance, or of parallel rays, which is by z-depth.
        background: (3,) colour behind the surfels.
        exposures: multiply the image by the gains predicted for the camera's pose; None is the mean exposure.
        detail_limits: of the surfels; None limits nothing.

    Raises:
        TypeError, ValueError: the message names the argument.
        OutOfMemoryError: memory does not suffice.
    """
    if options.low_pass:
        raise ValueError("low_pass: expected False with a camera of rays, whose pixels have no image plane, got True")
    expected = {
        "camera.viewmat": (camera.viewmat, (4, 4)),
        "camera.rays": (camera.rays, ("H", "W", 3)),
        "background": (background, (3,)),
    }
    check_tensors(expected, dtype=surfels.means.dtype, device=surfels.device)
    max_hits, degree = options.max_hits, options.sh_degree
    values = (0, surfels.means.dtype) if texture is None else texture.stored_per_point(degree)
    ops.check_image(camera.width, camera.height, max_hits, surfels.means.dtype, surfels.device, texture=values)
    viewmat = camera.viewmat
    distances = _distances(surfels.means, camera)
    shape = _antialiased(surfels, distances, camera, detail_limits)
    colors = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, _eye(surfels.means, camera), degree)
    projection = ops.project(*shape, colors, viewmat)
    records = ray_records(projection, _axes(shape, viewmat) if camera.parallel else None)
    keys = distances if camera.radial else projection.centers[:, 2]
    if options.order == "distance" and not camera.parallel and not camera.radial:
        keys = projection.centers.norm(dim=-1)
    tiles = intersect_rays(records, reaches_of(shape.opacities, shape.gammas), keys, camera.rays)
    hits = collect_rays(records, projection.limits, tiles, camera.rays, camera.near, viewmat, max_hits=max_hits)
    image, textured = _composed(hits, texture, camera, options, background, detail_limits)
    plain = hits.plain
    if exposures is not None:
        size = (camera.width, camera.height, camera.near)
        posed = Camera(viewmat, torch.eye(3).to(viewmat), *size, checked=(1.0, 1.0, 0.0, 0.0))
        gains = exposures.gains(posed).to(image)
        image, plain, textured = (x * gains for x in (image, plain, textured))
    s = hits.surface
    surface = (s.expected_depth, s.median_depth, s.top_depth, s.normals)
    return RayRendering(image, plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha, *surface)


def _composed(
    hits: RayHits,
    texture: NeuralTexture | None,
    camera: RayCamera,
    options: RenderOptions,
    background: torch.Tensor,
    detail_limits: DetailLimits | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the image and its textured part (H, W, 3)."""
    max_hits = options.max_hits
    texels, weights = hits.base.new_empty(*hits.alpha.shape, 0, 3), hits.weights[..., :0]
    if texture is not None and max_hits:
        positions, directions = _unproject(hits.depths, camera)
        # Empty slots keep a depth of 0, which the texture passes over.
        depths = (hits.weights > 0).to(hits.depths) if camera.parallel else hits.depths
        depths = limited_depths(hits.ids, depths, detail_limits, camera.focal)
        clamp = options.clamp_texture
        texels = texture.colors(positions, depths, directions, camera.focal, sh_degree=options.sh_degree, clamp=clamp)
        weights = hits.weights
    residual = texture is not None and texture.residual
    base = hits.base if texture is None or not max_hits or residual else None
    return ops.compose(hits.plain, texels, weights, hits.alpha, background, base)


def _distances(means: torch.Tensor, camera: RayCamera) -> torch.Tensor:
    """Return the centres' depths (N,) in units of rays: distances, z-depths, or 1 for parallel rays."""
    if camera.radial:
        return (means - camera.position).norm(dim=-1)
    if camera.parallel:
        return torch.ones_like(means[:, 0])
    row = camera.viewmat[2]
    return (means * row[:3]).sum(-1) + row[3]


def _eye(means: torch.Tensor, camera: RayCamera) -> torch.Tensor:
    """Return the point (3,) from which plain colours are seen; parallel rays see them from far away."""
    position = camera.position
    if not camera.parallel or not len(means):
        return position
    extent = (means - position).norm(dim=-1).max().clamp_min(1e-12)
    return position - FAR_AWAY * extent * camera.viewmat[2, :3]


def _antialiased(
    surfels: Surfels, distances: torch.Tensor, camera: RayCamera, limits: DetailLimits | None
) -> Activated:
    """Return the activated geometry, blurred where it is farther than in any training view; see `antialiased`."""
    shape = surfels.activated()
    if limits is None or not len(surfels):
        return shape
    blurred = ops.antialias(distances, shape.scales, shape.opacities, shape.gammas, limits.farthest, camera.focal)
    return Activated(shape.means, shape.quats, *blurred)


def _axes(shape: Activated, viewmat: torch.Tensor) -> torch.Tensor:
    """Return (N, 2, 3): the surfels' axes v1 / s2 and v2 / s1 in the camera frame."""
    w, x, y, z = shape.quats.unbind(-1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    second = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    axes = torch.stack([first / shape.scales[:, 1:], second / shape.scales[:, :1]], 1)
    return axes @ viewmat[:3, :3].T


def _unproject(depths: torch.Tensor, camera: RayCamera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the hits' points (H, W, K, 3) and the rays' unit directions (H, W, 3), world frame."""
    rotation, shift, rays = camera.viewmat[:3, :3], camera.viewmat[:3, 3], camera.rays
    along = torch.tensor([0.0, 0.0, 1.0]).to(rays).expand_as(rays) if camera.parallel else rays
    start = rays * rays.new_tensor([1.0, 1.0, 0.0]) if camera.parallel else torch.zeros_like(rays)
    points = start[:, :, None] + depths[..., None] * along[:, :, None]
    return (points - shift) @ rotation, torch.nn.functional.normalize(along @ rotation, dim=-1)
