"""Rendering: (antialias ->) project -> tiles -> collect -> texture -> compose (paper Sec. 4.2)."""

import numbers
from dataclasses import dataclass, field
from functools import cached_property

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import OutOfMemoryError, check_range, check_tensors
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.machine import keep_freed_memory, needed_memory
from nexwarp.model.background import Color, color_tensor
from nexwarp.model.detail_limits import DetailLimits, limited_depths
from nexwarp.model.exposures import Exposures
from nexwarp.model.surfels import Activated, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.ops.tiles import Order, check_order

MAX_JITTER = 1000.0  # pixels


@dataclass(frozen=True)
class Intermediates:
    """Results of the stages of a rendering, from which `Rendering` computes further buffers on request.

    Attributes:
        projection: projected surfels.
        tiles: depth-sorted lists of the surfels in each tile.
        hits: result of the collection pass.
        pinhole: intrinsics of the image.
        viewmat: (4, 4) world to camera.
        low_pass: argument of `render`.
        texels: (H, W, K, 3) textured colours of the hits; None without a texture.
        residual: whether the texture's colours are added to the plain colours.
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

    All fields but `ids` are differentiable. `expected_depth`, `median_depth`, `top_depth`, `normals`,
    `blended_normals`, `distortion` and `colors` are computed on first access, without a second rendering, and are
    differentiable, too. The gradient of `median_depth` and `top_depth` is that of the depth of the hit that they are
    taken from.

    Attributes:
        image: (H, W, 3) plain + textured + (1 - alpha) background (paper Eq. 7, with a background); not clamped.
        plain: (H, W, 3) blended colours of the hits that are not textured (N of paper Eq. 6), without background.
        textured: (H, W, 3) sum over the K textured hits of weight * colour. Without a texture the colour is the hit's
            plain colour; with a residual texture it is the plain colour plus the texture's.
        ids: (H, W, K) int32, surfels of the K heaviest hits, heaviest first; -1 in empty slots.
        depths: (H, W, K) their z-depths, world units; 0 in empty slots.
        weights: (H, W, K) their blending weights; 0 in empty slots.
        alpha: (H, W) 1 - final transmittance.
        intermediates: results of the stages.
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
        """(H, W) z-depth of the hit at which the transmittance falls to 1/2; of the last one if it stays above."""
        return self._surface.median_depth

    @property
    def top_depth(self) -> torch.Tensor:
        """(H, W) z-depth of the heaviest hit, whatever K is, world units; 0 where nothing is hit."""
        return self._surface.top_depth

    @property
    def normals(self) -> torch.Tensor:
        """(H, W, 3) unit normals, world frame: `blended_normals` normalised; 0 where nothing is hit."""
        return self._surface.normals

    @property
    def blended_normals(self) -> torch.Tensor:
        """(H, W, 3) sum over all hits of weight * unit normal, on the side that faces the camera; world frame."""
        return self._surface.blended_normals

    @property
    def distortion(self) -> torch.Tensor:
        """(H, W) depth distortion of 2DGS: sum over pairs of hits of w_i w_j |z_i - z_j|; see `kernels.surface`."""
        return self._surface.distortion

    @cached_property
    def colors(self) -> torch.Tensor:
        """(H, W, K, 3) colours of the K hits: textured = sum over k of weights * colors; 0 in empty slots."""
        stages, empty = self.intermediates, (self.ids < 0)[..., None]
        colors = self.weights.new_zeros(*self.ids.shape, 3) if stages.texels is None else stages.texels
        if (stages.texels is None or stages.residual) and len(stages.projection.records):
            colors = colors + stages.projection.records[:, 3, :3][self.ids.clamp_min(0).long()]
        if stages.factors is not None:
            colors = colors * (stages.factors if stages.factors.ndim == 1 else stages.factors[:, :, None])
        return colors.masked_fill(empty, 0.0)

    @cached_property
    def _surface(self) -> ops.DifferentiableSurface:
        stages = self.intermediates
        given = (stages.projection, stages.tiles, stages.hits, stages.pinhole, stages.viewmat)
        # It is kept for later uses, so that its gradients must not depend on where the first one is.
        with torch.set_grad_enabled(stages.projection.records.requires_grad):
            return ops.surface(*given, low_pass=stages.low_pass)

    def request_splat_error(self, errors: torch.Tensor) -> ops.SplatErrorRequest:
        """Request `splat_error(errors)` from the backward pass, which computes it at almost no cost.

        Args:
            errors: (H, W) error of each pixel, >= 0.

        Returns:
            A request; the backward pass writes its `sums_after_backward` (N,).
        """
        request = self.intermediates.hits.error_request
        check_tensors({"errors": (errors, self.alpha.shape)}, dtype=self.alpha.dtype, device=self.alpha.device)
        request.errors = errors.detach().contiguous()
        return request

    def splat_error(self, errors: torch.Tensor) -> torch.Tensor:
        """Return each surfel's sum (N,) over pixels of blending weight * errors (H, W). Not differentiable."""
        stages = self.intermediates
        return ops.splat_error(
            stages.projection, stages.tiles, stages.hits, stages.pinhole, errors, low_pass=stages.low_pass
        )


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
    order: Order = "depth",
) -> Rendering:
    """Render surfels from a camera (paper Sec. 4.2). `Model.render` renders a trained scene.

    Differentiable with respect to the surfels, the texture, `background` and `camera.viewmat`. `torch.autocast` changes
    nothing: all is computed in the surfels' dtype, and a texture as its `half_precision` says.

    Args:
        surfels: the N surfels, N >= 0, float32 or float64.
        texture: the neural texture, on the same device; None leaves all hits their plain colours.
        camera: the camera, on the same device.
        max_hits: K, number of hits textured in each pixel, 0 to 8.
        background: a number, three numbers or a (3,) tensor, weighted by the final transmittance. The values of a CUDA
            tensor are not checked, which would wait for the GPU.
        sh_degree: largest SH degree of the plain colours, 0 to 6, and of the textured ones, which have 3 at most.
        low_pass: give surfels smaller than a pixel a screen-space Gaussian (the low-pass filter of 2DGS).
        clamp_texture: clamp textured colours to >= 0; not for residual textures.
        depth_jitter: for training, random shifts of the texture's points along their rays. A number is their standard
            deviation in pixels at the hit's depth; a tensor (H, W, K) holds the factors of `jitter_factors`.
        generator: random generator of the jitter, on the surfels' device; None is torch's default.
        exposures: multiply the image by the camera's gains and lens falloff; None is the mean exposure.
        detail_limits: detail limits of the N surfels; None limits nothing.
        order: blend surfels by their centres' z-depth, as the paper, or by their distance, which turning the camera
            does not change.

    Raises:
        TypeError, ValueError: a type, shape, value or device does not fit; the message names the argument.
        OutOfMemoryError: memory does not suffice; what surely does not fit is refused before anything is allocated.
    """
    _check_types(surfels, texture, camera, max_hits, sh_degree, low_pass, clamp_texture, depth_jitter)
    check_order(order)
    try:
        background = color_tensor(background, surfels.means)
        _check_tensors(surfels, texture, camera, max_hits, background, depth_jitter, detail_limits)
        values = (0, surfels.means.dtype) if texture is None else texture.stored_per_point(sh_degree)
        ops.check_image(camera.width, camera.height, max_hits, surfels.means.dtype, surfels.device, texture=values)
        options = (max_hits, background, sh_degree, low_pass, clamp_texture, depth_jitter, generator)
        with torch.autocast(surfels.device.type, enabled=False):
            return _render(surfels, texture, camera, *options, exposures, detail_limits, order)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, OutOfMemoryError) or (needed := needed_memory(error)) is None:
            raise
    # Outside of the handler: the error's traceback would keep alive what has been allocated.
    raise OutOfMemoryError.of(f"an image of {camera.width}x{camera.height} pixels with K = {max_hits}", needed)


def _render(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int,
    background: torch.Tensor,
    sh_degree: int,
    low_pass: bool,
    clamp_texture: bool,
    depth_jitter: float | torch.Tensor,
    generator: torch.Generator | None,
    exposures: Exposures | None,
    detail_limits: DetailLimits | None,
    order: Order,
) -> Rendering:
    """Render with arguments that have been checked; see `render`."""
    shape = antialiased(surfels, camera, detail_limits)
    pinhole = ops.Pinhole(camera.K.to(surfels.means), camera.width, camera.height, camera.near)
    colors = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, sh_degree)
    projection = ops.project(*shape, colors, camera.viewmat)
    tiles = ops.intersect_tiles(*shape, projection, camera.viewmat, pinhole, low_pass=low_pass, blending=order)
    hits = ops.collect(projection, tiles, pinhole, max_hits=max_hits, low_pass=low_pass)
    texels = None
    if texture is not None:
        jittered = _jittered(hits.depths, camera, depth_jitter, generator)
        positions, directions = ops.unproject(jittered, camera.viewmat, pinhole)
        depths = limited_depths(hits.ids, hits.depths, detail_limits, camera.focal)
        texels = texture.colors(positions, depths, directions, camera.focal, sh_degree=sh_degree, clamp=clamp_texture)
    residual = texture is not None and texture.residual
    base = hits.base if texture is None or residual else None
    blended = _no_texels(hits) if texels is None else (texels, hits.weights)
    image, textured = ops.compose(hits.plain, *blended, hits.alpha, background, base)
    factors = None if exposures is None else exposures.factors(camera).to(image)
    image, plain, textured = (x if factors is None else x * factors for x in (image, hits.plain, textured))
    intermediates = Intermediates(projection, tiles, hits, pinhole, camera.viewmat, low_pass, texels, residual, factors)
    return Rendering(image, plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha, intermediates)


def _jittered(
    depths: torch.Tensor, camera: Camera, jitter: float | torch.Tensor, generator: torch.Generator | None
) -> torch.Tensor:
    """Return depths (H, W, K) times the factors of a `depth_jitter`."""
    if not isinstance(jitter, torch.Tensor):
        if not jitter > 0:
            return depths
        jitter = jitter_factors(camera, depths.shape[2], jitter, depths.dtype, generator)
    return depths * jitter


def _no_texels(hits: ops.Hits) -> tuple[torch.Tensor, torch.Tensor]:
    """Return empty colours (H, W, 0, 3) and weights (H, W, 0), for a composition without texture."""
    return hits.base.new_empty(*hits.base.shape[:2], 0, 3), hits.weights[..., :0]


def jitter_factors(
    camera: Camera,
    max_hits: int,
    jitter: float,
    dtype: torch.dtype = torch.float32,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draw random factors on depths for the `depth_jitter` of `render`.

    Args:
        camera: the camera of the rendering.
        max_hits: K.
        jitter: standard deviation in pixels.
        dtype: dtype of the surfels.
        generator: random generator, on the camera's device; None is torch's default.

    Returns:
        (H, W, K), normally distributed with mean 1 and standard deviation jitter / focal.
    """
    shape = (camera.height, camera.width, max_hits)
    noise = torch.randn(shape, generator=generator, dtype=dtype, device=camera.device)
    return noise.mul_(jitter / camera.focal).add_(1)


def antialiased(surfels: Surfels, camera: Camera, limits: DetailLimits | None) -> Activated:
    """Return the N surfels' activated geometry, with those blurred that are farther away than in any training view.

    Differentiable with respect to the surfels and `camera.viewmat`.

    Args:
        surfels: the surfels.
        camera: the camera.
        limits: detail limits of the N surfels; None blurs nothing.
    """
    shape = surfels.activated()
    if limits is None or not len(surfels):
        return shape
    row = camera.viewmat[2].to(shape.means)
    depths = (shape.means * row[:3]).sum(-1) + row[3]
    blurred = ops.antialias(depths, shape.scales, shape.opacities, shape.gammas, limits.farthest, camera.pixel_focal)
    return Activated(shape.means, shape.quats, *blurred)


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
    for name, number, high in (("max_hits", max_hits, MAX_HITS), ("sh_degree", sh_degree, MAX_SH_DEGREE)):
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
    if surfels.device.type == "cuda":
        torch.cuda.init()  # in a process forked from one that used CUDA, torch's own error says so
    elif surfels.device.type == "cpu":
        keep_freed_memory()
    else:
        raise ValueError(f"surfels: expected parameters on a CPU or a CUDA device, got {surfels.device}")


def _check_tensors(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int,
    background: torch.Tensor,
    depth_jitter: float | torch.Tensor,
    limits: DetailLimits | None,
) -> None:
    """Check shapes, dtypes and devices; checking values would wait for the GPU."""
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
    if camera.K.device != surfels.device:  # of any dtype
        raise ValueError(f"camera.K: expected a tensor on {surfels.device}, got one on {camera.K.device}")
