"""From model parts to pixels: antialias, project, tiles, collect, texture, compose (paper Sec. 4.2)."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import OutOfMemoryError, check_tensors, check_type
from nexwarp.machine import keep_freed_memory, needed_memory
from nexwarp.model.exposures import Exposures
from nexwarp.model.options import Color, RenderOptions, color_tensor
from nexwarp.model.surfels import Activated, Surfels
from nexwarp.model.texture import DetailLimits, Hits, NeuralTexture, Texture
from nexwarp.ops.tiles import Order

MAX_JITTER = 1000.0  # pixels


@dataclass(frozen=True)
class Intermediates:
    """Results of the stages, from which `Rendering` computes further buffers on request."""

    projection: ops.Projection
    hits: ops.Hits
    texels: torch.Tensor | None  # (H, W, K, 3) textured colours of the hits
    residual: bool  # whether these are added to the plain colours
    factors: torch.Tensor | None  # (3,) or (H, W, 3) gains and falloff of the exposure; None is the mean exposure

    tiles: ops.Tiles
    pinhole: ops.Pinhole
    viewmat: torch.Tensor


@dataclass(frozen=True)
class Rendering:
    """The buffers of one rendering.

    All fields but `ids` are differentiable. `expected_depth`, `median_depth`, `top_depth`, `normals`,
    `blended_normals` and `colors` are computed on first access, without a second rendering, and are differentiable,
    too. The gradient of `median_depth` and `top_depth` is that of the depth of the hit that they are taken from.

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
        # It is kept for later uses, so that its gradients must not depend on where the first one is.
        with torch.set_grad_enabled(stages.projection.records.requires_grad):
            return ops.surface(stages.projection, stages.hits, stages.viewmat)

    def request_splat_error(self, errors: torch.Tensor) -> ops.SplatErrorRequest:
        """Request `splat_error(errors)` from the backward pass, which computes it at almost no cost.

        The backward pass writes the request's `sums_after_backward` (N,) for errors (H, W) >= 0.
        """
        request = self.intermediates.hits.error_request
        check_tensors({"errors": (errors, self.alpha.shape)}, dtype=self.alpha.dtype, device=self.alpha.device)
        request.errors = errors.detach().contiguous()
        return request

    def splat_error(self, errors: torch.Tensor) -> torch.Tensor:
        """Return each surfel's sum (N,) over pixels of blending weight * errors (H, W). Not differentiable."""
        return ops.splat_error(self.intermediates.hits, errors)


def render(
    surfels: Surfels,
    texture: Texture | None,
    camera: Camera,
    max_hits: int = 2,
    background: Color = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
    clamp_texture: bool = False,
    order: Order = "depth",
) -> Rendering:
    """Render surfels from a camera (paper Sec. 4.2). `Model.render` renders a trained scene.

    Differentiable with respect to the surfels, the texture, `background` and `camera.viewmat`. `torch.autocast` changes
    nothing: all is computed in the surfels' dtype, and a texture as its `half_precision` says.

    Args:
        surfels: the N surfels, N >= 0, float32 or float64.
        texture: a `NeuralTexture`, or one of your own, on the same device; None leaves all hits their plain colours.
        camera: the camera, on the same device.
        max_hits: K, number of hits textured in each pixel, 0 to 8.
        background: a number, three numbers or a (3,) tensor, weighted by the final transmittance. The values of a CUDA
            tensor are not checked, which would wait for the GPU.
        sh_degree: largest SH degree of the colours, 0 to 3.
        clamp_texture: clamp textured colours to >= 0; not for residual textures.
        order: blend surfels by their centres' z-depth, as the paper, or by their distance, which turning the camera
            does not change.

    Raises:
        TypeError, ValueError: a type, shape, value or device does not fit; the message names the argument.
        OutOfMemoryError: memory does not suffice; what surely does not fit is refused before anything is allocated.
    """
    if torch.compiler.is_compiling():  # one break of the graph, instead of one at each kernel
        return torch.compiler.disable(render)(
            surfels, texture, camera, max_hits, background, sh_degree, clamp_texture, order
        )
    check_type("surfels", surfels, Surfels)
    check_type("camera", camera, Camera)
    check_type("texture", texture, Texture, optional=True)
    if background is None:
        raise TypeError("background: expected numbers or a tensor, got None")
    options = RenderOptions(max_hits, sh_degree=sh_degree, clamp_texture=clamp_texture, order=order)
    return draw(Frame(surfels, texture, camera, options, background))


@dataclass(frozen=True)
class Frame:
    """The parts of a model, or of a training, that one picture is drawn from; see `render`.

    Exposures and limits count as the options say. `jitter` are (H, W, K) factors on the depths at which the texture is
    evaluated, see `jitter_factors`; for training.
    """

    surfels: Surfels
    texture: Texture | None
    camera: Camera
    options: RenderOptions
    background: Color
    exposures: Exposures | None = None
    limits: DetailLimits | None = None
    jitter: torch.Tensor | None = None


def draw(frame: Frame) -> Rendering:
    """Draw a frame: the one path from the parts of a model to pixels."""
    surfels, texture, camera, options = frame.surfels, frame.texture, frame.camera, frame.options
    prepare_device("surfels", surfels.means)
    exposures = frame.exposures if options.exposure == "photos" else None
    limits = frame.limits if options.detail_limits and len(surfels) else None
    try:
        with torch.autocast(surfels.device.type, enabled=False):
            color = color_tensor(frame.background, surfels.means)
            _check(frame, color, limits)
            shape = antialiased(surfels.activated(), camera, limits)
            harmonics = surfels.sh0, surfels.shN
            colors = ops.plain_colors(harmonics, shape.means, camera.position, options.sh_degree)
            projection = ops.project(*shape, colors, camera.viewmat)
            pinhole = pinhole_of(camera, shape.means)
            tiles = ops.intersect_tiles(shape, projection, camera.viewmat, pinhole, blending=options.order)
            hits = ops.collect(projection, tiles, pinhole, max_hits=options.max_hits)
            texels = None if texture is None else _texels(frame, texture, hits, limits)
            residual = texture is not None and texture.residual
            slots = (hits.plain.new_empty(*hits.alpha.shape, 0, 3), hits.weights[..., :0])  # none are textured
            textured_slots = slots if texels is None else (texels, hits.weights)
            base = hits.base if texels is None or residual else None
            image, textured = ops.compose(hits.plain, *textured_slots, hits.alpha, color, base)
            factors = None if exposures is None else exposures.factors(camera).to(image)
            image, plain, textured = (x if factors is None else x * factors for x in (image, hits.plain, textured))
            buffers = (image, plain, textured, hits.ids, hits.depths, hits.weights, hits.alpha)
            stages = Intermediates(projection, hits, texels, residual, factors, tiles, pinhole, camera.viewmat)
            return Rendering(*buffers, stages)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, OutOfMemoryError) or (needed := needed_memory(error)) is None:
            raise
    # Outside of the handler, and by no name: tracebacks would keep alive what has been allocated.
    raise memory_error(needed, camera, options.max_hits)


def memory_error(needed: str, camera: Camera, max_hits: int) -> OutOfMemoryError:
    """Return the error of a rendering that lacked memory, of which it needed so much."""
    return OutOfMemoryError.of(f"an image of {camera.width}x{camera.height} pixels with K = {max_hits}", needed)


def prepare_device(name: str, means: torch.Tensor) -> None:
    """Check the dtype and device of an argument's surfels, and get the device ready."""
    dtype, device = means.dtype, means.device
    if dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected float32 or float64 values, got {dtype}")
    if device.type == "cuda":
        torch.cuda.init()  # in a process forked from one that used CUDA, torch's own error says so
    elif device.type == "cpu":
        keep_freed_memory()
    else:
        raise ValueError(f"{name}: expected values on a CPU or a CUDA device, got {device}")


def _check(frame: Frame, background: torch.Tensor, limits: DetailLimits | None) -> None:
    """Check shapes, dtypes, devices and the memory of the image; checking values would wait for the GPU."""
    surfels, texture, camera, options = frame.surfels, frame.texture, frame.camera, frame.options
    dtype, device = surfels.means.dtype, surfels.device
    if options.clamp_texture and texture is not None and texture.residual:
        raise ValueError("clamp_texture: expected False with a residual texture, got True")
    check_camera(camera, surfels.means)
    expected: dict[str, tuple[torch.Tensor, tuple[int, ...]]] = {"background": (background, (3,))}
    if isinstance(texture, NeuralTexture):
        expected["texture.grid"] = (texture.grid, tuple(texture.grid.shape))
    if frame.jitter is not None:
        expected["jitter"] = (frame.jitter, (camera.height, camera.width, options.max_hits))
    if limits is not None:
        expected["detail_limits.nearest"] = (limits.nearest, (len(surfels),))
        expected["detail_limits.farthest"] = (limits.farthest, (len(surfels),))
    check_tensors(expected, dtype=dtype, device=device)
    stored = texture.stored_per_point(options.sh_degree) if isinstance(texture, NeuralTexture) else (0, dtype)
    ops.check_image(camera.width, camera.height, options.max_hits, dtype, device, texture=stored)


def check_camera(camera: Camera, like: torch.Tensor) -> None:
    """Check a camera's tensors: intrinsics may have any dtype, but no gradient."""
    check_tensors({"camera.viewmat": (camera.viewmat, (4, 4))}, dtype=like.dtype, device=like.device)
    if camera.K.device != like.device:
        raise ValueError(f"camera.K: expected a tensor on {like.device}, got one on {camera.K.device}")
    if camera.K.requires_grad and torch.is_grad_enabled():
        raise ValueError("camera.K: expected requires_grad=False: renderings have no gradient of the intrinsics")


def antialiased(shape: Activated, camera: Camera, limits: DetailLimits | None) -> Activated:
    """Blur surfels that are farther away than in any training view; differentiable in the geometry and the viewmat."""
    if limits is None:
        return shape
    row = camera.viewmat[2].to(shape.means)
    depths, focal = (shape.means * row[:3]).sum(-1) + row[3], camera.pixel_focal
    blurred = ops.antialias(depths, shape.scales, shape.opacities, shape.gammas, limits.farthest, focal)
    return Activated(shape.means, shape.quats, *blurred)


def pinhole_of(camera: Camera, like: torch.Tensor) -> ops.Pinhole:
    """Return the camera's image plane, as the ops take it."""
    return ops.Pinhole(camera.K.to(like), camera.width, camera.height, camera.near)


def _texels(frame: Frame, texture: Texture, hits: ops.Hits, limits: DetailLimits | None) -> torch.Tensor:
    """Return the textured colours (H, W, K, 3) of the hits."""
    camera, options = frame.camera, frame.options
    pinhole = pinhole_of(camera, hits.depths)
    positions, directions = ops.unproject(hits.depths, camera.viewmat, pinhole, frame.jitter)
    found = Hits(hits.ids, hits.depths, hits.weights, hits.plain, hits.alpha, positions, directions)
    if not isinstance(texture, NeuralTexture):
        colors = texture.colors(found, camera)
        expected = {"texture.colors": (colors, tuple(positions.shape))}
        check_tensors(expected, dtype=positions.dtype, device=positions.device)
        return (colors.clamp_min(0) if options.clamp_texture else colors).contiguous()
    if limits is not None:
        depths = ops.limit_depths(hits.ids, hits.depths, limits.nearest, limits.farthest, camera.focal)
        found = replace(found, depths=depths)
    return texture.colors(found, camera, sh_degree=options.sh_degree, clamp=options.clamp_texture)


def jitter_factors(
    camera: Camera, max_hits: int, jitter: float, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draw factors (H, W, K) on depths, N(1, jitter / focal), which shift the texture's points along their rays."""
    shape = (camera.height, camera.width, max_hits)
    factors = torch.empty(shape, dtype=camera.viewmat.dtype, device=camera.device)
    return factors.normal_(1.0, jitter / camera.focal, generator=generator)
