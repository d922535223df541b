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


@wp.struct
class FixedSums:
    """As `types(real).Sums`, in pairs of integers, see `native.fixed_point`: they do not depend on any order."""

    records: wp.array2d(dtype=wp.int64)
    errors: wp.array2d(dtype=wp.int64)
    channels: wp.array2d(dtype=wp.int64)
    slots: ints
    bad: ints


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
    class HitGradients:
        """Gradients of `Hits`, and the error of each pixel."""

        plain: vec3s
        base: vec3s
        depths: real_rows
        weights: real_rows
        alphas: reals
        errors: reals
        channels: vec4_rows

    @wp.struct
    class Sums:
        """What is added up for each surfel or gradient slot, and the flag of a term that fixed point cannot hold."""

        records: vec4_rows
        errors: reals
        channels: vec4_rows
        slots: ints
        bad: ints

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

    @wp.struct
    class Atlas:
        """Texels of baked scenes, and where those of each surfel lie."""

        texels: vec4_rows  # (height, width) RGBA
        boxes: vec4s  # (N) u0, v0, 1 / (u1 - u0), 1 / (v1 - v0), in units of the records' scales
        rects: vec4s  # (N) column and row of the first texel's centre, and from there to the last one's
        cutoff: real  # alpha of half a coverage
        steepness: real  # of the sigmoid; 0 is a threshold

    @wp.struct
    class Drawn:
        """What is drawn of a baked scene, or its gradients; and the hits of cut-outs."""

        image: vec3s  # (pixels)
        alphas: reals
        ids: int_rows  # (pixels, layers), -1 behind the last

    @wp.struct
    class TexelSums:
        """Gradients of a baked scene that all pixels add to."""

        texels: vec4_rows  # (height, width)
        colors: vec4s  # (N) of plain colours and opacity

    constants = {"ALPHA_MIN": ALPHA_MIN, "ALPHA_MAX": ALPHA_MAX, "TRANSMITTANCE_MIN": TRANSMITTANCE_MIN, "TINY": TINY}
    constants |= {"ZERO": 0.0, "HALF": 0.5, "ONE": 1.0, "TWO": 2.0}
    return SimpleNamespace(**locals(), **{name: wp.constant(real(value)) for name, value in constants.items()})


class PerReal:
    """A function of Warp that is written once, and compiled for a scalar type and for values of `names`.

    Calling it with both returns the compiled form. In its body and annotations, which must be strings:

    * `real`, `vec3`, `ONE` and so on are those of `types(real)`;
    * each of `names`, such as `max_hits`, is the value that the call gives;
    * float constants of the module have the scalar type;
    * other `PerReal` functions are compiled for the same scalar type and values.
    """

    def __init__(self, make: Callable[..., Any], names: tuple[str, ...] | None, function: FunctionType) -> None:
        self.names, self.__module__ = names, function.__module__

        @functools.cache
        def made(real: type, **values: Any) -> Any:
            namespace = function.__globals__ | vars(types(real)) | values
            for name in function.__code__.co_names:
                if isinstance(value := namespace.get(name), PerReal):
                    namespace[name] = value(real, **values)
                elif type(value) is float:
                    namespace[name] = wp.constant(real(value))
            specialised = FunctionType(function.__code__, namespace)
            specialised.__annotations__ = function.__annotations__
            return make(specialised, real, values)

        self.made = made

    def __call__(self, real: type, **values: Any) -> Any:
        """Return the kernel or function of a scalar type."""
        return self.made(real, **values)


def per_real(*names: str, **options: Any) -> Callable[[FunctionType], PerReal]:
    """Decorate a function that becomes kernels, see `PerReal`; `ops._interop.launch` makes and launches them.

    Options are those of `wp.kernel`, or functions that return them; `fast_math` holds for float32 alone.
    """
    fast_math = options.pop("fast_math", False)

    def make(function: FunctionType, real: type, values: dict[str, Any]) -> wp.Kernel:
        chosen = {name: x(real, **values) if callable(x) else x for name, x in options.items()}
        module_options = {"fast_math": fast_math and real is wp.float32}
        return wp.kernel(function, enable_backward=False, module="unique", module_options=module_options, **chosen)

    return functools.partial(PerReal, make, names)


func_per_real = functools.partial(PerReal, lambda function, *_: wp.func(function), None)
