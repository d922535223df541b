"""Warp types, structs and constants.

A `@wp.func` at the top level serves float32 and float64: the annotations `Real`, `Vec3` and the like are for the
reader, to Warp each is Any. A `@per_real` kernel is written once, and compiled for a scalar type with its `types`.
There `real` is the scalar type, `vec3` a vector, `vec3s` an array of them, and `vec3_rows` an array of two dimensions.
"""

import functools
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
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
ints, int_rows = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
MAX_SH_DEGREE = 3


@wp.struct
class TileLists:
    """The lists of (tile, surfel) entries, see `nexwarp.ops.Tiles`."""

    surfel_ids: ints
    tile_offsets: ints
    order: ints
    ends: ints


@functools.cache
def types(real: type) -> SimpleNamespace:
    """Vector, matrix, array and struct types over `real` (wp.float32 or wp.float64), and wrapped constants."""
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4, vec7 = wp.types.vector(length=4, dtype=real), wp.types.vector(length=7, dtype=real)
    mat33, mat44 = wp.types.matrix(shape=(3, 3), dtype=real), wp.types.matrix(shape=(4, 4), dtype=real)
    reals, vec2s, vec3s, vec4s, mat33s, mat44s = (
        wp.array(dtype=dtype) for dtype in (real, vec2, vec3, vec4, mat33, mat44)
    )
    real_rows, vec2_rows, vec3_rows, vec4_rows = (wp.array2d(dtype=dtype) for dtype in (real, vec2, vec3, vec4))

    @wp.struct
    class View:
        """The image plane."""

        Ks: mat33s  # (1) the camera's matrix: read from memory, so that a CUDA graph serves every camera
        size: wp.vec2i  # width and height in pixels
        tile_columns: wp.int32
        near: real  # hits at a depth of at most this are ignored

    @wp.struct
    class Surfels:
        """Surfels in the camera's frame."""

        records: vec4_rows  # (N, 4) see `kernels.surfel`
        limits: reals  # (N) see `shape.exponent_limit`
        reaches: vec2s  # (N) see `shape.reach`
        channels: vec4_rows  # (N, 4) sixteen more channels of the plain colour

    @wp.struct
    class Hits:
        """What `collect` writes of each pixel."""

        plain: vec3s
        base: vec3s
        ids: int_rows
        depths: real_rows
        weights: real_rows
        alphas: reals
        stops: ints
        channels: vec4_rows

    @wp.struct
    class Surface:
        """What `surface` writes of each pixel."""

        expected: reals
        median: reals
        top: reals
        normals: vec3s
        totals: reals
        picks: wp.array(dtype=wp.vec2i)

    @wp.struct
    class Parameters:
        """Parameters of surfels, raw or activated, or their gradients; arrays that a kernel does not use are null."""

        quats: vec4s
        scales: vec2s
        opacities: reals
        gammas: vec2s
        means: vec3s
        colors: vec3s

    @wp.struct
    class Layers:
        """What `compose` adds up of each pixel, or gradients of it; the background is one colour."""

        plain: vec3s
        base: vec3s
        colors: vec3_rows
        weights: real_rows
        alphas: reals
        background: vec3s

    @wp.struct
    class Compared:
        """What `photometric` compares in each pixel, or gradients of it."""

        image: vec3s
        textured: vec3s
        weights: real_rows
        target: vec3s

    @wp.struct
    class Polygons:
        """Tile polygons of surfels, see `tiles`."""

        corners: vec2_rows  # (N, 5) pixels
        shapes: wp.array(dtype=wp.vec3i)  # (N) number of corners, first and last tile row
        margins: reals  # (N) pixels

    constants = {"ALPHA_MIN": ALPHA_MIN, "ALPHA_MAX": ALPHA_MAX, "TRANSMITTANCE_MIN": TRANSMITTANCE_MIN, "TINY": TINY}
    constants |= {"ZERO": 0.0, "HALF": 0.5, "ONE": 1.0, "TWO": 2.0}
    return SimpleNamespace(**locals(), **{name: wp.constant(real(value)) for name, value in constants.items()})


def per_real(**options: Any) -> Callable[[FunctionType], Callable[[type], wp.Kernel]]:
    """Decorate a function that becomes a kernel for each scalar type: `kernel(real)`, or as `ops._interop.launch` asks.

    In its annotations, which must be strings, and in its body `real`, `vec3`, `ONE` and so on are those of
    `types(real)`. Options are those of `wp.kernel`; `fast_math` holds for float32 alone.
    """
    fast_math = options.pop("fast_math", False)

    def decorated(function: FunctionType) -> Callable[[type], wp.Kernel]:
        @functools.cache
        def kernel(real: type) -> wp.Kernel:
            specialised = FunctionType(function.__code__, function.__globals__ | vars(types(real)))
            specialised.__annotations__ = function.__annotations__
            module_options = {"fast_math": fast_math and real is wp.float32}
            return wp.kernel(
                specialised, enable_backward=False, module="unique", module_options=module_options, **options
            )

        vars(kernel)["is_kernel"] = True  # of each scalar type, for who looks for all kernels
        return functools.update_wrapper(kernel, function)

    return decorated
