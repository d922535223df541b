"""Arithmetic on SIMD vectors, for CPUs: `width` neighbouring pixels or points at once.

What is written once for one value or for several, such as the hit of a ray, calls the functions below in place of
operators. With width 1 a value is a scalar, as on CUDA. Otherwise it is a Warp vector whose elements lie in a SIMD
register. (`width` counts its elements; a lane is a thread's index in a CUDA warp, see `native.warp`.)
"""

import functools
from types import SimpleNamespace

import warp as wp


@functools.cache
def simd_functions(real: type, width: int, for_gradients: bool = False) -> SimpleNamespace:
    """Make the functions of values of `width` elements; `for_gradients` makes another set, see `surfel.hit_functions`.

    Their names are not those of Warp's own, mul or div: Warp would call them for the operators.

    Returns:
        `reals`, the type of values (`real` itself for width 1), and the differentiable functions splat(x),
        scaled(s, a), times(a, b), over(a, b), power_of_e(v), power_of_2(v), binary_logarithm(v), inner(a, b) to a
        scalar, at_least(a, low), at_most(a, high), below(a, b) to a mask, pick(mask, a, b). With width 1, powers of 2
        and binary logarithms have no derivative. For widths over 1 also `integers`, the type of masks and of whole
        numbers, `integer`, an element of it, as wide as `real`, and the rest of `mask_functions`.
    """
    return _scalar_functions(real)


# Base 2 is what a GPU has instructions for: base e would multiply by ln 2 before or after each. Accurate to 2 units in
# the last place, as Warp's `fast_math` makes of base e.
_EXP2 = """
#if defined(__CUDA_ARCH__)
    float result;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(v));
    return result;
#else
    return ::exp2f(v);
#endif
"""

_LOG2 = """
#if defined(__CUDA_ARCH__)
    float result;
    asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(v));
    return result;
#else
    return ::log2f(v);
#endif
"""


def _scalar_functions(real: type) -> SimpleNamespace:
    exp2, log2 = ("    return ::exp2(v);", "    return ::log2(v);") if real is wp.float64 else (_EXP2, _LOG2)

    @wp.func_native(exp2)
    def power_of_2(v: real) -> real: ...

    @wp.func_native(log2)
    def binary_logarithm(v: real) -> real: ...

    @wp.func
    def splat(x: real):
        return x

    @wp.func
    def scaled(s: real, a: real):
        return s * a

    @wp.func
    def times(a: real, b: real):
        return a * b

    @wp.func
    def over(a: real, b: real):
        return a / b

    @wp.func
    def power_of_e(v: real):
        return wp.exp(v)

    @wp.func
    def below(a: real, b: real):
        return a < b

    @wp.func
    def pick(mask: wp.bool, a: real, b: real):
        return wp.where(mask, a, b)

    @wp.func
    def at_least(a: real, low: real):
        return wp.max(a, low)

    @wp.func
    def at_most(a: real, high: real):
        return wp.min(a, high)

    return SimpleNamespace(
        reals=real,
        splat=splat,
        scaled=scaled,
        times=times,
        over=over,
        inner=times,
        power_of_e=power_of_e,
        power_of_2=power_of_2,
        binary_logarithm=binary_logarithm,
        below=below,
        pick=pick,
        at_least=at_least,
        at_most=at_most,
    )
