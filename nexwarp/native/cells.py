"""Rows of the hash grid's tables: their loads, sums over the points of a cell, and the addition of these."""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.native import snippet

# Loads on a GPU, by the length of a row and its scalar.
_LOADS = {
    (4, wp.float32): """
    const float4 v = __ldg(reinterpret_cast<const float4*>(&wp::index(table, level, slot)));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);""",
    (2, wp.float32): """
    const float2 v = __ldg(reinterpret_cast<const float2*>(&wp::index(table, level, slot)));
    return wp::vec_t<2, float>(v.x, v.y);""",
    (4, wp.float16): """
    const uint2 bits = __ldg(reinterpret_cast<const uint2*>(&wp::index(table, level, slot)));
    wp::vec_t<4, wp::half> v;
    v.c[0].u = (unsigned short)(bits.x & 0xffffu);
    v.c[1].u = (unsigned short)(bits.x >> 16);
    v.c[2].u = (unsigned short)(bits.y & 0xffffu);
    v.c[3].u = (unsigned short)(bits.y >> 16);
    return v;""",
    (2, wp.float16): """
    const unsigned bits = __ldg(reinterpret_cast<const unsigned*>(&wp::index(table, level, slot)));
    wp::vec_t<2, wp::half> v;
    v.c[0].u = (unsigned short)(bits & 0xffffu);
    v.c[1].u = (unsigned short)(bits >> 16);
    return v;""",
}
_LOAD = "return wp::index(table, level, slot);"

# Atomics of two and of four floats exist from sm_90 on: as many fewer in the backward pass.
_ADD = """
    bool there = false;
    for (int k = 0; k < FEATURES; ++k) there = there || value[k] != 0.0f;
    if (!there) return;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<floatFEATURES*>(&wp::index(table, level, slot)), make_floatFEATURES(VALUES));
#else
    wp::atomic_add(table, level, slot, value);
#endif
"""

# Neighbouring pixels fall into the same cell of a coarse level: the lanes of a cell add up theirs in a tree, and only
# the first of them goes on to the atomics. Absent lanes (a part-filled warp, empty hits) are left out by the mask.
_MERGE = """
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const unsigned long long xy = ((unsigned long long)(unsigned)y << 32) | (unsigned)x;
    const unsigned peers = __match_any_sync(active, xy) & __match_any_sync(active, z);
    const int lane = threadIdx.x & 31;
    int rank = __popc(peers & ((1u << lane) - 1u));
    const bool first = rank == 0;
    unsigned rest = peers & (0xfffffffeu << lane);
    while (__any_sync(active, rest != 0u)) {
        const int next = __ffs(rest) - 1;
        for (int j = 0; j < 8; ++j) {
            for (int k = 0; k < FEATURES; ++k) {
                const float other = __shfl_sync(active, value.data[j][k], next < 0 ? lane : next);
                if (next >= 0) value.data[j][k] += other;
            }
        }
        rest &= __ballot_sync(active, (rank & 1) == 0);
        rank >>= 1;
    }
    if (!first) {
        for (int j = 0; j < 8; ++j) for (int k = 0; k < FEATURES; ++k) value.data[j][k] = 0.0f;
    }
#endif
    return value;
"""


@functools.cache
def load_function(length: int, scalar: type) -> wp.Function:
    """Make the function that returns table[level, slot], a vector of scalars, in one load where one is known."""
    row = wp.types.vector(length=length, dtype=scalar)

    @wp.func_native(snippet(_LOADS.get((length, scalar), _LOAD), _LOAD))
    def load(table: wp.array2d(dtype=row), level: wp.int32, slot: wp.int32) -> row: ...

    return load


@functools.cache
def merge_functions(features: int) -> SimpleNamespace:
    """Make `merge_cells` and `add_row` for tables of rows of 2 or 4 floats."""
    row = wp.types.vector(length=features, dtype=wp.float32)
    corners = wp.types.matrix(shape=(8, features), dtype=wp.float32)
    values = ", ".join(f"value[{k}]" for k in range(features))

    def filled(text: str) -> str:
        return text.replace("FEATURES", str(features)).replace("VALUES", values)

    @wp.func_native(filled(_MERGE))
    def merge_cells(x: wp.int32, y: wp.int32, z: wp.int32, value: corners) -> corners:
        """Return the sum over all lanes with the cell (x, y, z) in the first of them, zeros in the others."""
        ...

    @wp.func_native(filled(_ADD))
    def add_row(table: wp.array2d(dtype=row), level: wp.int32, slot: wp.int32, value: row):
        """Add to table[level, slot] atomically, unless there is nothing to add."""
        ...

    return SimpleNamespace(merge_cells=merge_cells, add_row=add_row)
