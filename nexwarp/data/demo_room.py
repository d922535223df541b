"""Geometry and light of the demo scene: a courtyard with a raised lawn, boxes with pictures and a cage of thin bars.

World frame: z up, floor at z = 0, the middle of the lawn at x = y = 0, units of about a metre. The pictures
are part of scikit-image's wheel, so nothing is downloaded.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from nexwarp.data.raytrace import Rectangle, sample_texture, visible

HALF_SIDE, WALL_HEIGHT, LAWN_HEIGHT = 4.2, 3.4, 0.3
LAMP = np.array([-1.6, -2.2, 3.2])
LAMP_SIDE, LAMP_STEPS, LAMP_POWER = 1.2, 4, 0.62
FILL_LIGHTS, FILL_POWER, AMBIENT = 20, 0.55, 0.34
# Texels per world unit and per pixel of image width.
OBJECT_DETAIL, FLOOR_DETAIL, WALL_DETAIL = 0.75, 0.5, 0.4

Paint = Callable[[float, float], np.ndarray]  # width and height in world units -> (h, w, 3) float32 texture


def build_room(width: int) -> list[Rectangle]:
    """Build the scene with baked light; `width`, that of the images in pixels, sets the resolution of the textures."""
    pictures = _pictures()
    rectangles = _courtyard(pictures, width) + _objects(pictures, width) + _cage(width)
    return _bake_light(rectangles)


def _pictures() -> dict[str, np.ndarray]:
    """Load the pictures by name, (h, w, 3) float32 in [0, 1] each."""
    from skimage import data

    names = "page brick grass gravel astronaut coins chelsea coffee rocket immunohistochemistry".split()
    pictures = {}
    for name in names:
        image = getattr(data, name)().astype(np.float32) / 255.0
        pictures[name] = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    pictures["brick"] = pictures["brick"].transpose(1, 0, 2)  # brick courses are horizontal
    pictures["title"] = pictures["page"][4:42, 0:288]
    pictures["wood"] = pictures["coffee"][5:165, 500:598]
    return pictures


def _picture(image: np.ndarray, detail: float, frame: float = 0.0) -> Paint:
    """Fit an image to a face, with a white frame whose width is in world units."""

    def paint(width: float, height: float) -> np.ndarray:
        texture = _resize(image, width, height, detail)
        border = round(frame * detail)
        if border:
            inner = _resize(image, width - 2 * frame, height - 2 * frame, detail)
            texture[:] = 0.93
            rows, columns = (
                min(inner.shape[0], len(texture) - border),
                min(inner.shape[1], texture.shape[1] - border),
            )
            texture[border : border + rows, border : border + columns] = inner[:rows, :columns]
        return texture

    return paint


def _tiles(image: np.ndarray, detail: float, period: float, tint: tuple[float, float, float]) -> Paint:
    """Tile a face with an image of `period` world units; neighbouring tiles are mirrored to avoid seams."""

    def paint(width: float, height: float) -> np.ndarray:
        tile = _resize(image, period, period, detail)
        tile = np.concatenate([tile, tile[::-1]])
        tile = np.concatenate([tile, tile[:, ::-1]], axis=1)
        rows, columns = (max(2, round(size * detail)) for size in (height, width))
        repeats = -(-rows // tile.shape[0]), -(-columns // tile.shape[1]), 1
        return np.clip(np.tile(tile, repeats)[:rows, :columns] * np.asarray(tint, np.float32), 0.0, 1.0)

    return paint


def _stripes(colors: list[tuple[float, float, float]], detail: float, period: float) -> Paint:
    """Bands of equal width along the longer side of a face."""

    def paint(width: float, height: float) -> np.ndarray:
        rows, columns = (max(2, round(size * detail)) for size in (height, width))
        position = (np.arange(max(rows, columns)) + 0.5) / detail / period
        bands = np.asarray(colors, np.float32)[position.astype(int) % len(colors)]
        bands = bands[None] if columns >= rows else bands[:, None]
        return np.broadcast_to(bands, (rows, columns, 3)).copy()

    return paint


def _resize(image: np.ndarray, width: float, height: float, detail: float) -> np.ndarray:
    from skimage.transform import resize

    shape = max(2, round(height * detail)), max(2, round(width * detail)), 3
    return np.clip(resize(image, shape, order=1, anti_aliasing=True), 0.0, 1.0).astype(np.float32)


def _rectangle(corner: ArrayLike, along: ArrayLike, down: ArrayLike, paint: Paint, gloss: float = 0.0) -> Rectangle:
    """A rectangle with a corner (3,) and two edges (3,); `down` is the direction of the texture's rows."""
    origin, u, v = (np.asarray(vector, dtype=np.float64) for vector in (corner, along, down))
    return Rectangle(origin, u, v, paint(float(np.linalg.norm(u)), float(np.linalg.norm(v))), gloss)


def _box(
    base: ArrayLike, size: tuple[float, float, float], yaw: float, sides: list[Paint], top: Paint, gloss: float = 0.0
) -> list[Rectangle]:
    """A box with the centre of its base at `base` (3,), rotated by `yaw` degrees about z.

    The sides are in the order -y, +x, +y, -x. The bottom is left out unless the box is above the lawn.
    """
    center, (length, depth, height) = np.asarray(base, dtype=np.float64), size
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    x, y, z = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0]), np.array([0.0, 0.0, 1.0])
    faces = []
    for index, (along, out, wide, deep) in enumerate(
        [(x, -y, length, depth), (y, x, depth, length), (-x, y, length, depth), (-y, -x, depth, length)]
    ):
        corner = center - along * wide / 2 + out * deep / 2 + z * height
        faces.append(_rectangle(corner, along * wide, -z * height, sides[index % len(sides)], gloss))
    corner = center - x * length / 2 + y * depth / 2
    faces.append(_rectangle(corner + z * height, x * length, -y * depth, top, gloss))
    if center[2] > LAWN_HEIGHT:
        faces.append(_rectangle(corner - y * depth, x * length, y * depth, top, gloss))
    return faces


def _courtyard(pictures: dict[str, np.ndarray], width: int) -> list[Rectangle]:
    """Gravel, four brick walls with a picture on each, a pale sky, and the lawn in the middle."""
    ground, far, near = (detail * width for detail in (FLOOR_DETAIL, WALL_DETAIL, OBJECT_DETAIL))
    side, height = HALF_SIDE, WALL_HEIGHT
    gravel = _tiles(pictures["gravel"], ground, 3.0, (1.25, 1.16, 1.02))
    brick = _tiles(pictures["brick"], far, 2.6, (1.5, 0.92, 0.68))
    sky = _tiles(np.full((2, 2, 3), 0.9, np.float32), far, 3.0, (0.9, 1.0, 1.1))
    room = [
        _rectangle((-side, side, 0.0), (2 * side, 0, 0), (0, -2 * side, 0), gravel),
        _rectangle((-side, -side, height), (2 * side, 0, 0), (0, 2 * side, 0), sky),
    ]
    posters = [pictures[name] for name in ("coffee", "chelsea", "rocket", "immunohistochemistry")]
    for quarter, poster in enumerate(posters):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        along, inward = np.array([cos, sin, 0.0]), np.array([sin, -cos, 0.0])
        corner = -along * side - inward * side + np.array([0.0, 0.0, height])
        room.append(_rectangle(corner, along * 2 * side, (0, 0, -height), brick))
        paper = _picture(poster, far, frame=0.07)
        white = _stripes([(0.9, 0.9, 0.88)], far, 1.0)
        room += _box(-inward * (side - 0.03) + [0, 0, 0.6], (2.1, 0.06, 1.45), 90.0 * quarter, [paper, white], white)
    lawn = _tiles(pictures["grass"], near, 1.7, (0.86, 1.12, 0.45))
    curb = _tiles(pictures["brick"], near, 1.3, (1.5, 1.3, 1.1))
    return room + _box((0, 0, 0), (2.9, 2.3, LAWN_HEIGHT), 0.0, [curb], lawn)


def _objects(pictures: dict[str, np.ndarray], width: int) -> list[Rectangle]:
    """A pillar of portraits, a printed page, a sign, a glossy crate and a block of coins."""
    detail = OBJECT_DETAIL * width
    portrait, cat = (
        _picture(pictures["astronaut"], detail, 0.03),
        _picture(pictures["chelsea"][:, 60:360], detail, 0.03),
    )
    page, title = _picture(pictures["page"], detail, 0.02), _picture(pictures["title"], detail)
    paper = _stripes([(0.93, 0.91, 0.85), (0.75, 0.72, 0.66)], detail, 0.035)
    wood = _tiles(pictures["wood"], detail, 0.5, (1.1, 1.1, 1.1))
    coins = _picture(pictures["coins"], detail)
    teal = _stripes([(0.1, 0.42, 0.46), (0.14, 0.5, 0.53)], detail, 0.11)
    base = LAWN_HEIGHT
    return [
        *_box((-0.25, 0.42, base), (0.78, 0.78, 0.98), 12.0, [portrait, cat], wood),
        *_box((-0.62, -0.62, base), (1.1, 0.58, 0.13), -14.0, [paper], page),
        *_box((0.98, -0.1, base), (0.07, 1.6, 0.24), -20.0, [wood, title, wood, title], wood),
        *_box((-1.08, 0.3, base), (0.42, 0.42, 0.42), 32.0, [teal], coins, gloss=0.35),
    ]


def _cage(width: int) -> list[Rectangle]:
    """A cube of twelve thin bars, two pixels wide in images of 192 pixels width."""
    detail, edge, bar = OBJECT_DETAIL * width, 0.62, 0.032
    stripes = _stripes([(0.86, 0.16, 0.12), (0.95, 0.93, 0.9)], detail, 0.104)
    center, yaw = np.array([0.42, -0.5, LAWN_HEIGHT]), 28.0
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    x, y, z = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0]), np.array([0.0, 0.0, 1.0])
    half, bars = (edge - bar) / 2, []
    for first in (-half, half):
        for second in (-half, half):
            bars += _box(center + first * x + second * y, (bar, bar, edge), yaw, [stripes], stripes)
            level = z * ((first + half) / (2 * half) * (edge - bar))
            bars += _box(center + second * y + level, (edge - 2 * bar, bar, bar), yaw, [stripes], stripes)
            bars += _box(center + second * x + level, (bar, edge - 2 * bar, bar), yaw, [stripes], stripes)
    return bars


def _bake_light(rectangles: list[Rectangle]) -> list[Rectangle]:
    """Multiply diffuse light with soft shadows into the textures."""
    grids = [_light_grid(rectangle) for rectangle in rectangles]
    points = np.concatenate([grid.reshape(-1, 3) for grid in grids])
    normals = np.repeat([rectangle.normal for rectangle in rectangles], [grid[..., 0].size for grid in grids], axis=0)
    # The walls of a convex room cast no shadows inside it.
    blockers = [rectangle for rectangle in rectangles if np.abs(rectangle.origin[:2]).max() < HALF_SIDE - 0.1]

    def lit(light: tuple[np.ndarray, float]) -> np.ndarray:
        toward = light[0] - points
        cosine = (toward * normals).sum(axis=1) / np.linalg.norm(toward, axis=1)
        facing = np.flatnonzero(cosine > 0.0)
        total = np.zeros(len(points))
        total[facing] = light[1] * cosine[facing] * visible(blockers, light[0], points[facing])
        return total

    with ThreadPoolExecutor() as pool:
        total = np.asarray(AMBIENT + sum(pool.map(lit, _lights())))
    baked, start = [], 0
    for rectangle, grid in zip(rectangles, grids, strict=True):
        rows, columns = grid.shape[:2]
        light = total[start : start + rows * columns].reshape(rows, columns, 1).astype(np.float32)
        start += rows * columns
        baked.append(replace(rectangle, texture=np.clip(rectangle.texture * _spread(light, rectangle), 0.0, 1.0)))
    return baked


def _lights() -> list[tuple[np.ndarray, float]]:
    """Position (3,) and power of the point lights: a square lamp, and a dome of weak lights that brightens corners."""
    steps = (np.arange(LAMP_STEPS) + 0.5) / LAMP_STEPS - 0.5
    lamp = [LAMP + LAMP_SIDE * np.array([x, y, 0.0]) for x in steps for y in steps]
    angles = np.arange(FILL_LIGHTS) * np.pi * (3.0 - 5.0**0.5)  # the golden angle gives an even distribution
    radii = 3.8 * np.sqrt((np.arange(FILL_LIGHTS) + 0.5) / FILL_LIGHTS)
    dome = [np.array([r * np.cos(t), r * np.sin(t), 3.3 - 0.1 * r * r]) for r, t in zip(radii, angles, strict=True)]
    return [(p, LAMP_POWER / len(lamp)) for p in lamp] + [(p, FILL_POWER / len(dome)) for p in dome]


def _light_grid(rectangle: Rectangle) -> np.ndarray:
    """(rows, columns, 3) world positions for baking: centres of cells of 0.06 units, or 0.12 on large faces."""
    area = np.linalg.norm(rectangle.u) * np.linalg.norm(rectangle.v)
    spacing = 0.12 if area > 10.0 else 0.06
    columns, rows = (max(2, round(np.linalg.norm(edge) / spacing)) for edge in (rectangle.u, rectangle.v))
    a, b = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return rectangle.at(a, b)


def _spread(light: np.ndarray, rectangle: Rectangle) -> np.ndarray:
    """Interpolate `light` (rows, columns, 1) at the texels of the rectangle, (h, w, 1)."""
    height, width = rectangle.texture.shape[:2]
    a, b = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return sample_texture(light, a.ravel(), b.ravel()).reshape(height, width, 1)
