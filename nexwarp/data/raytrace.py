"""An exact ray tracer for textured rectangles, in numpy: the ground truth of the demo scene.

Symbols: a rectangle is origin + a u + b v with 0 <= a, b <= 1, a ray is start + t d. With the columns
M = (u, v, origin - start), M (a, b, 1) = t d, so one solve gives (a, b, 1) / t = M^-1 d, linear in d.
Rectangles are visible only from the side of their normal v x u, where the texture is not mirrored.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SHADOW_BIAS = 1e-4  # relative to the distance, so that a surface does not shade itself
HIGHLIGHT_EXPONENT = 40.0
MIN_DEPTH = 1e-3  # a corner with a smaller depth leaves the window unbounded


@dataclass(frozen=True)
class Rectangle:
    """A flat textured rectangle.

    Attributes:
        origin: (3,) float64 corner a = b = 0, world frame.
        u: (3,) float64 edge along the texture's columns.
        v: (3,) float64 edge along the texture's rows, orthogonal to `u`; the front is the side of v x u.
        texture: (h, w, 3) float32 in [0, 1], bilinear between texel centres, light included.
        gloss: strength of the highlight, 0 for matt.
    """

    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    texture: np.ndarray
    gloss: float = 0.0

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal of the front."""
        normal = np.cross(self.v, self.u)
        return normal / np.linalg.norm(normal)

    def at(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(..., 3) world positions of the coordinates `a`, `b`."""
        return self.origin + a[..., None] * self.u + b[..., None] * self.v

    def solve(self, start: np.ndarray) -> np.ndarray | None:
        """(3, 3) matrix that maps directions from `start` to (a, b, 1) / t; None if `start` is behind the rectangle."""
        if (start - self.origin) @ self.normal < 1e-9:
            return None
        return np.linalg.inv(np.stack([self.u, self.v, self.origin - start], axis=1))


@dataclass(frozen=True)
class RayHits:
    """The first rectangle on each ray, with the rays' shape (...).

    Attributes:
        ids: (...) int32 index of the rectangle, -1 without a hit.
        a: (...) coordinate along u.
        b: (...) coordinate along v.
        nearness: (...) 1 / t, 0 without a hit.
    """

    ids: np.ndarray
    a: np.ndarray
    b: np.ndarray
    nearness: np.ndarray


def first_hits(
    rectangles: Sequence[Rectangle],
    start: np.ndarray,
    directions: np.ndarray,
    windows: Sequence[tuple[slice, ...]] | None = None,
) -> RayHits:
    """Find the first rectangle on each ray from `start`.

    Args:
        rectangles: the scene.
        start: (3,) world position.
        directions: (..., 3) world directions, of any length.
        windows: for each rectangle the slices of the ray array that can hit it; None is all rays.
    """
    shape = directions.shape[:-1]
    ids = np.full(shape, -1, dtype=np.int32)
    a, b, nearness = (np.zeros(shape, dtype=directions.dtype) for _ in range(3))
    for index, rectangle in enumerate(rectangles):
        inverse = rectangle.solve(start)
        if inverse is None:
            continue
        window = (slice(None),) * len(shape) if windows is None else windows[index]
        over_t = directions[window] @ inverse.T.astype(directions.dtype)
        a_over_t, b_over_t, near = np.moveaxis(over_t, -1, 0)
        hit = _inside(a_over_t, b_over_t, near) & (near > nearness[window])
        ids[window][hit] = index
        nearness[window][hit] = near[hit]
        a[window][hit] = a_over_t[hit] / near[hit]
        b[window][hit] = b_over_t[hit] / near[hit]
    return RayHits(ids, a, b, nearness)


def visible(rectangles: Sequence[Rectangle], start: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) bool: no rectangle is between `start` (3,) and `points` (N, 3), except the points' own surface."""
    directions = np.ascontiguousarray((points - start).T)
    clear = np.ones(len(points), dtype=bool)
    for rectangle in rectangles:
        inverse = rectangle.solve(start)
        if inverse is not None:
            a, b, near = inverse @ directions
            clear &= ~(_inside(a, b, near) & (near > 1.0 + SHADOW_BIAS))
    return clear


def _inside(a_over_t: np.ndarray, b_over_t: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Whether a hit is in front of the start and inside its rectangle, without a division."""
    inside = near > 0.0
    for coordinate in (a_over_t, b_over_t):
        inside &= (coordinate >= 0.0) & (coordinate <= near)
    return inside


def sample_texture(texture: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, c) bilinear values of a (h, w, c) texture at `a`, `b` (N,); clamped at the border."""
    height, width = texture.shape[:2]
    x = np.clip(a * width - 0.5, 0.0, width - 1.0)
    y = np.clip(b * height - 0.5, 0.0, height - 1.0)
    left = np.minimum(x.astype(np.int64), max(width - 2, 0))
    top = np.minimum(y.astype(np.int64), max(height - 2, 0))
    x, y = (x - left)[:, None].astype(np.float32), (y - top)[:, None].astype(np.float32)
    flat = texture.reshape(height * width, -1)
    right, down = min(width - 1, 1), min(height - 1, 1) * width
    corner = top * width + left
    above = flat[corner] * (1.0 - x) + flat[corner + right] * x
    below = flat[corner + down] * (1.0 - x) + flat[corner + down + right] * x
    return above * (1.0 - y) + below * y


def shade(rectangles: Sequence[Rectangle], hits: RayHits, start: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(..., 3) float32 colours of `hits` seen from `start` (3,), with highlights of a lamp at `light`."""
    image = np.zeros((*hits.ids.shape, 3), dtype=np.float32)
    for index in np.unique(hits.ids[hits.ids >= 0]):
        rectangle, here = rectangles[index], hits.ids == index
        a, b = hits.a[here], hits.b[here]
        color = sample_texture(rectangle.texture, a, b)
        if rectangle.gloss:
            position = rectangle.at(a, b)
            half = _unit(_unit(start - position) + _unit(light - position))
            highlight = np.maximum(half @ rectangle.normal, 0.0) ** HIGHLIGHT_EXPONENT
            color = color + (rectangle.gloss * highlight[:, None]).astype(np.float32)
        image[here] = color
    return np.clip(image, 0.0, 1.0)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def render(
    rectangles: Sequence[Rectangle],
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    light: np.ndarray,
    samples: int = 4,
) -> np.ndarray:
    """Render the rectangles with `samples` x `samples` rays per pixel.

    Args:
        rectangles: the scene.
        viewmat: (4, 4) float64 world to camera, OpenCV axes.
        K: (3, 3) float64 intrinsics in pixels, pixel centres at +0.5.
        size: width, height in pixels.
        light: (3,) position of the lamp for highlights.
        samples: number of rays along each side of a pixel.

    Returns:
        (H, W, 3) uint8.
    """
    width, height = size
    fine = K.copy()
    fine[:2] *= samples
    rotation, start = viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
    x = (np.arange(width * samples) + 0.5 - fine[0, 2]) / fine[0, 0]
    y = (np.arange(height * samples) + 0.5 - fine[1, 2]) / fine[1, 1]
    directions = (x[None, :, None] * rotation[0] + y[:, None, None] * rotation[1] + rotation[2]).astype(np.float32)
    windows = [_window(rectangle, viewmat, fine, directions.shape[:2]) for rectangle in rectangles]
    hits = first_hits(rectangles, start, directions, windows)
    image = shade(rectangles, hits, start, light)
    pixels = image.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    return np.floor(pixels * 255.0 + 0.5).astype(np.uint8)


def _window(rectangle: Rectangle, viewmat: np.ndarray, K: np.ndarray, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns that the projected rectangle can cover; all if a corner is behind the camera."""
    edges = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
    corners = rectangle.at(*edges) @ viewmat[:3, :3].T + viewmat[:3, 3]
    if corners[:, 2].max() < MIN_DEPTH:
        return slice(0, 0), slice(0, 0)
    if corners[:, 2].min() < MIN_DEPTH:
        return slice(None), slice(None)
    pixels = corners @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    low = np.clip(np.floor(pixels.min(axis=0) - 1.0), 0, shape[::-1]).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0) + 1.0), 0, shape[::-1]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])
