"""Vector loads and stores. Warp moves a vector one component at a time; one wide access is what a GPU's memory wants.

Rows must be aligned to their own size, as rows of whole arrays from an allocator are.
"""

import functools
from typing import Any

import warp as wp

from nexwarp.native import for_both_reals, snippet

_ROW = "&wp::index(rows, i, j)"
_EXACT = "return wp::index(rows, i, j);"

# By the length of a row and its scalar, on a GPU.
_LOADS = {
    (4, wp.float32): f"""
    const float4 v = __ldg(reinterpret_cast<const float4*>({_ROW}));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);""",
    (2, wp.float32): f"""
    const float2 v = __ldg(reinterpret_cast<const float2*>({_ROW}));
    return wp::vec_t<2, float>(v.x, v.y);""",
    (4, wp.float16): f"""
    const uint2 bits = __ldg(reinterpret_cast<const uint2*>({_ROW}));
    wp::vec_t<4, wp::half> v;
    v.c[0].u = (unsigned short)(bits.x & 0xffffu);
    v.c[1].u = (unsigned short)(bits.x >> 16);
    v.c[2].u = (unsigned short)(bits.y & 0xffffu);
    v.c[3].u = (unsigned short)(bits.y >> 16);
    return v;""",
    (2, wp.float16): f"""
    const unsigned bits = __ldg(reinterpret_cast<const unsigned*>({_ROW}));
    wp::vec_t<2, wp::half> v;
    v.c[0].u = (unsigned short)(bits & 0xffffu);
    v.c[1].u = (unsigned short)(bits >> 16);
    return v;""",
}

# Without the strides, which rows of whole arrays do not need: the address of a row serves all four.
_LOAD_ROW = """
    const float4 v = __ldg(reinterpret_cast<const float4*>(records.data) + (4u * (unsigned)i + j));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
"""
_STORE_ROW = """
    reinterpret_cast<float4*>(records.data)[4u * (unsigned)i + j] = make_float4(row.c[0], row.c[1], row.c[2], row.c[3]);
"""


@functools.cache
def load_function(length: int, scalar: type) -> wp.Function:
    """Make the function that returns rows[i, j], a vector of `length` scalars, in one load where one is known."""
    row = wp.types.vector(length=length, dtype=scalar)
    cuda = _LOADS.get((length, scalar), _EXACT)

    @wp.func_native(snippet(cuda, _EXACT))
    def load(rows: wp.array2d(dtype=row), i: wp.int32, j: wp.int32) -> row: ...

    return load


load_pair = for_both_reals(functools.partial(load_function, 2))


@for_both_reals
def record_row(real: type) -> wp.Function:
    """Return row j of the record i (see `surfel`), records being contiguous, (N, 4) vec4."""
    row = wp.types.vector(length=4, dtype=real)
    exact = "return records.data[4 * (size_t)i + j];"

    @wp.func_native(snippet(_LOAD_ROW, exact) if real is wp.float32 else exact)
    def record_row(records: wp.array2d(dtype=row), i: wp.int32, j: wp.int32) -> row: ...

    return record_row


@wp.func
def load_record(records: Any, i: wp.int32):
    """(a, b, n, c) rows of the record i."""
    return record_row(records, i, 0), record_row(records, i, 1), record_row(records, i, 2), record_row(records, i, 3)


@for_both_reals
def store_record_row(real: type) -> wp.Function:
    """Write row j of the record i."""
    row_type = wp.types.vector(length=4, dtype=real)
    exact = "records.data[4 * (size_t)i + j] = row;"
    text = snippet(_STORE_ROW, exact) if real is wp.float32 else exact

    @wp.func_native(text)
    def store_record_row(records: wp.array2d(dtype=row_type), i: wp.int32, j: wp.int32, row: row_type): ...

    return store_record_row
