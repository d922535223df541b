"""The browser's coordinate frame, and cameras for the view of a browser."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nexwarp.cameras.camera import Camera, in_image
from nexwarp.cameras.paths import focus, up_direction
from nexwarp.model.model import Model
from nexwarp.viewer.pacing import MOST_SIDE

# The browser moves two units a second, so that it crosses a scene of this radius in three seconds.
RADIUS = 3.0
MOST_COMPARED = 300  # cameras, for the first view
FRUSTUM_SHARE = 0.4  # size of a frustum, in distances of neighbouring cameras
SMALLEST_FRUSTUM, LARGEST_FRUSTUM = 0.02, 0.16  # browser units; all cameras lie within RADIUS of the origin
BAND_ROWS = 16  # rows of a tile
LEAST_ALPHA = 0.25  # of a pixel that shows a surface

FloatVector: TypeAlias = Sequence[float] | npt.NDArray[np.float64]


@dataclass(frozen=True)
class World:
    """The browser's frame: the scene's frame, translated and scaled so that all cameras lie within `RADIUS`."""

    centre: np.ndarray  # (3,) its origin, in the scene's frame, as `up` and `focus`
    unit: float  # length of a browser unit
    up: np.ndarray  # (3,) unit upward direction
    focus: np.ndarray  # (3,) what the first camera orbits

    @staticmethod
    def around(cameras: Sequence[Camera], means: torch.Tensor) -> "World":
        """Choose a frame for the cameras of a scene and the (N, 3) means of its surfels."""
        poses = np.stack([camera_to_world(camera) for camera in cameras])
        centres, axes = poses[:, :3, 3], poses[:, :3, 2]
        centre = centres.mean(axis=0)
        radius = np.linalg.norm(centres - centre, axis=1).max()
        middle = means.detach().double().median(dim=0).values.cpu().numpy() if len(means) else centre
        away = np.linalg.norm(middle - centre)
        radius = radius if radius > 1e-6 * away else away  # of cameras at one place
        up = up_direction(cameras).numpy()
        try:
            target = focus(cameras).numpy()
        except ValueError:  # parallel axes
            target = centres[0]
        if (target - centres[0]) @ axes[0] < 0.1 * radius:
            target = centres[0] + axes[0] * radius
        return World(centre, float(radius) / RADIUS or 1.0, up, target)

    def to_browser(self, points: np.ndarray) -> np.ndarray:
        """Convert scene positions (..., 3) to browser positions."""
        return (points - self.centre) / self.unit

    def to_scene(self, points: np.ndarray) -> np.ndarray:
        """Convert browser positions (..., 3) to scene positions."""
        return points * self.unit + self.centre


@dataclass(frozen=True)
class Viewpoint:
    """The camera of a browser's canvas."""

    pose: np.ndarray  # (4, 4) float64, camera to world in the scene's frame, x right, y down, z forward
    fov: float  # vertical, radians
    width: int  # pixels
    height: int

    @staticmethod
    def of_camera(camera: Camera) -> "Viewpoint":
        """Return the view of a camera of the scene."""
        return Viewpoint(camera_to_world(camera), vertical_fov(camera), camera.width, camera.height)

    @staticmethod
    def of(wxyz: FloatVector, position: FloatVector, fov: float, width: int, height: int, world: World) -> "Viewpoint":
        """Convert a browser's camera: rotation (4,), position (3,) in browser units, fov in radians, size in pixels.

        TypeError or ValueError: values that do not describe a camera.
        """
        values = np.array([*wxyz, *position, fov, width, height], dtype=np.float64)
        is_camera = values.shape == (10,) and bool(np.isfinite(values).all()) and 1e-3 < fov < math.pi - 1e-3
        if not (is_camera and 1e-6 <= np.abs(values[:4]).max() and np.abs(values[4:7]).max() <= 1e9):
            raise ValueError(f"camera: expected a rotation, a position and a field of view, got {values.tolist()}")
        if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
            raise ValueError(f"camera: expected a canvas of 1 to {MOST_SIDE} pixels a side, got {width}x{height}")
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix()
        pose[:3, 3] = world.to_scene(values[4:7])
        return Viewpoint(pose, float(fov), int(width), int(height))

    def bands(
        self, scale: float, near: float, like: torch.Tensor, count: int = 1, focal_limit: float = math.inf
    ) -> list[Camera]:
        """Return cameras of a picture with `scale` times the canvas's size, as bands of rows from top to bottom.

        There are at most `count`, whose heights but the last are multiples of 16 rows; dtype and device are those of
        `like`. `focal_limit` is an upper limit of `Camera.focal`, pixels, which limits the detail of the texture.
        """
        width, height = max(round(self.width * scale), 1), max(round(self.height * scale), 1)
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        viewmat = torch.from_numpy(np.linalg.inv(self.pose)).to(like)
        K = like.new_tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = LimitedCamera(viewmat, K, width, height, near, focal_limit=focal_limit)
        rows = -(-height // (BAND_ROWS * count)) * BAND_ROWS
        return [camera.crop(0, top, width, min(rows, height - top)) for top in range(0, height, rows)]


@dataclass(frozen=True)
class LimitedCamera(Camera):
    """A camera with an upper limit, in pixels, on the focal length by which the texture's levels are weighted."""

    focal_limit: float = field(default=math.inf, kw_only=True)

    @property
    def focal(self) -> float:
        """Focal length for the weights of the texture's levels (paper Eq. 4), pixels."""
        return min(self.pixel_focal, self.focal_limit)


@torch.no_grad()
def surface_point(model: Model, view: Viewpoint, place: tuple[float, float], near: float) -> np.ndarray | None:
    """Return the point (3,) float64, scene's frame, of the surface at (x, y) of a view, from (0, 0) to (1, 1).

    It is at the median depth of the pixel there; None where the surfels cover less than `LEAST_ALPHA` of it.
    """
    (camera,) = view.bands(1.0, near, model.surfels.means)
    column, row = (min(int(x * size), size - 1) for x, size in zip(place, (view.width, view.height), strict=True))
    pixel = camera.crop(column, row, 1, 1)
    rendering = model.bare().render(pixel)
    if rendering.alpha.item() < LEAST_ALPHA:
        return None
    ray = np.array([(0.5 - pixel.cx) / pixel.fx, (0.5 - pixel.cy) / pixel.fy, 1.0])
    return view.pose[:3, :3] @ ray * rendering.median_depth.item() + view.pose[:3, 3]


def clearest(cameras: Sequence[Camera]) -> Camera:
    """Return the first of up to 300 cameras in whose picture the frustums of the others, 1 / depth^2, cover least."""
    chosen = list(cameras[:: -(-len(cameras) // MOST_COMPARED)])
    centres = torch.stack([camera.position.detach().double().cpu() for camera in chosen])
    covered: list[float] = []
    for camera in chosen:
        pixels, depths = camera.to("cpu", torch.float64).project(centres)
        seen = in_image(pixels, depths, camera.width, camera.height)
        covered.append(float(depths[seen].square().reciprocal().sum()))
    return chosen[int(np.argmin(np.round(covered, 9)))]


def frustum_size(places: np.ndarray) -> float:
    """Return a size of frustums at which those of neighbours among `places` (N, 3) stay apart; browser units."""
    if len(places) < 2:
        return LARGEST_FRUSTUM
    distances = cKDTree(places).query(places, k=2)[0][:, 1]
    return float(np.clip(FRUSTUM_SHARE * np.median(distances), SMALLEST_FRUSTUM, LARGEST_FRUSTUM))


def camera_to_world(camera: Camera) -> np.ndarray:
    """(4, 4) float64 camera-to-world pose of a camera."""
    return np.linalg.inv(camera.viewmat.detach().double().cpu().numpy())


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view in radians for the camera's focal length and height, with a centred principal point."""
    return 2.0 * math.atan(0.5 * camera.height / camera.fy)
