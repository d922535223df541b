"""Products, quotients and sums of SIMD vectors, with their adjoints."""

from types import SimpleNamespace

import warp as wp

from nexwarp.native.simd.snippets import TYPES, filled

_SPLAT = """
    reals_t y = x;
    wp::vec_t<WIDTH, REAL> v;
    __builtin_memcpy(&v, &y, sizeof(v));
    return v;
"""

_ADJOINT_SPLAT = """
    reals_t g;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    SUM_OF_G
    adj_x += sum;
"""

_SCALED = """
    reals_t x;
    __builtin_memcpy(&x, &a, sizeof(x));
    x = x * s;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_SCALED = """
    reals_t g, x, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&total, &adj_a, sizeof(total));
    total = total + g * s;
    __builtin_memcpy(&adj_a, &total, sizeof(total));
    g = g * x;
    SUM_OF_G
    adj_s += sum;
"""

# Warp's own products and quotients of vectors are loops over their elements, and so are their derivatives.
_TIMES = """
    reals_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = x * y;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_TIMES = """
    reals_t g, x, y, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    __builtin_memcpy(&total, &adj_a, sizeof(total));
    total = total + g * y;
    __builtin_memcpy(&adj_a, &total, sizeof(total));
    __builtin_memcpy(&total, &adj_b, sizeof(total));
    total = total + g * x;
    __builtin_memcpy(&adj_b, &total, sizeof(total));
"""

_OVER = _TIMES.replace("x * y", "x / y")

_ADJOINT_OVER = """
    reals_t g, x, y, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    g = g / y;
    __builtin_memcpy(&total, &adj_a, sizeof(total));
    total = total + g;
    __builtin_memcpy(&adj_a, &total, sizeof(total));
    __builtin_memcpy(&total, &adj_b, sizeof(total));
    total = total - g * (x / y);
    __builtin_memcpy(&adj_b, &total, sizeof(total));
"""

_INNER = """
    reals_t g, x;
    __builtin_memcpy(&g, &a, sizeof(g));
    __builtin_memcpy(&x, &b, sizeof(x));
    g = g * x;
    SUM_OF_G
    return sum;
"""

_ADJOINT_INNER = """
    reals_t x, y, total;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    __builtin_memcpy(&total, &adj_a, sizeof(total));
    total = total + y * adj_ret;
    __builtin_memcpy(&adj_a, &total, sizeof(total));
    __builtin_memcpy(&total, &adj_b, sizeof(total));
    total = total + x * adj_ret;
    __builtin_memcpy(&adj_b, &total, sizeof(total));
"""


def arithmetic_functions(real: type, width: int) -> SimpleNamespace:
    """Make splat(x), scaled(s, a), times(a, b), over(a, b) and inner(a, b), the sum of a * b over the elements."""
    reals = wp.types.vector(length=width, dtype=real)

    def snippet(text: str) -> str:
        return filled(TYPES + text, real, width)

    @wp.func_native(snippet(_SPLAT), adj_snippet=snippet(_ADJOINT_SPLAT))
    def splat(x: real) -> reals: ...

    @wp.func_native(snippet(_SCALED), adj_snippet=snippet(_ADJOINT_SCALED))
    def scaled(s: real, a: reals) -> reals: ...

    @wp.func_native(snippet(_TIMES), adj_snippet=snippet(_ADJOINT_TIMES))
    def times(a: reals, b: reals) -> reals: ...

    @wp.func_native(snippet(_OVER), adj_snippet=snippet(_ADJOINT_OVER))
    def over(a: reals, b: reals) -> reals: ...

    @wp.func_native(snippet(_INNER), adj_snippet=snippet(_ADJOINT_INNER))
    def inner(a: reals, b: reals) -> real: ...

    return SimpleNamespace(splat=splat, scaled=scaled, times=times, over=over, inner=inner)
