"""Comparisons of SIMD vectors, and what is done with their masks: integers, -1 where true and 0 where not."""

from types import SimpleNamespace

import warp as wp

from nexwarp.native.simd.snippets import TYPES, filled

_PICK = """
    integers_t m;
    reals_t x, y;
    __builtin_memcpy(&m, &mask, sizeof(m));
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = m != 0 ? x : y;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_PICK = """
    integers_t m;
    reals_t g, x, y;
    __builtin_memcpy(&m, &mask, sizeof(m));
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&x, &adj_a, sizeof(x));
    __builtin_memcpy(&y, &adj_b, sizeof(y));
    x = m != 0 ? x + g : x;
    y = m != 0 ? y : y + g;
    __builtin_memcpy(&adj_a, &x, sizeof(x));
    __builtin_memcpy(&adj_b, &y, sizeof(y));
"""

_COMPARE = """
    reals_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    const integers_t m = COMPARISON;
    wp::vec_t<WIDTH, INT> mask;
    __builtin_memcpy(&mask, &m, sizeof(m));
    return mask;
"""

_INTEGERS = """
    integers_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = (integers_t)(OPERATION);
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ANY = """
    integers_t m;
    __builtin_memcpy(&m, &mask, sizeof(m));
    return __builtin_reduce_or(m) != 0;
"""


def mask_functions(real: type, width: int, splat: wp.Function) -> SimpleNamespace:
    """Make the functions.

    Of reals: below(a, b) and above(a, b, or_equal) to a mask; pick(mask, a, b), at_least(a, low) and at_most(a, high),
    which have adjoints. Of integers: equal_integers, less_integers, both, either, pick_integers, any_of.
    """
    reals = wp.types.vector(length=width, dtype=real)
    integers = wp.types.vector(length=width, dtype=wp.int64 if real is wp.float64 else wp.int32)

    def snippet(text: str, **replaced: str) -> str:
        return filled(TYPES + text, real, width, **replaced)

    @wp.func_native(snippet(_COMPARE, COMPARISON="(integers_t)(x < y)"), adj_snippet="")
    def below(a: reals, b: reals) -> integers: ...

    @wp.func_native(snippet(_COMPARE, COMPARISON="or_equal ? (integers_t)(x >= y) : (integers_t)(x > y)"))
    def above(a: reals, b: reals, or_equal: wp.bool) -> integers: ...

    @wp.func_native(snippet(_PICK), adj_snippet=snippet(_ADJOINT_PICK))
    def pick(mask: integers, a: reals, b: reals) -> reals: ...

    # Warp's own min and max of vectors call a function an element in their derivative.
    @wp.func
    def at_least(a: reals, low: real):
        return pick(below(a, splat(low)), splat(low), a)

    @wp.func
    def at_most(a: reals, high: real):
        return pick(below(splat(high), a), splat(high), a)

    @wp.func_native(snippet(_INTEGERS, OPERATION="x == y"))
    def equal_integers(a: integers, b: integers) -> integers: ...

    @wp.func_native(snippet(_INTEGERS, OPERATION="x < y"))
    def less_integers(a: integers, b: integers) -> integers: ...

    @wp.func_native(snippet(_INTEGERS, OPERATION="x & y"))
    def both(a: integers, b: integers) -> integers: ...

    @wp.func_native(snippet(_INTEGERS, OPERATION="x | y"))
    def either(a: integers, b: integers) -> integers: ...

    @wp.func_native(snippet(_PICK.replace("reals_t", "integers_t")))
    def pick_integers(mask: integers, a: integers, b: integers) -> integers: ...

    @wp.func_native(snippet(_ANY))
    def any_of(mask: integers) -> wp.bool: ...

    return SimpleNamespace(
        below=below,
        above=above,
        pick=pick,
        at_least=at_least,
        at_most=at_most,
        equal_integers=equal_integers,
        less_integers=less_integers,
        both=both,
        either=either,
        pick_integers=pick_integers,
        any_of=any_of,
    )
