"""Settings of a reconstruction."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

Cameras = Literal["auto", "single", "folder", "image"]
CameraModel = Literal[
    "auto", "simple_pinhole", "pinhole", "simple_radial", "radial", "opencv", "full_opencv", "opencv_fisheye"
]
Matching = Literal["auto", "exhaustive", "sequential"]

EXHAUSTIVE_UP_TO = 150  # photos: 11,175 pairs, a quarter of an hour on two cores


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
    max_features: Annotated[int, tyro.conf.arg(metavar="N")] = 8192
    """SIFT features per photo; fewer are faster, more give more points."""
    max_image_size: Annotated[int, tyro.conf.arg(metavar="PIXELS")] = 3200
    """Longer side for feature extraction; larger photos are reduced for this step only."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one a core)")] = None
    """CPU threads; with 1 thread the same photos give the same scene, bit for bit."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""

    def check(self) -> None:
        """Raise ValueError, naming the option, when a value is out of range or unknown."""
        for name, choices in (("cameras", Cameras), ("camera_model", CameraModel), ("matching", Matching)):
            if getattr(self, name) not in get_args(choices):
                expected = ", ".join(get_args(choices))
                raise ValueError(f"{name}: expected one of {expected}, got {getattr(self, name)!r}")
        for name, low in (("overlap", 1), ("max_features", 64), ("max_image_size", 64), ("threads", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and not low <= value < 2**31:
                raise ValueError(f"{name}: expected at least {low}, got {value}")
