"""All passes of a rendering, those that follow from it too, and their OpenEXR file (see docs/outputs.md)."""

import os
from dataclasses import dataclass
from pathlib import Path

import torch
from typing_extensions import Unpack

from nexwarp.camera import Camera
from nexwarp.io.pictures import load_exr, save_exr
from nexwarp.model.model import Model
from nexwarp.model.options import RenderChanges

FORMAT = 2
PASSES = (
    "image",
    "plain",
    "textured",
    "alpha",
    "ids",
    "depths",
    "weights",
    "colors",
    "expected_depth",
    "median_depth",
    "top_depth",
    "normals",
)
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
        expected_depth: (H, W) mean z-depth of all hits, weighted by their blending weights; 0 where nothing is hit.
        median_depth: (H, W) z-depth of the hit that takes the transmittance to 1/2; of the last hit where it stays
            above; 0 where nothing is hit.
        top_depth: (H, W) z-depth of the heaviest hit; 0 where nothing is hit.
        normals: (H, W, 3) unit, world frame: mean of all hits' normals, weighted by their blending weights, each on the
            side that faces the camera; 0 where nothing is hit.
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
    median_depth: torch.Tensor
    top_depth: torch.Tensor
    normals: torch.Tensor
    camera: Camera
    background: torch.Tensor


@torch.no_grad()
def render_buffers(model: Model, camera: Camera, **changes: Unpack[RenderChanges]) -> Buffers:
    """Render every pass of a model; arguments and errors are those of `Model.render`."""
    camera = camera.to(model.device)
    out = model.render(camera, **changes)
    background = torch.tensor(model.options.background).to(out.image)
    if (factors := out.intermediates.factors) is not None:
        background = background * factors
    passes = {name: getattr(out, name) for name in PASSES}
    return Buffers(**passes, camera=camera, background=background)


def save_buffers(path: str | os.PathLike[str], buffers: Buffers) -> None:
    """Write one multi-part OpenEXR file: a part a pass, and a slot of it where there are K.

    Parts: `image`, `plain`, `textured`, `normals`, `colors.0` to `colors.K-1` (channels R, G, B); `alpha`,
    `expected_depth`, `median_depth`, `top_depth`, `depths.k`, `weights.k` (Y); `ids.k` (Y, UINT, 4294967295 in empty
    slots). Camera, background and K are in the text attribute `nexwarp`, as JSON; a background of one colour a pixel is
    a part `background` (R, G, B), and null there.

    Raises:
        TypeError: buffers that are not float32; OSError: `path` cannot be written.
    """
    parts: dict[str, torch.Tensor] = {}
    for name in PASSES:
        value = getattr(buffers, name)
        if name in SLOTS:
            parts |= {f"{name}.{k}": value[:, :, k] for k in range(value.shape[2])}
        else:
            parts[name] = value
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
        known = metadata["camera"]
        viewmat, K = (torch.tensor(known[name], dtype=torch.float32) for name in ("viewmat", "K"))
        camera = Camera(viewmat, K, known["width"], known["height"], known["near"])
        slots = range(metadata["max_hits"])
        found: dict[str, torch.Tensor] = {}
        for name in PASSES:
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
