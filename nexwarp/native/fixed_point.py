"""Sums of floats that do not depend on the order of their terms: fixed-point numbers, added up as integers by atomics.

A float is a pair of 64-bit integers, its multiples of 2^-20 and what is left in multiples of 2^-60: magnitudes below
2^23, 10^-18 apart, millions of terms. Larger ones and those that are not finite raise a flag instead, which makes the
sums NaN. A hash grid would take too much memory so: its terms share one scale, see `hashgrid`.
"""

from __future__ import annotations

import warp as wp

from nexwarp import native
from nexwarp.native import snippet
from nexwarp.native.warp import record_sum_snippet

integers, flags = wp.array2d(dtype=wp.int64), wp.array(dtype=wp.int32)

HIGH, LOW = 2.0**20, 2.0**60

LARGEST = 2.0**23

# One term that is scaled already may have at most this many units.
MOST_UNITS = 2.0**52

_CUDA_ADD = """
    auto add = [](wp::int64* sum, long long term) {
        atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(term));
    };
    auto raise = [&]() { atomicOr(&wp::index(bad, 0), 1); };
"""
_CPU_ADD = """
    auto add = [](wp::int64* sum, long long term) { *sum += term; };
    auto raise = [&]() { wp::index(bad, 0) = 1; };
"""
_ADD = (
    snippet(_CUDA_ADD, _CPU_ADD) + "auto nearest = [](double x) { return (long long)(x + (x < 0.0 ? -0.5 : 0.5)); };\n"
)

_PUT = (
    _ADD
    + f"""
    auto put = [&](wp::int64* sums, double x) {{
        if (!(x < {LARGEST!r} && x > -{LARGEST!r})) {{
            raise();
            return;
        }}
        const long long high = nearest(x * {HIGH!r});
        add(sums, high);
        add(sums + 1, nearest((x - high * {1 / HIGH!r}) * {LOW!r}));
    }};
"""
)

_UNITS = f"""
    {_ADD}
    const double units = double(value) * scale;
    if (!(units < {MOST_UNITS!r} && units > -{MOST_UNITS!r})) {{
        raise();
        return;
    }}
    const long long whole = nearest(units);
    if (whole != 0) add(&wp::index(sums, row, column), whole);
"""


_RECORD = _PUT + "wp::int64* target = &wp::index(records, slot, 0);\n"


@native.func_native(record_sum_snippet(_RECORD, "put(target + 2 * k, value);"))
def fixed_point_record_sum(records: integers, slot: wp.int32, a: vec4, b: vec4, c: vec4, d: vec4, bad: flags):
    """Add the sum over all lanes of four vec4 to the 16 pairs of records[slot]."""


@native.func_native(_PUT + "put(&wp::index(sums, slot, 0), x);")
def fixed_point_add(sums: integers, slot: wp.int32, x: real, bad: flags):
    """Add a scalar to the pair sums[slot]."""


@native.func_native(_UNITS)
def fixed_point_units(sums: integers, row: wp.int32, column: wp.int32, value: real, scale: wp.float64, bad: flags):
    """Add a scalar times a scale, rounded, to sums[row, column]."""
