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
        texels: (H, W, K, 3) the texture's colours of the hits; None without a texture.
        residual: whether the texture's colours are added to the plain ones.
        factors: (3,) or (H, W, 3) gains and falloff of the exposure; None is the mean exposure.
    """

    projection: ops.Projection
    tiles: ops.Tiles
    hits: ops.Hits
    pinhole: ops.Pinhole
    viewmat: torch.Tensor
    low_pass: bool
    texels: torch.Tensor | None
    residual: bool
    factors: torch.Tensor | None


@dataclass(frozen=True)
class Rendering:
    """The buffers of one rendering.

    Differentiable: all fields but `ids`. Computed on first access, without a second rendering: `expected_depth`,
    `median_depth`, `top_depth`, `normals` and `colors`; the first four are not differentiable.

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
    def colors(self) -> torch.Tensor:
        """(H, W, K, 3) colours of the K hits, so that textured = sum over k of weights * colors; 0 in empty slots."""
        made, empty = self.intermediates, (self.ids < 0)[..., None]
        colors = self.weights.new_zeros(*self.ids.shape, 3) if made.texels is None else made.texels
        if (made.texels is None or made.residual) and len(made.projection.records):
            colors = colors + made.projection.records[:, 3, :3][self.ids.clamp_min(0).long()]
        if made.factors is not None:
            colors = colors * (made.factors if made.factors.ndim == 1 else made.factors[:, :, None])
        return colors.masked_fill(empty, 0.0)

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
    _check_types(surfels, texture, camera, max_hits, sh_degree, low_pass, clamp_texture, depth_jitter)
    background = _background(background, surfels.means)
    _check_tensors(surfels, texture, camera, max_hits, background, depth_jitter, detail_limits)
    shape = antialiased(surfels, camera, detail_limits)
    pinhole = ops.Pinhole(camera.K.to(surfels.means), camera.width, camera.height, camera.near)
    colors = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, sh_degree)
    projection = ops.project(*shape, colors, camera.viewmat)
    tiles = ops.intersect_tiles(*shape, projection, camera.viewmat, pinhole, low_pass=low_pass)
    hits = ops.collect(projection, tiles, pinhole, max_hits=max_hits, low_pass=low_pass)
    texels = None
    if texture is not None:
        if not isinstance(depth_jitter, torch.Tensor) and depth_jitter > 0:
            depth_jitter = jitter_factors(camera, max_hits, depth_jitter, hits.depths.dtype, generator)
        looked_up = hits.depths * depth_jitter if isinstance(depth_jitter, torch.Tensor) else hits.depths
        positions, directions = ops.unproject(looked_up, camera.viewmat, pinhole)
        depths = limited_depths(hits.ids, hits.depths, detail_limits, camera.focal)
        texels = texture.colors(positions, depths, directions, camera.focal, sh_degree=sh_degree, clamp=clamp_texture)
    residual = texture is not None and texture.residual
    base = hits.base if texture is None or residual else None
    plain = hits.plain
    blended = (hits.base.new_empty(*hits.base.shape[:2], 0, 3), hits.weights[..., :0])
    if texels is not None:
        blended = (texels, hits.weights)
    image, textured = ops.compose(plain, *blended, hits.alpha, background, base)
    factors = None if exposures is None else exposures.factors(camera).to(image)
    if factors is not None:
        image, plain, textured = image * factors, plain * factors, textured * factors
    made = Intermediates(projection, tiles, hits, pinhole, camera.viewmat, low_pass, texels, residual, factors)
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
    values: Sequence[object]
    if isinstance(background, numbers.Real):
        values = [background] * 3
    elif isinstance(background, Iterable) and not isinstance(background, str):
        values = list(background)
    else:
        raise TypeError(f"background: expected numbers or a tensor, got {type(background).__name__}")
    if len(values) != 3:
        raise ValueError(f"background: expected 3 values, got {len(values)}")
    numbers_ = [float(x) for x in values if isinstance(x, numbers.Real)]
    if len(numbers_) != 3:
        raise TypeError(f"background: expected three numbers or a tensor, got {values}")
    return torch.stack([like.new_full((), x) for x in numbers_])


def _check_types(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int,
    sh_degree: int,
    low_pass: bool,
    clamp_texture: bool,
    depth_jitter: float | torch.Tensor,
) -> None:
    """Check the arguments' types and ranges."""
    if not isinstance(surfels, Surfels):
        raise TypeError(f"surfels: expected a nexwarp.Surfels, got {type(surfels).__name__}")
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a nexwarp.Camera, got {type(camera).__name__}")
    if texture is not None and not isinstance(texture, NeuralTexture):
        raise TypeError(f"texture: expected a nexwarp.NeuralTexture or None, got {type(texture).__name__}")
    for name, number, high in (("max_hits", max_hits, MAX_HITS), ("sh_degree", sh_degree, 3)):
        if isinstance(number, bool) or not isinstance(number, int):
            raise TypeError(f"{name}: expected an int, got {type(number).__name__}")
        check_range(name, number, 0, high)
    for name, flag in (("low_pass", low_pass), ("clamp_texture", clamp_texture)):
        if not isinstance(flag, bool):
            raise TypeError(f"{name}: expected True or False, got {type(flag).__name__}")
    if not isinstance(depth_jitter, torch.Tensor):
        if isinstance(depth_jitter, bool) or not isinstance(depth_jitter, numbers.Real):
            raise TypeError(f"depth_jitter: expected a number or a tensor, got {type(depth_jitter).__name__}")
        check_range("depth_jitter", depth_jitter, 0.0, MAX_JITTER)
    if clamp_texture and texture is not None and texture.residual:
        raise ValueError("clamp_texture: expected False with a residual texture, got True")
    if surfels.means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"surfels: expected float32 or float64 parameters, got {surfels.means.dtype}")


def _check_tensors(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int,
    background: torch.Tensor,
    depth_jitter: float | torch.Tensor,
    limits: DetailLimits | None,
) -> None:
    """Check shapes, dtypes and devices only, so as never to wait for a GPU."""
    expected: dict[str, tuple[torch.Tensor, tuple[int, ...]]] = {
        "camera.viewmat": (camera.viewmat, (4, 4)),
        "background": (background, (3,)),
    }
    if isinstance(depth_jitter, torch.Tensor):
        expected["depth_jitter"] = (depth_jitter, (camera.height, camera.width, max_hits))
    if texture is not None:
        expected["texture.grid"] = (texture.grid, tuple(texture.grid.shape))
    if limits is not None:
        expected["detail_limits.nearest"] = (limits.nearest, (len(surfels),))
        expected["detail_limits.farthest"] = (limits.farthest, (len(surfels),))
    check_tensors(expected, dtype=surfels.means.dtype, device=surfels.means.device)
