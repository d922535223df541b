"""Panoramas, fisheye lenses and other rays from one point: resampled from pinhole pictures, the faces of a cube."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.cameras.ray_camera import RayCamera
from nexwarp.model.options import color_tensor
from nexwarp.model.render import Frame, Rendering, draw

FINER = 2.0  # resolution of a face's middle over that of the ray camera
MOST_FINER = 4096  # pixels along a face's side that FINER asks for, at most
MARGIN = 2  # pixels around a face: bilinear samples at its border need them
FACING = (  # rows: right, down and forward of each face, in the ray camera's frame
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
)


class Face(Camera):
    """A pinhole camera that shows the detail of another's pixels, whose focal length is `focal`."""

    def __init__(self, camera: RayCamera, facing: torch.Tensor) -> None:
        """Look along the last row of `facing` (3, 3), the axes of the face in the ray camera's frame."""
        side = max(min(math.ceil(2 * FINER * camera.focal), MOST_FINER), math.ceil(2 * camera.focal), 2)
        whole = side + 2 * MARGIN
        turn = torch.eye(4).to(camera.viewmat)
        turn[:3, :3] = facing
        K = torch.tensor([[side / 2, 0, whole / 2], [0, side / 2, whole / 2], [0, 0, 1]]).to(camera.viewmat)
        super().__init__(turn @ camera.viewmat, K, whole, whole, camera.near)
        vars(self)["detail"] = camera.focal

    @property
    def focal(self) -> float:
        """Pixels of the ray camera in a world unit at depth 1."""
        return float(vars(self)["detail"])


@dataclass(frozen=True)
class Look:
    """Where pixels of a ray camera lie in the rendering of a face."""

    rendering: Rendering
    pixels: torch.Tensor  # (P,) int64, row * width + column of the ray camera
    places: torch.Tensor  # (P, 2) their x and y in the face, -1 and 1 at its borders

    def sampled(self, name: str, mode: str) -> torch.Tensor:
        """Return a buffer of the rendering at the places, (P, ...), `mode` being bilinear or nearest."""
        values = getattr(self.rendering, name)
        channels = values.flatten(2) if values.ndim > 2 else values[..., None]
        if not channels.shape[2]:
            return values.new_zeros(len(self.pixels), *values.shape[2:])
        image, places = channels.permute(2, 0, 1)[None].to(self.places), self.places[None, None]
        found = torch.nn.functional.grid_sample(image, places, mode, "border", align_corners=False)
        return found[0, :, 0].T.reshape(-1, *values.shape[2:]).to(values.dtype)


@dataclass(frozen=True)
class RayRendering(Rendering):
    """The buffers of a rendering by a `RayCamera`, resampled from the faces of a cube; not differentiable.

    Depths are in units of the pixels' rays, such as distances of panoramas and fisheye lenses. They, `ids`, `weights`
    and normals are those of the nearest pixel of a face. `alpha` is 0 where a pixel has no ray. `colors` and
    `blended_normals` are not there.
    """

    intermediates: "FaceBuffers"  # type: ignore[assignment]  # without those of an image plane

    @cached_property
    def _surface(self) -> ops.Surface:  # type: ignore[override]
        buffers = self.intermediates
        expected, median, top = (buffers.depths(name) for name in ("expected_depth", "median_depth", "top_depth"))
        return ops.Surface(expected, median, top, buffers.values("normals", "nearest"))


@dataclass(frozen=True)
class FaceBuffers:
    """Buffers of a ray camera, by the name of a property of `Rendering`."""

    lengths: torch.Tensor  # (H, W) of the rays' vectors, along the axes of their faces; 0 where there is no ray
    looks: list[Look]

    def values(self, name: str, mode: str, empty: Any = 0) -> torch.Tensor:
        """Return a buffer (H, W, ...), with `empty` where there is no ray."""
        parts = [look.sampled(name, mode) for look in self.looks]
        whole = parts[0].new_zeros(self.lengths.numel(), *parts[0].shape[1:]) + torch.as_tensor(empty).to(parts[0])
        for look, part in zip(self.looks, parts, strict=True):
            whole[look.pixels] = part
        return whole.view(*self.lengths.shape, *whole.shape[1:])

    def depths(self, name: str) -> torch.Tensor:
        """Return depths (H, W, ...) in units of the pixels' rays."""
        values = self.values(name, "nearest")
        lengths = self.lengths.where(self.lengths > 0, 1.0)
        return values / (lengths if values.ndim == 2 else lengths[..., None])


@torch.no_grad()
def draw_faces(camera: RayCamera, frame_of: Callable[[Camera], Frame]) -> RayRendering:
    """As `draw`, from a camera of rays: blended by distance, so that faces agree where they meet.

    `frame_of` returns what the picture of a face is drawn from.
    """
    rays = camera.rays.reshape(-1, 3).to(camera.viewmat)
    facings = torch.tensor(FACING).to(rays)
    lengths, faces = (rays @ facings[:, 2].T).max(dim=1)  # along the axis that a ray is closest to
    looks = []
    for index in faces[lengths > 0].unique().tolist() or [0]:
        face, pixels = Face(camera, facings[index]), ((faces == index) & (lengths > 0)).nonzero()[:, 0]
        frame, turned = frame_of(face), rays[pixels] @ facings[index].T
        places = turned[:, :2] / turned[:, 2:] * (face.fx / (face.width / 2))
        options = frame.options.changed(order="distance")
        looks.append(Look(draw(replace(frame, options=options, exposures=None)), pixels, places))
    buffers = FaceBuffers(lengths.view(camera.height, camera.width), looks)
    gains = frame.exposures if options.exposure == "photos" else None
    factors = 1.0 if gains is None else gains.factors(camera)
    background = color_tensor(frame.background, frame.surfels.means)
    image = buffers.values("image", "bilinear", background) * factors
    plain, textured = (buffers.values(name, "bilinear") * factors for name in ("plain", "textured"))
    ids, weights = buffers.values("ids", "nearest", -1), buffers.values("weights", "nearest")
    alpha = buffers.values("alpha", "bilinear")
    return RayRendering(image, plain, textured, ids, buffers.depths("depths"), weights, alpha, buffers)
