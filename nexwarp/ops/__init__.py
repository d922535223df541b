"""What a tensor means and how it differentiates: one torch op a stage, the only torch <-> Warp boundary."""

from nexwarp.ops.activate import activate
from nexwarp.ops.collect import Hits, SplatErrorRequest, collect, splat_error
from nexwarp.ops.compose import compose
from nexwarp.ops.detail import antialias, limit_depths
from nexwarp.ops.graphs import captured
from nexwarp.ops.memory import check_image
from nexwarp.ops.neural_field import Field, Points, Rays
from nexwarp.ops.photometric import expose
from nexwarp.ops.project import Pinhole, Projection, project
from nexwarp.ops.sh import plain_colors
from nexwarp.ops.surface import DifferentiableSurface, Surface, surface
from nexwarp.ops.texture import texture
from nexwarp.ops.tiles import ListCapacity, Tiles, UnknownLengthError, fits, intersect_tiles
from nexwarp.ops.unproject import unproject

__all__ = [
    "DifferentiableSurface",
    "Field",
    "Hits",
    "ListCapacity",
    "Pinhole",
    "Points",
    "Projection",
    "Rays",
    "SplatErrorRequest",
    "Surface",
    "Tiles",
    "UnknownLengthError",
    "activate",
    "antialias",
    "captured",
    "check_image",
    "collect",
    "compose",
    "expose",
    "fits",
    "intersect_tiles",
    "limit_depths",
    "plain_colors",
    "project",
    "splat_error",
    "surface",
    "texture",
    "unproject",
]
