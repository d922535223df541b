"""The kernel's shape: how opaque a surfel is at a point (u, v) of its plane (paper Eq. 3). It is written here alone.

    alpha(u, v) = min(opacity exp(-(|u|^(2 gamma 1) + |v|^(2 gamma 2)) / 2), 0.99)

with u and v in units of the surfel's scales. The compositing passes call `alpha_at` and, for its derivative,
`alpha_gradients`; what culls calls `exponent_limit`, `reach` and `far_outside`. A hit counts where alpha >= 1/255.

Another shape with the same parameters, opacity and two exponents, changes these files:

    kernels/shape.py                    the functions below
    tests/reference/collect.py          the float64 reference that proves the functions
    export/web/shaders/                 the same in WGSL: project.wgsl the reach, collect.wgsl alpha
    export/web/page/baked_shaders.js    the same in GLSL, for baked pages; export/glb.py draws it as opacities
    examples/read_model.py              the same in NumPy

Another number of parameters also changes the record (kernels/surfel.py, kernels/project.py), activation and
antialiasing (kernels/activate.py, kernels/detail.py), `Surfels` and model files (model/), and what export/ writes
of them.
"""

import math

import warp as wp

from nexwarp.kernels.types import ALPHA_MAX, LIMIT_MARGIN, TINY, Real, Vec2
from nexwarp.native.powers import binary_logarithm, power_of_2

# Warp takes a Python float as float32: what float32 does not hold exactly is a float64 here.
CAP = wp.constant(wp.float64(ALPHA_MAX))
LEAST_SQUARE = wp.constant(wp.float64(TINY))
MARGIN = wp.constant(wp.float64(LIMIT_MARGIN))
WIDER = wp.constant(wp.float64(1.001))
# e^(-x / 2) is 2 to the power of this times x.
FALLOFF = wp.constant(wp.float64(-0.5 / math.log(2.0)))
LN_2 = wp.constant(wp.float64(math.log(2.0)))


@wp.func
def square(x: Real):
    """x^2, above 0, so that its logarithm stays finite at a surfel's centre."""
    return wp.max(x * x, type(x)(LEAST_SQUARE))


@wp.func
def alpha_at(u: Real, v: Real, opacity: Real, gamma_1: Real, gamma_2: Real):
    """Opacity of the surfel at (u, v)."""
    power_u = power_of_2(gamma_1 * binary_logarithm(square(u)))
    power_v = power_of_2(gamma_2 * binary_logarithm(square(v)))
    return wp.min(opacity * power_of_2(type(u)(FALLOFF) * (power_u + power_v)), type(u)(CAP))


@wp.func
def alpha_gradients(u: Real, v: Real, opacity: Real, gamma_1: Real, gamma_2: Real, grad_alpha: Real):
    """Gradients of u, v, opacity, gamma 1 and gamma 2, given that of `alpha_at`."""
    two = type(u)(2.0)
    log_u = binary_logarithm(square(u))
    log_v = binary_logarithm(square(v))
    power_u = power_of_2(gamma_1 * log_u)
    power_v = power_of_2(gamma_2 * log_v)
    falloff = power_of_2(type(u)(FALLOFF) * (power_u + power_v))
    alpha = opacity * falloff
    # A capped alpha is constant.
    grad_falloff = wp.where(alpha < type(u)(CAP), grad_alpha, type(u)(0.0))
    grad_exponent = type(u)(-0.5) * (grad_falloff * alpha)
    grad_power_u = grad_exponent * power_u
    grad_power_v = grad_exponent * power_v
    grad_u = two * gamma_1 * (grad_power_u / square(u) * u)
    grad_v = two * gamma_2 * (grad_power_v / square(v) * v)
    grad_gamma_1 = type(u)(LN_2) * (grad_power_u * log_u)
    grad_gamma_2 = type(u)(LN_2) * (grad_power_v * log_v)
    return grad_u, grad_v, grad_falloff * falloff, grad_gamma_1, grad_gamma_2


@wp.func
def exponent_limit(opacity: Real):
    """What the exponent |u|^(2 gamma 1) + |v|^(2 gamma 2) of a hit cannot exceed, and a little more."""
    two = type(opacity)(2.0)
    return two * wp.log(type(opacity)(255.0) * wp.max(opacity, type(opacity)(LEAST_SQUARE))) + type(opacity)(MARGIN)


@wp.func
def reach(opacity: Real, gamma: Vec2):
    """What |u| and |v| of a hit cannot exceed: half the sides of the support; (0, 0) where nothing can be hit."""
    # 0.1 % beyond the support, so that rounding in log and pow cannot cull a hit.
    limit = type(opacity)(2.0) * wp.log(type(opacity)(255.0) * type(opacity)(WIDER) * opacity)
    half = type(opacity)(0.5)
    if limit > type(opacity)(0.0):
        return wp.vector(wp.pow(limit, half / gamma[0]), wp.pow(limit, half / gamma[1]))
    return type(gamma)()


@wp.func
def far_outside(u: Real, v: Real, limit: Real):
    """True only where alpha is certainly below 1/255, given `exponent_limit`: spares the exponentials.

    Beyond 1, |u|^(2 gamma) is at least u^2.
    """
    one = type(u)(1.0)
    zero = type(u)(0.0)
    u2 = u * u
    v2 = v * v
    return wp.where(u2 > one, u2, zero) + wp.where(v2 > one, v2, zero) > limit
