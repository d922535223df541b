"""The built-in scene `demo`: ray-traced photos and noisy sparse points, written as a COLMAP scene."""

import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from nexwarp.data.cache import cache_folder
from nexwarp.data.demo_points import Rig, SparsePoint, sparse_points
from nexwarp.data.demo_room import LAMP, build_room
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.raytrace import render
from nexwarp.errors import check_range

VERSION = 1  # of the scene's content; raise it when the output of `write_demo` changes
WIDTH, HEIGHT, VIEWS, POINTS = 192, 144, 40, 4000
TARGET = np.array([0.0, 0.0, 0.62])
RINGS = ((3.15, 14.0), (3.3, 36.0))  # distance from the target in world units, elevation in degrees
FIELD_OF_VIEW = 56.0  # horizontal, degrees


def demo_folder() -> Path:
    """Return the folder of the built-in scene; the first call writes it, which takes some seconds.

    It is in the user's cache: $NEXWARP_CACHE, else $XDG_CACHE_HOME/nexwarp, else ~/.cache/nexwarp.
    """
    folder = cache_folder() / f"demo-v{VERSION}-{WIDTH}x{HEIGHT}-{VIEWS}"
    if not folder.is_dir():
        try:
            write_demo(folder)
        except FileExistsError:  # another process has written the same scene
            pass
    return folder


def write_demo(
    folder: str | os.PathLike[str],
    width: int = WIDTH,
    height: int = HEIGHT,
    views: int = VIEWS,
    points: int = POINTS,
    seed: int = 0,
) -> Path:
    """Write the demo as a COLMAP scene: images/*.png and a binary model in sparse/0.

    The same arguments give the same files. They are written to a temporary folder beside `folder` and moved at the
    end, so that a crash leaves no incomplete scene.

    Args:
        folder: folder to write; must be empty or absent.
        width: width of the photos in pixels; it also sets the resolution of the textures.
        height: height of the photos in pixels.
        views: number of photos, at least 4.
        points: largest number of sparse points.
        seed: seed of the points' noise; the photos do not depend on it.

    Returns:
        `folder`.

    Raises:
        FileExistsError: `folder` exists and is not empty.
        ValueError: a number is out of range.
    """
    folder = Path(folder)
    for name, value, low in (
        ("width", width, 16),
        ("height", height, 16),
        ("views", views, 4),
        ("points", points, 1),
    ):
        check_range(name, value, low)
    _check_free(folder)
    rig = demo_cameras(width, height, views)
    room = build_room(width)
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        images = list(pool.map(lambda viewmat: render(room, viewmat, rig.K, rig.size, LAMP), rig.viewmats))
    sparse = sparse_points(room, rig, images, points, np.random.default_rng(seed))
    names = [f"view_{index:03d}.png" for index in range(views)]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
        scene = Path(temporary) / "scene"
        _write_images(scene / "images", names, images)
        _write_model(scene / "sparse" / "0", names, rig, sparse)
        _move(scene, folder)
    return folder


def _check_free(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"folder: {folder} exists already, expected none or an empty one")


def _move(scene: Path, folder: Path) -> None:
    """Rename `scene` to `folder`, in one step."""
    _check_free(folder)
    if folder.exists():
        folder.rmdir()  # on Windows, rename needs a target that does not exist
    try:
        scene.rename(folder)
    except OSError:
        _check_free(folder)  # another process has written the folder meanwhile
        raise


def demo_cameras(width: int, height: int, views: int) -> Rig:
    """Two rings of cameras around the lawn; the upper ring is rotated by half a step.

    All cameras share intrinsics with fx != fy and a principal point off the centre.
    """
    fx = 0.5 * width / np.tan(np.radians(FIELD_OF_VIEW / 2))
    K = np.array([[fx, 0.0, 0.507 * width], [0.0, 1.03 * fx, 0.489 * height], [0.0, 0.0, 1.0]])
    lower = (views + 1) // 2
    viewmats = []
    for ring, (count, (distance, degrees)) in enumerate(zip((lower, views - lower), RINGS, strict=True)):
        elevation = np.radians(degrees)
        for azimuth in 2.0 * np.pi * (np.arange(count) + 0.5 * ring) / count - np.pi / 2:
            outward = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * np.cos(elevation)
            viewmats.append(_look_at(TARGET + distance * outward, TARGET))
    return Rig(K, np.stack(viewmats), (width, height))


def _look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) world to camera, x right, y down, z forward, with the world's z up."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def _write_images(folder: Path, names: Sequence[str], images: Sequence[np.ndarray]) -> None:
    from PIL import Image

    folder.mkdir(parents=True)
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(folder / name)


def _write_model(folder: Path, names: Sequence[str], rig: Rig, points: Sequence[SparsePoint]) -> None:
    """Write a binary COLMAP model: one PINHOLE camera, the views, the points with their tracks."""
    pycolmap = pycolmap_module()
    (fx, _, cx), (_, fy, cy), _ = rig.K.tolist()
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=rig.size[0], height=rig.size[1], params=[fx, fy, cx, cy], camera_id=1
    )
    reconstruction.add_camera_with_trivial_rig(camera)
    keypoints: list[list[np.ndarray]] = [[] for _ in names]
    tracks = []
    for point in points:
        track = pycolmap.Track()
        for view, pixel in zip(point.views.tolist(), point.pixels, strict=True):
            track.add_element(view + 1, len(keypoints[view]))
            keypoints[view].append(pixel)
        tracks.append(track)
    for view, name in enumerate(names):
        image = pycolmap.Image(
            name=name, keypoints=np.array(keypoints[view]).reshape(-1, 2), camera_id=1, image_id=view + 1
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rig.viewmats[view, :3]))
    for point, track in zip(points, tracks, strict=True):
        reconstruction.add_point3D(point.position, track, point.color)
    reconstruction.update_point_3d_errors()
    folder.mkdir(parents=True)
    reconstruction.write_binary(str(folder))
