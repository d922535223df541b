"""Exposures: a gain per training photo and channel, predicted for other cameras. Not in the paper.

Cameras set exposure and white balance anew for each photo, and lenses darken the corners (vignetting). Surfels that had
to explain these differences would fit each photo with errors in all other views. The surfels are therefore trained at
the mean exposure and without vignetting. A rendering is multiplied by the gains that the photos near its camera
predict, and by the falloff of the lens.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import nn

from nexwarp.cameras.camera import Camera, StagedCamera
from nexwarp.cameras.ray_camera import RayCamera
from nexwarp.errors import check_tensors
from nexwarp.machine import torch_threads

DECIMALS = 6  # of log gains: rounding errors of the solver must not change a run
MOST_PHOTOS = 1000  # largest number of photos that are kept
EVEN = (0.0, 0.0, 1.0)  # the falloff of a lens without vignetting

LENGTHS = (0.4, 0.8, 1.6, 3.2, 6.4)  # candidates of the kernel's length, relative to the spread of the cameras
NOISES = (1e-3, 1e-2, 1e-1)  # candidates of the noise variance, relative to that of the process
MOST_FALLOFFS = 16  # largest number of falloff images that are cached
SHAPES = {
    "log_gains": ("V", 3),
    "positions": ("V", 3),
    "directions": ("V", 3),
    "coefficients": ("V", 3),
    "mean": (3,),
    "lengths": (2,),
    "falloff": (3,),
}


class Exposures(nn.Module):
    """Gaussian process with a Matern 3/2 kernel that predicts gains from camera poses, fitted to V photos.

    The V photos of older models may include virtual ones between the cameras.

    Buffers:
        log_gains: (V, 3) logarithms of the photos' gains.
        positions: (V, 3) positions of the cameras, world units.
        directions: (V, 3) unit viewing directions, world frame.
        coefficients: (V, 3) coefficients of the process.
        mean: (3,) mean log gain of the process.
        lengths: (2,) world units: the distance that equals a change of the direction by 1, and the kernel's length.
        falloff: (3,) a, b and T > 0. The lens transmits exp(a t + b t^2) of the light, where t = min(tan^2(x) / T, 1)
            and x is the angle to the optical axis.

    Raises:
        TypeError, ValueError: a type, shape, device or value does not fit; the message names the argument.
    """

    log_gains: torch.Tensor
    positions: torch.Tensor
    directions: torch.Tensor
    coefficients: torch.Tensor
    mean: torch.Tensor
    lengths: torch.Tensor
    falloff: torch.Tensor

    def __init__(self, buffers: Mapping[str, torch.Tensor]) -> None:
        """Take the buffers by name; without `falloff`, which older model files do not have, the lens has none."""
        super().__init__()
        missing = [name for name in SHAPES if name not in buffers and name != "falloff"]
        if missing:
            raise ValueError(f"exposures: expected {missing[0]}, found none")
        buffers = {"falloff": buffers["lengths"].new_tensor(EVEN), **buffers}
        check_tensors({name: (buffers[name], shape) for name, shape in SHAPES.items()})
        if not 1 <= (count := len(buffers["log_gains"])) <= MOST_PHOTOS:
            raise ValueError(f"exposures: expected 1 to {MOST_PHOTOS:,} photos, got {count:,}")
        for name in SHAPES:
            self.register_buffer(name, buffers[name])
        self._read_falloff()
        self.register_load_state_dict_post_hook(Exposures._read_falloff)  # no lambda: models can be pickled

    def _read_falloff(self, *_: object) -> None:
        """Copy the falloff to Python numbers, so that renderings do not wait for the GPU."""
        a, b, largest = self.falloff.tolist()
        if not largest > 0:
            raise ValueError(f"falloff: expected a largest squared tangent > 0, got {largest:g}")
        self.lens = (a, b, largest)
        self._falloffs: dict[tuple[object, ...], torch.Tensor] = {}

    @classmethod
    def of(
        cls, log_gains: torch.Tensor, cameras: Sequence[Camera], falloff: Sequence[float] | None = None
    ) -> "Exposures":
        """Fit exposures, float32 on the CPU, to the log gains (V, 3) of V >= 1 photos.

        The kernel's length and the noise are those that best predict each photo from the others. Of many photos,
        every n-th is kept, at most 1,000. A falloff of None is a lens without vignetting.
        """
        viewmats = torch.stack([camera.viewmat.detach().cpu().double() for camera in cameras])
        stride = -(-len(cameras) // MOST_PHOTOS)
        positions, directions = (x[::stride] for x in poses_of(viewmats))
        gains = log_gains.double()[::stride]
        with torch_threads(1):
            size = (positions - positions.mean(0)).square().sum(1).mean().sqrt().clamp_min(1e-12)  # RMS spread
            poses = torch.cat([positions, size * directions], 1)
            squares = torch.cdist(poses, poses).square()
            kernels = [(matern_kernel(squares, length * size), length * size) for length in LENGTHS]
            fits = [(*fit_process(kernel, gains, noise), length) for kernel, length in kernels for noise in NOISES]
            _, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
        buffers = {
            "log_gains": gains,
            "positions": positions,
            "directions": directions,
            "coefficients": coefficients.round(decimals=5),
            "mean": mean,
            "lengths": torch.stack([size, length]),
            "falloff": torch.tensor([float(x) for x in falloff or EVEN]),
        }
        return cls({name: x.float() for name, x in buffers.items()})

    @torch.no_grad()
    def gains(self, camera: Camera | RayCamera) -> torch.Tensor:
        """Return a camera's gains (3,), within the range of the photos' gains; far from all photos, their mean."""
        position, direction = poses_of(camera.viewmat.to(self.positions))
        turned = self.lengths[0] * (self.directions - direction)
        squares = (self.positions - position).square().sum(1) + turned.square().sum(1)
        log_gains = self.mean + (matern_kernel(squares, self.lengths[1])[..., None] * self.coefficients).sum(-2)
        return log_gains.clamp(self.log_gains.amin(0), self.log_gains.amax(0)).exp()

    @torch.no_grad()
    def factors(self, camera: Camera | RayCamera) -> torch.Tensor:
        """Return gains times falloff of a camera, (H, W, 3), or (3,) for a lens without vignetting."""
        gains, light = self.gains(camera), self.falloff_of(camera)
        return gains if light is None else light * gains

    @torch.inference_mode(False)  # a later training may use what is cached
    @torch.no_grad()
    def falloff_of(self, camera: Camera | RayCamera) -> torch.Tensor | None:
        """Return the fraction of light (H, W, 1) that the lens transmits; cached: callers must not write to it.

        None for a lens without vignetting, and for a `RayCamera`, whose lens is not that of the photos.
        """
        if isinstance(camera, StagedCamera):
            return camera.falloff
        a, b, largest = self.lens
        if a == b == 0 or isinstance(camera, RayCamera):
            return None
        device = self.falloff.device
        key = (device, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        falloff = self._falloffs.get(key)
        if falloff is None:
            x = (torch.arange(camera.width, device=device) + 0.5 - camera.cx) / camera.fx
            y = (torch.arange(camera.height, device=device) + 0.5 - camera.cy) / camera.fy
            t = ((x**2 + (y**2)[:, None]) / largest).clamp(max=1.0)
            if len(self._falloffs) >= MOST_FALLOFFS:
                self._falloffs.clear()
            falloff = self._falloffs[key] = (t * (a + b * t)).exp()[..., None]
        return falloff


def matern_kernel(squares: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
    """Evaluate the Matern 3/2 kernel at squared distances."""
    r = (3 * squares).sqrt() / length
    return (1 + r) * torch.exp(-r)


def fit_process(kernel: torch.Tensor, values: torch.Tensor, noise: float) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Return the sum of the squared errors of predicting each value (V, 3) from the others, coefficients and mean."""
    inverse = torch.linalg.inv(kernel + noise * torch.eye(len(values), dtype=values.dtype))
    mean = inverse.sum(0) @ values / inverse.sum()
    coefficients = inverse @ (values - mean)
    errors = coefficients / inverse.diagonal()[:, None]
    return round(errors.square().sum().item(), 9), coefficients, mean


def poses_of(viewmats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return positions and viewing directions (..., 3) of world-to-camera matrices (..., 4, 4)."""
    rotation, shift = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    return -(rotation * shift).sum(-2), rotation[..., 2, :]
