"""The demo's sparse points: a simulation of structure from motion with noise and outliers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nexwarp.data.raytrace import Rectangle, first_hits, sample_texture, visible

MIN_VIEWS = 3
POSITION_NOISE = 0.005  # standard deviation, in units of the cameras' distance from their mean
COLOR_NOISE = 3.0  # standard deviation, of 255
DETECTION_NOISE = 0.3  # standard deviation of an observation, in pixels
DETECTION_RATE = 0.7  # share of the views that detect a visible point
OUTLIER_RATE = 0.03
BORDER = 1.0  # pixels at the image border without observations


@dataclass(frozen=True)
class SparsePoint:
    """One triangulated point.

    Attributes:
        position: (3,) float64 world position, noise included.
        color: (3,) uint8.
        views: (n,) indices of the views that observed it, ascending.
        pixels: (n, 2) float64 pixel coordinates of the observations, noise included.
    """

    position: np.ndarray
    color: np.ndarray
    views: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Rig:
    """The cameras of all views.

    Attributes:
        K: (3, 3) float64 intrinsics in pixels, common to all views.
        viewmats: (V, 4, 4) float64, world to camera.
        size: width and height of the images in pixels.
    """

    K: np.ndarray
    viewmats: np.ndarray
    size: tuple[int, int]

    @property
    def centres(self) -> np.ndarray:
        """(V, 3) centres of projection in the world frame."""
        return -np.einsum("vji,vj->vi", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates (V, N, 2) of `points` (N, 3) in every view, and whether they lie in the image."""
        local = np.einsum("vij,nj->vni", self.viewmats[:, :3, :3], points) + self.viewmats[:, None, :3, 3]
        depth = local[..., 2:]
        ahead = depth[..., 0] > 0.1
        pixels = local[..., :2] / np.where(ahead[..., None], depth, 1.0) * self.K[[0, 1], [0, 1]] + self.K[:2, 2]
        inside = (pixels >= BORDER).all(axis=-1) & (pixels <= np.array(self.size) - BORDER).all(axis=-1)
        return pixels, ahead & inside


def sparse_points(
    rectangles: Sequence[Rectangle],
    rig: Rig,
    images: Sequence[np.ndarray],
    count: int,
    rng: np.random.Generator,
) -> list[SparsePoint]:
    """Simulate detection, matching and triangulation: surface points that at least 3 views see, and some outliers.

    Args:
        rectangles: the scene.
        rig: the cameras.
        images: (H, W, 3) uint8 image of each view; detection is more likely at high contrast.
        count: largest number of points.
        rng: generator of all random numbers.

    Returns:
        At most `count` points.
    """
    views, surface, colors, normals = _candidates(rectangles, rig, images, 2 * count, rng)
    pixels, seen = rig.project(surface)
    for view, centre in enumerate(rig.centres):
        toward = centre - surface
        seen[view] &= (toward * normals).sum(axis=1) > 0.15 * np.linalg.norm(toward, axis=1)
        here = np.flatnonzero(seen[view])
        seen[view, here] = visible(rectangles, centre, surface[here])
    seen &= rng.random(seen.shape) < DETECTION_RATE
    kept = np.flatnonzero(seen.sum(axis=0) >= MIN_VIEWS)[:count]
    extent = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).mean()
    colors = colors + rng.normal(0.0, COLOR_NOISE / 255.0, colors.shape)
    colors = np.clip(colors * 255.0 + 0.5, 0, 255).astype(np.uint8)
    positions = surface + rng.normal(0.0, POSITION_NOISE * extent, surface.shape)
    points = []
    for index in kept:
        outlier = _outlier(rig, views[index], surface[index], rng) if rng.random() < OUTLIER_RATE else None
        if outlier is None:
            tracked = np.flatnonzero(seen[:, index])
            found = pixels[tracked, index] + rng.normal(0.0, DETECTION_NOISE, (len(tracked), 2))
            outlier = positions[index], tracked, found
        position, tracked, found = outlier
        points.append(SparsePoint(position, colors[index], tracked, found))
    return points


def _candidates(
    rectangles: Sequence[Rectangle], rig: Rig, images: Sequence[np.ndarray], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Draw surface points at high contrast, in random order: views (N,), positions, colours and normals (N, 3)."""
    share = -(-count // len(images))
    found = []
    for view, (image, centre) in enumerate(zip(images, rig.centres, strict=True)):
        grey = image.astype(np.float64).mean(axis=2)
        contrast = sum(np.abs(gradient) for gradient in np.gradient(grey)) + 2.0
        chosen = rng.choice(grey.size, size=share, p=(contrast / contrast.sum()).ravel())
        rows, columns = np.unravel_index(chosen, grey.shape)
        pixels = np.stack([columns, rows], axis=1) + rng.random((share, 2))
        local = np.concatenate([(pixels - rig.K[:2, 2]) / rig.K[[0, 1], [0, 1]], np.ones((share, 1))], axis=1)
        directions = local @ rig.viewmats[view, :3, :3]
        hits = first_hits(rectangles, centre, directions)
        for index in np.unique(hits.ids[hits.ids >= 0]):
            rectangle, here = rectangles[index], hits.ids == index
            a, b = hits.a[here], hits.b[here]
            normals = np.broadcast_to(rectangle.normal, (len(a), 3))
            color = sample_texture(rectangle.texture, a, b)
            found.append((np.full(len(a), view), rectangle.at(a, b), color, normals))
    order = rng.permutation(sum(len(views) for views, *_ in found))
    return tuple(np.concatenate(column)[order] for column in zip(*found, strict=True))


def _outlier(
    rig: Rig, view: int, surface: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Simulate a wrong match: a point elsewhere on the viewing ray, with a short or inaccurate track.

    Returns:
        Position (3,), views (n,) and pixels (n, 2); None if too few views have the point in their image.
    """
    shift = rng.uniform(0.5, 0.85) if rng.random() < 0.5 else rng.uniform(1.2, 1.8)
    position = rig.centres[view] + shift * (surface - rig.centres[view])
    pixels, inside = rig.project(position[None])
    length, noise = ((2, 0.5), (3, 5.0))[rng.integers(2)]
    others = np.setdiff1d(np.flatnonzero(inside[:, 0]), [view])
    if len(others) < length - 1:
        return None
    tracked = np.sort(np.append(rng.choice(others, size=length - 1, replace=False), view))
    return position, tracked, pixels[tracked, 0] + rng.normal(0.0, noise, (length, 2))
