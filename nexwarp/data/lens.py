"""Lenses: COLMAP's camera models, undistortion to a pinhole image, and the resampling for it.

Pixel centres are at +0.5. A photo is resampled once by bicubic interpolation, a mask by nearest neighbours.
"""

import math
import signal
import sys
import threading
from collections import OrderedDict
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
MAX_SIDE = 2**16  # pixels, of an undistorted image
MIN_FOCAL, MAX_PARAMETER = 1e-3, 1e9  # pixels; rays and pixels stay finite in single precision
ROWS = 128  # rows of a map that are computed at a time, as their rays are float64
KEPT_MAPS = 6  # for the faces of a panorama
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
    """Intrinsics and size of an image without distortion.

    Attributes:
        K: (3, 3) float64, in pixels, pixel centres at +0.5.
        width: width of the image in pixels.
        height: height of the image in pixels.
    """

    K: np.ndarray
    width: int
    height: int

    def resized(self, width: int, height: int) -> "Intrinsics":
        """Return the intrinsics of the same view with another size; each axis is scaled on its own."""
        K = self.K.copy()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return Intrinsics(K, width, height)


@dataclass(frozen=True)
class Lens:
    """The camera of a photo before undistortion: one of COLMAP's camera models.

    Attributes:
        model: COLMAP's name, such as OPENCV.
        params: parameters in COLMAP's order, in pixels of a width x height image.
        width: width of the photo in pixels.
        height: height of the photo in pixels.

    Raises:
        ValueError: an unknown model, a wrong number of parameters, a parameter that is not finite, a focal length or
            size that is not positive.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            raise ValueError(f"expected an image size of 1 to {MAX_SIDE} pixels, got {self.width}x{self.height}")
        if self.model == "INVALID" or self.model not in pycolmap_module().CameraModelId.__members__:
            raise ValueError(f"camera model {self.model} is unknown to COLMAP")
        camera = self._camera()
        if not camera.verify_params():
            raise ValueError(f"camera model {self.model}: expected {camera.params_info}, got {len(self.params)} values")
        if not all(map(math.isfinite, self.params)):
            raise ValueError(f"camera model {self.model}: expected finite parameters, got {self.params}")
        focal = [self.params[index] for index in camera.focal_length_idxs()]
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

        Raises:
            ValueError: the parameters allow no undistortion.
        """
        if not self.distorted:
            return Intrinsics(np.array(self._camera().calibration_matrix()), self.width, self.height)
        if self.model == PANORAMA:
            side = max(round(self.width / math.pi), 1)
            K = np.array([[side / 2, 0.0, side / 2], [0.0, side / 2, side / 2], [0.0, 0.0, 1.0]])
            return Intrinsics(K, side, side)
        pycolmap = pycolmap_module()
        options = pycolmap.UndistortCameraOptions()
        camera = pycolmap.undistort_camera(options, self._camera())
        K = np.array(camera.calibration_matrix())
        if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE and np.isfinite(K).all()):
            raise ValueError(f"camera model {self.model}: cannot undistort with the parameters {self.params}")
        return Intrinsics(K, int(camera.width), int(camera.height))

    def project(self, rays: np.ndarray) -> np.ndarray:
        """Pixel coordinates (N, 2) float64 of camera-frame directions (N, 3); NaN outside the lens's field of view."""
        return np.asarray(self._camera().img_from_cam(np.ascontiguousarray(rays, dtype=np.float64)))

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Camera-frame directions (N, 3) float64 of pixel coordinates (N, 2); NaN if a pixel has none."""
        return np.asarray(self._camera().cam_ray_from_img(np.ascontiguousarray(pixels, dtype=np.float64)))

    def _camera(self) -> "pycolmap.Camera":
        camera: pycolmap.Camera = pycolmap_module().Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )
        return camera


@dataclass(frozen=True)
class Map:
    """The positions in the photo of the pixels of an undistorted image.

    Attributes:
        grid: (1, h, w, 2) float32, for `torch.nn.functional.grid_sample`.
        valid: (h, w) bool, True inside the photo; None if all pixels are.
    """

    grid: torch.Tensor
    valid: torch.Tensor | None

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
        if mask is None:
            return self.valid
        near = torch.nn.functional.grid_sample(
            mask[None, None].float(), self.grid, mode="nearest", padding_mode="border", align_corners=False
        )
        out = near[0, 0] > 0.5
        return out if self.valid is None else out & self.valid


class Maps:
    """A thread-safe cache of the most recent maps, for photos that share a lens."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._maps: OrderedDict[tuple[Lens, int, int, bytes, str | None], Map] = OrderedDict()

    def get(self, lens: Lens, target: Intrinsics, face: str | None) -> Map:
        """Return the map from an undistorted image to a photo; `face` is the face of a panorama, a key of `FACES`."""
        key = (lens, target.width, target.height, target.K.tobytes(), face)
        with self._lock:
            if key not in self._maps:
                self._maps[key] = _map(lens, target, face)
            self._maps.move_to_end(key)
            while len(self._maps) > KEPT_MAPS:
                self._maps.popitem(last=False)
            return self._maps[key]


def _map(lens: Lens, target: Intrinsics, face: str | None) -> Map:
    grid = np.empty((target.height, target.width, 2), np.float32)
    valid = np.empty((target.height, target.width), bool)
    x = (np.arange(target.width) + 0.5 - target.K[0, 2]) / target.K[0, 0]
    for top in range(0, target.height, ROWS):
        rows = slice(top, min(top + ROWS, target.height))
        y = (np.arange(rows.start, rows.stop) + 0.5 - target.K[1, 2]) / target.K[1, 1]
        rays = np.ones((len(y), len(x), 3))
        rays[..., 0], rays[..., 1] = x, y[:, None]
        if face is not None:
            rays = rays @ np.array(FACES[face], np.float64)
        pixels = lens.project(rays.reshape(-1, 3)).reshape(len(y), len(x), 2)
        size = np.array([lens.width, lens.height], np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            valid[rows] = ((pixels >= -BORDER) & (pixels <= size + BORDER)).all(axis=-1)
            grid[rows] = np.nan_to_num(2.0 * pixels / size - 1.0, nan=0.0, posinf=2.0, neginf=-2.0).clip(-2.0, 2.0)
    return Map(torch.from_numpy(grid)[None], None if valid.all() else torch.from_numpy(valid))
