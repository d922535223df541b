"""Parts of a capture that do not agree: models that were not joined, and matches that the cameras contradict."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm.report import Link, Overlaps

if TYPE_CHECKING:
    import pycolmap

Pair = tuple[str, str]

FEWEST = 15  # matches of a pair that is judged, as the mapper uses them
APART = 0.02  # longer sides of a photo between a match and where its point is seen, from which they contradict
MOST = 0.5  # share of such matches above which the pair does


def separate(overlaps: Overlaps, models: Sequence[Sequence[str]]) -> list[Link]:
    """Return what links the photos of the first model, by name, with the others of each other one."""
    scene, links = set(models[0]), []
    for model in models[1:]:
        if part := set(model) - scene:
            pairs = [pair for pair in overlaps.inliers if len(part & {*pair}) == 1 and scene & {*pair}]
            links.append(Link(sorted(scene), sorted(part), len(pairs), sum(overlaps.inliers[pair] for pair in pairs)))
    return links


def contradictions(database: "pycolmap.Database", model: "pycolmap.Reconstruction") -> dict[Pair, int]:
    """Return the pairs of photos, by name, whose verified matches contradict the model, and how many matches do.

    A match contradicts where the point of one feature is not seen at the other. This does not find copies of a thing
    that were joined to one, if each has surroundings of its own, which no photo connects: then no match contradicts.
    """
    views = {index: _View(model, model.image(index)) for index in model.reg_image_ids()}
    found: dict[Pair, int] = {}
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        ids = pycolmap_module().pair_id_to_image_pair(pair)
        if len(geometry.inlier_matches) < FEWEST or not all(index in views for index in ids):
            continue
        one, other = (views[index] for index in ids)
        first, second = geometry.inlier_matches.T
        errors = np.fmin(other.errors(one.points[first], second), one.errors(other.points[second], first))
        judged, wrong = int((~np.isnan(errors)).sum()), int((errors > APART).sum())
        if judged >= FEWEST and wrong > MOST * judged:
            found[one.name, other.name] = wrong
    return found


class _View:
    """The features of a registered photo, and the points that they see."""

    def __init__(self, model: "pycolmap.Reconstruction", image: "pycolmap.Image") -> None:
        self.name, self.camera = image.name, model.camera(image.camera_id)
        self.pose = image.cam_from_world().matrix()
        self.pixels = np.array([feature.xy for feature in image.points2D]).reshape(-1, 2)
        self.points = np.full((len(self.pixels), 3), np.nan)  # in the world; NaN without one
        for index in image.get_observation_point2D_idxs():
            self.points[index] = model.point3D(image.point2D(index).point3D_id).xyz

    def errors(self, points: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Distances (N,) of the images of points (N, 3) from features (N,), in longer sides; infinite behind."""
        local = points @ self.pose[:, :3].T + self.pose[:, 3]
        pixels = self.camera.img_from_cam(local)
        apart = np.linalg.norm(pixels - self.pixels[features], axis=1) / max(self.camera.width, self.camera.height)
        return np.where(local[:, 2] > 0, apart, np.where(np.isnan(local[:, 2]), np.nan, np.inf))


def grouped(pairs: Mapping[Pair, int]) -> list[Link]:
    """Group contradicting pairs: the photos that contradict one photo against those that contradict its partner."""
    left, links = dict(pairs), []
    while left:
        first, second = max(left, key=lambda pair: left[pair])
        one = {name for pair in left if second in pair for name in pair} - {second}
        other = {name for pair in left if first in pair for name in pair} - {first}
        between = [(a, b) for a, b in left if (a in one and b in other) or (b in one and a in other)]
        links.append(Link(sorted(one), sorted(other), len(between), sum(left[pair] for pair in between)))
        left = {pair: count for pair, count in left.items() if pair not in between}
    return links
