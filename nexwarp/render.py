"""Rendering: (antialias ->) project -> tiles -> collect -> texture -> compose (paper Sec. 4.2)."""

import numbers
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch

from nexwarp import ops
from nexwarp.camera import Camera
from nexwarp.checks import check_range, check_tensors
from nexwarp.kernels.types import MAX_HITS
from nexwarp.representation.detail_limits import DetailLimits
from nexwarp.representation.exposures import Exposures
from nexwarp.representation.surfels import Activated, Surfels
from nexwarp.representation.texture import NeuralTexture

MAX_JITTER = 1000.0  # pixels

Color = float | Sequence[float] | torch.Tensor


@dataclass(frozen=True)
class Intermediates:
    """What the stages of one rendering hand on, for what a `Rendering` computes on request.

    Attributes:
        projection: of the surfels.
        tiles: the lists that the collection pass walked along.
        hits: what it found.
        pinhole: the image plane.
        viewmat: (4, 4) world to camera.
        low_pass: as given to `render`.
    """

    projection: ops.Projection
    tiles: ops.Tiles
    hits: ops.Hits
    pinhole: ops.Pinhole
    viewmat: torch.Tensor
    low_pass: bool


@dataclass(frozen=True)
class Rendering:
    """The buffers of one rendering.

    Differentiable: all fields but `ids`. Computed on first access, from the same lists and without a second rendering:
    `expected_depth`, `median_depth`, `top_depth` and `normals`, which are not differentiable.

    Attributes:
        image: (H, W, 3) = plain + textured + (1 - alpha) background; not clamped.
        plain: (H, W, 3) blended colours of the hits that are not textured, N of paper Eq. 6; without background.
        textured: (H, W, 3) sum over the K textured hits of weight * colour. Without a texture the colour is the hit's
            plain colour; with a residual texture it is the plain colour plus the texture's.
        ids: (H, W, K) int32, surfels of the K heaviest hits, heaviest first; -1 in empty slots.
        depths: (H, W, K) their z-depths, world units; 0 in empty slots.
        weights: (H, W, K) their blending weights; 0 in empty slots.
        alpha: (H, W) 1 - final transmittance.
        intermediates: what the stages handed on.
    """

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor
    intermediates: Intermediates = field(repr=False, compare=False)

    @property
    def expected_depth(self) -> torch.Tensor:
        """(H, W) mean z-depth of all hits, weighted by their blending weights, world units; 0 where nothing is hit."""
        return self._surface.expected_depth

    @property
    def median_depth(self) -> torch.Tensor:
        """(H, W) z-depth of the hit that takes the transmittance to 1/2, world units.

        Where the transmittance stays above 1/2, that of the last hit; 0 where nothing is hit.
        """
        return self._surface.median_depth

    @property
    def top_depth(self) -> torch.Tensor:
        """(H, W) z-depth of the heaviest hit, whatever K is, world units; 0 where nothing is hit."""
        return self._surface.top_depth

    @property
    def normals(self) -> torch.Tensor:
        """(H, W, 3) unit normals, world frame: the mean of all hits' normals, weighted by their blending weights.

        Each hit's normal is taken on the side that faces the camera; 0 where nothing is hit.
        """
        return self._surface.normals

    @cached_property
    def _surface(self) -> ops.Surface:
        made = self.intermediates
        return ops.surface(made.projection, made.tiles, made.hits, made.pinhole, made.viewmat, low_pass=made.low_pass)

    def request_splat_error(self, errors: torch.Tensor) -> ops.SplatErrorRequest:
        """Ask the coming backward pass for `splat_error(errors)`, at hardly any cost.

        Args:
            errors: (H, W) error of each pixel, >= 0.

        Returns:
            A request whose `sums_after_backward` (N,) the backward pass fills.
        """
        request = self.intermediates.hits.error_request
        check_tensors({"errors": (errors, self.alpha.shape)}, dtype=self.alpha.dtype, device=self.alpha.device)
        request.errors = errors.detach().contiguous()
        return request

    def splat_error(self, errors: torch.Tensor) -> torch.Tensor:
        """Return (N,): each surfel's sum over pixels of blending weight * errors (H, W). Not differentiable."""
        made = self.intermediates
        return ops.splat_error(made.projection, made.tiles, made.hits, made.pinhole, errors, low_pass=made.low_pass)


def render(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int = 2,
    background: Color = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
    low_pass: bool = False,
    clamp_texture: bool = False,
    depth_jitter: float | torch.Tensor = 0.0,
    generator: torch.Generator | None = None,
    *,
    exposures: Exposures | None = None,
    detail_limits: DetailLimits | None = None,
) -> Rendering:
    """Render surfels as a camera sees them. A trained scene is rendered by `Model.render`.

    Differentiable with respect to the surfels, the texture, `background` and `camera.viewmat`; `exposures` and
    `detail_limits` are constants.

    Args:
        surfels: the N surfels, N may be 0.
        texture: the neural texture, on the same device; None gives the textured hits their plain colour instead.
        camera: the camera, on the same device.
        max_hits: K, how many hits a pixel textures, 0 to 8.
        background: a number, three numbers or a (3,) tensor, seen through what is left of the transmittance.
        sh_degree: 0 to 3, limits the degree of both appearances.
        low_pass: give surfels smaller than a pixel a screen-space Gaussian (2DGS's low-pass).
        clamp_texture: limit textured colours to >= 0; not for residual textures.
        depth_jitter: for training: standard deviation, in pixels at that depth, of random shifts along the ray of the
            points at which the texture is looked up. The buffers' depths stay. A tensor holds the factors on the
            depths themselves, as `jitter_factors` draws them.
        generator: of those random numbers, on the surfels' device; None is torch's own.
        exposures: multiplies all colours, the background's too, by the gains predicted for this camera and by the
            lens's falloff; None is the mean exposure.
        detail_limits: of the N surfels; None limits nothing.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
    """
    background = _check(
        surfels, texture, camera, max_hits, background, sh_degree, low_pass, clamp_texture, depth_jitter, detail_limits
    )
    shape = antialiased(surfels, camera, detail_limits)
    pinhole = ops.Pinhole(camera.K.to(surfels.means), camera.width, camera.height, camera.near)
    colors = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, sh_degree)
    projection = ops.project(*shape, colors, camera.viewmat)
    tiles = ops.intersect_tiles(*shape, projection, camera.viewmat, pinhole, low_pass=low_pass)
    hits = ops.collect(projection, tiles, pinhole, max_hits=max_hits, low_pass=low_pass)
    if texture is None:
        texels, weights = hits.base.new_empty(*hits.base.shape[:2], 0, 3), hits.weights[..., :0]
    else:
        weights, looked_up = hits.weights, hits.depths
        if not isinstance(depth_jitter, torch.Tensor) and depth_jitter > 0:
            depth_jitter = jitter_factors(camera, max_hits, depth_jitter, looked_up.dtype, generator)
        if isinstance(depth_jitter, torch.Tensor):
            looked_up = looked_up * depth_jitter
        positions, directions = ops.unproject(looked_up, camera.viewmat, pinhole)
        depths = limited_depths(hits.ids, hits.depths, detail_limits, camera.focal)
        texels = texture.colors(positions, depths, directions, camera.focal, sh_degree=sh_degree, clamp=clamp_texture)
    base = hits.base if texture is None or texture.residual else None
    plain = hits.plain
    image, textured = ops.compose(plain, texels, weights, hits.alpha, background, base)
    if exposures is not None:
        factors = exposures.factors(camera).to(image)
        image, plain, textured = image * factors, plain * factors, textured * factors
    made = Intermediates(projection, tiles, hits, pinhole, camera.viewmat, low_pass)
    return Rendering(image, plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha, made)


def jitter_factors(
    camera: Camera,
    max_hits: int,
    jitter: float,
    dtype: torch.dtype = torch.float32,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draw what `render` multiplies depths by for a `depth_jitter`: (H, W, K) normal, 1 +- jitter / focal.

    Args:
        camera: to render with.
        max_hits: K.
        jitter: standard deviation in pixels.
        dtype: of the surfels.
        generator: on the camera's device; None is torch's own.
    """
    shape = (camera.height, camera.width, max_hits)
    noise = torch.randn(shape, generator=generator, dtype=dtype, device=camera.device)
    return noise.mul_(jitter / camera.focal).add_(1)


def antialiased(surfels: Surfels, camera: Camera, limits: DetailLimits | None) -> Activated:
    """Return the N surfels' geometry for a camera, blurred where it is farther away than any training view was.

    Differentiable with respect to the surfels and `camera.viewmat`.

    Args:
        surfels: the surfels.
        camera: the camera.
        limits: of the surfels; None blurs nothing.
    """
    shape = surfels.activated()
    if limits is None or not len(surfels):
        return shape
    row = camera.viewmat[2].to(shape.means)
    depths = torch.addmv(row[3], shape.means, row[:3])
    focal = (camera.fx * camera.fy) ** 0.5  # of the image's own pixels: a camera may lower `focal` for the texture
    blurred = ops.antialias(depths, shape.scales, shape.opacities, shape.gammas, limits.farthest, focal)
    return Activated(shape.means, shape.quats, *blurred)


def limited_depths(
    ids: torch.Tensor, depths: torch.Tensor, limits: DetailLimits | None, focal: float | torch.Tensor
) -> torch.Tensor:
    """Return depths for the texture's down-weighting: the hits', clamped to the range in which training saw them.

    Args:
        ids: (H, W, K) surfels, -1 in empty slots.
        depths: (H, W, K) their z-depths.
        limits: of the surfels; None clamps nothing.
        focal: of the camera, in pixels.
    """
    if limits is None or not len(limits):
        return depths
    indices = ids.clamp_min(0).long()
    clamped = torch.minimum(depths, focal * limits.farthest[indices])
    # The nearest limit comes last: where training never saw a texture, there is none.
    clamped = torch.maximum(clamped, focal * limits.nearest[indices])
    return torch.where(ids >= 0, clamped, depths)


def _background(background: Color, like: torch.Tensor) -> torch.Tensor:
    """Return the background as a (3,) tensor; a tensor keeps its graph."""
    if isinstance(background, torch.Tensor):
        return background.expand(3) if background.ndim == 0 else background
    if isinstance(background, numbers.Real):
        background = [background] * 3
    if not isinstance(background, Iterable) or isinstance(background, str):
        raise TypeError(f"background: expected numbers or a tensor, got {type(background).__name__}")
    values = list(background)
    if len(values) != 3:
        raise ValueError(f"background: expected 3 values, got {len(values)}")
    if not all(isinstance(x, numbers.Real) for x in values):
        raise TypeError(f"background: expected three numbers or a tensor, got {values}")
    return torch.stack([like.new_full((), float(x)) for x in values])


def _check(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int,
    background: Color,
    sh_degree: int,
    low_pass: bool,
    clamp_texture: bool,
    depth_jitter: float | torch.Tensor,
    detail_limits: DetailLimits | None,
) -> torch.Tensor:
    """Check types, shapes and devices only, so as never to wait for a GPU; return the background as a tensor."""
    for name, value, kind in (("surfels", surfels, Surfels), ("camera", camera, Camera)):
        if not isinstance(value, kind):
            raise TypeError(f"{name}: expected a nexwarp.{kind.__name__}, got {type(value).__name__}")
    if texture is not None and not isinstance(texture, NeuralTexture):
        raise TypeError(f"texture: expected a nexwarp.NeuralTexture or None, got {type(texture).__name__}")
    for name, value, high in (("max_hits", max_hits, MAX_HITS), ("sh_degree", sh_degree, 3)):
        if isinstance(value, bool) or not isinstance(value, int):
            raise TypeError(f"{name}: expected an int, got {type(value).__name__}")
        check_range(name, value, 0, high)
    for name, value in (("low_pass", low_pass), ("clamp_texture", clamp_texture)):
        if not isinstance(value, bool):
            raise TypeError(f"{name}: expected True or False, got {type(value).__name__}")
    if not isinstance(depth_jitter, torch.Tensor):
        if isinstance(depth_jitter, bool) or not isinstance(depth_jitter, numbers.Real):
            raise TypeError(f"depth_jitter: expected a number or a tensor, got {type(depth_jitter).__name__}")
        check_range("depth_jitter", depth_jitter, 0.0, MAX_JITTER)
    if clamp_texture and texture is not None and texture.residual:
        raise ValueError("clamp_texture: expected False with a residual texture, got True")
    means = surfels.means
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"surfels: expected float32 or float64 parameters, got {means.dtype}")
    background = _background(background, means)
    others = {"camera.viewmat": (camera.viewmat, (4, 4)), "background": (background, (3,))}
    if isinstance(depth_jitter, torch.Tensor):
        others["depth_jitter"] = (depth_jitter, (camera.height, camera.width, max_hits))
    if texture is not None:
        others["texture.grid"] = (texture.grid, tuple(texture.grid.shape))
    if detail_limits is not None:
        others["detail_limits.nearest"] = (detail_limits.nearest, (len(surfels),))
        others["detail_limits.farthest"] = (detail_limits.farthest, (len(surfels),))
    check_tensors(others, dtype=means.dtype, device=means.device)
    return background
