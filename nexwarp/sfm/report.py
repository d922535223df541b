"""What became of the photos, and what to do when too few of them got a camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nexwarp.sfm.pairs import components

FEW_FEATURES = 500  # a photo
GOOD_SHARE = 0.9  # of the photos: below, the report says what to do
LISTED = 8


@dataclass(frozen=True)
class Overlaps:
    """What features and matches say about the photos.

    Attributes:
        features: number of features of each photo, by name.
        inliers: number of matches of a pair that agree with one camera motion, by names; pairs without are left out.
        pairs: number of pairs compared.
        sequential: only neighbours were compared.
    """

    features: dict[str, int]
    inliers: dict[tuple[str, str], int]
    pairs: int
    sequential: bool


@dataclass(frozen=True)
class SfmReport:
    """A finished reconstruction.

    Attributes:
        photos: number of photos given.
        registered: names of those that got a camera, in the scene's order.
        left_out: reason why each other photo has none, by name.
        points: number of 3D points.
        mean_track_length: photos that see a point.
        mean_reprojection_error: over the points, in pixels of the photos as given.
        models: number of photos of each model found, largest first; the first is the one kept.
        cameras: each camera of the photos as given: its model, parameters, number of photos, and whether EXIF gave the
            focal length to start from.
        sizes: widths and heights of the undistorted photos.
        pairs: number of pairs compared.
        matched_pairs: number of them that overlap.
        matching: "exhaustive" or "sequential".
        seconds: of wall clock, by stage.
        advice: what to do to get more photos registered; empty when all is well.
    """

    photos: int
    registered: list[str]
    left_out: dict[str, str]
    points: int
    mean_track_length: float
    mean_reprojection_error: float
    models: list[int]
    cameras: list[dict[str, Any]]
    sizes: list[tuple[int, int]]
    pairs: int
    matched_pairs: int
    matching: str
    seconds: dict[str, float]
    advice: list[str]

    def rows(self) -> dict[str, str]:
        """Lines of a table."""
        rows = {
            "registered": f"{len(self.registered)} of {self.photos} photos",
            "points": f"{self.points:,}",
            "mean track length": f"{self.mean_track_length:.2f} photos",
            "mean reprojection error": f"{self.mean_reprojection_error:.3f} px",
            "overlapping pairs": f"{self.matched_pairs:,} of {self.pairs:,} compared ({self.matching})",
            "undistorted photos": ", ".join(f"{width}x{height}" for width, height in self.sizes[:LISTED]),
        }
        for index, camera in enumerate(self.cameras[:LISTED]):
            prior = "EXIF prior" if camera["exif_focal"] else "no EXIF focal length"
            values = " ".join(f"{value:.5g}" for value in camera["params"])
            rows[f"camera {index + 1}"] = f"{camera['model']} {values}, {camera['photos']} photos, {prior}"
        if len(self.cameras) > LISTED:
            rows["more cameras"] = str(len(self.cameras) - LISTED)
        if len(self.models) > 1:
            rows["models"] = f"{', '.join(map(str, self.models))} photos; the largest is kept"
        rows["time"] = f"{sum(self.seconds.values()):.0f} s ({_times(self.seconds)})"
        return rows

    def lines(self) -> list[str]:
        """Which photos were left out and what to do about it, a sentence each."""
        names = list(self.left_out)
        lines = [f"left out: {name}: {self.left_out[name]}" for name in names[:LISTED]]
        if len(names) > LISTED:
            lines.append(f"left out: {len(names) - LISTED} more, all named in sfm.json")
        return lines + [f"advice: {text}" for text in self.advice]


def left_out(overlaps: Overlaps, registered: Sequence[str], models: Sequence[Sequence[str]]) -> dict[str, str]:
    """Say of every photo that is not registered why.

    Args:
        overlaps: of all photos.
        registered: names in the model that is kept.
        models: names in each model found.
    """
    kept, reasons = set(registered), {}
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


def advise(overlaps: Overlaps, registered: int) -> list[str]:
    """What to do to get more photos registered, most promising first; nothing when nearly all are."""
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
