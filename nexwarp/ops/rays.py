"""Collection for cameras of any rays; see `nexwarp.kernels.rays`. Not differentiable."""

from dataclasses import dataclass

import torch
import warp as wp

from nexwarp.errors import check_tensors
from nexwarp.kernels.rays import UNBOUNDED, collect_rays_kernel, ray_list_kernel
from nexwarp.kernels.tiles import check_entries
from nexwarp.kernels.types import types
from nexwarp.native.warp import tile_size_on
from nexwarp.ops._interop import array, launch, real_of, struct
from nexwarp.ops.collect import hits_argument, launch_pixels
from nexwarp.ops.memory import check_memory
from nexwarp.ops.project import Projection
from nexwarp.ops.surface import Surface, surface_argument

SPAN = 8  # tiles along the side of a block of tiles
BYTES_AN_ENTRY = 40  # of the arrays that `intersect_rays` makes, the sort's included
# A block whose rays are farther than this from its mean, as a cosine, has no bound.
LEAST_COSINE = 0.1
# Rounding may put a ray beside its block's bound: the bounds are a little larger.
WIDER = 1.0001


@dataclass(frozen=True)
class RayHits:
    """What rays hit: the fields of `Hits` but `stops`, depths in units of the ray's vector, and the surface."""

    plain: torch.Tensor
    base: torch.Tensor
    ids: torch.Tensor
    depths: torch.Tensor
    weights: torch.Tensor
    alpha: torch.Tensor
    surface: Surface


@dataclass(frozen=True)
class RayTiles:
    """(M,) int32 surfels by tile, near to far, (tiles + 1,) int64 ranges of them, row by row, and tiles in a row."""

    surfel_ids: torch.Tensor
    tile_offsets: torch.Tensor
    columns: int


@dataclass(frozen=True)
class RayRecords:
    """Surfels as rays read them.

    Attributes:
        records: (N, 4, 4) as in `nexwarp.kernels.surfel`; for parallel rays such that they hold for rays (x, y, 1).
        planes: (N, 3) g, where t = g . ray / n . ray; None stands for the records' m.
        normals: (N, 3) unit normals, camera frame.
        facings: (N,) sign of n . ray where a surfel can be hit; 0 where it cannot.
    """

    records: torch.Tensor
    planes: torch.Tensor | None
    normals: torch.Tensor
    facings: torch.Tensor


def ray_records(projection: Projection, axes: torch.Tensor | None) -> RayRecords:
    """Return the records of projected surfels for rays through the camera's centre, or for parallel ones.

    For these `axes` (N, 2, 3) are v1 / s2 and v2 / s1 in the camera frame.
    """
    records = projection.records.detach()
    normals = records[:, 2, :3].contiguous()
    if axes is None:
        return RayRecords(records, None, normals, records[:, 3, 3].sign().contiguous())
    # The moment of the ray from (x, y, 0) along z is (y, -x, 0), and u gets - v2 . moment / s1, v + v1 . moment / s2.
    records = records.clone()
    first, second = axes.unbind(1)
    zero = torch.zeros_like(first[:, 0])
    planes = torch.stack([-normals[:, 0], -normals[:, 1], records[:, 3, 3]], -1)
    records[:, 0, :3] = torch.stack([second[:, 1], -second[:, 0], records[:, 0, 2]], -1)
    records[:, 1, :3] = torch.stack([-first[:, 1], first[:, 0], records[:, 1, 2]], -1)
    records[:, 2, :3] = torch.stack([zero, zero, normals[:, 2]], -1)
    return RayRecords(records, planes, normals, normals[:, 2].sign().contiguous())


def intersect_rays(surfels: RayRecords, keys: torch.Tensor, rays: torch.Tensor) -> RayTiles:
    """List the surfels of each tile of rays (H, W, 3), by rising key (N,), ties by index: all that a ray may hit."""
    height, width = rays.shape[:2]
    side = tile_size_on(rays.is_cuda)
    columns, rows = -(-width // side), -(-height // side)
    real = real_of(rays)
    t = types(real)
    order = torch.sort(keys.float(), stable=True).indices.int()
    count, device = len(order), rays.device
    counts = torch.zeros(count, dtype=torch.int64, device=device)
    kernel = ray_list_kernel(real)
    bounds = (
        dict(zip(t.Bounds.vars, map(array, _bounds(rays, side), (t.mat33, t.vec2, t.vec2)), strict=True))
        for side in (side, side * SPAN)
    )
    inputs = [
        array(order, wp.int32),
        array(surfels.records.contiguous(), t.vec4),
        array(surfels.facings, real),
        *(struct(t.Bounds, **fields) for fields in bounds),
        wp.vec2i(columns, rows),
        SPAN,
    ]
    launch(rays, kernel, count, [*inputs, None], [array(counts, wp.int64), None, None])
    ends = counts.cumsum(0)
    total = check_entries(int(ends[-1]), count, columns * rows) if count else 0
    check_memory(BYTES_AN_ENTRY * total, device, f"a list of {total:,} (tile, surfel) entries")
    tiles, ids = (torch.zeros(total, dtype=torch.int32, device=device) for _ in range(2))
    outputs = [array(counts, wp.int64), array(tiles, wp.int32), array(ids, wp.int32)]
    if total:
        launch(rays, kernel, count, [*inputs, array(ends, wp.int64)], outputs)
    tiles, sorting = torch.sort(tiles, stable=True)
    every = torch.arange(columns * rows + 1, dtype=torch.int32, device=device)
    return RayTiles(ids[sorting].contiguous(), torch.searchsorted(tiles, every).contiguous(), columns)


def _bounds(rays: torch.Tensor, side: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Bound the rays of blocks of `side` x `side` pixels, row by row.

    Returned are (B, 3, 3) frames, whose rows are axes, and the (B, 2) middles and half extents of the rectangle that
    holds all rays (x, y, 1) in the block's frame; half extents are UNBOUNDED where there is none.
    """
    height, width = rays.shape[:2]
    columns, rows = -(-width // side), -(-height // side)
    at = [torch.arange(n * side, device=rays.device).clamp_max(m - 1) for n, m in ((rows, height), (columns, width))]
    blocks = rays[at[0]][:, at[1]].view(rows, side, columns, side, 3).transpose(1, 2).reshape(-1, side * side, 3)
    lengths = blocks.norm(dim=-1, keepdim=True)
    exists = lengths[..., 0] > 0
    units = blocks / lengths.where(lengths > 0, 1)
    forward = torch.nn.functional.normalize(units.sum(1), dim=-1)
    # Any axis across: the coordinate axis that is farthest from the mean ray turns into one.
    other = torch.eye(3).to(rays)[forward.abs().argmin(-1)]
    right = torch.nn.functional.normalize(torch.linalg.cross(other, forward), dim=-1)
    frames = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    local = units @ frames.mT
    cosines = local[..., 2].where(exists, 1.0)
    bounded = (cosines.amin(1) > LEAST_COSINE) & exists.any(1)
    x = local[..., :2] / cosines.clamp_min(LEAST_COSINE)[..., None]
    low = x.where(exists[..., None], torch.inf).amin(1)
    high = x.where(exists[..., None], -torch.inf).amax(1)
    half = (0.5 * (high - low) * WIDER + 1e-6).where(bounded[:, None], UNBOUNDED)
    # Where no pixel has a ray, an empty rectangle culls nearly all.
    half = half.where(exists.any(1)[:, None], 0.0)
    middle = (0.5 * (low + high)).where(bounded[:, None], 0.0)
    return frames.nan_to_num(0.0).contiguous(), middle.contiguous(), half.contiguous()


def collect_rays(
    surfels: RayRecords,
    limits: torch.Tensor,
    tiles: RayTiles,
    rays: torch.Tensor,
    near: float,
    viewmat: torch.Tensor,
    *,
    max_hits: int,
) -> RayHits:
    """Walk every ray's list front to back; where a ray (H, W, 3) is 0, there is none and nothing is hit.

    `limits` (N,) are those of `Projection`; `viewmat`, world to camera, turns the normals into the world.
    """
    real = real_of(rays)
    t = types(real)
    height, width = rays.shape[:2]
    check_tensors({"rays": (rays, ("H", "W", 3)), "limits": (limits, (len(surfels.records),))})
    plain, base, normals = (rays.new_zeros(height, width, 3) for _ in range(3))
    alpha, expected, median, top = (rays.new_zeros(height, width) for _ in range(4))
    ids = torch.full((height, width, max_hits), -1, dtype=torch.int32, device=rays.device)
    depths, weights = (rays.new_zeros(height, width, max_hits) for _ in range(2))
    records = struct(
        t.RaySurfels,
        records=array(surfels.records.contiguous(), t.vec4),
        planes=array(surfels.planes, t.vec3),
        normals=array(surfels.normals, t.vec3),
        limits=array(limits, real),
    )
    arguments = [
        records,
        array(tiles.surfel_ids, wp.int32),
        array(tiles.tile_offsets, wp.int64),
        array(rays.contiguous().view(-1, 3), t.vec3),
        struct(t.View, size=wp.vec2i(width, height), tile_columns=tiles.columns, near=near),
        hits_argument(real, (plain, base, ids, depths, weights, alpha, None, None)),
        surface_argument(real, (expected, median, top, normals)),
    ]
    launch_pixels(rays, collect_rays_kernel(real, max_hits), len(tiles.tile_offsets) - 1, arguments)
    normals = torch.nn.functional.normalize(normals @ viewmat[:3, :3].to(normals), dim=-1)
    return RayHits(plain, base, ids, depths, weights, alpha, Surface(expected, median, top, normals))
