"""What a picture is taken with: another projection, a lens of a certain aperture, or a shutter that stays open."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, cast, get_args

import torch
from typing_extensions import Unpack

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import camera_poses, with_pose
from nexwarp.cameras.ray_camera import MAX_SIDE, RayCamera
from nexwarp.errors import SettingError
from nexwarp.model.model import Model
from nexwarp.model.options import RenderChanges

Kind = Literal["pinhole", "panorama", "fisheye", "orthographic"]
KINDS = get_args(Kind)
SAMPLES = 16
MOST_SAMPLES = 4096
GOLDEN_ANGLE = math.pi * (3 - 5**0.5)


@dataclass(frozen=True)
class Optics:
    """Options of taking pictures.

    Attributes:
        kind: projection. A panorama shows the whole sphere, a fisheye is equidistant; an orthographic view shows what
            is at the middle depth as large as a pinhole does.
        fov: angle that the smaller side of a fisheye image shows, degrees.
        aperture: diameter of the lens, world units; 0 is a pinhole.
        focus: z-depth of the plane in focus, world units; None is the median depth of each picture.
        shutter: share of the time to a path's next frame in which the shutter is open; 0 is an instant.
        samples: renderings that are averaged for a lens or an open shutter.

    Raises:
        SettingError: the message names the option.
    """

    kind: Kind = "pinhole"
    fov: float = 180.0
    aperture: float = 0.0
    focus: float | None = None
    shutter: float = 0.0
    samples: int | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise SettingError(f"--camera: expected {', '.join(KINDS)}, got {self.kind!r}")
        if not 1 <= self.fov <= 360:
            raise SettingError(f"--fov: expected 1 to 360 degrees, got {self.fov:g}")
        if self.fov != 180.0 and self.kind != "fisheye":
            raise SettingError(f"--fov: expected together with --camera fisheye, got --camera {self.kind}")
        if not 0 <= self.aperture < math.inf:
            raise SettingError(f"--aperture: expected a diameter of at least 0, got {self.aperture:g}")
        if self.focus is not None and not 0 < self.focus < math.inf:
            raise SettingError(f"--focus: expected a depth above 0, got {self.focus:g}")
        if self.focus is not None and self.aperture == 0:
            raise SettingError("--focus: expected together with --aperture, got no --aperture")
        if not 0 <= self.shutter <= 1:
            raise SettingError(f"--shutter: expected 0 to 1, got {self.shutter:g}")
        if self.kind != "pinhole" and self.aperture > 0:
            raise SettingError(f"--aperture: expected together with --camera pinhole, got --camera {self.kind}")
        if self.samples is not None:
            if not 1 <= self.samples <= MOST_SAMPLES:
                raise SettingError(f"--samples: expected 1 to {MOST_SAMPLES}, got {self.samples}")
            if not self.averages:
                raise SettingError("--samples: expected together with --aperture or --shutter, got neither")

    @property
    def averages(self) -> bool:
        """Whether a picture is the mean of several renderings."""
        return self.aperture > 0 or self.shutter > 0

    @property
    def plain(self) -> bool:
        """Whether a picture is what `Model.render` shows."""
        return self.kind == "pinhole" and not self.averages

    @torch.no_grad()
    def image(
        self, model: Model, camera: Camera, following: Camera | None = None, **changes: Unpack[RenderChanges]
    ) -> torch.Tensor:
        """Return a picture (H, W, 3), not clamped.

        Args:
            model: the model, on the device to render on.
            camera: pose and size of the picture.
            following: the camera of the path's next frame, towards which an open shutter sees the camera move.
            changes: see `Model.render`.
        """
        if self.aperture == 0 and (self.shutter == 0 or following is None):
            return model.render(self._taken(model, camera), **changes).image
        focus = self.focus
        if focus is None and self.aperture > 0:
            focus = middle_depth(model, camera)
        count = self.samples or SAMPLES
        # One sum for lens and shutter: the points of the lens come in a random order, whatever the time.
        places = torch.randperm(count, generator=torch.Generator().manual_seed(0)).tolist()
        total = torch.zeros(camera.height, camera.width, 3, device=model.device)
        for index, place in enumerate(places):
            moment = camera if following is None else moved(camera, following, self.shutter * (index + 0.5) / count)
            if focus is not None:
                moment = seen_from(moment, lens_point(place, count, self.aperture), focus)
            total += model.render(self._taken(model, moment), **changes).image
        return total / count

    def _taken(self, model: Model, camera: Camera) -> Camera | RayCamera:
        """Return the camera of the projection, at the pose of a pinhole of the picture's size."""
        viewmat, size = camera.viewmat.float(), (camera.width, camera.height)
        if self.kind == "panorama":
            return RayCamera.panorama(viewmat, *size, near=camera.near)
        if self.kind == "fisheye":
            angle = math.radians(self.fov)
            focal = min(size) / angle
            K = torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
            return RayCamera.fisheye(viewmat, K.to(viewmat), (0, 0, 0, 0), *size, near=camera.near)
        if self.kind == "orthographic":
            pixel = middle_depth(model, camera) / camera.focal
            return RayCamera.orthographic(viewmat, *size, pixel, near=camera.near)
        return camera

    def resized(self, camera: Camera) -> Camera:
        """Return a camera with the size that the projection has by default.

        A panorama's pixels are as large as the photos' in their middle; a fisheye image is a square.
        """
        if self.kind not in ("panorama", "fisheye"):
            return camera
        height = camera.height
        width = height
        if self.kind == "panorama":
            height = max(min(round(math.pi * camera.focal), MAX_SIDE // 2), 2)
            width = 2 * height
        return dataclasses.replace(camera, width=width, height=height)


PLAIN = Optics()


def middle_depth(model: Model, camera: Camera) -> float:
    """Return the median z-depth of a rendering, world units; where nothing is hit, the scene's scale."""
    depths = model.render(camera).median_depth
    seen = depths[depths > 0]
    return seen.median().item() if len(seen) else float(cast(float, model.meta.get("scene_scale", 1.0)))


def lens_point(index: int, count: int, aperture: float) -> tuple[float, float]:
    """Return one of `count` points that cover a lens of a diameter evenly (a sunflower), world units."""
    radius, angle = 0.5 * aperture * math.sqrt((index + 0.5) / count), index * GOLDEN_ANGLE
    return radius * math.cos(angle), radius * math.sin(angle)


def seen_from(camera: Camera, point: tuple[float, float], focus: float) -> Camera:
    """Return the camera as a point of its lens sees: moved sideways, with the plane at z-depth `focus` held in place.

    Args:
        camera: the camera at the lens's middle.
        point: x and y of the lens's point in the camera frame, world units.
        focus: z-depth of the plane in focus, world units.
    """
    viewmat, K = camera.viewmat.clone(), camera.K.clone()
    viewmat[0, 3] -= point[0]
    viewmat[1, 3] -= point[1]
    K[0, 2] += camera.fx * point[0] / focus
    K[1, 2] += camera.fy * point[1] / focus
    return Camera(viewmat, K, camera.width, camera.height, camera.near)


def moved(camera: Camera, following: Camera, time: float) -> Camera:
    """Return a camera on its way to another one, at a time from 0 to 1: centres and rotations are interpolated."""
    from scipy.spatial.transform import Rotation, Slerp

    viewmats, centers = camera_poses([camera, following])
    rotation = Slerp([0.0, 1.0], Rotation.from_matrix(viewmats[:, :3, :3].numpy()))(time)
    position = torch.lerp(centers[0], centers[1], time)
    return with_pose(camera, torch.from_numpy(rotation.as_matrix()), position)
