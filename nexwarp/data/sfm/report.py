"""The report of a reconstruction: registered photos, reasons for the others, advice."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

from nexwarp.data.sfm.pairs import components

FEW_FEATURES = 500  # a photo
GOOD_SHARE = 0.9  # share of registered photos below which the report gives advice
FEW_MATCHES = 50  # of a pair, below which it says nothing about motion
MOVING_SHARE = 0.15  # of refuted matches, above the median, from which something seems to move
LISTED = 8  # entries of a list in the report


@dataclass(frozen=True)
class Overlaps:
    """Features and matches of the photos.

    Attributes:
        features: number of features of each photo, by name.
        inliers: number of geometrically verified matches of a pair, by names; only pairs with at least one.
        pairs: number of compared pairs.
        sequential: whether only neighbours were compared.
        matches: number of matches of each compared pair before their verification.
    """

    features: dict[str, int]
    inliers: dict[tuple[str, str], int]
    pairs: int
    sequential: bool
    matches: dict[tuple[str, str], int] = field(default_factory=dict)


@dataclass(frozen=True)
class EstimatedCamera:
    """A camera of the photos before undistortion.

    Attributes:
        model: COLMAP's name of its model.
        params: parameters in COLMAP's order, pixels.
        width: width of its photos, pixels.
        height: height of its photos, pixels.
        photos: number of registered photos that share it.
        exif_focal: whether EXIF gave its initial focal length.
    """

    model: str
    params: list[float]
    width: int
    height: int
    photos: int
    exif_focal: bool


@dataclass(frozen=True)
class SfmReport:
    """The result of a reconstruction.

    Attributes:
        photos: number of given photos.
        registered: names of the photos with an estimated pose, in the scene's order.
        left_out: name -> reason, for each photo without a pose.
        points: number of 3D points.
        mean_track_length: mean number of photos that see a point.
        mean_reprojection_error: mean over the points, in pixels of the given photos.
        models: number of photos of each model that was found, largest first; the scene is the first one.
        cameras: the cameras of the photos before undistortion.
        sizes: distinct widths and heights of the undistorted photos.
        pairs: number of compared pairs.
        matched_pairs: number of compared pairs that overlap.
        matching: "exhaustive" or "sequential".
        seconds: wall-clock time of each stage.
        advice: how to get more photos registered; empty if 90 % or more are registered.
        moving: for photos in which things seem to move, the share of the matches with their neighbours in the list
            that contradict one motion of the camera.
    """

    photos: int
    registered: list[str]
    left_out: dict[str, str]
    points: int
    mean_track_length: float
    mean_reprojection_error: float
    models: list[int]
    cameras: list[EstimatedCamera]
    sizes: list[tuple[int, int]]
    pairs: int
    matched_pairs: int
    matching: str
    seconds: dict[str, float]
    advice: list[str]
    moving: dict[str, float] = field(default_factory=dict)

    def rows(self) -> dict[str, str]:
        """The figures as rows of a table: name -> text."""
        rows = {
            "registered": f"{len(self.registered)} of {self.photos} photos",
            "points": f"{self.points:,}",
            "mean track length": f"{self.mean_track_length:.2f} photos",
            "mean reprojection error": f"{self.mean_reprojection_error:.3f} px",
            "overlapping pairs": f"{self.matched_pairs:,} of {self.pairs:,} compared ({self.matching})",
            "undistorted photos": ", ".join(f"{width}x{height}" for width, height in self.sizes[:LISTED]),
        }
        for index, camera in enumerate(self.cameras[:LISTED]):
            prior = "EXIF prior" if camera.exif_focal else "no EXIF focal length"
            values = " ".join(f"{value:.5g}" for value in camera.params)
            rows[f"camera {index + 1}"] = f"{camera.model} {values}, {camera.photos} photos, {prior}"
        if len(self.cameras) > LISTED:
            rows["more cameras"] = str(len(self.cameras) - LISTED)
        if len(self.models) > 1:
            rows["models"] = f"{', '.join(map(str, self.models))} photos; the largest is kept"
        rows["time"] = f"{sum(self.seconds.values()):.0f} s ({_times(self.seconds)})"
        return rows

    def lines(self) -> list[str]:
        """The photos that were left out and the advice, one line each."""
        names = list(self.left_out)
        lines = [f"left out: {name}: {self.left_out[name]}" for name in names[:LISTED]]
        if len(names) > LISTED:
            lines.append(f"left out: {len(names) - LISTED} more, all named in sfm.json")
        moving = [
            f"moving: {name}: {share:.0%} of its matches contradict the camera's motion; mask what moves"
            for name, share in self.moving.items()
        ]
        if len(moving) > LISTED:
            moving[LISTED:] = [f"moving: {len(moving) - LISTED} more, all named in sfm.json"]
        return lines + moving + [f"advice: {text}" for text in self.advice]


def left_out(overlaps: Overlaps, registered: Sequence[str], models: Sequence[Sequence[str]]) -> dict[str, str]:
    """Give the reason for each photo that is not registered.

    Args:
        overlaps: features and matches of all photos.
        registered: names of the photos in the model that becomes the scene.
        models: names of the photos in each model.

    Returns:
        Name -> reason.
    """
    kept = set(registered)
    reasons: dict[str, str] = {}
    for name, count in overlaps.features.items():
        if name in kept:
            continue
        partners = {other for pair in overlaps.inliers if name in pair for other in pair if other != name}
        others = next((len(model) for model in models if name in model), 0)
        if others:
            reason = f"in a separate model of {others} photos"
        elif count < FEW_FEATURES and not partners:
            reason = f"only {count} features: dark, blurred or without texture"
        elif not partners:
            reason = "overlaps no other photo"
        elif not partners & kept:
            reason = "overlaps no registered photo"
        else:
            reason = f"too few points in common with the {len(partners & kept)} registered photos that it overlaps"
        reasons[name] = reason
    return reasons


def moving_things(overlaps: Overlaps, names: Sequence[str]) -> dict[str, float]:
    """Find photos in which things seem to move: many matches with the next photos contradict the camera's motion.

    A match that the pair's geometry refutes is a wrong one, or of a thing that moved. Wrong ones are as frequent in all
    photos of a capture, so that a photo is suspicious if its share is well above the median.

    Args:
        overlaps: features and matches of all photos.
        names: the photos in order.

    Returns:
        Name -> share of refuted matches.
    """
    matched, refuted = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    for one, other in pairwise(names):
        pair = (one, other) if (one, other) in overlaps.matches else (other, one)
        count, good = overlaps.matches.get(pair, 0), overlaps.inliers.get(pair, 0)
        if count >= FEW_MATCHES and good:  # else the pair does not overlap
            for name in pair:
                matched[name] += count
                refuted[name] += count - good
    shares = {name: refuted[name] / matched[name] for name in names if matched[name]}
    if not shares:
        return {}
    limit = median(shares.values()) + MOVING_SHARE
    return {name: round(share, 3) for name, share in shares.items() if share > limit}


def advise(overlaps: Overlaps, registered: int) -> list[str]:
    """Advice on how to get more photos registered, most promising first.

    Args:
        overlaps: features and matches of all photos.
        registered: number of registered photos.

    Returns:
        Sentences; none if 90 % or more of the photos are registered.
    """
    count = len(overlaps.features)
    if registered >= GOOD_SHARE * count:
        return []
    advice = []
    poor = sum(features < FEW_FEATURES for features in overlaps.features.values())
    if poor > (1 - GOOD_SHARE) * count:
        advice.append(
            f"{poor} of {count} photos have fewer than {FEW_FEATURES} features: give larger, sharper, brighter photos, "
            "and put something with texture into the scene"
        )
    groups = [group for group in components(overlaps.features, overlaps.inliers) if len(group) > 1]
    if overlaps.sequential:
        advice.append("photos were compared with their neighbours by name alone: try --matching exhaustive")
    if not groups:
        advice.append("no two photos overlap: let each share two thirds of its view with the next")
    elif len(groups) > 1:
        sizes = ", ".join(str(len(group)) for group in groups[:LISTED])
        between = f"{min(groups[0])} and {min(groups[1])}"
        advice.append(f"the photos fall into groups of {sizes} that do not overlap: add photos between {between}")
    elif len(groups[0]) < GOOD_SHARE * count:
        advice.append(
            "add photos between those left out and the rest, each sharing two thirds of its view with the next"
        )
    if groups and len(groups[0]) >= GOOD_SHARE * count:
        advice.append(
            "the photos overlap, but too little or without depth: take more of them, closer to each other, step "
            "sideways rather than turn on the spot, avoid moving, glossy and transparent things; give "
            "--cameras image if the zoom changed"
        )
    return advice


def _times(seconds: dict[str, float]) -> str:
    return ", ".join(f"{stage} {value:.0f}" for stage, value in seconds.items())
