"""Vector loads and stores. Warp moves a vector one component at a time; one wide access is what a GPU's memory wants.

Rows must be aligned to their own size, as rows of whole arrays from an allocator are.
"""

import functools
from typing import Any

import warp as wp

from nexwarp.native import for_both_reals

_LOAD_FLOAT4 = """
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(&wp::index(rows, i, j)));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::index(rows, i, j);
#endif
"""

_LOAD_FLOAT2 = """
#if defined(__CUDA_ARCH__)
    const float2 v = __ldg(reinterpret_cast<const float2*>(&wp::index(rows, i, j)));
    return wp::vec_t<2, float>(v.x, v.y);
#else
    return wp::index(rows, i, j);
#endif
"""

_LOAD_HALF2 = """
#if defined(__CUDA_ARCH__)
    const unsigned bits = __ldg(reinterpret_cast<const unsigned*>(&wp::index(rows, i, j)));
    wp::vec_t<2, wp::half> v;
    v.c[0].u = (unsigned short)(bits & 0xffffu);
    v.c[1].u = (unsigned short)(bits >> 16);
    return v;
#else
    return wp::index(rows, i, j);
#endif
"""

_LOAD_HALF4 = """
#if defined(__CUDA_ARCH__)
    const uint2 bits = __ldg(reinterpret_cast<const uint2*>(&wp::index(rows, i, j)));
    wp::vec_t<4, wp::half> v;
    v.c[0].u = (unsigned short)(bits.x & 0xffffu);
    v.c[1].u = (unsigned short)(bits.x >> 16);
    v.c[2].u = (unsigned short)(bits.y & 0xffffu);
    v.c[3].u = (unsigned short)(bits.y >> 16);
    return v;
#else
    return wp::index(rows, i, j);
#endif
"""

# Without the strides, which rows of whole arrays do not need: the address of a row serves all four.
_RECORD_ROW = """
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(records.data) + (4u * (unsigned)i + j));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return records.data[4 * (size_t)i + j];
#endif
"""

_STORE_RECORD_ROW = """
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(records.data)[4u * (unsigned)i + j] = make_float4(row.c[0], row.c[1], row.c[2], row.c[3]);
#else
    records.data[4 * (size_t)i + j] = row;
#endif
"""

# Gradients of arrays are in the arrays themselves on a tape, and else in an array of their own.
_ADJOINT_STORE = """
    if (records.grad) adj_row += records.grad[4 * (size_t)i + j];
    else if (adj_records.data) adj_row += adj_records.data[4 * (size_t)i + j];
"""

_SNIPPETS = {
    (4, wp.float32): _LOAD_FLOAT4,
    (2, wp.float32): _LOAD_FLOAT2,
    (4, wp.float16): _LOAD_HALF4,
    (2, wp.float16): _LOAD_HALF2,
}


@functools.cache
def load_function(length: int, scalar: type) -> wp.Function:
    """Make the function that returns rows[i, j], a vector of `length` scalars, in one load where one is known."""
    row = wp.types.vector(length=length, dtype=scalar)
    snippet = _SNIPPETS.get((length, scalar), "    return wp::index(rows, i, j);")

    @wp.func_native(snippet)
    def load(rows: wp.array2d(dtype=row), i: wp.int32, j: wp.int32) -> row: ...

    return load


@for_both_reals
def load_pair(real: type) -> wp.Function:
    """Return rows[i, j], a vec2, in one load."""
    pair = wp.types.vector(length=2, dtype=real)

    @wp.func_native(_SNIPPETS.get((2, real), "    return wp::index(rows, i, j);"))
    def load_pair(rows: wp.array2d(dtype=pair), i: wp.int32, j: wp.int32) -> pair: ...

    return load_pair


@for_both_reals
def record_row(real: type) -> wp.Function:
    """Return row j of the record i (see `surfel`), records being contiguous, (N, 4) vec4."""
    row = wp.types.vector(length=4, dtype=real)
    exact = "    return records.data[4 * (size_t)i + j];"

    @wp.func_native(_RECORD_ROW if real is wp.float32 else exact)
    def record_row(records: wp.array2d(dtype=row), i: wp.int32, j: wp.int32) -> row: ...

    return record_row


@wp.func
def load_record(records: Any, i: wp.int32):
    """(a, b, n, c) rows of the record i."""
    return record_row(records, i, 0), record_row(records, i, 1), record_row(records, i, 2), record_row(records, i, 3)


@for_both_reals
def store_record_row(real: type) -> wp.Function:
    """Write row j of the record i; differentiable."""
    row_type = wp.types.vector(length=4, dtype=real)
    exact = "    records.data[4 * (size_t)i + j] = row;"

    @wp.func_native(_STORE_RECORD_ROW if real is wp.float32 else exact, adj_snippet=_ADJOINT_STORE)
    def store_record_row(records: wp.array2d(dtype=row_type), i: wp.int32, j: wp.int32, row: row_type): ...

    return store_record_row
