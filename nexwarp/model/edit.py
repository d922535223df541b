"""Edits of a trained model: which surfels stay, and the coordinates in which they are exported.

They are a list in a file beside the model, whose own file never changes. Surfels that stay keep their numbers, in the
frame of the training: so texture, colours and detail are those of the training, exactly. Positions and lengths of an
edit are in the coordinates that the ones before it have made.
"""

import dataclasses
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import torch

from nexwarp.cameras.camera import LARGEST_DISTANCE
from nexwarp.cameras.similarity import IDENTITY, Similarity
from nexwarp.errors import FormatError, check_range, check_version
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, read_object, write_json
from nexwarp.model.buffers import Buffers
from nexwarp.model.model import Model
from nexwarp.model.surfels import Surfels, harmonics
from nexwarp.model.texture import DetailLimits

EDIT_FILE = "edit.json"
EDIT_VERSION = 1
REMOVE = "remove"  # numbers: a checksum of the trained surfels, and indices of some
REGIONS = {"box": 6, "sphere": 4}  # numbers: lowest and highest corner; centre and radius; world units
# Numbers: a rotation, row by row, and a shift; a factor; the new origin.
MOVES = {"level": 12, "scale": 1, "origin": 3}
SCALES = (1e-9, 1e9)
EXACT = 1e-6  # of a rotation
RAYS = 64  # directions from which the rotation of harmonics is solved


@dataclass(frozen=True)
class Edit:
    """One edit: its name, of `REGIONS`, `MOVES` or `REMOVE`, and its numbers. ValueError: they do not fit."""

    name: str
    numbers: tuple[float, ...]

    def __post_init__(self) -> None:
        known = REGIONS | MOVES
        if self.name != REMOVE and len(self.numbers) != known.get(self.name):
            raise ValueError(f"{self.name}: expected {known.get(self.name)} numbers, got {len(self.numbers)}")
        if not all(type(x) in (int, float) and abs(x) <= LARGEST_DISTANCE for x in self.numbers):
            raise ValueError(f"{self.name}: expected numbers up to {LARGEST_DISTANCE:g}, got {self.numbers!s:.60}")
        if self.name == "level":
            rotation = self.motion.rotation
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > EXACT or np.linalg.det(rotation) < 0:
                raise ValueError(f"level: expected a rotation, got {rotation.tolist()}")
        if self.name == "box" and not all(np.less(self.numbers[:3], self.numbers[3:])):
            raise ValueError(f"box: expected a lowest and a highest corner, got {self.numbers}")
        if self.name in ("sphere", "scale"):
            check_range(self.name, self.numbers[-1], *SCALES)
        if self.name == REMOVE and not (len(self.numbers) > 1 and all(type(x) is int and x >= 0 for x in self.numbers)):
            raise ValueError(f"{REMOVE}: expected a checksum and indices")

    def __str__(self) -> str:
        if self.name == REMOVE:
            return f"remove {len(self.numbers) - 1:,} floaters"
        numbers = () if self.name == "level" else (f"{x:g}" for x in self.numbers)
        return " ".join(["crop", self.name, *numbers] if self.name in REGIONS else [self.name, *numbers])

    @property
    def motion(self) -> Similarity:
        """The motion of a name of `MOVES`."""
        if self.name == "scale":
            return Similarity(np.eye(3), np.zeros(3), self.numbers[0])
        if self.name == "origin":
            return Similarity(np.eye(3), -np.array(self.numbers))
        return Similarity(np.reshape(self.numbers[:9], (3, 3)), np.array(self.numbers[9:]))


def _inside(region: str, numbers: Sequence[float], points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool: which of (N, 3) points lie in a region, one of `REGIONS`, with its numbers."""
    if region == "sphere":
        return np.asarray(np.square(points - numbers[:3]).sum(axis=1) <= numbers[3] ** 2)
    return np.asarray(((points >= numbers[:3]) & (points <= numbers[3:])).all(axis=1))


def checksum(surfels: Surfels) -> int:
    """Return a checksum of the surfels' centres."""
    return zlib.crc32(surfels.means.detach().cpu().numpy().tobytes())


def frame_of(edits: Sequence[Edit]) -> Similarity:
    """Return the motion from the frame of the training to the coordinates that edits make."""
    motions = [edit.motion for edit in edits if edit.name in MOVES]
    return reduce(Similarity.then, motions, IDENTITY)


def kept_surfels(surfels: Surfels, edits: Sequence[Edit]) -> np.ndarray:
    """Return which of trained surfels (N,) bool edits keep.

    ValueError: nothing is left, or surfels were removed from another model than this one.
    """
    means = surfels.means.detach().cpu().numpy()
    kept = np.ones(len(means), bool)
    for number, edit in enumerate(edits):
        if edit.name in REGIONS:
            kept &= _inside(edit.name, edit.numbers, frame_of(edits[:number]).points(means))
        elif edit.name == REMOVE and (edit.numbers[0] != checksum(surfels) or max(edit.numbers[1:]) >= len(kept)):
            raise ValueError(f"the model has changed since {edit}; take that back with nexwarp edit --undo")
        elif edit.name == REMOVE:
            kept[np.array(edit.numbers[1:], int)] = False
        if len(kept) and not kept.any():
            raise ValueError(f"expected edits that leave surfels, but {edit} leaves none of {len(kept):,}")
    return kept


def select(model: Model, kept: torch.Tensor) -> Model:
    """Return the model of those surfels for which `kept` (N,) is true; the rest of the model is shared."""
    surfels = Surfels({name: value[kept] for name, value in model.surfels.state_dict().items()})
    limits = model.detail_limits
    if limits is not None:
        limits = DetailLimits(limits.nearest[kept], limits.farthest[kept])
    return Model(surfels, model.texture, model.exposures, limits, model.options, model.meta)


def moved_poses(means: torch.Tensor, quats: torch.Tensor, motion: Similarity) -> tuple[torch.Tensor, torch.Tensor]:
    """Return means (N, 3) and rotations (N, 4) wxyz, moved; unit rotations, if they turn at all."""
    from scipy.spatial.transform import Rotation

    moved = torch.from_numpy(motion.points(means.detach().cpu().numpy())).to(means)
    if (motion.rotation == np.eye(3)).all():
        return moved, quats
    turned = Rotation.from_matrix(motion.rotation) * Rotation.from_quat(quats[:, [1, 2, 3, 0]].detach().cpu().numpy())
    return moved, torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]).to(quats)


@torch.no_grad()
def moved_surfels(surfels: Surfels, motion: Similarity) -> Surfels:
    """Return surfels moved by a motion, with their colours turned along."""
    if motion.is_identity:
        return surfels
    raw = surfels.state_dict()
    raw["means"], raw["raw_quats"] = moved_poses(raw["means"], raw["raw_quats"], motion)
    raw["log_scales"] = raw["log_scales"] + math.log(motion.scale)
    if (motion.rotation != np.eye(3)).any():
        # In each degree, the harmonics of turned directions are combinations of those of the directions.
        rays = torch.from_numpy(np.random.default_rng(0).normal(size=(RAYS, 3)))
        back = rays @ torch.from_numpy(motion.rotation)
        after, before = (harmonics(x, rays.new_zeros(3), raw["shN"].shape[1] + 1)[:, 1:] for x in (rays, back))
        turn = torch.linalg.lstsq(after, before).solution.to(raw["shN"].device)
        raw["shN"] = (turn @ raw["shN"].double()).to(raw["shN"])
    return Surfels(raw)


def moved_buffers(buffers: Buffers, motion: Similarity) -> Buffers:
    """Return the buffers of the same picture in moved coordinates."""
    names = ("depths", "expected_depth", "median_depth", "top_depth")
    depths = {name: getattr(buffers, name) * motion.scale for name in names}
    normals = buffers.normals @ torch.from_numpy(motion.rotation.T).to(buffers.normals)
    return dataclasses.replace(buffers, camera=motion.camera(buffers.camera), normals=normals, **depths)


def write_edits(folder: Path, edits: Sequence[Edit]) -> None:
    """Write the edits in effect into a folder, atomically; without any, there is no file."""
    if edits:
        records = [{"name": edit.name, "numbers": [*edit.numbers]} for edit in edits]
        write_json(folder / EDIT_FILE, {"format_version": EDIT_VERSION, "edits": records})
    else:
        (folder / EDIT_FILE).unlink(missing_ok=True)


def read_edits(folder: Path) -> list[Edit]:
    """Read the edits of the model in a folder; none without a file. FormatError: the file is damaged or newer."""
    path = folder / EDIT_FILE
    if not path.exists():
        return []
    try:
        data = read_object(path, finite=True)
        check_version(data["format_version"], EDIT_VERSION)
        records = cast(list[dict[str, list[float]]], data["edits"])
        return [Edit(str(record["name"]), tuple(record["numbers"])) for record in records]
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the edits of a model ({one_line(error)})") from None
