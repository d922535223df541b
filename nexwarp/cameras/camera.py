"""Pinhole cameras, with OpenCV axes as in COLMAP: x right, y down, z forward."""

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch

from nexwarp.errors import check_finite, check_integer, check_number, check_range, check_tensors

Array: TypeAlias = torch.Tensor | np.ndarray

ROTATION_TOLERANCE = 1e-3
MAX_CAMERAS = 30_000  # of a file
LARGEST_DISTANCE = 1e16  # of a camera from the origin, world units: its square is finite in single precision
SMALLEST_FOCAL = 1e-16  # pixels


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5). The ray through pixel coordinates (x, y) has the
    camera-frame direction ((x - cx) / fx, (y - cy) / fy, 1): distances along it, in units of that vector, are z-depths.

    Attributes:
        viewmat: (4, 4) float, world to camera, a rigid motion. Rendering is differentiable with respect to it. A NumPy
            array or nested lists become a float32 tensor on the CPU.
        K: (3, 3) float, intrinsics in pixels, without skew; the principal point may lie outside the image. Arrays and
            lists become a tensor as above, on the device of `viewmat`.
        width: image width in pixels.
        height: image height in pixels.
        near: hits with a z-depth of at most this are ignored, world units.
        origin: world coordinates of the origin of the frame that `viewmat` maps from: (0, 0, 0) for the world frame
            itself. None is the frame of the surfels that the camera renders. A model far from its world's origin, as
            with georeferenced coordinates, has a frame of its own, since float32 would round its coordinates.
        fx, fy, cx, cy: focal lengths and principal point in pixels, the numbers in `K`.

    Args:
        checked: fx, fy, cx and cy of matrices that have been checked before: these are not checked again, which would
            wait for a GPU. None checks `viewmat` and `K` and takes the numbers from `K`.

    Raises:
        TypeError: `viewmat` or `K` is neither a floating tensor nor numbers, or a number has the wrong type.
        ValueError: a shape or device is wrong; a value is not finite; the translation of `viewmat` is beyond 1e16; its
            rotation is a reflection, or differs from orthonormal by more than 1e-3; `K` has skew or a focal length
            below 1e-16; a size is < 1; `near` is < 0 or beyond 1e16.
    """

    viewmat: torch.Tensor
    K: torch.Tensor
    width: int
    height: int
    near: float = 0.01
    origin: tuple[float, float, float] | None = field(default=None, kw_only=True)
    checked: InitVar[tuple[float, float, float, float] | None] = field(default=None, kw_only=True)
    fx: float = field(init=False)
    fy: float = field(init=False)
    cx: float = field(init=False)
    cy: float = field(init=False)

    if TYPE_CHECKING:  # the constructor takes arrays, the fields are tensors

        def __init__(
            self,
            viewmat: Array,
            K: Array,
            width: int,
            height: int,
            near: float = 0.01,
            *,
            origin: tuple[float, float, float] | None = None,
            checked: tuple[float, float, float, float] | None = None,
        ) -> None: ...

    def __post_init__(self, checked: tuple[float, float, float, float] | None) -> None:
        if checked is None:
            viewmat = _as_tensor("viewmat", self.viewmat, None)
            K = _as_tensor("K", self.K, viewmat.device)
            vars(self).update(viewmat=viewmat, K=K)
            checked = _check(self)
        vars(self).update(zip(("fx", "fy", "cx", "cy"), checked, strict=True))

    @property
    def focal(self) -> float:
        """Geometric mean of the focal lengths, in pixels (f of paper Eq. 4)."""
        return (self.fx * self.fy) ** 0.5

    @property
    def pixel_focal(self) -> float:
        """Focal length of the image's pixels: `focal` may be lower, to limit the detail of the texture."""
        return (self.fx * self.fy) ** 0.5

    @property
    def device(self) -> torch.device:
        """Device of `viewmat`."""
        return self.viewmat.device

    @property
    def position(self) -> torch.Tensor:
        """(3,) centre of projection in the world frame, differentiable with respect to `viewmat`."""
        # Not a product: cuBLAS keeps 32 MiB for each stream, in a CUDA graph's memory too.
        return -(self.viewmat[:3, :3] * self.viewmat[:3, 3:]).sum(0)

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return pixel coordinates (N, 2) and z-depths (N,) of world points (N, 3), of those behind the camera too."""
        # Not a matrix product: see `position`. A product of all with all, then summed, took four times as long.
        a, b, c = (points[:, axis, None] * self.viewmat[:3, axis] for axis in range(3))
        x = a + b + c + self.viewmat[:3, 3]
        depths = x[:, 2]
        columns, rows = self.fx * x[:, 0] / depths + self.cx, self.fy * x[:, 1] / depths + self.cy
        return torch.stack([columns, rows], dim=-1), depths

    def crop(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of a window of this image, in pixels; the window may extend beyond the image."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        checked = (self.fx, self.fy, self.cx - left, self.cy - top)
        return replace(self, K=K, width=width, height=height, checked=checked)

    def to(self, *args: Any, **kwargs: Any) -> "Camera":
        """Return a copy with `viewmat` and `K` moved or converted; arguments as of `torch.Tensor.to`."""
        viewmat, K = self.viewmat.to(*args, **kwargs), self.K.to(*args, **kwargs)
        same = (viewmat.dtype, K.dtype) == (self.viewmat.dtype, self.K.dtype)
        checked = (self.fx, self.fy, self.cx, self.cy) if same else None
        return Camera(viewmat, K, self.width, self.height, self.near, origin=self.origin, checked=checked)

    def moved(self, origin: tuple[float, float, float]) -> "Camera":
        """Return the camera in the frame with another origin in world coordinates; ValueError if it has no `origin`."""
        if self.origin is None:
            raise ValueError("origin: expected the world coordinates of the camera's frame, got None")
        viewmat = self.viewmat.double()
        way = viewmat.new_tensor([new - old for new, old in zip(origin, self.origin, strict=True)])
        shift = viewmat[:3, 3] + (viewmat[:3, :3] * way).sum(1)
        moved = torch.cat([torch.cat([viewmat[:3, :3], shift[:, None]], 1), viewmat[3:]]).to(self.viewmat.dtype)
        return replace(self, viewmat=moved, origin=origin, checked=(self.fx, self.fy, self.cx, self.cy))


class StagedCamera(Camera):
    """A camera whose tensors are overwritten in place, so that a recorded CUDA graph renders what other cameras see.

    It has the size, near depth and dtype of `camera`, and zeros for numbers until `copy_`.

    Attributes:
        numbers: (30,) viewmat, K, `focal`, `pixel_focal` and a background colour of the camera that was copied last:
            one copy brings them all. `fx` to `cy` are those of the first camera.
        falloff: (H, W, 1) falloff of the lens for that camera; None where the lens has none, or is not rendered.
    """

    def __init__(self, camera: Camera, device: torch.device, falloff: torch.Tensor | None = None) -> None:
        self.numbers = torch.zeros(30, dtype=camera.viewmat.dtype, device=device)
        self.falloff = falloff
        viewmat, K = self.numbers[:16].view(4, 4), self.numbers[16:25].view(3, 3)
        checked = (camera.fx, camera.fy, camera.cx, camera.cy)
        super().__init__(viewmat, K, camera.width, camera.height, camera.near, checked=checked)

    @property
    def focal(self) -> torch.Tensor:  # type: ignore[override]  # a graph reads the number from the device
        """(1,) focal length in pixels, on the device."""
        return self.numbers[25:26]

    @property
    def pixel_focal(self) -> torch.Tensor:  # type: ignore[override]
        """(1,) focal length of the image's pixels, on the device."""
        return self.numbers[26:27]

    @property
    def color(self) -> torch.Tensor:
        """(3,) background colour, on the device."""
        return self.numbers[27:]

    def copy_(self, camera: Camera, color: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Overwrite all but the falloff with another camera of the same size and near depth, and a background."""
        dtype = self.numbers.dtype
        # From pageable memory, which is read before the copy returns.
        scalars = torch.tensor([camera.focal, camera.pixel_focal, *color], dtype=dtype)
        matrices = [camera.viewmat.detach().reshape(-1), camera.K.detach().to(dtype).reshape(-1)]
        if camera.device.type == "cpu":
            self.numbers.copy_(torch.cat([*matrices, scalars]), non_blocking=True)
        else:
            torch.cat(matrices, out=self.numbers[:25])
            self.numbers[25:].copy_(scalars, non_blocking=True)


def _as_tensor(name: str, value: object, device: torch.device | None) -> torch.Tensor:
    """Return a tensor as it is; an array or lists of numbers as a new float32 tensor on a device."""
    if isinstance(value, torch.Tensor):
        return value
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.ndim != 2:
        raise TypeError(f"{name}: expected a torch.Tensor, an array or lists of numbers, got {type(value).__name__}")
    return torch.tensor(numbers, dtype=torch.float32, device=device)


def _check(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy; raise TypeError or ValueError where a field of a camera does not fit."""
    viewmat, K = camera.viewmat, camera.K
    check_tensors({"viewmat": (viewmat, (4, 4))})
    check_tensors({"K": (K, (3, 3))}, device=viewmat.device)
    pose, intrinsics = viewmat.detach().double().cpu(), K.detach().double().cpu()
    check_finite("viewmat", pose)
    check_finite("K", intrinsics)
    check_integer("width", camera.width, 1)
    check_integer("height", camera.height, 1)
    check_number("near", camera.near, 0, LARGEST_DISTANCE)
    rotation, moved = pose[:3, :3], pose[:3, 3]
    error = (rotation.T @ rotation - torch.eye(3, dtype=pose.dtype)).abs().max().item()
    last_row = (pose[3] - pose.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().max()
    (fx, skew, cx), (shear, fy, cy), last = intrinsics.tolist()
    orthonormal = f"an orthonormal rotation (max |R^T R - 1| <= {ROTATION_TOLERANCE:g})"
    proper, mirroring = "a rotation with determinant 1", "a mirroring one (determinant < 0)"
    lengths = f"focal lengths > 0, at least {SMALLEST_FOCAL:g}"
    checks = [
        (error <= ROTATION_TOLERANCE, f"viewmat: expected {orthonormal}, got {error:.3g}"),
        (torch.linalg.det(rotation) >= 0, f"viewmat: expected {proper}, got {mirroring}"),
        (last_row <= ROTATION_TOLERANCE, f"viewmat: expected the last row (0, 0, 0, 1), got {(*pose[3].tolist(),)}"),
        (
            moved.abs().max() <= LARGEST_DISTANCE,
            f"viewmat: expected a translation of at most {LARGEST_DISTANCE:g}, got {(*moved.tolist(),)}",
        ),
        (min(fx, fy) >= SMALLEST_FOCAL, f"K: expected {lengths}, got fx={fx:g}, fy={fy:g}"),
        (skew == shear == 0, f"K: expected no skew, got K[0, 1]={skew:g}, K[1, 0]={shear:g}"),
        (last == [0.0, 0.0, 1.0], f"K: expected the last row (0, 0, 1), got {tuple(last)}"),
    ]
    for fits, message in checks:
        if not fits:
            raise ValueError(message)
    return fx, fy, cx, cy


def in_image(pixels: torch.Tensor, depths: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Return (M,) bool: which pixel coordinates (M, 2) with z-depths (M,) are in an image; NaN and <= 0 are not."""
    size = torch.tensor([width, height], device=pixels.device)
    return (depths > 0) & ((pixels >= 0) & (pixels < size)).all(-1)


def visible_points(
    pixels: torch.Tensor, depths: torch.Tensor, width: int, height: int, mask: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Select the points that project into an image, and where there is a mask (H, W), to True.

    Return the row-major indices (P,) of their pixels, and their z-depths (P,).
    """
    inside = in_image(pixels, depths, width, height)
    column, row = pixels[inside].long().unbind(-1)
    places, expected = row * width + column, depths[inside]
    if mask is not None:
        included = mask.flatten()[places]
        places, expected = places[included], expected[included]
    return places, expected


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with another image size in pixels and the same vertical field of view.

    Pixels keep their aspect ratio: another aspect ratio of the image shows more or less at the sides. The principal
    point keeps its offset from the centre, relative to the height.
    """
    check_range("width", width, 1)
    check_range("height", height, 1)
    if (width, height) == (camera.width, camera.height):
        return camera
    scale = height / camera.height
    fx, fy, cy = (number * scale for number in (camera.fx, camera.fy, camera.cy))
    cx = (camera.cx - camera.width / 2) * scale + width / 2
    K = camera.K.new_tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])  # one copy to a GPU
    fx, fy, cx, cy = torch.tensor([fx, fy, cx, cy], dtype=K.dtype).tolist()  # as K has them
    checked = (fx, fy, cx, cy) if min(fx, fy) >= SMALLEST_FOCAL and math.isfinite(fx + fy + cx + cy) else None
    return replace(camera, K=K, width=width, height=height, checked=checked)


def reduced(camera: Camera, height: int) -> Camera:
    """Return the camera with an image at most `height` pixels tall, in the same aspect ratio."""
    if camera.height <= height:
        return camera
    return resized(camera, max(round(camera.width * height / camera.height), 1), height)
