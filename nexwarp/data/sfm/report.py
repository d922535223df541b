"""The settings and the report of a reconstruction: registered photos, reasons for the others, advice."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

import tyro

from nexwarp.data.capture import listed, short
from nexwarp.data.sfm.frames import FrameChoice

Cameras = Literal["auto", "single", "folder", "image"]
CameraModel = Literal[
    "auto", "simple_pinhole", "pinhole", "simple_radial", "radial", "opencv", "full_opencv", "opencv_fisheye"
]
Matching = Literal["auto", "exhaustive", "sequential"]
Mapper = Literal["auto", "incremental", "global"]

Observer = Callable[[str, int, int], None]  # takes a stage's title, the number of its items that are done, and of all
PYCOLMAP = "pycolmap failed"  # in messages

EXHAUSTIVE_UP_TO = 150  # photos: 11,175 pairs, a quarter of an hour on two cores
FEW_FEATURES = 500  # a photo
GOOD_SHARE = 0.9  # share of registered photos below which the report gives advice
LISTED = 8  # entries of a list in the report


@dataclass(frozen=True)
class SfmOptions:
    """Settings of structure from motion."""

    cameras: Cameras = "auto"
    """Photos that share a camera: equal size, lens and EXIF focal length (auto), all, of a folder, or none (image)."""
    camera_model: CameraModel = "auto"
    """COLMAP's lens model of the photos; auto is opencv for a camera of 5 photos or more, else simple_radial."""
    matching: Matching = "auto"
    """Compare every pair (exhaustive) or neighbours by name (sequential); auto is exhaustive up to 150 photos."""
    overlap: Annotated[int, tyro.conf.arg(metavar="N")] = 10
    """Successors that a photo is compared with in sequential matching, in addition to those at 2, 4, 8, ... photos."""
    mapper: Mapper = "auto"
    """Register photo by photo (incremental) or all at once (global); auto tries global too where photos are left out,
    and takes what registers more."""
    max_features: Annotated[int, tyro.conf.arg(metavar="N")] = 8192
    """SIFT features per photo; fewer are faster, more give more points."""
    max_image_size: Annotated[int, tyro.conf.arg(metavar="PIXELS")] = 3200
    """Longer side for feature extraction; larger photos are reduced for this step only."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one a core)")] = None
    """CPU threads; with 1 thread the same photos give the same scene, bit for bit."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    strict: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = False
    """Stop at the first photo that cannot be read, instead of leaving it out."""

    def check(self) -> None:
        """Raise ValueError, naming the option, when a value is out of range or unknown."""
        known = {"cameras": Cameras, "camera_model": CameraModel, "matching": Matching, "mapper": Mapper}
        for name, choices in known.items():
            if getattr(self, name) not in get_args(choices):
                expected = ", ".join(get_args(choices))
                raise ValueError(f"{name}: expected one of {expected}, got {getattr(self, name)!r}")
        for name, low in (("overlap", 1), ("max_features", 64), ("max_image_size", 64), ("threads", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and not low <= value < 2**31:
                raise ValueError(f"{name}: expected at least {low}, got {value}")


@dataclass(frozen=True)
class Overlaps:
    """Features and matches of the photos."""

    features: dict[str, int]  # number of features of each photo, by name
    inliers: dict[tuple[str, str], int]  # verified matches of a pair, by names; only pairs with at least one
    pairs: int  # number of compared pairs
    sequential: bool  # whether only neighbours were compared


@dataclass(frozen=True)
class EstimatedCamera:
    """A camera of the photos before undistortion."""

    model: str  # COLMAP's name
    params: list[float]  # in COLMAP's order, pixels
    width: int  # of its photos, pixels
    height: int
    photos: int  # number of registered photos that share it
    exif_focal: bool  # whether EXIF gave its initial focal length

    def text(self) -> str:
        """Its figures in words."""
        values = " ".join(f"{value:.5g}" for value in self.params)
        prior = "EXIF prior" if self.exif_focal else "no EXIF focal length"
        return f"{self.model} {values}, {prior}, {self.photos} photos"


@dataclass(frozen=True)
class SfmReport:
    """The result of a reconstruction."""

    photos: int  # number of given photos
    registered: list[str]  # names of the photos with an estimated pose, in the scene's order
    left_out: dict[str, str]  # name -> reason, for each photo without a pose
    points: int  # number of 3D points
    mean_track_length: float  # mean number of photos that see a point
    mean_reprojection_error: float  # mean over the points, in pixels of the given photos
    models: list[int]  # number of photos of each model that was found, largest first; the scene is the first one
    cameras: list[EstimatedCamera]
    sizes: list[tuple[int, int]]  # distinct widths and heights of the undistorted photos
    pairs: int  # number of compared pairs
    matched_pairs: int  # number of compared pairs that overlap
    matching: str  # "exhaustive" or "sequential"
    seconds: dict[str, float]  # wall-clock time of each stage
    advice: list[str]  # how to get more photos registered; empty if 90 % or more are registered
    frames: FrameChoice | None = None  # the frames of a video; None for photos
    mapper: str = "incremental"  # or "global"
    skipped: dict[str, str] = field(default_factory=dict)  # name -> reason, for each photo that was not read
    panoramas: int = 0  # number of panoramas, each cut into six of the photos

    def rows(self) -> dict[str, str]:
        """The figures as rows of a table: name -> text."""
        rows = {} if self.frames is None else self.frames.rows()
        if self.panoramas:
            rows["panoramas"] = f"{self.panoramas}, each cut into six photos"
        rows |= {
            "registered": f"{len(self.registered)} of {self.photos} photos ({self.mapper} mapper)",
            "points": f"{self.points:,}",
            "mean track length": f"{self.mean_track_length:.2f} photos",
            "mean reprojection error": f"{self.mean_reprojection_error:.3f} px",
            "overlapping pairs": f"{self.matched_pairs:,} of {self.pairs:,} compared ({self.matching})",
            "undistorted photos": ", ".join(f"{width}x{height}" for width, height in self.sizes[:LISTED]),
        }
        cameras = Counter(camera.text() for camera in self.cameras)
        for index, (text, count) in enumerate(list(cameras.items())[:LISTED]):
            rows[f"camera {index + 1}"] = text if count == 1 else f"{count} of {text} each"
        if len(cameras) > LISTED:
            rows["more cameras"] = str(len(cameras) - LISTED)
        if len(self.models) > 1:
            rows["models"] = f"{', '.join(map(str, self.models))} photos; the largest is kept"
        times = ", ".join(f"{stage} {value:.0f}" for stage, value in self.seconds.items())
        rows["time"] = f"{sum(self.seconds.values()):.0f} s ({times})"
        return rows

    def lines(self) -> list[str]:
        """The photos that were not read or left out, and the advice, one line each."""
        lines = []
        for reason in list(dict.fromkeys(self.skipped.values())):
            names = [short(name) for name in self.skipped if self.skipped[name] == reason]
            lines.append(f"skipped {len(names)}: {listed(names, LISTED)}: {reason}")
        names = list(self.left_out)
        lines += [f"left out: {name}: {self.left_out[name]}" for name in names[:LISTED]]
        if len(names) > LISTED:
            lines.append(f"left out: {len(names) - LISTED} more, all named in sfm.json")
        return lines + [f"advice: {text}" for text in self.advice]


def left_out(overlaps: Overlaps, registered: Sequence[str], models: Sequence[Sequence[str]]) -> dict[str, str]:
    """Return name -> reason for each photo that is not registered; `models` are the photos' names by model."""
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


def advise(overlaps: Overlaps, registered: int) -> list[str]:
    """Advise how to get more photos registered, most promising first; nothing if 90 % or more are registered."""
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


def components(nodes: Iterable[str], edges: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Return the connected components of a graph, largest first."""
    group = {node: {node} for node in nodes}
    for one, other in edges:
        if group[one] is not group[other]:
            small, large = sorted((group[one], group[other]), key=len)
            large |= small
            group |= dict.fromkeys(small, large)
    unique = {id(members): members for members in group.values()}.values()
    return sorted(unique, key=lambda members: (-len(members), min(members)))
