"""The baked scene as a glTF file: one textured quad a surfel, for Blender, three.js and other programs."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import up_direction
from nexwarp.errors import FormatError
from nexwarp.export.bake import Baked, Layout, lay_out, points_on
from nexwarp.io.files import write_atomically
from nexwarp.io.pictures import to_uint8
from nexwarp.kernels.types import ALPHA_MAX

# Programs draw where the texture's alpha is at least this, and nothing elsewhere: they need not sort the quads.
CUTOFF = 0.3
# The quads end where alpha falls to this: bilinear sampling needs what lies beyond the cut-off.
LEAST_ALPHA = 0.5 * CUTOFF
FEWEST = 8  # texels along an axis: alpha varies over every quad


@torch.no_grad()
def save_glb(path: str | os.PathLike[str], baked: Baked, cameras: Sequence[Camera]) -> None:
    """Write a baked scene as a glTF 2.0 binary file, atomically: unlit quads with one texture of colours and alpha.

    Colours are those at the mean exposure from the direction in which the views see each surfel. The mean of the
    cameras' upward directions becomes +y. FormatError: no surfel is opaque enough to be seen.
    """
    import trimesh
    from PIL import Image
    from trimesh.exchange.gltf import export_glb

    layout, pixels = _texture(baked)
    if not len(layout.textured()):
        raise FormatError(f"{path}: expected surfels with an opacity above {CUTOFF}, which glTF shows; found none")
    corners, places, faces = _quads(baked, layout)
    material = trimesh.visual.material.PBRMaterial(
        name="surfels",
        baseColorTexture=Image.fromarray(pixels, "RGBA"),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="MASK",
        alphaCutoff=CUTOFF,
        doubleSided=True,
    )
    visual = trimesh.visual.TextureVisuals(uv=places, material=material)
    mesh = trimesh.Trimesh(vertices=corners @ upright(cameras).T, faces=faces, visual=visual, process=False)
    write_atomically(Path(path), export_glb(trimesh.Scene(mesh), tree_postprocessor=_unlit))


def upright(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rotation (3, 3) of the world that turns the scene's upward direction to +y."""
    up = up_direction(cameras).numpy()
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    return np.stack([side, up, np.cross(side, up)])


def _texture(baked: Baked) -> tuple[Layout, np.ndarray]:
    """Return a layout of the surfels' visible parts, and its texels (height, width, 4) uint8, RGBA."""
    surfels = baked.surfels
    opacities, gammas = surfels.opacities.clamp(max=ALPHA_MAX), surfels.gammas
    # |u|^(2 gamma) = 2 log(opacity / alpha) at the end of the quad.
    reach = (2 * (opacities / LEAST_ALPHA).clamp_min(1).log())[:, None].pow(0.5 / gammas)
    boxes = torch.cat([-reach, reach], dim=1).where((opacities > CUTOFF)[:, None], 0.0)
    layout = lay_out(boxes, baked.seen.pixels, fewest=FEWEST)
    plain = baked.mean_colors()
    pixels = np.zeros((layout.height, layout.width, 4), np.uint8)
    for places, ids, local in layout.centres():
        colors = plain[ids] + baked.added(ids, local)
        exponent = local.square().clamp_min(1e-20).pow(gammas[ids]).sum(1)
        alphas = (surfels.opacities[ids] * torch.exp(-0.5 * exponent)).clamp(max=ALPHA_MAX)
        columns, rows = places.cpu().numpy().T
        pixels[rows, columns] = to_uint8(torch.cat([colors, alphas[:, None]], dim=1)).cpu().numpy()
    return layout, pixels


def _quads(baked: Baked, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners (4 M, 3) in the world, their texture coordinates (4 M, 2) from the bottom left, faces (2 M, 3)."""
    surfels = baked.surfels
    ids = layout.textured()
    boxes, rects = layout.boxes[ids], layout.rects[ids].double()
    sides = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], device=boxes.device)
    local = boxes[:, None, :2] + sides * (boxes[:, None, 2:] - boxes[:, None, :2])
    offsets = local * surfels.scales.detach()[ids, None]
    corners = points_on(surfels, ids[:, None], offsets)
    size = torch.tensor([layout.width, layout.height], device=boxes.device)
    places = (rects[:, None, :2] + 0.5 + sides * (rects[:, None, 2:] - 1)) / size
    places[..., 1] = 1 - places[..., 1]
    first = 4 * np.arange(len(ids))[:, None]
    faces = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])
    return corners.reshape(-1, 3).double().cpu().numpy(), places.reshape(-1, 2).cpu().numpy(), faces


def _unlit(tree: dict[str, Any]) -> None:
    """Make the material show its texture as it is, without light and without coarser levels of the texture."""
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    tree["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]
    for texture in tree["textures"]:
        texture["sampler"] = 0
