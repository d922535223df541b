"""A painted room whose colour is known at every point, its photos, and checks of scenes against it, in NumPy alone.

The room is a box, so that every point of its walls is visible wherever it projects into a photo. Units are metres.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SIZE = np.array([4.0, 3.0, 4.0])  # the origin is its centre; y points down
WIDTH, HEIGHT = 64, 48
PINHOLE = (40.0, 41.0, 31.0, 24.5)  # fx, fy, cx, cy
LENS = f"{WIDTH} {HEIGHT} {' '.join(map(str, PINHOLE))}"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
VIEWS = 6
RIGHT = 1.0  # of 255: a scene that is read as it was written has an error of 0.3; a shift of one pixel, 5


def paint(points: np.ndarray) -> np.ndarray:
    """Colours (..., 3) in 10 to 245 of points (..., 3): waves of 2 m and more, without any symmetry."""
    turns = points @ np.array([[2.6, 0.9, 1.7], [1.1, 2.9, -1.3], [-0.8, 1.4, 2.3]]) + np.array([0.4, 1.9, 3.1])
    return 127.5 + 78.0 * np.sin(turns) + 39.5 * np.sin(0.5 * turns[..., [1, 2, 0]] + 1.0)


def poses(count: int = VIEWS) -> list[np.ndarray]:
    """World-to-camera matrices (4, 4) float64 of cameras near the centre, which look outwards in all directions."""
    matrices = []
    for index in range(count):
        yaw, pitch = 2 * np.pi * index / count, 0.2 * np.cos(2.3 * index)
        about_y = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
        about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        matrix = np.eye(4)
        matrix[:3, :3] = about_x @ about_y
        matrix[:3, 3] = -matrix[:3, :3] @ np.array([0.7 * np.sin(yaw), 0.2 * np.sin(3 * yaw), -0.6 * np.cos(yaw)])
        matrices.append(matrix)
    return matrices


def pinhole_rays(pinhole: Sequence[float] = PINHOLE, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Directions (H, W, 3) in the camera's frame of the pixels' centres."""
    fx, fy, cx, cy = pinhole
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def photograph(viewmat: np.ndarray, rays: np.ndarray | None = None) -> np.ndarray:
    """Take a photo (H, W, 3), unrounded, of 0 to 255, along rays (H, W, 3) of the camera's frame, of any lens."""
    directions = (pinhole_rays() if rays is None else rays) @ viewmat[:3, :3]
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    with np.errstate(divide="ignore"):
        distances = (np.sign(directions) * SIZE / 2 - centre) / directions
    return paint(centre + directions * np.where(directions == 0, np.inf, distances).min(axis=-1, keepdims=True))


def photos(count: int = VIEWS, rays: np.ndarray | None = None) -> list[np.ndarray]:
    """The photos (H, W, 3) uint8 of all poses."""
    return [np.round(photograph(viewmat, rays)).astype(np.uint8) for viewmat in poses(count)]


def wall_points(count: int = 600, seed: int = 0) -> np.ndarray:
    """Random points (N, 3) of the walls."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-SIZE / 2, SIZE / 2, (count, 3))
    axes = rng.integers(0, 3, count)
    points[np.arange(count), axes] = SIZE[axes] / 2 * rng.choice([-1.0, 1.0], count)
    return points


def save_png(file: Path, photo: np.ndarray) -> None:
    Image.fromarray(photo).save(file)


def write_photos(folder: Path, save: Callable[..., None] = save_png, suffix: str = "png", rays=None) -> list[str]:
    """Write the photos of all poses into a folder and return their names."""
    folder.mkdir(parents=True)
    names = [f"{index}.{suffix}" for index in range(VIEWS)]
    for name, photo in zip(names, photos(rays=rays), strict=True):
        save(folder / name, photo)
    return names


def write_colmap(path: Path, names: Sequence[str], camera=f"PINHOLE {LENS}", offset=(0, 0, 0), points=None) -> Path:
    """Write a COLMAP text model of the photos `names`, in sparse/0, with the room's centre at `offset`.

    `points` are of the room, without the offset; None takes 300.
    """
    model = path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 {camera}\n")
    lines = []
    for index, (name, viewmat) in enumerate(zip(names, poses(len(names)), strict=True)):
        shift = viewmat[:3, 3] - viewmat[:3, :3] @ np.array(offset, np.float64)
        lines.append(f"{index + 1} {' '.join(map(repr, [*_quaternion(viewmat), *shift.tolist()]))} 1 {name}\n\n")
    (model / "images.txt").write_text("".join(lines), encoding="utf-8")
    points = wall_points(300) if points is None else points
    colors = np.round(paint(points)).astype(int)
    rows = zip((points + np.array(offset)).tolist(), colors.tolist(), strict=True)
    text = "".join(f"{i + 1} {' '.join(map(repr, [*xyz, *rgb]))} 0.5\n" for i, (xyz, rgb) in enumerate(rows))
    (model / "points3D.txt").write_text(text)
    return path


def transforms(names: Sequence[str], applied: np.ndarray | None = None, **keys: Any) -> dict[str, Any]:
    """Return a transforms.json of the photos `names`, its world moved by `applied` (3, 4); `keys` add or replace."""
    moved = np.eye(4) if applied is None else np.vstack([applied, [0, 0, 0, 1]])
    frames = [
        {"file_path": name, "transform_matrix": (moved @ np.linalg.inv(viewmat) @ OPENGL).tolist()}
        for name, viewmat in zip(names, poses(len(names)), strict=True)
    ]
    fx, fy, cx, cy = PINHOLE
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    return {"camera_model": "PINHOLE", **lens, "frames": frames, **keys}


def write_transforms(path: Path, data: dict[str, object]) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "transforms.json").write_text(json.dumps(data))
    return path


def project(view, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (M, 2) of those of the points (N, 3), in a view's own frame, that it shows, and their indices (M,)."""
    viewmat, K = (matrix.double().numpy() for matrix in (view.camera.viewmat, view.camera.K))
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    inside = (local[:, 2] > 0) & ((pixels > 1) & (pixels < [view.camera.width - 1, view.camera.height - 1])).all(axis=1)
    return pixels[inside], np.flatnonzero(inside)


def color_error(scene, origin: Sequence[float] = (0.0, 0.0, 0.0), paint: Callable[..., np.ndarray] = paint) -> float:
    """Largest mean difference of a view, of 255, between its photo and the room's colours at points of its walls.

    `origin` is the room's point at the origin of the scene's cameras.
    """
    differences = []
    points = wall_points(2000, seed=1)
    for view in (*scene.train, *scene.test):
        pixels, shown = project(view, points - np.array(origin))
        assert len(shown) > 50, f"{view.name} shows no wall"
        left, top = (pixels - 0.5).astype(int).T
        right, down = (pixels - 0.5 - np.stack([left, top], axis=1)).T[:, :, None]
        image = view.image.numpy().astype(np.float64)
        above = image[top, left] * (1 - right) + image[top, left + 1] * right
        below = image[top + 1, left] * (1 - right) + image[top + 1, left + 1] * right
        differences.append(np.abs(above * (1 - down) + below * down - paint(points[shown])).mean())
    return float(np.max(differences))


def _quaternion(viewmat: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(viewmat[:3, :3]).as_quat().tolist()
    return [w, x, y, z]
