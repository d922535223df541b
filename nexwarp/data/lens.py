"""Lenses: COLMAP's camera models, undistortion to a pinhole image, and the resampling for it.

Pixel centres are at +0.5. A photo is resampled once by bicubic interpolation, a mask by nearest neighbours.
"""

import math
import signal
import sys
import threading
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    import pycolmap

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
PANORAMA = "EQUIRECTANGULAR"
BROWN = "BROWN"  # OPENCV with a polynomial up to r^8, of Metashape and RealityCapture, which COLMAP does not have
BROWN_PARAMS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")
WIDE = ("FISHEYE", "FOV", "EUCM", "DIVISION")  # ends of the names of models that can see more than 180 degrees
LEAST_SCALE, MOST_SCALE = 0.2, 2.0  # of the sides of an undistorted image, in those of the photo
NEWTON_STEPS, NEWTON_DELTA = 50, 1e-7
MAX_SIDE = 2**16  # pixels, of an undistorted image
MIN_FOCAL, MAX_PARAMETER = 1e-3, 1e9  # pixels; rays and pixels stay finite in single precision
ROWS = 128  # rows of a map that are computed at a time, as their rays are float64
BORDER = 0.5  # pixels outside a photo that take the colour of its edge

# Rotations from a panorama's frame to its six faces of 90 degrees, x right, y down, z forward.
FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def pycolmap_module() -> ModuleType:
    """Import pycolmap when it is needed, since it delays the start, and after numpy and PIL.

    If version 4.2.1 is imported before them, it sometimes corrupts the heap. It also takes SIGTERM for a crash of its
    own, prints a stack trace and dies: the handler from before the import is put back.
    """
    import PIL.Image  # noqa: F401

    first, handler = "pycolmap" not in sys.modules, signal.getsignal(signal.SIGTERM)
    import pycolmap

    if first and handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


@lru_cache(maxsize=1)
def camera_models() -> dict[int, tuple[str, int]]:
    """COLMAP's camera models: id -> (name, number of parameters)."""
    pycolmap = pycolmap_module()
    create = pycolmap.Camera.create_from_model_id
    models = {name: model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    return {int(model): (name, len(create(1, model, 1.0, 2, 2).params)) for name, model in models.items()}


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics and size of an image without distortion, in pixels, pixel centres at +0.5."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def resized(self, width: int, height: int) -> "Intrinsics":
        """Return the intrinsics of the same view with another size; each axis is scaled on its own."""
        x, y = width / self.width, height / self.height
        return Intrinsics(self.fx * x, self.fy * y, self.cx * x, self.cy * y, width, height)


@dataclass(frozen=True)
class Lens:
    """The camera of a photo before undistortion; ValueError where model, parameters or size are not usable."""

    model: str  # COLMAP's name, such as OPENCV; or BROWN
    params: tuple[float, ...]  # in COLMAP's order, in pixels of a width x height image; of BROWN `BROWN_PARAMS`
    width: int  # of the photo in pixels
    height: int

    def __post_init__(self) -> None:
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            raise ValueError(f"expected an image size of 1 to {MAX_SIDE} pixels, got {self.width}x{self.height}")
        if self.model == BROWN:
            fitting, expected = len(self.params) == len(BROWN_PARAMS), ", ".join(BROWN_PARAMS)
        elif self.model == "INVALID" or self.model not in pycolmap_module().CameraModelId.__members__:
            raise ValueError(f"camera model {self.model} is unknown to COLMAP")
        else:
            fitting, expected = self._camera().verify_params(), self._camera().params_info
        if not fitting:
            raise ValueError(f"camera model {self.model}: expected {expected}, got {len(self.params)} values")
        if not all(map(math.isfinite, self.params)):
            raise ValueError(f"camera model {self.model}: expected finite parameters, got {self.params}")
        focal = [self.params[index] for index in self._camera().focal_length_idxs()]
        if min(focal, default=1.0) <= 0:
            raise ValueError(f"K: expected focal lengths > 0, got {', '.join(f'{f:g}' for f in focal)}")
        if min(focal, default=1.0) < MIN_FOCAL or max(map(abs, self.params), default=1.0) > MAX_PARAMETER:
            raise ValueError(
                f"camera model {self.model}: expected focal lengths of at least {MIN_FOCAL:g} and parameters of at "
                f"most {MAX_PARAMETER:g}, got {self.params}"
            )

    @property
    def distorted(self) -> bool:
        """Whether the model is not a pinhole."""
        return self.model not in PINHOLES

    def undistorted(self) -> Intrinsics:
        """Intrinsics of the undistorted image; those of the photo if it is not distorted.

        The undistorted image shows the largest part of the photo without empty corners. It has the photo's focal length
        and is at most twice as wide and high. The faces of a panorama have the resolution of its equator.
        """
        if self.model == PANORAMA:
            side = max(round(self.width / math.pi), 1)
            return Intrinsics(side / 2, side / 2, side / 2, side / 2, side, side)
        K = self._camera().calibration_matrix()
        focal, centre = [K[0, 0], K[1, 1]], [K[0, 2], K[1, 2]]
        if not self.distorted:
            return Intrinsics(focal[0], focal[1], centre[0], centre[1], self.width, self.height)
        photo, sides = (self.width, self.height), [1, 1]
        for axis, side in enumerate(photo):
            middle = centre[axis]
            border = np.empty((photo[1 - axis], 2))
            border[:, 1 - axis] = np.arange(photo[1 - axis]) + 0.5
            border[:, axis] = 0.5
            first = middle + focal[axis] * self._tangents(border, axis, -math.inf).max()
            border[:, axis] = side - 0.5
            last = middle + focal[axis] * self._tangents(border, axis, math.inf).min()
            with np.errstate(divide="ignore"):
                scale = 1 / np.maximum(middle / (middle - first), (side - 0.5 - middle) / (last - middle))
            sides[axis] = max(int(side * np.clip(np.nan_to_num(scale, nan=1.0), LEAST_SCALE, MOST_SCALE)), 1)
            centre[axis] *= sides[axis] / side
        if max(sides) > MAX_SIDE:
            raise ValueError(f"camera model {self.model}: cannot undistort with the parameters {self.params}")
        return Intrinsics(focal[0], focal[1], centre[0], centre[1], sides[0], sides[1])

    def _tangents(self, pixels: np.ndarray, axis: int, beyond: float) -> np.ndarray:
        """Positions (N,) along an axis at depth 1 of pixels (N, 2); `beyond` where the lens sees more than 180 degrees.

        COLMAP gives pixels beyond 180 degrees a direction in front of the camera, which is that of another pixel.
        """
        rays = self.unproject(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            tangents = rays[:, axis] / rays[:, 2]
            if self.model.endswith(WIDE):
                seen = (rays[:, 2] > 0) & (np.abs(self.project(rays) - pixels).max(axis=1) <= BORDER)
                return np.where(seen, tangents, beyond)
        return np.where(np.isnan(tangents), beyond, tangents)

    def project(self, rays: np.ndarray) -> np.ndarray:
        """Pixel coordinates (N, 2) float64 of camera-frame directions (N, 3); NaN outside the lens's field of view."""
        if self.model == BROWN:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                flat = np.where(rays[:, 2:] > 0, rays[:, :2] / rays[:, 2:], np.nan)
                return self._bent(flat) * self.params[:2] + self.params[2:4]
        return np.asarray(self._camera().img_from_cam(np.ascontiguousarray(rays, dtype=np.float64)))

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Camera-frame directions (N, 3) float64 of pixel coordinates (N, 2); NaN if a pixel has none."""
        if self.model != BROWN:
            return np.asarray(self._camera().cam_ray_from_img(np.ascontiguousarray(pixels, dtype=np.float64)))
        bent = (pixels - self.params[2:4]) / self.params[:2]
        flat = bent.copy()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(NEWTON_STEPS):
                error = self._bent(flat) - bent
                a, c = ((self._bent(flat + step) - bent - error) / NEWTON_DELTA for step in np.eye(2) * NEWTON_DELTA)
                determinant = a[:, 0] * c[:, 1] - a[:, 1] * c[:, 0]
                flat[:, 0] -= (c[:, 1] * error[:, 0] - c[:, 0] * error[:, 1]) / determinant
                flat[:, 1] -= (a[:, 0] * error[:, 1] - a[:, 1] * error[:, 0]) / determinant
        return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)

    def _bent(self, flat: np.ndarray) -> np.ndarray:
        """Distorted positions (N, 2) of positions at depth 1, by Brown's polynomial."""
        k1, k2, p1, p2, k3, k4 = self.params[4:]
        x, y = flat[:, 0], flat[:, 1]
        r = x * x + y * y
        radial = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
        bent_y = y * radial + 2 * p2 * x * y + p1 * (r + 2 * y * y)
        return np.stack([bent_x, bent_y], axis=1)

    def _camera(self) -> "pycolmap.Camera":
        """COLMAP's camera; of BROWN the one that has all but the last two coefficients."""
        model, params = ("OPENCV", self.params[:8]) if self.model == BROWN else (self.model, self.params)
        camera: pycolmap.Camera = pycolmap_module().Camera(
            model=model, width=self.width, height=self.height, params=list(params)
        )
        return camera


@dataclass(frozen=True)
class Map:
    """The positions in the photo of the pixels of an undistorted image."""

    grid: torch.Tensor  # (1, h, w, 2) float32, for `torch.nn.functional.grid_sample`
    valid: torch.Tensor | None  # (h, w) bool, True inside the photo; None if all pixels are

    def colors(self, image: torch.Tensor) -> torch.Tensor:
        """Resample a photo (H, W, C) uint8 to (h, w, C) uint8; each channel on its own, to save memory."""
        out = torch.empty(*self.grid.shape[1:3], image.shape[2], dtype=torch.uint8)
        for channel in range(image.shape[2]):
            plane = image[None, None, :, :, channel].float()
            fine = torch.nn.functional.grid_sample(
                plane, self.grid, mode="bicubic", padding_mode="border", align_corners=False
            )
            out[:, :, channel] = (fine[0, 0] + 0.5).clamp_(0, 255).byte()
        return out

    def mask(self, mask: torch.Tensor | None) -> torch.Tensor | None:
        """Resample a mask (H, W) bool to (h, w) bool, False outside the photo; None if all pixels are True."""
        return self.valid if mask is None else self.nearest(mask.float()) > 0.5

    def nearest(self, values: torch.Tensor) -> torch.Tensor:
        """Resample values (H, W) float to (h, w) by nearest neighbours, 0 outside the photo; theirs may be any size."""
        near = torch.nn.functional.grid_sample(
            values[None, None], self.grid, mode="nearest", padding_mode="border", align_corners=False
        )[0, 0]
        return near if self.valid is None else near * self.valid


@lru_cache(maxsize=256)
def _reach(lens: Lens) -> float:
    """Tangent of the angle from the axis up to which a lens is one to one; polynomials turn back beyond."""
    tangents = np.tan(np.radians(np.linspace(0.0, 89.5, 359)))
    turns = np.arange(8) * math.pi / 4
    flat = tangents[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1)
    pixels = lens.project(rays.reshape(-1, 3)).reshape(flat.shape)
    with np.errstate(invalid="ignore", over="ignore"):
        farther = (np.diff(np.linalg.norm(pixels - pixels[:1], axis=-1), axis=0) > 0).all(axis=1)
    return math.inf if farther.all() else float(tangents[max(int(np.argmin(farther)) - 1, 0)])


def undistortion(lens: Lens, target: Intrinsics, face: str | None) -> Map:
    """Return the map from an undistorted image to a photo; `face` is the face of a panorama, a key of `FACES`."""
    grid = np.empty((target.height, target.width, 2), np.float32)
    valid = np.empty((target.height, target.width), bool)
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx
    for top in range(0, target.height, ROWS):
        rows = slice(top, min(top + ROWS, target.height))
        y = (np.arange(rows.start, rows.stop) + 0.5 - target.cy) / target.fy
        rays = np.ones((len(y), len(x), 3))
        rays[..., 0], rays[..., 1] = x, y[:, None]
        if face is not None:
            rays = rays @ np.array(FACES[face], np.float64)
        pixels = lens.project(rays.reshape(-1, 3)).reshape(len(y), len(x), 2)
        size = np.array([lens.width, lens.height], np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            valid[rows] = ((pixels >= -BORDER) & (pixels <= size + BORDER)).all(axis=-1)
            if face is None:
                valid[rows] &= np.hypot(x, y[:, None]) <= _reach(lens)
            grid[rows] = np.nan_to_num(2.0 * pixels / size - 1.0, nan=0.0, posinf=2.0, neginf=-2.0).clip(-2.0, 2.0)
    return Map(torch.from_numpy(grid)[None], None if valid.all() else torch.from_numpy(valid))
