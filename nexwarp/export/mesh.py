"""Meshes: the median depths of the training views, fused into a distance field, and its surface (as 2DGS does)."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.errors import RunError, SettingError
from nexwarp.io.files import written_aside
from nexwarp.kernels.tsdf import BLOCK_SIDE
from nexwarp.model.model import Model
from nexwarp.ops.tsdf import DistanceField

PIXELS_A_VOXEL = 1.5  # side of a voxel, in pixels of the photos at their median depth
TRUNCATION = 4.0  # voxels
FAR = 3.0  # scene scales
LEAST_ALPHA = 0.25  # of a pixel whose depth counts
LEAST_WEIGHT = 1.1  # of a voxel that counts: a view that sees a surface there weighs 1, one that sees past it a fifth
LEAST_SHARE = 5e-4  # of all triangles: smaller components are removed
MOST_BLOCKS = 2_000_000
WELD = 1e4  # vertices that agree to a part of this many of a voxel are one

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with colours.

    Attributes:
        vertices: (V, 3) float32, world frame.
        normals: (V, 3) float32, unit, towards the side that was seen.
        colors: (V, 3) uint8 sRGB.
        triangles: (F, 3) int32, counter-clockwise from the side that was seen.
    """

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    triangles: np.ndarray


@torch.no_grad()
def extract_mesh(
    model: Model,
    cameras: Sequence[Camera],
    *,
    voxel: float | None = None,
    far: float | None = None,
    observe: Progress = lambda *_: None,
) -> Mesh:
    """Return the surface of a model as a mesh, without components of less than 0.05 % of the triangles.

    Args:
        model: the model, on the device to work on.
        cameras: the training cameras.
        voxel: resolution of the mesh, world units; None is 1.5 pixels of the photos at their median depth.
        far: surfaces at larger z-depths are left out, world units; None is 3 scene scales.
        observe: called with each stage's name, how many views or blocks of it are done, and of how many.

    Raises:
        SettingError: `voxel` or `far` does not fit.
        RunError: no camera sees a surface.
        OutOfMemoryError: the voxels need more memory than there is.
    """
    for name, value in (("--voxel", voxel), ("--far", far)):
        if value is not None and not 0 < value < math.inf:
            raise SettingError(f"{name}: expected a length above 0 in world units, got {value:g}")
    cameras = [camera.to(model.device) for camera in cameras]
    scale = model.meta.get("scene_scale")
    if far is None:
        far = FAR * float(scale) if isinstance(scale, (int, float)) else math.inf
    if voxel is None:
        voxel = _pixel_size(model, cameras, far) * PIXELS_A_VOXEL
    field = DistanceField(voxel, TRUNCATION * voxel, model.device)
    try:
        for done, camera in enumerate(cameras, 1):
            field.reserve(camera, _depths(model, camera, far)[0], MOST_BLOCKS)
            observe("finding surfaces", done, len(cameras))
    except ValueError as error:
        raise SettingError(f"--{error}; give a larger --voxel or a smaller --far") from None
    if not len(field.keys):
        raise RunError("mesh: expected surfaces that a training camera sees, found none")
    field.allocate()
    for done, camera in enumerate(cameras, 1):
        field.fuse(camera, *_depths(model, camera, far))
        observe("fusing depths", done, len(cameras))
    mesh = _without_crumbs(_surface(field, observe))
    if not len(mesh.triangles):
        raise RunError("mesh: expected a surface that two training cameras see, found none; give a larger --voxel")
    return mesh


def _depths(model: Model, camera: Camera, far: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return z-depths (H, W), 0 where there is no surface, and colours (H, W, 3) at the photos' mean exposure."""
    out = model.render(camera, exposure="mean")
    depths = out.median_depth
    return depths.where((out.alpha > LEAST_ALPHA) & (depths < far), 0.0), out.image.clamp(0, 1)


def _pixel_size(model: Model, cameras: Sequence[Camera], far: float) -> float:
    """Return the side of a pixel at the median depth, the median over the cameras; world units."""
    sizes = []
    for camera in cameras:
        depths, _ = _depths(model, camera, far)
        if len(seen := depths[depths > 0]):
            sizes.append(seen.median().item() / camera.focal)
    if not sizes:
        raise RunError("mesh: expected surfaces that a training camera sees, found none")
    return median(sizes)


def _surface(field: DistanceField, observe: Progress) -> Mesh:
    """Return the zero level of a distance field where all corners of a cell are known; marching cubes by blocks."""
    from scipy.ndimage import map_coordinates
    from skimage.measure import marching_cubes

    side, count = BLOCK_SIDE, len(field.blocks)
    values, known, colors = _with_borders(field)
    corners = field.blocks.cpu().numpy()
    parts: list[tuple[np.ndarray, ...]] = []
    total = 0
    for b in range(count):
        volume, sure = values(b), known(b)
        cells = _all_corners(sure)
        if cells.any() and volume[sure].min() < 0 < volume[sure].max():
            volume = np.where(sure, volume, 1.0)
            vertices, triangles, normals, _ = marching_cubes(volume, 0.0, gradient_direction="descent")
            at = np.minimum(vertices[triangles].mean(1).astype(int), side - 1)
            triangles = triangles[cells[at[:, 0], at[:, 1], at[:, 2]]]
            shades = np.stack([map_coordinates(c, vertices.T, order=1, mode="nearest") for c in colors(b)], -1)
            # The normals are those of a volume that falls outwards.
            parts.append((vertices + corners[b] * side, -normals, shades, triangles + total))
            total += len(vertices)
        if b % 256 == 255 or b + 1 == count:
            observe("marching cubes", b + 1, count)
    if not parts:
        return Mesh(*(np.zeros((0, 3), kind) for kind in (np.float32, np.float32, np.uint8, np.int32)))
    vertices, normals, shades, triangles = (np.concatenate(each) for each in zip(*parts, strict=True))
    # Blocks share the vertices on their borders.
    _, first, place = np.unique(
        np.round(vertices * WELD).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    triangles = place.reshape(-1)[triangles]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return Mesh(
        (vertices[first] * field.voxel).astype(np.float32),
        normals[first].astype(np.float32),
        np.clip(np.round(shades[first] * 255), 0, 255).astype(np.uint8),
        triangles[whole].astype(np.int32),
    )


def _all_corners(sure: np.ndarray) -> np.ndarray:
    """Return which cells (n - 1)^3 of n^3 voxels have eight known corners."""
    n = sure.shape[0] - 1
    parts = [sure[i : i + n, j : j + n, k : k + n] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return np.logical_and.reduce(parts)


def _with_borders(
    field: DistanceField,
) -> tuple[Callable[[int], np.ndarray], Callable[[int], np.ndarray], Callable[[int], np.ndarray]]:
    """Return functions of a block: distances and known (17, 17, 17), colours (3, 17, 17, 17).

    The last layers are the first ones of the neighbours.
    """
    side = BLOCK_SIDE
    offsets = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    neighbors = torch.stack([field.neighbors(offset) for offset in offsets], 1).cpu().numpy()
    shape = (-1, side, side, side)
    distances, weights = (x.cpu().numpy().reshape(shape) for x in (field.distances, field.weights))
    means = field.means.cpu().numpy().reshape(*shape, 4)

    def gathered(source: np.ndarray, b: int, empty: float) -> np.ndarray:
        out = np.full((side + 1, side + 1, side + 1, *source.shape[4:]), empty, dtype=source.dtype)
        for offset, n in zip(offsets, neighbors[b], strict=True):
            if n < len(source):
                there = tuple(slice(side, None) if o else slice(0, side) for o in offset)
                out[there] = source[n][tuple(slice(0, 1) if o else slice(0, side) for o in offset)]
        return out

    return (
        lambda b: gathered(distances, b, 0.0),
        lambda b: gathered(weights, b, 0.0) >= LEAST_WEIGHT,
        lambda b: np.moveaxis(gathered(means, b, 0.0)[..., :3], -1, 0),
    )


def _without_crumbs(mesh: Mesh) -> Mesh:
    """Remove connected components of less than LEAST_SHARE of the triangles, and vertices of no triangle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    triangles, count = mesh.triangles, len(mesh.vertices)
    if not len(triangles):
        return mesh
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][triangles[:, 0]]
    sizes = np.bincount(labels)
    triangles = triangles[sizes[labels] >= LEAST_SHARE * len(triangles)]
    used, place = np.unique(triangles, return_inverse=True)
    kept = (mesh.vertices[used], mesh.normals[used], mesh.colors[used])
    return Mesh(*kept, place.reshape(-1, 3).astype(np.int32))


def save_mesh(path: str | os.PathLike[str], mesh: Mesh) -> None:
    """Write a mesh as binary PLY: x, y, z, nx, ny, nz, red, green, blue, and triangles as vertex_indices.

    Raises:
        OSError: `path` cannot be written.
    """
    axes = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    colors = [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(mesh.vertices), [*axes, *colors])
    for names, values in ((axes[:3], mesh.vertices), (axes[3:], mesh.normals), (colors, mesh.colors)):
        for column, (name, _) in enumerate(names):
            rows[name] = values[:, column]
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    kinds = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment nexwarp mesh",
        f"element vertex {len(rows)}",
        *(f"property {kinds[kind]} {name}" for name, kind in (*axes, *colors)),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    with written_aside(Path(path)) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(rows.tobytes())
        file.write(faces.tobytes())
