"""Warp types and constants for a scalar type."""

import functools
from types import SimpleNamespace

import warp as wp

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
# The exponent of a hit is at most 2 ln(255 opacity); rounding must not cull one.
LIMIT_MARGIN = 1e-3
# Floor of u^2, so that log stays finite at a surfel's centre.
TINY = 1e-20
MAX_HITS = 8
MAX_SH_DEGREE = 6  # of the surfels' colours
MAX_TEXTURE_SH_DEGREE = 3


@functools.cache
def types(real: type) -> SimpleNamespace:
    """Vector, matrix and array types over `real` (wp.float32 or wp.float64), and wrapped constants."""
    return SimpleNamespace(
        real=real,
        vec2=wp.types.vector(length=2, dtype=real),
        vec3=wp.types.vector(length=3, dtype=real),
        vec4=wp.types.vector(length=4, dtype=real),
        mat33=wp.types.matrix(shape=(3, 3), dtype=real),
        mat44=wp.types.matrix(shape=(4, 4), dtype=real),
        ALPHA_MIN=wp.constant(real(ALPHA_MIN)),
        ALPHA_MAX=wp.constant(real(ALPHA_MAX)),
        TRANSMITTANCE_MIN=wp.constant(real(TRANSMITTANCE_MIN)),
        TINY=wp.constant(real(TINY)),
        ZERO=wp.constant(real(0.0)),
        HALF=wp.constant(real(0.5)),
        ONE=wp.constant(real(1.0)),
        TWO=wp.constant(real(2.0)),
    )
