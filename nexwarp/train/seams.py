"""Refinement of a merged model near its seams: what the blocks trained apart learns to fit.

Blocks disagree where they meet: each has explained the photos with surfels of its own beyond its cell, which merging
replaces by those of its neighbour. So the surfels within a band around the seams are trained again, for a short time,
together, with all others frozen. The textures stay apart; each goes on learning.
"""

import dataclasses

import torch

from nexwarp.cameras.camera import Camera, visible_points
from nexwarp.data import Scene, View
from nexwarp.errors import SceneError
from nexwarp.model.merged_texture import MergedTexture
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.blocks import LEAST_SEEN
from nexwarp.train.config import Config
from nexwarp.train.graphs import Gradients
from nexwarp.train.trainer import Trainer

BAND = 0.3  # of the scene's scale, on each side of a seam
BEGIN = 0.5  # of the schedules of a whole training


def near_seams(points: torch.Tensor, cells: torch.Tensor, band: float) -> torch.Tensor:
    """Return (P,) bool: which points are within a band of a side that two cells share.

    Args:
        points: (P, 3) world frame.
        cells: (M, 2, 3) corners of the cells, see `split_space`.
        band: world units.
    """
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for low, high in cells.to(points.device):
        reached = ((points > low - band) & (points < high + band)).all(dim=1)
        deep = ((points > low + band) & (points < high - band)).all(dim=1)
        found |= reached & ~deep
    return found


class SeamTrainer(Trainer):
    """A short training of a merged model, in which only the surfels near its seams and the textures change.

    Attributes:
        trained: (N,) bool, the surfels that change.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model,
        config: Config,
        *,
        band: float = BAND,
    ) -> None:
        """Take a merged model, of which surfels and textures are changed in place.

        Args:
            scene: the whole scene; views that see few of its points near a seam are not used.
            model: as `merge_blocks` makes it.
            config: settings of the blocks; `iterations` is the number of steps of this training alone.
            band: how far from a seam surfels are trained, in units of the scene's scale.

        Raises:
            TypeError: the model is not merged.
            ValueError: poses or motions are to be learned, which the frozen surfels would not follow.
            SceneError: no view sees the seams.
        """
        if not isinstance(model.texture, MergedTexture):
            raise TypeError("model: expected a merged model with a texture for each block")
        if config.learns_poses:
            raise ValueError("config: expected refine_poses=False and blur_poses=1 for the seams of blocks")
        model.texture.drop_half_copy()  # of the blocks' trainings: this one does not refresh them
        self.whole = scene
        self.start, cells = model, model.texture.cells
        self.trained = near_seams(model.surfels.means.detach(), cells, band * scene.scale)
        config = dataclasses.replace(
            config,
            more_hits_from=0,
            max_surfels=max(config.max_surfels, len(model.surfels)),
            losses=dataclasses.replace(config.losses, grid=0.0),
            densify=dataclasses.replace(config.densify, start=0, stop=0),
        )
        super().__init__(seam_scene(scene, cells, band), config, model.device)

    def _initial_model(self, colors: torch.Tensor | None) -> tuple[Surfels, NeuralTexture]:
        assert self.start.texture is not None
        return self.start.surfels, self.start.texture

    def _finish_views(self) -> tuple[list[View], list[Camera]]:
        # All views: surfels that none of the seams' views shows would lose their colours and texture.
        return self.whole.train, [view.camera.to(self.device) for view in self.whole.train]

    def _make_optimizer(self) -> torch.optim.Optimizer:
        optimizer = super()._make_optimizer()
        for group in optimizer.param_groups:
            first, last = group["ends"]
            group["ends"] = (first ** (1 - BEGIN) * last**BEGIN if first else 0.0), last
        return optimizer

    def render_options(self) -> RenderOptions:
        """Return how the merged model is rendered."""
        return self.start.options

    def _update(self, errors: torch.Tensor | None) -> Gradients | None:
        for name in PARAMETERS:
            gradient = getattr(self.surfels, name).grad
            if gradient is not None:  # Adam's moments stay zero, and so does its step
                gradient.mul_(self.trained.view(-1, *[1] * (gradient.ndim - 1)))
        return super()._update(errors)


def seam_scene(scene: Scene, cells: torch.Tensor, band: float) -> Scene:
    """Return the scene with the training views that see the seams.

    Args:
        scene: the whole scene.
        cells: (M, 2, 3) of its blocks.
        band: how far the seams reach, in units of the scene's scale.

    Raises:
        SceneError: there are no such views.
    """
    points = scene.points[near_seams(scene.points, cells.to(scene.points), band * scene.scale)]

    def sees(camera: Camera) -> bool:
        found = visible_points(*camera.project(points), camera.width, camera.height)
        return found is not None and len(found[1]) >= min(LEAST_SEEN, len(points))

    views = [view for view in scene.train if len(points) and sees(view.camera)]
    if not views:
        raise SceneError(f"{scene.path}: expected views that see the seams between the blocks, found none")
    return dataclasses.replace(scene, train=views)
