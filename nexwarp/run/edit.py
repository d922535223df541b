"""Edits of a run: the choice of one operation, and what it needs to know of the scene."""

import dataclasses
import math
import shlex
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch

from nexwarp.cameras.paths import focus_ahead, subject
from nexwarp.cameras.similarity import Similarity, upright
from nexwarp.data.option import Flag_, option
from nexwarp.errors import RunError, naming, require
from nexwarp.export.bake import Progress
from nexwarp.model.edit import REGIONS, REMOVE, Edit, checksum, moved_surfels, write_edits
from nexwarp.model.floaters import find_floaters
from nexwarp.run.folder import TRAIN, OpenedModel

SUBJECT = ("subject",)
MIDDLE = (0.05, 0.95)  # of the surfels' coordinates
LEVEL = 0.9  # least height of the normal of a surfel that may be ground
REACH = 1.5  # of the surfels that may be ground, in distances of the farthest camera from the middle of all
GROUND = 0.2  # share of such surfels below the cameras that lies below the ground's height


@dataclass(frozen=True)
class EditOrder:
    """The operation of `nexwarp edit`, one at a time. Positions and lengths are in the coordinates of exports."""

    crop: Annotated[tuple[str, ...] | None, option("{subject,box X0 Y0 Z0 X1 Y1 Z1,sphere X Y Z R}", "")] = None
    """Keep the surfels whose centres lie in a box along the axes, in a sphere, or around what all photos look at."""
    remove_floaters: Flag_ = False
    """Remove surfels in empty space that few training views agree on."""
    level: Flag_ = False
    """Turn the scene's upward direction to +y, and put the ground at y = 0."""
    scale: Annotated[float | None, option("FACTOR", "")] = None
    """Multiply all coordinates."""
    scale_between: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        option("X Y Z X Y Z LENGTH", ""),
    ] = None
    """Scale so that two points get this distance, such as one that you have measured."""
    origin: Annotated[tuple[float, float, float] | None, option("X Y Z", "")] = None
    """Make this point (0, 0, 0)."""
    undo: Flag_ = False
    """Take the last operation back."""

    def check(self) -> None:
        """Raise SettingError unless there is at most one operation, with numbers that fit."""
        asked = [name for name, value in vars(self).items() if value is not None and value is not False]
        names = ", ".join(f"--{name.replace('_', '-')}" for name in asked)
        require(len(asked) <= 1, f"{names}: expected one operation at a time, got {len(asked)}")
        with naming(names):
            self._given()

    def _given(self) -> Edit | None:
        """Return the edit that the options give alone, whatever the scene; ValueError where its numbers do not fit."""
        if self.crop is not None and self.crop != SUBJECT:
            if self.crop[:1] not in [(name,) for name in REGIONS]:
                raise ValueError(f"expected subject, box or sphere, and numbers, got {' '.join(self.crop)!r:.60}")
            return Edit(self.crop[0], tuple(map(float, self.crop[1:])))
        if self.scale_between is not None:
            *ends, length = self.scale_between
            distance = math.dist(ends[:3], ends[3:])
            return Edit("scale", (length / distance if distance else math.inf,))
        if self.scale is not None:
            return Edit("scale", (self.scale,))
        return None if self.origin is None else Edit("origin", self.origin)

    def edit(self, opened: OpenedModel, device: torch.device | str, observe: Progress = lambda *_: None) -> Edit | None:
        """Return the operation on a run, None for nothing to do; `device` and `observe` are for --remove-floaters."""
        if self.remove_floaters:
            found = find_floaters(opened.model.to(device), opened.trained_cameras, observe).numpy()
            removed = opened.kept.nonzero()[0][found]
            return Edit(REMOVE, (checksum(opened.trained.surfels), *removed.tolist())) if found.any() else None
        if self.level:
            motion = _levelling(opened)
            return Edit("level", (*motion.rotation.ravel().tolist(), *motion.shift.tolist()))
        if self.crop == SUBJECT:
            if (crop := subject_crop(opened)) is None:
                raise RunError(f"{opened.path}: --crop subject: expected photos from all around, found others")
            return crop
        return self._given()


def _levelling(opened: OpenedModel) -> Similarity:
    """Return the motion from a run's coordinates to levelled ones.

    A fifth of the level surfels, by opacity, lies below the ground: of those below the middle of the cameras, and not
    much farther from it than they are.
    """
    cameras = [opened.frame.camera(camera) for camera in opened.trained_cameras]
    turn = Similarity(upright(cameras), np.zeros(3))
    surfels = moved_surfels(opened.model.surfels, opened.frame.then(turn))
    places = turn.points(np.stack([camera.position.numpy() for camera in cameras]))
    middle, means = places.mean(0), surfels.means.detach().numpy()
    near = np.linalg.norm(means - middle, axis=1) <= REACH * np.linalg.norm(places - middle, axis=1).max()
    level = near & (np.abs(surfels.normals.detach().numpy()[:, 1]) >= LEVEL) & (means[:, 1] < middle[1])
    level = level if level.any() else np.ones(len(means), bool)
    order = np.argsort(means[level, 1])
    weights = surfels.opacities.detach().double().numpy()[level][order].cumsum()
    ground = means[level, 1][order][np.searchsorted(weights, GROUND * weights[-1])]
    return turn.then(Similarity(np.eye(3), np.array([0.0, -ground, 0.0])))


def described(opened: OpenedModel) -> list[str]:
    """Return lines that say how many surfels of a run are left, and where they and its subject are, for a crop."""
    means = opened.frame.points(opened.model.surfels.means.detach().cpu().numpy())
    low, high = (" ".join(f"{x:.4g}" for x in row) for row in np.quantile(means, MIDDLE, axis=0))
    count = f"{opened.kept.sum():,} of {len(opened.kept):,} surfels"
    lines = [f"{count}; nine of ten along each axis: {low} to {high}"]
    cameras = [opened.frame.camera(x) for x in opened.cameras.get(TRAIN, {}).values()]
    target, share = focus_ahead(cameras)
    if share == 1:
        places = torch.stack([camera.position.double() for camera in cameras])
        at = " ".join(f"{x:.4g}" for x in target.tolist())
        lines.append(f"the cameras look at {at}, from {(places - target).norm(dim=1).quantile(0.5):.4g} away")
    return lines


def crop_command(opened: OpenedModel, centre: np.ndarray, radius: float) -> str:
    """Return the command that crops a run by a sphere, whose centre (3,) and radius are in the frame of its cameras."""
    numbers = (*opened.frame.points(centre), radius * opened.frame.scale)
    return f"nexwarp edit {shlex.quote(str(opened.path))} --crop sphere {' '.join(f'{x:.4g}' for x in numbers)}"


def measured(opened: OpenedModel, points: np.ndarray, length: float) -> list[str]:
    """Return lines, in Markdown, on one or two points (N, 3) in the frame of a run's cameras, in that of exports.

    Of two, they have the distance and the command that makes it `length`.
    """
    places = opened.frame.points(points)
    texts = [" ".join(f"{x:.6g}" for x in place) for place in places]
    lines = [f"`{text}`" for text in texts]
    if len(places) == 2:
        lines.append(f"**{math.dist(*places):.4g} units**")
        command = f"nexwarp edit {shlex.quote(str(opened.path))} --scale-between {' '.join(texts)} {length:g}"
        lines.append(f"`{command}`")
    return lines


def subject_crop(opened: OpenedModel) -> Edit | None:
    """Return the crop to what the training cameras look at from all around, None where they do not."""
    ball = subject(opened.trained_cameras)
    if ball is None:
        return None
    return Edit("sphere", (*opened.frame.points(ball[0].numpy()).tolist(), ball[1] * opened.frame.scale))


def edited(opened: OpenedModel, edit: Edit) -> OpenedModel:
    """Return a run with one more edit, which is not written; RunError if nothing is left."""
    changed = dataclasses.replace(opened)
    vars(changed).update(trained=opened.trained, edits=[*opened.edits, edit])
    _ = changed.kept  # which checks them
    return changed


def added(opened: OpenedModel, edit: Edit) -> OpenedModel:
    """Write one more edit of a run, and return the run with it; RunError, and no file changes, if nothing is left."""
    changed = edited(opened, edit)
    write_edits(opened.folder, changed.edits)
    return changed
