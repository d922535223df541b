"""Vector loads and stores. Warp moves a vector one component at a time; one wide access is what a GPU's memory wants.

Rows must be aligned to their own size, as rows of whole arrays from an allocator are.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp import native
from nexwarp.native import snippet

_PAIR = "return wp::index(rows, i, j);"
_LOAD_PAIR = """
    const float2 v = __ldg(reinterpret_cast<const float2*>(&wp::index(rows, i, j)));
    return wp::vec_t<2, float>(v.x, v.y);
"""
# Without the strides, which rows of whole arrays do not need: the address of a row serves all four.
_ROW = "return records.data[4 * (size_t)i + j];"
_LOAD_ROW = """
    const float4 v = __ldg(reinterpret_cast<const float4*>(records.data) + (4u * (unsigned)i + j));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
"""
_STORE = "records.data[4 * (size_t)i + j] = row;"
_STORE_ROW = """
    reinterpret_cast<float4*>(records.data)[4u * (unsigned)i + j] = make_float4(row.c[0], row.c[1], row.c[2], row.c[3]);
"""


@native.func_native(snippet(_LOAD_PAIR, _PAIR), double=_PAIR)
def load_pair(rows: vec2_rows, i: wp.int32, j: wp.int32) -> vec2:
    """Return rows[i, j]."""


@native.func_native(snippet(_LOAD_ROW, _ROW), double=_ROW)
def record_row(records: vec4_rows, i: wp.int32, j: wp.int32) -> vec4:
    """Return row j of the record i (see `surfel`), records being contiguous, (N, 4) vec4."""


@wp.func
def load_record(records: Any, i: wp.int32):
    """(a, b, n, c) rows of the record i."""
    return record_row(records, i, 0), record_row(records, i, 1), record_row(records, i, 2), record_row(records, i, 3)


@native.func_native(snippet(_STORE_ROW, _STORE), double=_STORE)
def store_record_row(records: vec4_rows, i: wp.int32, j: wp.int32, row: vec4):
    """Write row j of the record i."""
