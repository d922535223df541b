"""The baked scene as a glTF file: one textured quad a surfel, for Blender, three.js and other programs."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.similarity import upright
from nexwarp.errors import FormatError
from nexwarp.export.bake import Observations, Progress, dimmed, lay_out, mean_colors, measure, points_on, texels_at
from nexwarp.export.baked_scene import BakedScene, Header, card_scene
from nexwarp.export.fit import Views, fit
from nexwarp.io.files import write_atomically
from nexwarp.io.pictures import to_uint8
from nexwarp.kernels.types import ALPHA_MAX
from nexwarp.model.model import Model
from nexwarp.ops.atlas import Cut

ALPHAS = ("mask", "blend")
# Cut-outs: programs draw where the texture's alpha is at least this, and nothing elsewhere: they need not sort.
CUTOFF = 0.3
# The quads end where alpha falls to this: bilinear sampling needs what lies beyond the cut-off.
LEAST_ALPHA = {"mask": 0.5, "blend": 0.05}  # of the cut-off
FEWEST = 8  # texels along an axis: alpha varies over every quad


def bake_cards(
    model: Model,
    views: Views,
    alpha: str = "mask",
    *,
    aim: Model | None = None,
    steps: int | None = None,
    progress: Progress = lambda *_: None,
) -> BakedScene:
    """Bake a model into cards, fitted to the views' photos, or for cameras to the renderings of `aim`; see `bake`.

    `aim` is the model itself, or a better one of the same scene, whose colours may depend on the direction.
    """
    cards = make_cards(model, *measure(model, views, progress), alpha)
    if not len(cards.shape.means):
        return cards
    return fit(cards, aim or model, views, steps, partial(progress, "baking the texture"))


@torch.no_grad()
def make_cards(model: Model, scene: BakedScene, seen: Observations, alpha: str) -> BakedScene:
    """Return what `measure` returns of a model as cards, for `save_glb`: cut out ("mask") or blended ("blend").

    Colours are those from the direction in which the views see each surfel, at the photos' mean exposure or a darker
    one: where photos differ much in exposure, half of a sunny scene would be clipped at the mean.
    """
    surfels = model.surfels
    least = LEAST_ALPHA[alpha] * CUTOFF
    opacities, gammas = surfels.opacities.clamp(max=ALPHA_MAX), surfels.gammas
    # |u|^(2 gamma) = 2 log(opacity / alpha) at the end of the quad.
    reach = (2 * (opacities / least).clamp_min(1).log())[:, None].pow(0.5 / gammas)
    shown = opacities > (CUTOFF if alpha == "mask" else 2 * least)
    boxes = torch.cat([-reach, reach], dim=1).where(shown[:, None], 0.0)
    layout = lay_out(boxes, seen.pixels, seen.influence, fewest=FEWEST)
    plain = mean_colors(model, seen)
    texels = reach.new_zeros(layout.height, layout.width, 4)
    for places, ids, local in layout.centres():
        colors = plain[ids] + texels_at(scene, ids, local)[..., :3]
        exponent = local.square().clamp_min(1e-20).pow(gammas[ids]).sum(1)
        alphas = (surfels.opacities[ids] * torch.exp(-0.5 * exponent)).clamp(max=ALPHA_MAX)
        texels[places[:, 1], places[:, 0]] = torch.cat([colors, alphas[:, None]], dim=1)
    exposure = dimmed(model, texels[..., :3][texels[..., 3] >= least])
    texels[..., :3] = (texels[..., :3] * exposure).clamp(0, 1)
    ids = layout.textured()
    cut = Cut(CUTOFF) if alpha == "mask" else None
    geometry = (surfels.means[ids], surfels.quats[ids], surfels.scales[ids] * reach[ids])
    return card_scene(geometry, texels, layout.spans()[ids], cut, exposure)


@torch.no_grad()
def save_glb(path: str | os.PathLike[str], scene: BakedScene, cameras: Sequence[Camera]) -> None:
    """Write cards as a glTF 2.0 binary file, atomically: unlit quads with one texture of colours and alpha.

    The cameras' upward direction becomes +y, by the mesh's node: the vertices stay in the cameras' frame.
    FormatError: there are no cards, as no surfel is opaque enough to be seen.
    """
    import trimesh
    from PIL import Image
    from trimesh.exchange.gltf import export_glb

    if not len(scene.shape.means):
        raise FormatError(f"{path}: expected surfels with an opacity above {CUTOFF}, which glTF shows; found none")
    corners, places, faces = quads(scene)
    mode = {"alphaMode": "BLEND"} if scene.cut is None else {"alphaMode": "MASK", "alphaCutoff": scene.cut.cutoff}
    material = trimesh.visual.material.PBRMaterial(
        name="surfels",
        baseColorTexture=Image.fromarray(to_uint8(scene.texels).cpu().numpy(), "RGBA"),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
        **mode,
    )
    visual = trimesh.visual.TextureVisuals(uv=places, material=material)
    mesh = trimesh.Trimesh(vertices=corners, faces=faces, visual=visual, process=False)
    turn = np.eye(4)
    turn[:3, :3] = upright(cameras)
    world = trimesh.Scene()
    world.add_geometry(mesh, transform=turn)
    write_atomically(Path(path), export_glb(world, tree_postprocessor=partial(_unlit, exposure=scene.exposure)))


def quads(scene: BakedScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners (4 M, 3) in the world, their texture coordinates (4 M, 2) from the bottom left, faces (2 M, 3)."""
    shape, rects = scene.shape, scene.rects.double()
    sides = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], device=rects.device)
    offsets = (2 * sides - 1) * shape.scales[:, None]
    corners = points_on(shape, torch.arange(len(rects), device=rects.device)[:, None], offsets)
    size = torch.tensor([scene.texels.shape[1], scene.texels.shape[0]], device=rects.device)
    places = (rects[:, None, :2] + 0.5 + sides * rects[:, None, 2:]) / size
    places[..., 1] = 1 - places[..., 1]
    first = 4 * np.arange(len(rects))[:, None]
    faces = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])
    return corners.reshape(-1, 3).double().cpu().numpy(), places.reshape(-1, 2).cpu().numpy(), faces


def _unlit(tree: Header, exposure: float) -> None:
    """Make the material show its texture as it is, without light and without coarser levels; note its exposure."""
    tree["asset"]["extras"] = {"exposure": exposure}
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    tree["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]
    for texture in tree["textures"]:
        texture["sampler"] = 0
