"""Warp types, structs and constants.

A `@wp.func` at the top level serves float32 and float64: the annotations `Real`, `Vec3` and the like are for the
reader, to Warp each is Any. Kernels are made by factories over the scalar type, whose types `types` gives.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

Real = Vec2 = Vec3 = Vec4 = Vec7 = Mat33 = Mat44 = Any
# Of these structs there is one for each scalar type, see `types`.
Surfels = View = Any

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
# The exponent of a hit is at most 2 ln(255 opacity); rounding must not cull one.
LIMIT_MARGIN = 1e-3
# Floor of u^2, so that log stays finite at a surfel's centre.
TINY = 1e-20
MAX_HITS = 8
MAX_SH_DEGREE = 3


@wp.struct
class TileLists:
    """The lists of (tile, surfel) entries, see `nexwarp.ops.Tiles`."""

    surfel_ids: wp.array(dtype=wp.int32)
    tile_offsets: wp.array(dtype=wp.int32)
    order: wp.array(dtype=wp.int32)
    ends: wp.array(dtype=wp.int32)


@functools.cache
def types(real: type) -> SimpleNamespace:
    """Vector, matrix, array and struct types over `real` (wp.float32 or wp.float64), and wrapped constants."""
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)

    @wp.struct
    class View:
        """The image plane."""

        Ks: wp.array(dtype=mat33)  # (1) the camera's matrix: read from memory, so that a CUDA graph serves every camera
        size: wp.vec2i  # width and height in pixels
        tile_columns: wp.int32
        near: real  # hits at a depth of at most this are ignored

    @wp.struct
    class Surfels:
        """Surfels in the camera's frame."""

        records: wp.array2d(dtype=vec4)  # (N, 4) see `kernels.surfel`
        limits: wp.array(dtype=real)  # (N) see `shape.exponent_limit`
        reaches: wp.array(dtype=vec2)  # (N) see `shape.reach`
        channels: wp.array2d(dtype=vec4)  # (N, 4) sixteen more channels of the plain colour

    @wp.struct
    class Hits:
        """What `collect` writes of each pixel."""

        plain: wp.array(dtype=vec3)
        base: wp.array(dtype=vec3)
        ids: wp.array2d(dtype=wp.int32)
        depths: wp.array2d(dtype=real)
        weights: wp.array2d(dtype=real)
        alphas: wp.array(dtype=real)
        stops: wp.array(dtype=wp.int32)
        channels: wp.array2d(dtype=vec4)

    @wp.struct
    class Surface:
        """What `surface` writes of each pixel."""

        expected: wp.array(dtype=real)
        median: wp.array(dtype=real)
        top: wp.array(dtype=real)
        normals: wp.array(dtype=vec3)
        totals: wp.array(dtype=real)
        picks: wp.array(dtype=wp.vec2i)

    @wp.struct
    class Parameters:
        """Parameters of surfels, raw or activated, or their gradients; arrays that a kernel does not use are null."""

        quats: wp.array(dtype=vec4)
        scales: wp.array(dtype=vec2)
        opacities: wp.array(dtype=real)
        gammas: wp.array(dtype=vec2)

    @wp.struct
    class Polygons:
        """Tile polygons of surfels, see `tiles`."""

        corners: wp.array2d(dtype=vec2)  # (N, 5) pixels
        shapes: wp.array(dtype=wp.vec3i)  # (N) number of corners, first and last tile row
        margins: wp.array(dtype=real)  # (N) pixels

    return SimpleNamespace(
        real=real,
        vec2=vec2,
        vec3=vec3,
        vec4=vec4,
        vec7=wp.types.vector(length=7, dtype=real),
        mat33=mat33,
        mat44=wp.types.matrix(shape=(4, 4), dtype=real),
        View=View,
        Surfels=Surfels,
        Hits=Hits,
        Surface=Surface,
        Polygons=Polygons,
        Parameters=Parameters,
        ALPHA_MIN=wp.constant(real(ALPHA_MIN)),
        ALPHA_MAX=wp.constant(real(ALPHA_MAX)),
        TRANSMITTANCE_MIN=wp.constant(real(TRANSMITTANCE_MIN)),
        TINY=wp.constant(real(TINY)),
        ZERO=wp.constant(real(0.0)),
        HALF=wp.constant(real(0.5)),
        ONE=wp.constant(real(1.0)),
        TWO=wp.constant(real(2.0)),
    )
