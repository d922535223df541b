"""Settings of a reconstruction."""

from dataclasses import dataclass
from typing import Literal, get_args

Cameras = Literal["auto", "single", "folder", "image"]
CameraModel = Literal[
    "auto", "simple_pinhole", "pinhole", "simple_radial", "radial", "opencv", "full_opencv", "opencv_fisheye"
]
Matching = Literal["auto", "exhaustive", "sequential"]

EXHAUSTIVE_UP_TO = 150  # photos: 11,175 pairs, a quarter of an hour on two cores


@dataclass(frozen=True)
class SfmOptions:
    """How photos are turned into cameras and points."""

    cameras: Cameras = "auto"
    """Which photos share a camera: those of one size and one EXIF lens and focal length (auto), all of them (single),
    those of a folder (folder), none (image)."""
    camera_model: CameraModel = "auto"
    """COLMAP's camera model of the photos as they are; auto is opencv for a camera of 5 photos or more, else
    simple_radial. The scene gets undistorted photos and PINHOLE cameras in any case."""
    matching: Matching = "auto"
    """Which photos are compared: every pair (exhaustive), or neighbours by name (sequential), for a walk with the
    camera or a film; auto is exhaustive up to 150 photos."""
    overlap: int = 10
    """In sequential matching, how many of its successors a photo is compared with, next to those 2, 4, 8, ... further
    on. The last photos are also compared with the first."""
    max_features: int = 8192
    """SIFT features a photo; fewer are quicker, more make more points."""
    max_image_size: int = 3200
    """Longer side in pixels at which features are searched; larger photos are reduced for that alone."""
    threads: int | None = None
    """CPU threads; all cores by default. With 1 the same photos give the same scene, bit for bit."""
    seed: int = 0
    """Of every random choice."""

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
