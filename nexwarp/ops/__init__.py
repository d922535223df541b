"""What a tensor means and how it differentiates: one torch op a stage, the only torch <-> Warp boundary."""

from nexwarp.ops.activate import activate
from nexwarp.ops.collect import ErrorWatch, Hits, collect, splat_error
from nexwarp.ops.compose import compose
from nexwarp.ops.graphs import captured
from nexwarp.ops.pinhole import Pinhole
from nexwarp.ops.project import Projection, project
from nexwarp.ops.sh import plain_colors
from nexwarp.ops.texture import texture
from nexwarp.ops.tiles import Room, Tiles, intersect_tiles, roomy
from nexwarp.ops.unproject import unproject
from nexwarp.ops.widen import widen

__all__ = [
    "ErrorWatch",
    "Hits",
    "Pinhole",
    "Projection",
    "Room",
    "Tiles",
    "activate",
    "captured",
    "collect",
    "compose",
    "intersect_tiles",
    "plain_colors",
    "project",
    "roomy",
    "splat_error",
    "texture",
    "unproject",
    "widen",
]
