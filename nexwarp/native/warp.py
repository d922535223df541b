"""Votes, exchanges and sums across a CUDA warp: 32 threads that run together. On a CPU a warp is one thread.

A lane is a thread's index in its warp, as in CUDA. All lanes of a warp must reach a call together.
Walks use these to cull for all pixels of a warp at once, and backward passes to add up what neighbouring pixels give to
one surfel before any atomic.
"""

from __future__ import annotations

import warp as wp

from nexwarp import native
from nexwarp.native import snippet

# Pixels along a tile's side. A GPU's warps cull within their tile; on a CPU tiles alone do, so they are smaller there.
TILE_SIZE, CPU_TILE_SIZE = 16, 8


def tile_size_on(on_gpu: bool) -> int:
    """Pixels along a tile's side."""
    return TILE_SIZE if on_gpu else CPU_TILE_SIZE


@wp.func_native(snippet(f"return {TILE_SIZE};", f"return {CPU_TILE_SIZE};"))
def tile_size() -> wp.int32:
    """Return the number of pixels along a tile's side."""


@wp.func_native(snippet("return __any_sync(0xffffffffu, x);", "return x;"))
def any_in_warp(x: wp.int32) -> wp.int32:
    """Return nonzero in all lanes when x is nonzero in any."""


@wp.func_native(snippet("return threadIdx.x & 31;", "return 0;"))
def lane_index() -> wp.int32:
    """Return the index of this lane, 0 to 31."""


@wp.func_native(snippet("return 32;", "return 1;"))
def warp_size() -> wp.int32:
    """Return the number of threads of a warp."""


@wp.func_native(snippet("return (int)__ballot_sync(0xffffffffu, x);", "return x != 0;"))
def ballot(x: wp.int32) -> wp.int32:
    """Return, as bits, the lanes in which x is nonzero."""


@wp.func_native(snippet("return __shfl_sync(0xffffffffu, x, source);", "return x;"))
def from_lane(x: wp.int32, source: wp.int32) -> wp.int32:
    """Return the value that x has in the lane `source`."""


_RUNNING_SUM = """
    const int lane = threadIdx.x & 31;
    for (int o = 1; o < 32; o <<= 1) {
        const int below = __shfl_up_sync(0xffffffffu, x, o);
        if (lane >= o) x += below;
    }
"""


@wp.func_native(snippet(_RUNNING_SUM) + "return x;")
def warp_running_sum(x: wp.int32) -> wp.int32:
    """Return the sum of x over this lane and those below it."""


_OWNER = """
    for (int o = 16; o > 0; o >>= 1)
        if (__shfl_sync(0xffffffffu, start, owner + o) <= place) owner += o;
"""


@wp.func_native("int owner = 0;\n" + snippet(_OWNER) + "return owner;")
def owner_lane(start: wp.int32, place: wp.int32) -> wp.int32:
    """Return the highest lane whose `start` is at most `place`, where starts do not decrease and lane 0 has 0."""


@wp.func_native(snippet("return __popc(mask);", "return mask != 0;"))
def population(mask: wp.int32) -> wp.int32:
    """Return the number of lanes in a ballot."""


@wp.func_native(snippet("return __popc(mask & ((1u << (threadIdx.x & 31)) - 1u));", "return 0;"))
def lanes_below(mask: wp.int32) -> wp.int32:
    """Return the number of lanes in a ballot that are lower than this one."""


@wp.func_native(snippet("__syncwarp();"))
def sync_warp():
    """Wait for all lanes of the warp, and make what they have written to shared memory visible to each other."""


_MAX = "for (int o = 16; o > 0; o >>= 1) x = max(x, __shfl_xor_sync(0xffffffffu, x, o));"


@wp.func_native(snippet(_MAX) + "return x;")
def warp_max(x: wp.int32) -> wp.int32:
    """Return the largest x of all lanes."""


_SUM = "for (int o = 16; o > 0; o >>= 1) x += __shfl_down_sync(0xffffffffu, x, o);"


@native.func_native(snippet(_SUM) + "return x;")
def warp_sum(x: real) -> real:
    """Return, in lane 0, the sum of x over all lanes."""


# In each step a lane hands over the half of its values that the other lane of a pair will own, and adds what it gets
# to its own half: 16 exchanges instead of the 80 of sixteen separate sums. Lane 2 k ends with the sum of value k, so
# that sixteen lanes add to sixteen neighbouring addresses at once.
_GATHER = """
    REAL v[16];
    for (int k = 0; k < 4; ++k) {
        v[k] = a.c[k];
        v[4 + k] = b.c[k];
        v[8 + k] = c.c[k];
        v[12 + k] = d.c[k];
    }
"""
_EXCHANGE = """
    for (int k = 0; k < HALF; ++k) {
        const REAL theirs = __shfl_xor_sync(0xffffffffu, lane & (2 * HALF) ? v[k] : v[k + HALF], 2 * HALF);
        v[k] = (lane & (2 * HALF) ? v[k + HALF] : v[k]) + theirs;
    }
"""
# Written out: the compiler does not unroll a loop over halves, and then keeps v in memory.
_EXCHANGES = "".join(_EXCHANGE.replace("HALF", str(half)) for half in (8, 4, 2, 1))


def record_sum_snippet(target: str, add: str) -> str:
    """C++ that sums four vec4, a to d, over all lanes; `add` adds the scalar `value` to the place `k` of `target`."""
    cuda = f"""
    const int lane = threadIdx.x & 31;
    {_EXCHANGES}
    const REAL value = v[0] + __shfl_xor_sync(0xffffffffu, v[0], 1);
    const int k = lane >> 1;
    if (!(lane & 1)) {{ {add} }}
"""
    cpu = f"for (int k = 0; k < 16; ++k) {{ const REAL value = v[k]; {add} }}"
    return _GATHER + target + snippet(cuda, cpu)


_TARGET = "REAL* target = reinterpret_cast<REAL*>(records.data + 4 * (size_t)(unsigned)slot);\n"
_ADD = "\n" + snippet("atomicAdd(target + k, value);", "target[k] += value;")


@native.func_native(record_sum_snippet(_TARGET, _ADD))
def warp_record_sum(records: vec4_rows, slot: wp.int32, a: vec4, b: vec4, c: vec4, d: vec4):
    """Add the sum over all lanes of four vec4 to the four of records[slot], (N, 4) contiguous."""
