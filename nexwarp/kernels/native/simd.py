"""Arithmetic on several pixels at once, for CPUs: a Warp vector whose elements are the lanes of SIMD registers.

The hit of a ray is written once, for one pixel or for a row of them; what differs are the operators below. With one
lane a value is a scalar, as on CUDA, where the hardware makes lanes of threads. Clang turns vector arithmetic into SIMD
instructions, but knows no SIMD exponential: those here are polynomials (Cephes), right to 2 units in the last place.
"""

import functools
from types import SimpleNamespace

import warp as wp

_TYPES = """
    typedef REAL lane_t __attribute__((ext_vector_type(LANES)));
    typedef INT word_t __attribute__((ext_vector_type(LANES)));
"""

# Without the instruction, a fused product and sum would be a call a lane.
_MADD = """
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__AVX512F__)
    #define MADD(a, b, c) __builtin_elementwise_fma(a, b, c)
#else
    #define MADD(a, b, c) ((a) * (b) + (c))
#endif
"""

_EXP = (
    _MADD
    + """
    lane_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    {
        x = x > (lane_t)88.0f ? (lane_t)88.0f : x;
        x = x < (lane_t)-87.0f ? (lane_t)-87.0f : x;
        const lane_t n = __builtin_elementwise_floor(MADD(x, (lane_t)1.44269504088896341f, (lane_t)0.5f));
        const lane_t r = MADD(n, (lane_t)2.12194440e-4f, MADD(n, (lane_t)-0.693359375f, x));
        p = MADD(r, (lane_t)1.9875691500e-4f, (lane_t)1.3981999507e-3f);
        p = MADD(p, r, (lane_t)8.3334519073e-3f);
        p = MADD(p, r, (lane_t)4.1665795894e-2f);
        p = MADD(p, r, (lane_t)1.6666665459e-1f);
        p = MADD(p, r, (lane_t)5.0000001201e-1f);
        p = MADD(p, r * r, r + 1.0f);
        const word_t power = (__builtin_convertvector(n, word_t) + 127) << 23;
        lane_t scale;
        __builtin_memcpy(&scale, &power, sizeof(scale));
        p = p * scale;
    }
"""
)

# x - x is 0, but NaN for infinities and NaN, which the bits alone would not show.
_LOG = (
    _MADD
    + """
    lane_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    {
        word_t bits;
        __builtin_memcpy(&bits, &x, sizeof(x));
        word_t exponent = (bits >> 23) - 126;
        bits = (bits & 0x007fffff) | 0x3f000000;
        lane_t m;
        __builtin_memcpy(&m, &bits, sizeof(m));
        const word_t low = (word_t)(m < (lane_t)0.707106781186547524f);
        exponent += low;
        m = (low ? m + m : m) - 1.0f;
        const lane_t e = __builtin_convertvector(exponent, lane_t);
        const lane_t z = m * m;
        p = MADD(m, (lane_t)7.0376836292e-2f, (lane_t)-1.1514610310e-1f);
        p = MADD(p, m, (lane_t)1.1676998740e-1f);
        p = MADD(p, m, (lane_t)-1.2420140846e-1f);
        p = MADD(p, m, (lane_t)1.4249322787e-1f);
        p = MADD(p, m, (lane_t)-1.6668057665e-1f);
        p = MADD(p, m, (lane_t)2.0000714765e-1f);
        p = MADD(p, m, (lane_t)-2.4999993993e-1f);
        p = MADD(p, m, (lane_t)3.3333331174e-1f);
        p = MADD(p, m * z, MADD(e, (lane_t)-2.12194440e-4f, z * -0.5f));
        p = MADD(e, (lane_t)0.693359375f, m + p) + (x - x);
    }
"""
)

# Float64 is for tests: exactness counts, not speed.
_EXACT = """
    lane_t x, p;
    __builtin_memcpy(&x, &v, sizeof(x));
    for (int l = 0; l < LANES; ++l) p[l] = FUNCTION(x[l]);
"""

_RETURN = """
    __builtin_memcpy(&v, &p, sizeof(p));
    return v;
"""

_ADJOINT = """
    lane_t g, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&total, &adj_v, sizeof(total));
    total = total + DERIVATIVE;
    __builtin_memcpy(&adj_v, &total, sizeof(total));
"""

_SPLAT = """
    lane_t y = x;
    wp::vec_t<LANES, REAL> v;
    __builtin_memcpy(&v, &y, sizeof(v));
    return v;
"""

_ADJOINT_SPLAT = """
    lane_t g;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    SUM_OF_G
    adj_x += sum;
"""

_SCALED = """
    lane_t x;
    __builtin_memcpy(&x, &a, sizeof(x));
    x = x * s;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_SCALED = """
    lane_t g, x, total;
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
    lane_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = x * y;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_TIMES = """
    lane_t g, x, y, total;
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
    lane_t g, x, y, total;
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
    lane_t g, x;
    __builtin_memcpy(&g, &a, sizeof(g));
    __builtin_memcpy(&x, &b, sizeof(x));
    g = g * x;
    SUM_OF_G
    return sum;
"""

_ADJOINT_INNER = """
    lane_t x, y, total;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    __builtin_memcpy(&total, &adj_a, sizeof(total));
    total = total + y * adj_ret;
    __builtin_memcpy(&adj_a, &total, sizeof(total));
    __builtin_memcpy(&total, &adj_b, sizeof(total));
    total = total + x * adj_ret;
    __builtin_memcpy(&adj_b, &total, sizeof(total));
"""

_PICK = """
    word_t m;
    lane_t x, y;
    __builtin_memcpy(&m, &mask, sizeof(m));
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = m != 0 ? x : y;
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

_ADJOINT_PICK = """
    word_t m;
    lane_t g, x, y;
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
    lane_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    const word_t m = COMPARISON;
    wp::vec_t<LANES, INT> mask;
    __builtin_memcpy(&mask, &m, sizeof(m));
    return mask;
"""

_WORDS = """
    word_t x, y;
    __builtin_memcpy(&x, &a, sizeof(x));
    __builtin_memcpy(&y, &b, sizeof(y));
    x = (word_t)(OPERATION);
    __builtin_memcpy(&a, &x, sizeof(x));
    return a;
"""

# Whole rows at once: element by element, Clang takes the table apart into numbers and puts vectors together again, at
# the cost of seconds of its time and of some of the kernel's.
_ROW_AT = """
    wp::vec_t<LANES, NUMBER> v;
    __builtin_memcpy(&v, rows.data[j], sizeof(v));
    return v;
"""

_ADJOINT_ROW_AT = """
    lane_t g, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&total, adj_rows.data[j], sizeof(total));
    total = total + g;
    __builtin_memcpy(adj_rows.data[j], &total, sizeof(total));
"""

_WITH_ROW = """
    __builtin_memcpy(rows.data[j], &v, sizeof(v));
    return rows;
"""

_ANY = """
    word_t m;
    __builtin_memcpy(&m, &mask, sizeof(m));
    return __builtin_reduce_or(m) != 0;
"""


@functools.cache
def lane_functions(real: type, lanes: int, for_gradients: bool = False) -> SimpleNamespace:
    """Operators of a value of `lanes` pixels; `for_gradients` makes another set (see `surfel.hit_functions`).

    Their names are not those of Warp's own, mul or div: Warp would call them for the operators.

    Returns:
        `lane`, the type (`real` itself for one pixel), and functions: splat(x), scaled(s, a), times(a, b), over(a, b),
        power_of_e(v), logarithm(v), inner(a, b) to a scalar, at_least(a, low), at_most(a, high), below(a, b) to a mask,
        pick(mask, a, b). For vectors also `word`, the type of masks (0 or -1) and of whole numbers, `integer`, of the
        width of `real`; above(a, b, or_equal) to a mask; and of words equal_words, below_words, both, either,
        pick_words, any_of.
    """
    return _vector_functions(real, lanes) if lanes > 1 else _scalar_functions(real)


def _scalar_functions(real: type) -> SimpleNamespace:
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
    def logarithm(v: real):
        return wp.log(v)

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
        lane=real,
        splat=splat,
        scaled=scaled,
        times=times,
        over=over,
        inner=times,
        power_of_e=power_of_e,
        logarithm=logarithm,
        below=below,
        pick=pick,
        at_least=at_least,
        at_most=at_most,
    )


def _filled(text: str, real: type, lanes: int, **replaced: str) -> str:
    """Put what a snippet leaves open: `replaced`, then the types and their lanes."""
    wide = real is wp.float64
    # The sum over the lanes by halves: in order it would be one addition after another.
    halves = [f"const auto g{n // 2} = g{n}.lo + g{n}.hi;" for n in (16, 8, 4) if n <= lanes]
    names = {
        "SUM_OF_G": f"const auto g{lanes} = g; {' '.join(halves)} const REAL sum = g2[0] + g2[1];",
        "REAL": "double" if wide else "float",
        "INT": "wp::int64" if wide else "wp::int32",
        "LANES": str(lanes),
    }
    for key, value in (replaced | names).items():
        text = text.replace(key, value)
    return text


def _vector_functions(real: type, lanes: int) -> SimpleNamespace:
    wide = real is wp.float64
    lane = wp.types.vector(length=lanes, dtype=real)
    integer = wp.int64 if wide else wp.int32
    word = wp.types.vector(length=lanes, dtype=integer)

    def snippet(*parts: str, **replaced: str) -> str:
        return _filled("".join((_TYPES, *parts)), real, lanes, **replaced)

    exp_body, log_body = (_EXACT.replace("FUNCTION", f"::{f}") for f in ("exp", "log")) if wide else (_EXP, _LOG)

    @wp.func_native(snippet(_SPLAT), adj_snippet=snippet(_ADJOINT_SPLAT))
    def splat(x: real) -> lane: ...

    @wp.func_native(snippet(_SCALED), adj_snippet=snippet(_ADJOINT_SCALED))
    def scaled(s: real, a: lane) -> lane: ...

    @wp.func_native(snippet(_TIMES), adj_snippet=snippet(_ADJOINT_TIMES))
    def times(a: lane, b: lane) -> lane: ...

    @wp.func_native(snippet(_OVER), adj_snippet=snippet(_ADJOINT_OVER))
    def over(a: lane, b: lane) -> lane: ...

    @wp.func_native(snippet(_INNER), adj_snippet=snippet(_ADJOINT_INNER))
    def inner(a: lane, b: lane) -> real: ...

    @wp.func_native(snippet(exp_body, _RETURN), adj_snippet=snippet(exp_body, _ADJOINT, DERIVATIVE="g * p"))
    def power_of_e(v: lane) -> lane: ...

    @wp.func_native(snippet(log_body, _RETURN), adj_snippet=snippet(log_body, _ADJOINT, DERIVATIVE="g / x"))
    def logarithm(v: lane) -> lane: ...

    @wp.func_native(snippet(_COMPARE, COMPARISON="(word_t)(x < y)"), adj_snippet="")
    def below(a: lane, b: lane) -> word: ...

    @wp.func_native(snippet(_PICK), adj_snippet=snippet(_ADJOINT_PICK))
    def pick(mask: word, a: lane, b: lane) -> lane: ...

    # Warp's own min and max of vectors call a function an element in their derivative.
    @wp.func
    def at_least(a: lane, low: real):
        return pick(below(a, splat(low)), splat(low), a)

    @wp.func
    def at_most(a: lane, high: real):
        return pick(below(splat(high), a), splat(high), a)

    @wp.func_native(snippet(_COMPARE, COMPARISON="or_equal ? (word_t)(x >= y) : (word_t)(x > y)"))
    def above(a: lane, b: lane, or_equal: wp.bool) -> word: ...

    @wp.func_native(snippet(_WORDS, OPERATION="x == y"))
    def equal_words(a: word, b: word) -> word: ...

    @wp.func_native(snippet(_WORDS, OPERATION="x < y"))
    def below_words(a: word, b: word) -> word: ...

    @wp.func_native(snippet(_WORDS, OPERATION="x & y"))
    def both(a: word, b: word) -> word: ...

    @wp.func_native(snippet(_WORDS, OPERATION="x | y"))
    def either(a: word, b: word) -> word: ...

    @wp.func_native(snippet(_PICK.replace("lane_t", "word_t")))
    def pick_words(mask: word, a: word, b: word) -> word: ...

    @wp.func_native(snippet(_ANY))
    def any_of(mask: word) -> wp.bool: ...

    return SimpleNamespace(
        lane=lane,
        word=word,
        integer=integer,
        splat=splat,
        scaled=scaled,
        times=times,
        over=over,
        inner=inner,
        power_of_e=power_of_e,
        logarithm=logarithm,
        below=below,
        pick=pick,
        at_least=at_least,
        at_most=at_most,
        above=above,
        equal_words=equal_words,
        below_words=below_words,
        both=both,
        either=either,
        pick_words=pick_words,
        any_of=any_of,
    )


@functools.cache
def slot_functions(real: type, lanes: int, slots: int, for_gradients: bool = False) -> SimpleNamespace:
    """Tables with a value of `lanes` > 1 pixels in each of `slots` rows; `for_gradients` as in `lane_functions`.

    Returns:
        `lanes_by_slot` and `words_by_slot`, types of tables of reals and of words, and functions: lane_at(rows, j),
        which is differentiable, and word_at(rows, j), a row; with_lane(rows, j, v) and with_word(rows, j, v), the table
        with another row j.
    """
    f = lane_functions(real, lanes, for_gradients)
    lane, word, integer = f.lane, f.word, f.integer
    lanes_by_slot = wp.types.matrix(shape=(slots, lanes), dtype=real)
    words_by_slot = wp.types.matrix(shape=(slots, lanes), dtype=integer)

    def snippet(text: str, **replaced: str) -> str:
        return _filled(text, real, lanes, **replaced)

    @wp.func_native(snippet(_ROW_AT, NUMBER="REAL"), adj_snippet=snippet(_TYPES + _ADJOINT_ROW_AT))
    def lane_at(rows: lanes_by_slot, j: wp.int32) -> lane: ...

    @wp.func_native(snippet(_ROW_AT, NUMBER="INT"))
    def word_at(rows: words_by_slot, j: wp.int32) -> word: ...

    @wp.func_native(_WITH_ROW)
    def with_lane(rows: lanes_by_slot, j: wp.int32, v: lane) -> lanes_by_slot: ...

    @wp.func_native(_WITH_ROW)
    def with_word(rows: words_by_slot, j: wp.int32, v: word) -> words_by_slot: ...

    return SimpleNamespace(
        lanes_by_slot=lanes_by_slot,
        words_by_slot=words_by_slot,
        lane_at=lane_at,
        word_at=word_at,
        with_lane=with_lane,
        with_word=with_word,
    )
