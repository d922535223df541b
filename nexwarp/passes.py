"""All passes of a rendering, those that follow from it too, and their OpenEXR file (see docs/outputs.md)."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from nexwarp import ops
from nexwarp.camera import Camera
from nexwarp.kernels.types import MAX_HITS
from nexwarp.pictures import load_exr, save_exr
from nexwarp.render import render, seen_depths
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture

FORMAT = 1
SLOTS = ("ids", "depths", "weights", "colors")


@dataclass(frozen=True)
class Buffers:
    """Every pass of one rendering, float32 unless said. Nothing is differentiable.

    Adds up to rounding: image = plain + textured + (1 - alpha) background, textured = sum over k of weights * colors.

    Attributes:
        image: (H, W, 3) the picture, not clamped.
        plain: (H, W, 3) blended colours of the hits that are not textured, without background.
        textured: (H, W, 3) sum over the K textured hits of weight * colour.
        alpha: (H, W) 1 - final transmittance.
        ids: (H, W, K) int32, surfels of the K heaviest hits, heaviest first; -1 in empty slots.
        depths: (H, W, K) their z-depths, world units; 0 in empty slots.
        weights: (H, W, K) their blending weights; 0 in empty slots.
        colors: (H, W, K, 3) their textured colours; 0 in empty slots.
        expected_depth: (H, W) mean z-depth of the 8 heaviest hits (all, where there are no more), weighted by their
            blending weights, whatever K is; 0 where nothing is hit.
        top_depth: (H, W) z-depth of the heaviest hit; 0 where nothing is hit.
        normal: (H, W, 3) unit normal of the heaviest hit's surfel, world frame, on the side that faces the camera;
            0 where nothing is hit.
        camera: what was looked through.
        background: (3,) colour behind everything; (H, W, 3) where a lens darkens it towards the corners.
    """

    image: torch.Tensor
    plain: torch.Tensor
    textured: torch.Tensor
    alpha: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    colors: torch.Tensor
    expected_depth: torch.Tensor
    top_depth: torch.Tensor
    normal: torch.Tensor
    camera: Camera
    background: torch.Tensor


@torch.no_grad()
def render_buffers(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    max_hits: int = 2,
    background: float | Sequence[float] | torch.Tensor = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
    low_pass: bool = False,
    clamp_texture: bool = False,
) -> Buffers:
    """Render every pass; arguments and errors are those of `nexwarp.render`."""
    out = render(surfels, texture, camera, max_hits, background, sh_degree, low_pass, clamp_texture)
    # Depths and normals want the heavy hits even where few or none are textured.
    wide = render(surfels, None, camera, max_hits=MAX_HITS, sh_degree=0, low_pass=low_pass)
    total = wide.weights.sum(-1)
    expected = (wide.weights * wide.depths).sum(-1) / total.clamp_min(torch.finfo(total.dtype).tiny)
    _, rays = _unproject(wide.depths[..., :1], camera)
    background = torch.as_tensor(background).to(out.image).expand(3).clone()
    colors = _slot_colors(surfels, texture, camera, out.ids, out.depths, sh_degree, clamp_texture)
    if surfels.exposures is not None:
        factors = surfels.exposures.factors(camera).to(out.image)
        background, colors = background * factors, colors * (factors if factors.ndim == 1 else factors[:, :, None])
    return Buffers(
        **{name: getattr(out, name) for name in ("image", "plain", "textured", "alpha", "ids", "depths", "weights")},
        colors=colors,
        expected_depth=expected,
        top_depth=wide.depths[..., 0].clone(),
        normal=_facing_normals(surfels, wide.ids[..., 0], rays),
        camera=camera,
        background=background,
    )


def save_buffers(path: str | os.PathLike[str], buffers: Buffers) -> None:
    """Write one multi-part OpenEXR file: a part a pass, and a slot of it where there are K.

    Parts: `image`, `plain`, `textured`, `normal`, `colors.0` to `colors.K-1` (channels R, G, B); `alpha`,
    `expected_depth`, `top_depth`, `depths.k`, `weights.k` (Y); `ids.k` (Y, UINT, 4294967295 in empty slots). Camera,
    background and K are in the text attribute `nexwarp`, as JSON; a background of one colour a pixel is a part
    `background` (R, G, B), and null there.

    Raises:
        TypeError: buffers that are not float32; OSError: `path` cannot be written.
    """
    parts = {}
    for field in fields(buffers):
        value = getattr(buffers, field.name)
        if field.name in SLOTS:
            parts |= {f"{field.name}.{k}": value[:, :, k] for k in range(value.shape[2])}
        elif field.name not in ("camera", "background"):
            parts[field.name] = value
    camera, background = buffers.camera, buffers.background
    if background.ndim > 1:
        parts["background"] = background
    metadata = {
        "format": FORMAT,
        "max_hits": buffers.ids.shape[2],
        "background": None if background.ndim > 1 else background.tolist(),
        "camera": {
            "viewmat": camera.viewmat.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "near": camera.near,
        },
        "frame": "world to camera; cameras x right, y down, z forward; pixel centres at +0.5",
    }
    save_exr(path, parts, metadata)


def load_buffers(path: str | os.PathLike[str]) -> Buffers:
    """Read what `save_buffers` wrote, bit for bit, onto the CPU.

    Raises:
        FileNotFoundError: no such file; ValueError: it is no such file, or it is damaged.
    """
    path = Path(path)
    parts, metadata = load_exr(path)
    try:
        if metadata["format"] != FORMAT:
            raise ValueError(f"format {metadata['format']}, expected {FORMAT}")
        values: dict[str, Any] = dict(metadata["camera"])
        matrices = {name: torch.tensor(values.pop(name), dtype=torch.float32) for name in ("viewmat", "K")}
        camera = Camera(**matrices, **values)
        slots = range(metadata["max_hits"])
        found: dict[str, Any] = {}
        for name in (f.name for f in fields(Buffers) if f.name not in ("camera", "background")):
            if name not in SLOTS:
                found[name] = parts[name]
            elif slots:
                found[name] = torch.stack([parts[f"{name}.{k}"] for k in slots], dim=2)
            else:
                shape = (camera.height, camera.width, 0, *((3,) if name == "colors" else ()))
                found[name] = torch.empty(shape, dtype=torch.int32 if name == "ids" else torch.float32)
        color = metadata["background"]
        background = parts["background"] if color is None else torch.tensor(color, dtype=torch.float32)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: expected the passes of a nexwarp rendering ({error})") from None
    return Buffers(**found, camera=camera, background=background)


def _unproject(depths: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """World points (H, W, K, 3) of z-depths (H, W, K), and unit directions (H, W, 3) of the rays."""
    pinhole = ops.Pinhole(camera.K.to(depths), camera.width, camera.height, camera.near)
    return ops.unproject(depths, camera.viewmat, pinhole)


def _slot_colors(
    surfels: Surfels,
    texture: NeuralTexture | None,
    camera: Camera,
    ids: torch.Tensor,
    depths: torch.Tensor,
    sh_degree: int,
    clamp: bool,
) -> torch.Tensor:
    """(H, W, K, 3) what `render` multiplies the weights by."""
    empty = (ids < 0)[..., None]
    colors = depths.new_zeros(*ids.shape, 3)
    if bool(empty.all()):
        return colors
    if texture is not None:
        positions, rays = _unproject(depths, camera)
        depths = seen_depths(ids, depths, surfels, camera.focal)
        colors = texture.colors(positions, depths, rays, camera.focal, sh_degree=sh_degree, clamp=clamp)
    if texture is None or texture.residual:
        plain = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, sh_degree)
        colors = colors + plain[ids.clamp_min(0).long()]
    return colors.masked_fill(empty, 0.0)


def _facing_normals(surfels: Surfels, ids: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
    """(H, W, 3) normals of surfels `ids` (H, W) against the rays (H, W, 3), 0 where there is none."""
    if not len(surfels):
        return torch.zeros_like(rays)
    normals = surfels.normals[ids.clamp_min(0).long()]
    away = (normals * rays).sum(-1, keepdim=True) > 0
    return torch.where(away, -normals, normals).masked_fill((ids < 0)[..., None], 0.0)
