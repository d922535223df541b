"""Rendering: (widen ->) project -> tiles -> collect -> texture -> compose (paper Sec. 3.2)."""

import numbers
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from nexwarp import ops
from nexwarp.camera import Camera
from nexwarp.kernels.types import MAX_HITS
from nexwarp.ops.checks import check_range, check_tensors
from nexwarp.surfels import Activated, Surfels
from nexwarp.texture import NeuralTexture

MAX_JITTER = 1000.0  # pixels


@dataclass(frozen=True)
class Passes:
    """What the passes of one rendering left behind, for `Rendering.splat_error`."""

    projection: ops.Projection
    tiles: ops.Tiles
    hits: ops.Hits
    pinhole: ops.Pinhole
    low_pass: bool


@dataclass(frozen=True)
class Rendering:
    """The buffers of one rendering; everything but `ids` is differentiable.

    Attributes:
        image: (H, W, 3) = plain + textured + (1 - alpha) background; not clamped.
        plain: (H, W, 3) blended colours of the hits that are not textured, N of paper Eq. 4; without background.
        textured: (H, W, 3) sum over the K textured hits of weight * colour; of their plain colour without a texture,
            of that plus the texture's with a residual one.
        ids: (H, W, K) int32, surfels of the K heaviest hits, heaviest first; -1 in empty slots.
        depths: (H, W, K) their z-depths, world units; 0 in empty slots.
        weights: (H, W, K) their blending weights; 0 in empty slots.
        alpha: (H, W) 1 - final transmittance.
    """

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor

    @property
    def tiles(self) -> ops.Tiles:
        """The lists that the collection pass walked along."""
        return self._passes.tiles

    def watch_error(self, errors: torch.Tensor) -> ops.ErrorWatch:
        """Ask the coming backward pass for `splat_error(errors)`, at hardly any cost.

        Args:
            errors: (H, W) error of each pixel, >= 0.

        Returns:
            An object whose `sums` (N,) are there once `backward` has run.
        """
        watch = self._passes.hits.watch
        check_tensors({"errors": (errors, self.alpha.shape)}, dtype=self.alpha.dtype, device=self.alpha.device)
        watch.errors = errors.detach().contiguous()
        return watch

    def splat_error(self, errors: torch.Tensor) -> torch.Tensor:
        """Return (N,): each surfel's sum over pixels of blending weight * errors (H, W). Not differentiable."""
        p = self._passes
        return ops.splat_error(p.projection, p.tiles, p.hits, p.pinhole, errors, low_pass=p.low_pass)


def render(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int = 2,
    background: float | Sequence[float] | torch.Tensor = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
    low_pass: bool = False,
    clamp_texture: bool = False,
    depth_jitter: float | torch.Tensor = 0.0,
    generator: torch.Generator | None = None,
) -> Rendering:
    """Render surfels as a camera sees them.

    Differentiable with respect to the surfels, the texture, `background` and `camera.viewmat`. With
    `surfels.exposures`, all colours, the background's too, are times the gains and the lens's falloff there, constants.

    Args:
        surfels: the N surfels, N may be 0.
        texture: the neural texture, on the same device; None gives the textured hits their plain colour instead.
        camera: the camera, on the same device.
        max_hits: K, how many hits a pixel textures, 0 to 8.
        background: a number, three numbers or a (3,) tensor, seen through what is left of the transmittance.
        sh_degree: 0 to 3, limits the degree of both appearances.
        low_pass: give surfels smaller than a pixel a screen-space Gaussian (2DGS's low-pass).
        clamp_texture: limit textured colours to >= 0; not for residual textures.
        depth_jitter: for training: where the texture is looked up moves along the ray, at random, with this standard
            deviation in units of depth / focal, a pixel's size there. The buffers' depths stay. A tensor of
            `jitter_factors` is what they are multiplied by for it.
        generator: of those random numbers, on the surfels' device; None is torch's own.

    Raises:
        TypeError, ValueError: naming the argument, when types, shapes or devices do not fit.
    """
    background = _check(
        surfels, texture, camera, max_hits, background, sh_degree, low_pass, clamp_texture, depth_jitter
    )
    shape = seen_from(surfels, camera)
    pinhole = ops.Pinhole(camera.K.to(surfels.means), camera.width, camera.height, camera.near)
    colors = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, sh_degree)
    projection = ops.project(*shape, colors, camera.viewmat)
    tiles = ops.intersect_tiles(*shape, projection, camera.viewmat, pinhole, low_pass=low_pass)
    hits = ops.collect(projection, tiles, pinhole, max_hits=max_hits, low_pass=low_pass)
    if texture is None:
        texels, weights = hits.base.new_empty(*hits.base.shape[:2], 0, 3), hits.weights[..., :0]
    else:
        weights = hits.weights
        looked_up = hits.depths
        if not isinstance(depth_jitter, torch.Tensor) and depth_jitter > 0:
            depth_jitter = jitter_factors(camera, max_hits, depth_jitter, looked_up.dtype, generator)
        if isinstance(depth_jitter, torch.Tensor):
            looked_up = looked_up * depth_jitter
        positions, directions = ops.unproject(looked_up, camera.viewmat, pinhole)
        depths = seen_depths(hits.ids, hits.depths, surfels, camera.focal)
        texels = texture.colors(positions, depths, directions, camera.focal, sh_degree=sh_degree, clamp=clamp_texture)
    base = hits.base if texture is None or texture.residual else None
    plain = hits.plain
    image, textured = ops.compose(plain, texels, weights, hits.alpha, background, base)
    if surfels.exposures is not None:
        factors = surfels.exposures.factors(camera).to(image)
        image, plain, textured = image * factors, plain * factors, textured * factors
    passes = Passes(projection, tiles, hits, pinhole, low_pass)
    rendering = Rendering(image, plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha)
    # No buffer, so no field: only `watch_error` and `splat_error` look at it.
    object.__setattr__(rendering, "_passes", passes)
    return rendering


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


def seen_from(surfels: Surfels, camera: Camera) -> Activated:
    """Return the N surfels' geometry as a camera's pixels show it: wider where they cover more than in training.

    Differentiable with respect to the surfels and `camera.viewmat`.

    Args:
        surfels: the surfels, with `far_footprints` or without.
        camera: the camera.
    """
    shape = surfels.activated()
    if surfels.far_footprints is None or not len(surfels):
        return shape
    row = camera.viewmat[2].to(shape.means)
    depths = torch.addmv(row[3], shape.means, row[:3])
    focal = (camera.fx * camera.fy) ** 0.5  # the pixels' own: `camera.focal` may be limited for the texture's sake
    wide = ops.widen(depths, shape.scales, shape.opacities, shape.gammas, surfels.far_footprints, focal)
    return Activated(shape.means, shape.quats, *wide)


def seen_depths(ids: torch.Tensor, depths: torch.Tensor, surfels: Surfels, focal: float) -> torch.Tensor:
    """Return depths for the texture's down-weighting: those of the hits, within those that training saw the surfels at.

    Args:
        ids: (H, W, K) surfels, -1 in empty slots.
        depths: (H, W, K) their z-depths.
        surfels: the surfels, with footprints or without.
        focal: of the camera, in pixels.
    """
    seen, indices = depths, ids.clamp_min(0).long()
    if len(surfels) and surfels.far_footprints is not None:
        seen = torch.minimum(seen, focal * surfels.far_footprints[indices])
    if len(surfels) and surfels.footprints is not None:  # after that: where training had no look, there is no texture
        seen = torch.maximum(seen, focal * surfels.footprints[indices])
    return seen if seen is depths else torch.where(ids >= 0, seen, depths)


def _background(background: float | Sequence[float] | torch.Tensor, like: torch.Tensor) -> torch.Tensor:
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
    background: float | Sequence[float] | torch.Tensor,
    sh_degree: int,
    low_pass: bool,
    clamp_texture: bool,
    depth_jitter: float | torch.Tensor,
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
    for name in ("footprints", "far_footprints"):
        if (seen := getattr(surfels, name)) is not None:
            others[f"surfels.{name}"] = (seen, (len(surfels),))
    check_tensors(others, dtype=means.dtype, device=means.device)
    return background
