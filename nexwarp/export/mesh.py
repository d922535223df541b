"""Meshes: the median depths of the training views, fused into a distance field, and its surface (as 2DGS does)."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.similarity import Similarity
from nexwarp.errors import RunError, SettingError
from nexwarp.export.bake import Progress, dimmed
from nexwarp.io.ply import write_elements
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
CORNERS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]  # of a cell; itself and its neighbours
WELD = 1e4  # vertices that agree to a part of this many of a voxel are one


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with colours."""

    vertices: np.ndarray  # (V, 3) float32, world frame
    normals: np.ndarray  # (V, 3) float32, unit, towards the side that was seen
    colors: np.ndarray  # (V, 3) uint8 sRGB
    triangles: np.ndarray  # (F, 3) int32, counter-clockwise from the side that was seen

    def moved(self, motion: Similarity) -> "Mesh":
        """Return the mesh in moved coordinates."""
        vertices = motion.points(self.vertices).astype(np.float32)
        return replace(self, vertices=vertices, normals=motion.directions(self.normals))


@torch.no_grad()
def extract_mesh(
    model: Model,
    cameras: Sequence[Camera],
    *,
    voxel: float | None = None,
    far: float | None = None,
    observe: Progress = lambda *_: None,
) -> Mesh:
    """Return the surface of a model that training cameras see, without components of less than 0.05 % of the triangles.

    `voxel`, the resolution, is 1.5 pixels of the photos at their median depth by default; surfaces are left out at
    z-depths beyond `far`, 3 scene scales by default; both in world units. `observe` is called with each stage's name,
    how many views or blocks of it are done, and of how many. SettingError: `voxel` or `far` does not fit. RunError: no
    camera sees a surface. OutOfMemoryError: the voxels need more memory than there is.
    """
    for name, value in (("--voxel", voxel), ("--far", far)):
        if value is not None and not 0 < value < math.inf:
            raise SettingError(f"{name}: expected a length above 0 in world units, got {value:g}")
    cameras = [camera.to(model.device) for camera in cameras]
    scale = model.meta.get("scene_scale")
    if far is None:
        far = FAR * float(scale) if isinstance(scale, (int, float)) else math.inf
    if voxel is None:
        sizes = []
        for done, camera in enumerate(cameras, 1):
            depths = _depths(model, camera, far)[0]
            if len(seen := depths[depths > 0]):
                sizes.append(seen.median().item() / camera.focal)
            observe("choosing the voxel", done, len(cameras))
        voxel = median(sizes or [1.0]) * PIXELS_A_VOXEL
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
    mesh = _without_crumbs(_surface(field, partial(dimmed, model), observe))
    if not len(mesh.triangles):
        raise RunError("mesh: expected a surface that two training cameras see, found none; give a larger --voxel")
    return mesh


def _depths(model: Model, camera: Camera, far: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return z-depths (H, W), 0 where there is no surface, and colours (H, W, 3) at the photos' mean exposure."""
    out = model.render(camera, exposure="mean")
    depths = out.median_depth
    return depths.where((out.alpha > LEAST_ALPHA) & (depths < far), 0.0), out.image.clamp_min(0)


def _surface(field: DistanceField, dimming: Callable[[torch.Tensor], float], observe: Progress) -> Mesh:
    """Return the zero level of a distance field where all corners of a cell are known; marching cubes by blocks.

    `dimming` returns by what to multiply the vertices' colours.
    """
    from scipy.ndimage import map_coordinates
    from skimage.measure import marching_cubes

    neighbors = torch.stack([field.neighbors(corner) for corner in CORNERS], 1).cpu().numpy()
    shape = (-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    distances, weights = (x.cpu().numpy().reshape(shape) for x in (field.distances, field.weights))
    colors = field.means.cpu().numpy().reshape(*shape, 4)[..., :3]
    origins = field.blocks.cpu().numpy() * BLOCK_SIDE
    parts: list[tuple[np.ndarray, ...]] = []
    total, count = 0, len(origins)
    for b, origin in enumerate(origins):
        volume, known = _bordered(distances, neighbors[b]), _bordered(weights, neighbors[b]) >= LEAST_WEIGHT
        cells = np.logical_and.reduce(sliding_window_view(known, (2, 2, 2)), axis=(3, 4, 5))
        if cells.any() and volume[known].min() < 0 < volume[known].max():
            volume = np.where(known, volume, 1.0)
            vertices, triangles, normals, _ = marching_cubes(volume, 0.0, gradient_direction="descent")
            at = np.minimum(vertices[triangles].mean(1).astype(int), BLOCK_SIDE - 1)
            triangles = triangles[cells[at[:, 0], at[:, 1], at[:, 2]]]
            channels = np.moveaxis(_bordered(colors, neighbors[b]), -1, 0)
            shades = np.stack([map_coordinates(c, vertices.T, order=1, mode="nearest") for c in channels], -1)
            # The normals are those of a volume that falls outwards.
            parts.append((vertices + origin, -normals, shades, triangles + total))
            total += len(vertices)
        if b % 256 == 255 or b + 1 == count:
            observe("marching cubes", b + 1, count)
    if not parts:
        return Mesh(*(np.zeros((0, 3), kind) for kind in (np.float32, np.float32, np.uint8, np.int32)))
    vertices, normals, shades, triangles = (np.concatenate(each) for each in zip(*parts, strict=True))
    # Blocks share the vertices on their borders.
    keys = np.round(vertices * WELD).astype(np.int64)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return Mesh(
        (vertices[first] * field.voxel).astype(np.float32),
        normals[first].astype(np.float32),
        np.clip(np.round(shades[first] * (255 * dimming(torch.from_numpy(shades[first])))), 0, 255).astype(np.uint8),
        triangles[whole].astype(np.int32),
    )


def _bordered(blocks: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Return a block of (B, 16, 16, 16, ...) values with one layer more, of its neighbours or 0: (17, 17, 17, ...).

    The neighbours (8,) are the blocks at `CORNERS`, the block itself first; B where there is none.
    """
    parts = blocks[np.minimum(neighbors, len(blocks) - 1)]
    parts[neighbors == len(blocks)] = 0
    parts = np.moveaxis(parts.reshape(2, 2, 2, *blocks.shape[1:]), [0, 1, 2], [0, 2, 4])
    whole = parts.reshape(*3 * [2 * BLOCK_SIDE], *blocks.shape[4:])
    return whole[: BLOCK_SIDE + 1, : BLOCK_SIDE + 1, : BLOCK_SIDE + 1]


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
    triangles = place.reshape(-1, 3).astype(np.int32)
    return Mesh(mesh.vertices[used], mesh.normals[used], mesh.colors[used], triangles)


def save_mesh(path: str | os.PathLike[str], mesh: Mesh) -> None:
    """Write a mesh as binary PLY: x, y, z, nx, ny, nz, red, green, blue, and triangles as vertex_indices."""
    values = [*mesh.vertices.T, *mesh.normals.T, *mesh.colors.T]
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    vertices = dict(zip(names, values, strict=True))
    write_elements(path, {"vertex": vertices, "face": {"vertex_indices": mesh.triangles}}, "nexwarp mesh")
