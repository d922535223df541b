"""Exponential and logarithm of SIMD vectors, with their adjoints.

Clang knows no SIMD form of either. In float32 they are polynomials (Cephes), right to 2 units in the last place.
"""

import math
from types import SimpleNamespace

import warp as wp

from nexwarp.native.simd.snippets import TYPES, filled

LN_2 = f"(REAL){math.log(2.0)!r}"

# Without the instruction, a fused product and sum would be a call a lane.
_MADD = """
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__AVX512F__)
    #define MADD(a, b, c) __builtin_elementwise_fma(a, b, c)
#else
    #define MADD(a, b, c) ((a) * (b) + (c))
#endif
"""

# Of r, |r| <= ln 2 / 2; then p * 2^n.
_EXP_REDUCED = """
        p = MADD(r, (reals_t)1.9875691500e-4f, (reals_t)1.3981999507e-3f);
        p = MADD(p, r, (reals_t)8.3334519073e-3f);
        p = MADD(p, r, (reals_t)4.1665795894e-2f);
        p = MADD(p, r, (reals_t)1.6666665459e-1f);
        p = MADD(p, r, (reals_t)5.0000001201e-1f);
        p = MADD(p, r * r, r + 1.0f);
        const integers_t power = (__builtin_convertvector(n, integers_t) + 127) << 23;
        reals_t scale;
        __builtin_memcpy(&scale, &power, sizeof(scale));
        p = p * scale;
"""

_EXP = (
    _MADD
    + """
    reals_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    {
        x = x > (reals_t)88.0f ? (reals_t)88.0f : x;
        x = x < (reals_t)-87.0f ? (reals_t)-87.0f : x;
        const reals_t n = __builtin_elementwise_floor(MADD(x, (reals_t)1.44269504088896341f, (reals_t)0.5f));
        const reals_t r = MADD(n, (reals_t)2.12194440e-4f, MADD(n, (reals_t)-0.693359375f, x));
"""
    + _EXP_REDUCED
    + "    }"
)

_EXP2 = (
    _MADD
    + """
    reals_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    {
        x = x > (reals_t)127.0f ? (reals_t)127.0f : x;
        x = x < (reals_t)-126.0f ? (reals_t)-126.0f : x;
        const reals_t n = __builtin_elementwise_floor(x + 0.5f);
        const reals_t r = (x - n) * 0.693147180559945309f;
"""
    + _EXP_REDUCED
    + "    }"
)

# x - x is 0, but NaN for infinities and NaN, which the bits alone would not show.
_LOG2 = (
    _MADD
    + """
    reals_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    {
        integers_t bits;
        __builtin_memcpy(&bits, &x, sizeof(x));
        integers_t exponent = (bits >> 23) - 126;
        bits = (bits & 0x007fffff) | 0x3f000000;
        reals_t m;
        __builtin_memcpy(&m, &bits, sizeof(m));
        const integers_t low = (integers_t)(m < (reals_t)0.707106781186547524f);
        exponent += low;
        m = (low ? m + m : m) - 1.0f;
        const reals_t e = __builtin_convertvector(exponent, reals_t);
        const reals_t z = m * m;
        p = MADD(m, (reals_t)7.0376836292e-2f, (reals_t)-1.1514610310e-1f);
        p = MADD(p, m, (reals_t)1.1676998740e-1f);
        p = MADD(p, m, (reals_t)-1.2420140846e-1f);
        p = MADD(p, m, (reals_t)1.4249322787e-1f);
        p = MADD(p, m, (reals_t)-1.6668057665e-1f);
        p = MADD(p, m, (reals_t)2.0000714765e-1f);
        p = MADD(p, m, (reals_t)-2.4999993993e-1f);
        p = MADD(p, m, (reals_t)3.3333331174e-1f);
        p = MADD(p, m * z, z * -0.5f) + m;
        p = MADD(p, (reals_t)1.44269504088896341f, e) + (x - x);
    }
"""
)

# Float64 is for tests: exactness counts, not speed.
_EXACT = """
    reals_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    for (int l = 0; l < WIDTH; ++l) p[l] = FUNCTION(x[l]);
"""

_RETURN = """
    __builtin_memcpy(&v, &p, sizeof(p));
    return v;
"""

_ADJOINT = """
    reals_t g, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&total, &adj_v, sizeof(total));
    total = total + DERIVATIVE;
    __builtin_memcpy(&adj_v, &total, sizeof(total));
"""


def exp_log_functions(real: type, width: int) -> SimpleNamespace:
    """Make power_of_e(v), power_of_2(v) and binary_logarithm(v)."""
    reals = wp.types.vector(length=width, dtype=real)
    exp_body, exp2_body, log2_body = _EXP, _EXP2, _LOG2
    if real is wp.float64:
        exp_body, exp2_body, log2_body = (_EXACT.replace("FUNCTION", f"::{f}") for f in ("exp", "exp2", "log2"))

    def snippet(*parts: str, **replaced: str) -> str:
        return filled("".join((TYPES, *parts)), real, width, **replaced)

    @wp.func_native(snippet(exp_body, _RETURN), adj_snippet=snippet(exp_body, _ADJOINT, DERIVATIVE="g * p"))
    def power_of_e(v: reals) -> reals: ...

    @wp.func_native(snippet(exp2_body, _RETURN), adj_snippet=snippet(exp2_body, _ADJOINT, DERIVATIVE=f"g * p * {LN_2}"))
    def power_of_2(v: reals) -> reals: ...

    @wp.func_native(
        snippet(log2_body, _RETURN), adj_snippet=snippet(log2_body, _ADJOINT, DERIVATIVE=f"g / (x * {LN_2})")
    )
    def binary_logarithm(v: reals) -> reals: ...

    return SimpleNamespace(power_of_e=power_of_e, power_of_2=power_of_2, binary_logarithm=binary_logarithm)
