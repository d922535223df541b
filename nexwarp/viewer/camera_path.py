"""Camera paths: keyframes, their interpolation, and nerfstudio's JSON for `nexwarp render --path`."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# From OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward).
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MAX_FRAMES = 20_000


@dataclass(frozen=True)
class Keyframe:
    """A camera that a path passes through: its (4, 4) camera-to-world pose and vertical field of view in radians."""

    pose: np.ndarray
    fov: float


def interpolate(keyframes: Sequence[Keyframe], count: int, closed: bool = False) -> list[Keyframe]:
    """Return `count` cameras on a smooth path through the keyframes, with equal time between neighbours.

    A closed path returns to the first keyframe without repeating it at the end. ValueError for fewer than two.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    n = len(keyframes)
    if min(n, count) < 2:
        raise ValueError(f"keyframes: expected at least two, got {n} for {count} frames")
    # A closed path repeats all keyframes at each end, so that the splines are smooth at the seam.
    order = np.arange(-n, 2 * n + 1) if closed else np.arange(n)
    times = np.linspace(0, n, count, endpoint=False) if closed else np.linspace(0, n - 1, count)
    poses = np.stack([keyframes[i % n].pose for i in order])
    # Interpolating log tan(fov / 2) keeps the focal length positive.
    zooms = [math.log(math.tan(keyframes[i % n].fov / 2.0)) for i in order]
    smooth = CubicSpline(order, np.column_stack([poses[:, :3, 3], zooms]))(times)
    rotations = RotationSpline(order, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    path = []
    for values, rotation in zip(smooth, rotations, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, values[:3]
        path.append(Keyframe(pose, 2.0 * math.atan(math.exp(values[3]))))
    return path


def path_json(
    keyframes: Sequence[Keyframe], width: int, height: int, fps: float, seconds: float, closed: bool = False
) -> bytes:
    """Return a path through keyframes as nerfstudio's camera-path JSON in UTF-8, one camera for each frame.

    Raises:
        ValueError: fewer than two keyframes, a size or time that is not positive, or more than 20,000 frames.
    """
    for name, value in (("width", width), ("height", height), ("fps", fps), ("seconds", seconds)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: expected a number above 0, got {value}")
    count = max(round(fps * seconds), 2)
    if count > MAX_FRAMES:
        raise ValueError(f"seconds: expected at most {MAX_FRAMES:,} frames, got {count:,} ({seconds:g} s at {fps:g})")
    frames = []
    for frame in interpolate(keyframes, count, closed):
        pose = (frame.pose @ OPENGL).ravel().tolist()
        frames.append({"camera_to_world": pose, "fov": math.degrees(frame.fov), "aspect": width / height})
    size = {"render_width": width, "render_height": height}
    data = {**size, "fps": fps, "seconds": seconds, "camera_path": frames}
    return (json.dumps(data, indent=2) + "\n").encode()
