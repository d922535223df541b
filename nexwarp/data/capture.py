"""What a scene's files say before a pixel is read: photos with their cameras, and points."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from nexwarp.data.lens import Lens


@dataclass(frozen=True)
class Photo:
    """One posed photo; the pixels are elsewhere.

    Attributes:
        name: its name below the images folder, "/" between its parts; unique in a scene.
        file: the image file.
        viewmat: (4, 4) float64, world to camera, OpenCV axes.
        lens: the camera as it took the photo, whose size may differ from the file's by a factor.
        mask: the mask's file where the scene names it.
        face: which face of a panorama this is, see `nexwarp.data.lens.FACES`.
        points: (M, 3) float32 world positions of the points that were triangulated from it; None when unknown.
    """

    name: str
    file: Path
    viewmat: np.ndarray
    lens: Lens
    mask: Path | None = None
    face: str | None = None
    points: np.ndarray | None = None


@dataclass(frozen=True)
class Cloud:
    """Points to start from.

    Attributes:
        positions: (P, 3) float64, world frame.
        colors: (P, 3) uint8 sRGB.
        track_lengths: (P,) int32, how many photos see a point; 0 when unknown.
        reprojection_errors: (P,) float32, mean over the track, in pixels of the photos as taken; -1 when unknown.
    """

    positions: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray
    reprojection_errors: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, colors: np.ndarray) -> "Cloud":
        """Points of which nothing but positions and colours is known."""
        count = len(positions)
        return cls(positions, colors, np.zeros(count, np.int32), np.full(count, -1.0, np.float32))


@dataclass(frozen=True)
class Capture:
    """A scene's photos and points.

    Attributes:
        source: the file or folder that the cameras were read from.
        photos: sorted by name.
        cloud: points, None where the scene has none.
        test: names of the photos to judge by; None for every eighth.
        background: colour that goes behind transparent photos unless another is asked for; None drops their alpha.
    """

    source: Path
    photos: list[Photo]
    cloud: Cloud | None
    test: frozenset[str] | None = None
    background: tuple[float, float, float] | None = None


def leaves_folder(name: str) -> bool:
    """Whether a file name of a scene is no printable relative path below the scene's folder, on any system."""
    return (
        not name
        or not name.isprintable()
        or any(".." in path.parts or path.anchor for path in (PurePosixPath(name), PureWindowsPath(name)))
    )
