"""A truncated signed distance field over blocks of voxels, fused from depth images; see `nexwarp.kernels.tsdf`."""

import torch
import warp as wp

from nexwarp.cameras.camera import Camera
from nexwarp.errors import check_tensors
from nexwarp.kernels.tsdf import BLOCK_SIDE, fuse
from nexwarp.ops._interop import launch
from nexwarp.ops.memory import check_memory

BYTES_A_VOXEL = 24
# Places along a ray, in units of the truncation, whose blocks are made; a block is wider than the steps.
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
# Block coordinates are packed into an int64 of three such fields.
FIELD_BITS = 20


class DistanceField:
    """Voxels near the surfaces of depth images. Voxel (i, j, k) is at the world point voxel * (i, j, k).

    Attributes:
        blocks: (B, 3) int32, sorted; block (i, j, k) starts at voxel 16 * (i, j, k).
        distances: (B, 4096) signed distances over the truncation, at most 1, positive in front of surfaces.
        weights: (B, 4096) number of views of each voxel, free space counting with FREE_WEIGHT; 0 is unknown.
        means: (B, 4096, 4) mean colours of the voxels near surfaces, and their number of views.
    """

    def __init__(self, voxel: float, truncation: float, device: torch.device) -> None:
        """Start without blocks; the truncation, where the field ends, is at most the side of a block."""
        self.voxel, self.truncation = voxel, truncation
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)
        self.device = self.keys.device  # with its index

    def reserve(self, camera: Camera, depths: torch.Tensor, most: int) -> None:
        """Note the blocks around a depth image's surfaces (H, W), 0 being none; ValueError when more than `most`."""
        row, column = (depths > 0).nonzero(as_tuple=True)
        z = depths[row, column]
        ray = torch.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy], -1)
        ray = torch.cat([ray, torch.ones_like(ray[:, :1])], -1)
        found = [self.keys]
        for step in STEPS:
            local = (z + step * self.truncation)[:, None] * ray
            world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
            cells = torch.floor(world / (self.voxel * BLOCK_SIDE))
            inside = (cells.abs() < 2 ** (FIELD_BITS - 1) - 1).all(-1)
            found.append(_packed(cells[inside].long()).unique())
        self.keys = torch.cat(found).unique()
        if len(self.keys) > most:
            raise ValueError(
                f"voxel: expected a side whose blocks of 16 voxels are at most {most:,}, got {self.voxel:g}"
            )

    def allocate(self) -> None:
        """Make the voxels of all blocks noted; OutOfMemoryError where memory does not suffice."""
        count, cells = len(self.keys), BLOCK_SIDE**3
        check_memory(BYTES_A_VOXEL * count * cells, self.device, f"a mesh of {count:,} blocks of 16 x 16 x 16 voxels")
        self.blocks = _unpacked(self.keys).int()
        self.distances = torch.zeros(count, cells, device=self.device)
        self.weights = torch.zeros(count, cells, device=self.device)
        self.means = torch.zeros(count, cells, 4, device=self.device)

    def fuse(self, camera: Camera, depths: torch.Tensor, colors: torch.Tensor) -> None:
        """Take a depth image (H, W), 0 where there is none, and its colours (H, W, 3) in [0, 1] into the field."""
        shape = (camera.height, camera.width)
        tensors = {"depths": (depths, shape), "colors": (colors, (*shape, 3)), "viewmat": (camera.viewmat, (4, 4))}
        check_tensors(tensors, dtype=torch.float32, device=self.device)
        inputs = [
            self.blocks,
            self.voxel,
            self.truncation,
            camera.viewmat.contiguous(),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            wp.vec2i(camera.width, camera.height),
            camera.near,
            depths.contiguous(),
            colors.contiguous(),
        ]
        launch(depths, fuse, self.distances.numel(), inputs, [self.distances, self.weights, self.means])

    def neighbors(self, offset: tuple[int, int, int]) -> torch.Tensor:
        """Return the index (B,) of each block's neighbour at an offset in blocks; B where there is none."""
        keys = _packed(self.blocks.long() + torch.tensor(offset, device=self.device))
        found = torch.searchsorted(self.keys, keys).clamp(max=max(len(self.keys) - 1, 0))
        return found.where(self.keys[found] == keys, len(self.keys))


def _packed(cells: torch.Tensor) -> torch.Tensor:
    x, y, z = (cells + 2 ** (FIELD_BITS - 1)).unbind(-1)
    return (x << (2 * FIELD_BITS)) | (y << FIELD_BITS) | z


def _unpacked(keys: torch.Tensor) -> torch.Tensor:
    mask = 2**FIELD_BITS - 1
    fields = torch.stack([keys >> (2 * FIELD_BITS), (keys >> FIELD_BITS) & mask, keys & mask], -1)
    return fields - 2 ** (FIELD_BITS - 1)
