"""Blocks of space: parts of a scene that are trained apart and merged into one model.

A scene that is too large for one GPU is cut into cells. A block trains the surfels of its cell and of an overlap around
it, on the views that see the cell. What else these views show is explained by few surfels, the context, whose errors
lead to no splits. The merged model takes from each block the surfels whose centres are in its cell.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import torch

from nexwarp.cameras.camera import visible_points
from nexwarp.data import Scene
from nexwarp.errors import SceneError
from nexwarp.model.detail import ORDERED
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.merged_texture import MergedTexture
from nexwarp.model.model import Model
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture
from nexwarp.train.config import Config
from nexwarp.train.graphs import Gradients
from nexwarp.train.schedules import OptimizerMaker
from nexwarp.train.step_losses import OwnLoss
from nexwarp.train.trainer import Trainer

FAR = 1e15  # world units: the outer sides of the outer cells
CONTEXT = 0.25  # share of the points outside of a block that it starts from
OVERLAP = 0.1  # of the scene's scale
LEAST_SEEN = 20  # points of a cell in a view that sees it, at least


def split_space(points: torch.Tensor, count: int) -> torch.Tensor:
    """Cut space into cells of equally many points, each cut along the axis in which its points spread most.

    Args:
        points: (P, 3) world frame.
        count: of cells.

    Returns:
        (count, 2, 3) lowest and highest corners of the cells; together they fill space.
    """
    if not 1 <= count <= len(points):
        raise ValueError(f"count: expected 1 to {len(points)} cells, as many as points, got {count}")
    everywhere = points.new_tensor([[-FAR] * 3, [FAR] * 3])
    cells = [(everywhere, points)]
    while len(cells) < count:
        cell, held = cells.pop(max(range(len(cells)), key=lambda index: len(cells[index][1])))
        low, high = held.quantile(0.05, dim=0), held.quantile(0.95, dim=0)
        axis = int((high - low).argmax())
        cut = held[:, axis].median()
        below, above = cell.clone(), cell.clone()
        below[1, axis] = above[0, axis] = cut
        left = held[:, axis] < cut
        cells += [(below, held[left]), (above, held[~left])]
    return torch.stack([cell for cell, _ in cells])


def grown(cell: torch.Tensor, margin: float) -> torch.Tensor:
    """Return a cell (2, 3) that reaches farther by a margin, world units."""
    return torch.stack([cell[0] - margin, cell[1] + margin])


def inside(points: torch.Tensor, cell: torch.Tensor) -> torch.Tensor:
    """Return (P,) bool: which points (P, 3) are in a cell (2, 3)."""
    low, high = cell.to(points.device)
    return ((points >= low) & (points < high)).all(dim=1)


def block_scene(scene: Scene, cell: torch.Tensor, *, overlap: float = OVERLAP, context: float = CONTEXT) -> Scene:
    """Return what a block is trained on: the views that see its cell, its points, and few of all others.

    Args:
        scene: the whole scene.
        cell: (2, 3) corners, as `split_space` returns them.
        overlap: how far the block reaches beyond its cell, in units of the scene's scale.
        context: share of the points outside that are kept.

    Raises:
        SceneError: no view sees the cell.
    """
    kept = inside(scene.points, grown(cell, overlap * scene.scale))
    own = scene.points[inside(scene.points, cell)]
    generator = torch.Generator().manual_seed(0)
    rows = (kept | (torch.rand(len(kept), generator=generator) < context)).nonzero()[:, 0]

    def sees(view_points: tuple[torch.Tensor, torch.Tensor], width: int, height: int) -> bool:
        found = visible_points(*view_points, width, height)
        return found is not None and len(found[1]) >= min(LEAST_SEEN, len(own))

    views = [v for v in scene.train if sees(v.camera.project(own), v.camera.width, v.camera.height)]
    if not views or not len(own):
        raise SceneError(f"{scene.path}: expected views that see the block, found none")
    return dataclasses.replace(
        scene,
        train=views,
        points=scene.points[rows],
        colors=scene.colors[rows],
        track_lengths=scene.track_lengths[rows],
        reprojection_errors=scene.reprojection_errors[rows],
    )


class BlockTrainer(Trainer):
    """A training run of one block: surfels outside of it are not split."""

    def __init__(
        self,
        scene: Scene,
        config: Config,
        device: torch.device | str,
        cell: torch.Tensor,
        *,
        overlap: float = OVERLAP,
        losses: Mapping[str, OwnLoss] | None = None,
        optimizer: OptimizerMaker | None = None,
    ) -> None:
        """Make the initial surfels and texture.

        Args:
            scene: of the block, see `block_scene`.
            config: settings; `max_surfels` counts those of the block and of its context.
            device: where to train.
            cell: (2, 3) corners of the block's cell.
            overlap: as of `block_scene`.
            losses: see `Trainer`.
            optimizer: see `Trainer`.
        """
        super().__init__(scene, config, device, losses=losses, optimizer=optimizer)
        self.reach = grown(cell, overlap * scene.scale).to(self.device)

    def _update(self, errors: torch.Tensor | None) -> Gradients | None:
        if errors is not None:
            errors = torch.where(inside(self.surfels.means.detach(), self.reach), errors, 0.0)
        return super()._update(errors)


def merge_blocks(models: Sequence[Model], cells: torch.Tensor, *, margin: float = 0.0) -> Model:
    """Return one model of several blocks, with copies of their surfels; the textures are shared.

    Args:
        models: of the blocks, finished or not, on one device.
        cells: (M, 2, 3) their cells.
        margin: also take surfels so far outside of a cell, world units, where blocks then lie over each other.

    Raises:
        ValueError: models have exposures, differ in their options, or some have no texture or no detail limits.
    """
    first = models[0]
    if len(models) != len(cells):
        raise ValueError(f"models: expected one for each of {len(cells)} cells, got {len(models)}")
    for index, model in enumerate(models):
        if model.options != first.options:
            raise ValueError(f"models[{index}]: expected the options of the first one, got {model.options}")
        if model.exposures is not None:
            raise ValueError(f"models[{index}]: expected no exposures: those of different blocks do not agree")
        if (model.detail_limits is None) != (first.detail_limits is None):
            raise ValueError(f"models[{index}]: expected detail limits in all models or in none")
    kept = [inside(m.surfels.means.detach(), grown(c, margin)) for m, c in zip(models, cells, strict=True)]
    raw = {
        name: torch.cat([getattr(m.surfels, name).detach()[rows] for m, rows in zip(models, kept, strict=True)])
        for name in PARAMETERS
    }
    limits = [
        (m.detail_limits.nearest[rows], m.detail_limits.farthest[rows])
        for m, rows in zip(models, kept, strict=True)
        if m.detail_limits is not None
    ]
    merged_limits = DetailLimits(*(torch.cat(values) for values in zip(*limits, strict=True))) if limits else None
    textures = [m.texture for m in models if isinstance(m.texture, NeuralTexture)]
    if textures and len(textures) < len(models):
        raise ValueError("models: expected textures in all models or in none")
    texture = MergedTexture(textures, cells.to(first.device).float()) if textures else None
    # One block after another, so not in the order of their share of the pictures.
    meta = {name: value for name, value in first.meta.items() if name != ORDERED}
    return Model(Surfels(raw), texture, None, merged_limits, first.options, meta)
