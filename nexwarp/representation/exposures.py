"""Exposures: how bright each training photo is, a gain a channel, and what a camera between them would take.

Phones and cameras set their exposure and white balance anew for every photo, and lenses darken the corners
(vignetting). A model that has to explain the differences by its surfels learns what no other view agrees with; here it
learns the scene as at the mean exposure and through an even lens, and a rendering takes the gains of the photos around
it and the falloff of the lens.
"""

from collections.abc import Sequence

import torch
from torch import nn

from nexwarp.camera import Camera
from nexwarp.checks import check_tensors
from nexwarp.determinism import one_thread

DECIMALS = 6  # of log gains: the solver's rounding must not make a run another one
MOST_PHOTOS = 1000  # that renderings take their gains from
EVEN = (0.0, 0.0, 1.0)  # the falloff of a lens without any

LENGTHS = (0.4, 0.8, 1.6, 3.2, 6.4)  # of the kernel, over the spread of the cameras

MOST_FALLOFFS = 16  # of different cameras, to be kept
NOISES = (1e-3, 1e-2, 1e-1)  # variance of a photo's own deviation, over that of the process

TINY = 1e-9  # squared error that is none


class Exposures(nn.Module):
    """Gains of photos by the pose of their cameras: a Gaussian process with the Matern 3/2 kernel.

    Places between the photos, whose gains were predicted (`nexwarp.finish.auto_exposure`), count as photos do.

    Buffers: `log_gains` (V, 3); `positions` (V, 3) of the cameras, world units; `directions` (V, 3) unit, where they
    look; `coefficients` (V, 3) and `mean` (3,) of the process; `lengths` (2,) world units: what a direction's change by
    1 counts, and the kernel's length; `falloff` (3,): a, b and the largest T > 0 of the lens, which leaves
    exp(a t + b t^2) of the light, where t = min(tan^2 / T, 1) and tan that of the angle to the optical axis.
    """

    log_gains: torch.Tensor
    positions: torch.Tensor
    directions: torch.Tensor
    coefficients: torch.Tensor
    mean: torch.Tensor
    lengths: torch.Tensor
    falloff: torch.Tensor

    def __init__(
        self,
        log_gains: torch.Tensor,
        positions: torch.Tensor,
        directions: torch.Tensor,
        coefficients: torch.Tensor,
        mean: torch.Tensor,
        lengths: torch.Tensor,
        falloff: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        if falloff is None:  # as in files from before there was one
            falloff = lengths.new_tensor(EVEN)
        shapes = {
            "log_gains": (log_gains, ("V", 3)),
            "positions": (positions, ("V", 3)),
            "directions": (directions, ("V", 3)),
            "coefficients": (coefficients, ("V", 3)),
            "mean": (mean, (3,)),
            "lengths": (lengths, (2,)),
            "falloff": (falloff, (3,)),
        }
        check_tensors(shapes)
        for name, (tensor, _) in shapes.items():
            self.register_buffer(name, tensor)
        self._read_falloff()
        self.register_load_state_dict_post_hook(lambda module, _: module._read_falloff())

    def _read_falloff(self) -> None:
        """Keep the falloff as numbers, so that a rendering need not wait for the GPU."""
        a, b, largest = self.falloff.tolist()
        if not largest > 0:
            raise ValueError(f"falloff: expected a largest squared tangent > 0, got {largest:g}")
        self._lens = (a, b, largest)
        self._falloffs: dict[tuple[object, ...], torch.Tensor] = {}

    @classmethod
    def of(
        cls, log_gains: torch.Tensor, cameras: Sequence[Camera], falloff: Sequence[float] | None = None
    ) -> "Exposures":
        """Exposures of photos with log gains (V, 3) that these V cameras took, V >= 1; float32 on the CPU.

        `falloff` (3,) is the lens's, None is an even one.

        How far gains reach and how exact they are is what would have predicted each photo best from the others.
        """
        viewmats = torch.stack([camera.viewmat.cpu().double() for camera in cameras])
        every = -(-len(cameras) // MOST_PHOTOS)
        positions, directions = (x[::every] for x in _poses(viewmats))
        gains = log_gains.double()[::every]
        with one_thread():
            size, squares = _apart(positions, directions)
            kernels = [(_matern(squares, length * size), length * size) for length in LENGTHS]
            fits = [(*_fit(kernel, gains, noise), length) for kernel, length in kernels for noise in NOISES]
            _, _, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
        return cls(
            gains.float(),
            positions.float(),
            directions.float(),
            coefficients.round(decimals=5).float(),
            mean.float(),
            torch.stack([size, length]).float(),
            torch.tensor([float(x) for x in falloff or EVEN]),
        )

    def tensors(self) -> dict[str, torch.Tensor]:
        """Its buffers by name; `Exposures(**tensors)` makes it again."""
        return dict(self.named_buffers())

    @torch.no_grad()
    def gains(self, camera: Camera) -> torch.Tensor:
        """Gains (3,) for the colours of a rendering; never beyond those of the photos, and their mean far away."""
        position, direction = _poses(camera.viewmat.to(self.positions))
        turned = self.lengths[0] * (self.directions - direction)
        squares = (self.positions - position).square().sum(1) + turned.square().sum(1)
        found = self.mean + _matern(squares, self.lengths[1]) @ self.coefficients
        return found.clamp(self.log_gains.amin(0), self.log_gains.amax(0)).exp()

    @torch.no_grad()
    def factors(self, camera: Camera) -> torch.Tensor:
        """What the colours (H, W, 3) of a rendering are times: (H, W, 3), or (3,) where the lens is even."""
        gains, light = self.gains(camera), self.falloff_of(camera)
        return gains if light is None else light * gains

    @torch.no_grad()
    def falloff_of(self, camera: Camera) -> torch.Tensor | None:
        """What the lens leaves of the light at each pixel, (H, W, 1), not to be written to; None where it is even."""
        a, b, largest = self._lens
        if a == b == 0:
            return None
        device = self.falloff.device
        key = (device, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        found = self._falloffs.get(key)
        if found is None:
            x = (torch.arange(camera.width, device=device) + 0.5 - camera.cx) / camera.fx
            y = (torch.arange(camera.height, device=device) + 0.5 - camera.cy) / camera.fy
            t = ((x**2 + (y**2)[:, None]) / largest).clamp(max=1.0)
            if len(self._falloffs) >= MOST_FALLOFFS:
                self._falloffs.clear()
            found = self._falloffs[key] = (t * (a + b * t)).exp()[..., None]
        return found


def _matern(squares: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
    """Matern 3/2 kernel of squared distances."""
    r = (3 * squares).sqrt() / length
    return (1 + r) * torch.exp(-r)


def _apart(positions: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Spread of cameras' positions (V, 3), and squares (V, V) of how far poses are apart."""
    size = (positions - positions.mean(0)).square().sum(1).mean().sqrt().clamp_min(1e-12)
    poses = torch.cat([positions, size * directions], 1)
    return size, torch.cdist(poses, poses).square()


def _fit(
    kernel: torch.Tensor, values: torch.Tensor, noise: float
) -> tuple[float, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Fit a process to values (V, 3).

    Returns:
        The sum of squares of the next; errors (V, 3) of each from the others; coefficients (V, 3); mean (3,).
    """
    inverse = torch.linalg.inv(kernel + noise * torch.eye(len(values), dtype=values.dtype))
    mean = inverse.sum(0) @ values / inverse.sum()
    coefficients = inverse @ (values - mean)
    errors = coefficients / inverse.diagonal()[:, None]
    return round(errors.square().sum().item(), 9), errors, coefficients, mean


def _poses(viewmats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and viewing directions (..., 3) of world-to-camera matrices (..., 4, 4)."""
    rotation, shift = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    return -(rotation.mT @ shift)[..., 0], rotation[..., 2, :]
