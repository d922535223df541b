"""Records that a warp walks along, staged in shared memory: each lane brings one, then all lanes read one by one.

A record that is read from shared memory needs no address of its own, and neither shuffles nor votes are between one
record and the next, so that the compiler computes two at once. On a CPU a warp is one thread, which stages nothing and
reads the record itself.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from nexwarp import native
from nexwarp.native import snippet
from nexwarp.native.vector_loads import load_record

# Of a CUDA block whose warps stage records.
BLOCK_DIM = 128

# One function writes and reads, since a shared array belongs to the function that declares it: step 0 writes, step
# j + 1 reads row j. Rows of neighbouring slots are neighbours, so that writes meet no bank twice.
_ROW = """
    struct __align__(16) Row { REAL x, y, z, w; };
    __shared__ Row rows[4 * THREADS];
    Row* mine = rows + (threadIdx.x >> 5) * 128 + slot;
    if (step == 0) {
        mine[0] = {a.c[0], a.c[1], a.c[2], a.c[3]};
        mine[32] = {b.c[0], b.c[1], b.c[2], b.c[3]};
        mine[64] = {n.c[0], n.c[1], n.c[2], n.c[3]};
        mine[96] = {c.c[0], c.c[1], c.c[2], c.c[3]};
        return a;
    }
    const Row row = mine[32 * (step - 1)];
    return wp::vec_t<4, REAL>(row.x, row.y, row.z, row.w);
""".replace("THREADS", str(BLOCK_DIM))
_ROW_ITSELF = "return step == 0 ? a : records.data[4 * (size_t)i + step - 1];"

_NAME = f"""
    __shared__ int2 names[{BLOCK_DIM}];
    int2* mine = names + (threadIdx.x >> 5) * 32 + slot;
    if (step == 0) *mine = make_int2(i, place);
    const int2 name = *mine;
    return wp::vec_t<2, int>(name.x, name.y);
"""


@native.func_native(snippet(_ROW, _ROW_ITSELF))
def _access(
    step: wp.int32, slot: wp.int32, a: vec4, b: vec4, n: vec4, c: vec4, records: vec4_rows, i: wp.int32
) -> vec4: ...


@wp.func_native(snippet(_NAME, "return wp::vec_t<2, int>(i, place);"))
def _access_name(step: wp.int32, slot: wp.int32, i: wp.int32, place: wp.int32) -> wp.vec2i: ...


@wp.func
def stage_record(slot: wp.int32, i: wp.int32, place: wp.int32, records: Any):
    """Stage the record of the surfel i, which is at a place of the walk."""
    a, b, n, c = load_record(records, i)
    _access(0, slot, a, b, n, c, records, i)
    _access_name(0, slot, i, place)


@wp.func
def staged_name(slot: wp.int32, i: wp.int32, place: wp.int32):
    """(surfel, place) of a slot; on a CPU, those given."""
    name = _access_name(1, slot, i, place)
    return name[0], name[1]


@wp.func
def staged_record(slot: wp.int32, records: Any, i: wp.int32):
    """(a, b, n, c) rows of a slot's record; on a CPU, of the record i."""
    none = type(records[0, 0])()
    return (
        _access(1, slot, none, none, none, none, records, i),
        _access(2, slot, none, none, none, none, records, i),
        _access(3, slot, none, none, none, none, records, i),
        _access(4, slot, none, none, none, none, records, i),
    )
