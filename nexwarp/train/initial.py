"""Makes the initial surfels, on points of the cloud, and the texture; or takes those that are given."""

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import TypedDict, cast

import numpy as np
import torch

from nexwarp.cameras.camera import in_image
from nexwarp.data import InitialPoints, Scene, View, initial_points
from nexwarp.data.skybox import skybox_points
from nexwarp.errors import check_type
from nexwarp.kernels.sh import BAND_0
from nexwarp.machine import in_threads
from nexwarp.model.bounds import check_bounds
from nexwarp.model.model import Model
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.surfels import SOFT, Surfels, axes, turned
from nexwarp.model.texture import NeuralTexture, Texture, TextureShape
from nexwarp.train.recipe import FEW_PHOTOS, Config

INITIAL_OPACITY = 0.1
NUMBERS_A_PIXEL = 0.1  # of the hash grid, for each pixel of the training photos
SKYBOX_SHARE = 6  # at most one initial surfel of so many lies on the sphere
SAME_SCALE = 1e-3  # relative difference of the scales of one scene
TABLE_POWERS = (12, 20)  # sizes of tables, as powers of two; the largest is the paper's
MANY_DOUBLINGS, MANY_POWER = 2, 19  # where photos are many, tables double twice, but not beyond 2^19


class Start(TypedDict, total=False):
    """What a training starts from, in place of the scene's points and a new texture; see `nexwarp.train`."""

    surfels: Surfels | None
    init: Model | None
    texture: Texture | type[Texture] | Callable[[Scene, Surfels], Texture] | None


def check_start(scene: Scene, config: Config, start: Start) -> None:
    """Raise TypeError or ValueError where what a training is to start from does not fit it."""
    for name in start:
        if name not in Start.__annotations__:
            raise TypeError(f"{name}: expected no argument of this name")
    surfels, init, texture = start.get("surfels"), start.get("init"), start.get("texture")
    check_type("surfels", surfels, Surfels, optional=True)
    check_type("init", init, Model, optional=True)
    if surfels is not None and init is not None:
        raise ValueError("init: expected None with surfels, which are the model's otherwise")
    if init is not None:
        check_scale("init", init, scene)
        surfels = init.surfels
    if surfels is not None:
        if not 1 <= len(surfels) <= config.max_surfels:
            raise ValueError(f"surfels: expected 1 to max_surfels, {config.max_surfels:,}, got {len(surfels):,}")
        check_bounds({f"surfels.{name}": x.detach() for name, x in surfels.named_parameters()})
    if texture is not None and not isinstance(texture, Texture) and not callable(texture):
        raise TypeError(f"texture: expected a nexwarp.Texture, or a function that makes one, got {texture!r:.60}")
    if texture is not None and config.max_hits == 0:
        raise ValueError("texture: expected None with max_hits = 0, which textures no hits")


def check_scale(name: str, model: Model, scene: Scene) -> None:
    """Raise ValueError where a model says that its scene had another scale."""
    scale = model.meta.get("scene_scale")
    if isinstance(scale, (int, float)) and not math.isclose(scale, scene.scale, rel_tol=SAME_SCALE):
        raise ValueError(
            f"{name}: expected a model of {scene.path}, whose scale is {scene.scale:.6g}, "
            f"got one of a scene of scale {scale:.6g}"
        )


def given_surfels(config: Config, start: Start) -> Surfels | None:
    """Return a copy of the surfels to start from, with the SH coefficients of the run; None where none are given."""
    init = start.get("init")
    surfels = start.get("surfels") if init is None else init.surfels
    if surfels is None:
        return None
    raw = {name: x.detach().float().clone() for name, x in surfels.state_dict().items()}
    rest = raw["shN"][:, : (config.sh_degree + 1) ** 2 - 1]
    raw["shN"] = torch.nn.functional.pad(rest, (0, 0, 0, (config.sh_degree + 1) ** 2 - 1 - rest.shape[1]))
    return Surfels(raw)


def initial_texture(scene: Scene, config: Config, surfels: Surfels, start: Start) -> Texture:
    """Return the texture to train: the one that is given, or a copy of the model's, or a new one for the scene."""
    init, texture = start.get("init"), start.get("texture")
    if isinstance(texture, type):
        texture = texture()
    elif texture is not None and not isinstance(texture, Texture):
        texture = texture(scene, surfels)
    if texture is None and init is not None and config.max_hits:
        given = init.texture
        texture = given.up_to(config.sh_degree) if type(given) is NeuralTexture else copy.deepcopy(given)
    if texture is None:
        return NeuralTexture(**texture_shape(scene, config))
    if not isinstance(texture, Texture):
        raise TypeError(f"texture: expected a function that returns a nexwarp.Texture, got {type(texture).__name__}")
    for name, x in texture.state_dict().items():
        if x.dtype != torch.float32:
            raise TypeError(f"texture.{name}: expected float32, got {x.dtype}")
    for name in texture.per_surfel:
        if (rows := len(texture.state_dict()[name])) != len(surfels):
            raise ValueError(f"texture.{name}: expected a row for each of {len(surfels)} surfels, got {rows}")
    return texture


def initial_surfels(
    scene: Scene, config: Config, generator: torch.Generator, colors: torch.Tensor | None = None
) -> Surfels:
    """Surfels on the `starting_points`, of `colors` (P, 3) or the scene's."""
    points = starting_points(scene, config, colors)
    count = len(points.means)
    quats = torch.randn(count, 4, generator=generator)
    raw = {
        "means": points.means,
        "raw_quats": quats_towards(points.normals, quats) if config.orient_points else quats,
        "log_scales": points.scales.log()[:, None].repeat(1, 2),
        "logit_opacities": torch.logit(torch.full((count,), INITIAL_OPACITY)),
        "raw_gammas": torch.full((count, 2), SOFT),
        "sh0": ((points.colors - 0.5) / BAND_0)[:, None],
        "shN": torch.zeros(count, (config.sh_degree + 1) ** 2 - 1, 3),
    }
    return Surfels(raw)


def starting_points(scene: Scene, config: Config, colors: torch.Tensor | None = None) -> InitialPoints:
    """Choose points of the cloud by farthest point sampling, and of a sphere around the scene, those last.

    They are half the budget at most (paper Sec. 4.3). Of the sphere's points, those near the cloud are left out; a
    sixth of all may lie on it, and none where photos are transparent.
    """
    most = max(config.max_surfels // 2, 1)
    # Behind transparent photos lies the background colour alone.
    count = 0 if scene.background is not None else min(config.skybox, most // SKYBOX_SHARE)
    sky = skybox_points(scene.train, scene.points, count) if count else None
    points = initial_points(
        scene.points,
        scene.colors if colors is None else colors,
        most if sky is None else most - len(sky.means),
        track_lengths=scene.track_lengths,
        errors=scene.reprojection_errors,
        filter_outliers=config.filter_points,
    )
    return points if sky is None else points.joined(sky)


def quats_towards(normals: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    """Turn rotations (N, 4) wxyz by the least angle so that their z axes lie along unit normals (N, 3)."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    axis = axes(quats)[2]
    normals = torch.where((axis * normals).sum(-1, keepdim=True) < 0, -normals, normals)
    # Half-way quaternion from axis to normal; their angle is at most 90 degrees, so it is never 0.
    turn = torch.cat([1 + (axis * normals).sum(-1, keepdim=True), torch.linalg.cross(axis, normals)], dim=-1)
    return turned(torch.nn.functional.normalize(turn, dim=-1), quats)


def initial_poses(scene: Scene, config: Config, device: torch.device) -> PoseCorrections | None:
    """Return corrections of 0 for the training poses; None where they stay as given."""
    if not config.refine_poses:
        return None
    depths = [_typical_depth(view, scene) for view in scene.train]
    return PoseCorrections([view.camera for view in scene.train], scene.scale, depths).to(device)


def _typical_depth(view: View, scene: Scene) -> float:
    """Return the median z-depth of the points in front of a view's camera, world units; without any, the scale."""
    points = scene.points if view.points is None or not len(view.points) else view.points
    depths = view.camera.project(points)[1]
    depths = depths[depths > view.camera.near]
    return depths.median().item() if len(depths) else scene.scale


def texture_shape(scene: Scene, config: Config) -> TextureShape:
    """Arguments of `NeuralTexture`, with resolutions that follow the scene when the config leaves them open.

    The finest level's cells are as small as the pixels of nearly all training views at the points they see (95th
    percentile of f / t), the coarsest's a 64th of the scene's scale: rescaling a scene changes nothing. A table that
    is too large for the photos learns each by heart; the fewer there are, the sooner.
    """
    asked = config.texture
    finest = _pixel_resolution(scene) if asked.max_resolution is None else asked.max_resolution
    coarsest = min(64.0 / scene.scale, finest / 4) if asked.min_resolution is None else asked.min_resolution
    entries = _table_size(scene, asked.levels * asked.features) if asked.table_size is None else asked.table_size
    degree = config.sh_degree if asked.sh_degree is None else asked.sh_degree
    shape = dataclasses.replace(
        asked, table_size=entries, min_resolution=coarsest, max_resolution=finest, sh_degree=degree
    )
    return cast(TextureShape, dataclasses.asdict(shape))


def _table_size(scene: Scene, width: int) -> int:
    """Entries of tables of `width` numbers an entry, a power of two, of `NUMBERS_A_PIXEL`, more for many photos."""
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    power = round(math.log2(NUMBERS_A_PIXEL * pixels / width))
    if len(scene.train) > FEW_PHOTOS:
        power = max(power, min(power + MANY_DOUBLINGS, MANY_POWER))
    return 2 ** min(max(power, TABLE_POWERS[0]), TABLE_POWERS[1])


def _pixel_resolution(scene: Scene) -> float:
    """95th percentile, over training views and the points in them, of pixels per world unit."""

    def densities(view: View) -> torch.Tensor:
        camera = view.camera
        pixel, depth = camera.project(scene.points)
        seen = in_image(pixel, depth, camera.width, camera.height) & (depth > camera.near)
        return camera.focal / depth[seen]

    density = torch.cat(list(in_threads(densities, scene.train)))
    if density.numel() == 0:
        raise ValueError(f"{scene.path}: expected points in front of the training cameras, found none")
    return float(np.quantile(density.numpy(), 0.95))
