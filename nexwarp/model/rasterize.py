"""The K-buffer of plain tensors, for a shading of one's own: `rasterize` and `compose` (paper Sec. 4.2)."""

import dataclasses
from collections.abc import Sequence

import numpy.typing as npt
import torch
from torch.nn.functional import pad

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import OutOfMemoryError, check_tensors
from nexwarp.machine import needed_memory
from nexwarp.model.options import Color, RenderOptions, color_tensor
from nexwarp.model.render import check_camera, memory_error, pinhole_of, prepare_device
from nexwarp.model.surfels import Activated, check_coefficients
from nexwarp.model.texture import Hits
from nexwarp.ops.collect import CHANNELS
from nexwarp.ops.project import GEOMETRY

Values = torch.Tensor | npt.ArrayLike  # arrays and lists become tensors of the camera's dtype, on its device


def rasterize(  # noqa: PLR0913  # gsplat's order of arguments
    means: Values,
    quats: Values,
    scales: Values,
    opacities: Values,
    gammas: Values,
    colors: Values,
    camera: Camera | Sequence[Camera],
    max_hits: int = 2,
    background: Color | None = None,
) -> Hits:
    """Find the K heaviest hits of each pixel, and blend the colours of all others (paper Sec. 4.2).

    Differentiable with respect to all tensors given, `camera.viewmat` and a background tensor included, and through
    them to whatever they were computed from. NumPy arrays and lists become tensors of the camera's dtype, on its
    device. As in `render`, types, shapes and devices are checked, and no values.

    Args:
        means: (N, 3) centres, world units; float32 or float64.
        quats: (N, 4) rotations surfel to world, wxyz, of any length > 0.
        scales: (N, 2) > 0, world units along the surfel's x and y axes.
        opacities: (N,) in [0, 1].
        gammas: (N, 2) >= 1; 1 is a Gaussian, large values a hard-edged quad.
        colors: (N, D) any D >= 1 channels, without limits; or (N, C, 3) spherical harmonics as of `Surfels`, for D = 3.
        camera: the camera, on the same device and of the same dtype; or a list of cameras of one size.
        max_hits: K, length of the buffer, 0 to 8; with 0, `plain` blends all hits.
        background: a number, D numbers or a (D,) tensor, added to `plain` times (1 - alpha). None adds nothing: give
            the background here or to `compose`.

    Raises:
        TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
        OutOfMemoryError: memory does not suffice.
    """
    if torch.compiler.is_compiling():  # one break of the graph, instead of one at each kernel
        return torch.compiler.disable(rasterize)(
            means, quats, scales, opacities, gammas, colors, camera, max_hits, background
        )
    cameras = [camera] if isinstance(camera, Camera) else list(camera)
    if not cameras or not all(isinstance(x, Camera) for x in cameras):
        raise TypeError(f"camera: expected a nexwarp.Camera or a list of them, got {camera!r:.60}")
    if len({(x.width, x.height) for x in cameras}) > 1:
        raise ValueError(f"camera: expected cameras of one size, got {sorted({(x.width, x.height) for x in cameras})}")
    like, max_hits = cameras[0].viewmat, RenderOptions(max_hits).max_hits
    shape = Activated(*(_tensor(x, like) for x in (means, quats, scales, opacities, gammas)))
    colors = _tensor(colors, like)
    _check(shape, colors, cameras, max_hits)
    color = None if background is None else _background(background, shape.means, colors.shape[-1])
    try:
        hits = [_rasterize(shape, colors, each, max_hits, color) for each in cameras]
        if isinstance(camera, Camera):
            return hits[0]
        return Hits(*(torch.stack([getattr(x, field.name) for x in hits]) for field in dataclasses.fields(Hits)))
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, OutOfMemoryError) or (needed := needed_memory(error)) is None:
            raise
    raise memory_error(needed, cameras[0], max_hits)  # outside of the handler, see `draw`


def compose(hits: Hits, colors: torch.Tensor, background: Color | None = None) -> torch.Tensor:
    """Return the image (H, W, D) = plain + sum over k of weights * colors (paper Eq. 7) + (1 - alpha) background.

    Differentiable in everything. For hits of a list of cameras, all have the dimension of these in front.

    Args:
        hits: as `rasterize` returns them.
        colors: (H, W, K, D) your colours of the hits; those in empty slots do not count, as long as they are finite.
        background: a number, D numbers or a (D,) tensor; None adds nothing.

    Raises:
        TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
    """
    check_tensors({"colors": (colors, (*hits.weights.shape, hits.plain.shape[-1]))}, dtype=hits.plain.dtype)
    image = hits.plain + (hits.weights[..., None] * colors).sum(-2)
    if background is None:
        return image
    return image + (1 - hits.alpha)[..., None] * _background(background, hits.plain, hits.plain.shape[-1])


def _tensor(value: Values, like: torch.Tensor) -> torch.Tensor:
    return value if isinstance(value, torch.Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)


def _background(background: Color, like: torch.Tensor, channels: int) -> torch.Tensor:
    color = color_tensor(background, like, channels)
    check_tensors({"background": (color, (channels,))}, dtype=like.dtype, device=like.device)
    return color


def _check(shape: Activated, colors: torch.Tensor, cameras: Sequence[Camera], max_hits: int) -> None:
    """Check types, shapes, devices and the memory of one image, and get the device ready."""
    tensors = {name: (x, size) for (name, size), x in zip(GEOMETRY.items(), shape, strict=True)}
    harmonics = isinstance(colors, torch.Tensor) and colors.ndim == 3
    check_tensors({**tensors, "colors": (colors, ("N", "C", 3) if harmonics else ("N", "D"))})
    if harmonics:
        check_coefficients("colors", colors.shape[1])
    elif colors.shape[1] < 1:
        raise ValueError("colors: expected at least 1 channel, got 0")
    prepare_device("means", shape.means)
    for camera in cameras:
        check_camera(camera, shape.means)
    dtype, device = shape.means.dtype, shape.means.device
    ops.check_image(cameras[0].width, cameras[0].height, max_hits, dtype, device, texture=(0, dtype))


def _rasterize(
    shape: Activated, colors: torch.Tensor, camera: Camera, max_hits: int, background: torch.Tensor | None
) -> Hits:
    """Draw one camera: one walk blends 3 + 16 channels, and a further one each further 16."""
    with torch.autocast(shape.means.device.type, enabled=False):
        if colors.ndim == 3:
            colors = ops.plain_colors(colors, shape.means, camera.position, 3)
        channels, pinhole = colors.shape[1], pinhole_of(camera, shape.means)
        first = colors if channels == 3 else pad(colors[:, :3], (0, max(3 - channels, 0)))
        projection = ops.project(*shape, first, camera.viewmat)
        tiles = ops.intersect_tiles(shape, projection, camera.viewmat, pinhole)
        groups: list[torch.Tensor | None] = [None]
        if channels > 3:
            groups = [pad(x, (0, CHANNELS - x.shape[1])) for x in colors[:, 3:].split(CHANNELS, dim=1)]
        walks = [ops.collect(projection, tiles, pinhole, max_hits=max_hits, channels=x) for x in groups]
        hits = walks[0]
        plain = hits.plain
        if channels != 3:
            more = [x.channels for x in walks if x.channels is not None]
            plain = torch.cat([plain, *more], dim=-1)[..., :channels]
        if background is not None:
            plain = plain + (1 - hits.alpha)[..., None] * background
        points, directions = ops.unproject(hits.depths, camera.viewmat, pinhole)
        return Hits(hits.ids, hits.depths, hits.weights, plain, hits.alpha, points, directions)
