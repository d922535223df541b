"""Votes, exchanges and sums across a CUDA warp: 32 threads that run together. On a CPU a warp is one thread.

A lane is a thread's index in its warp, as in CUDA. All lanes of a warp must reach a call together.
Walks use these to cull for all pixels of a warp at once, and backward passes to add up what neighbouring pixels give to
one surfel before any atomic.
"""

import functools

import warp as wp

_ANY = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x);
#else
    return x;
#endif
"""

_LANE = """
#if defined(__CUDA_ARCH__)
    return threadIdx.x & 31;
#else
    return 0;
#endif
"""

_SIZE = """
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
"""

_BALLOT = """
#if defined(__CUDA_ARCH__)
    return (int)__ballot_sync(0xffffffffu, x);
#else
    return x != 0;
#endif
"""

_FIRST = """
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return 0;
#endif
"""

_FROM_LANE = """
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, source);
#else
    return x;
#endif
"""

_RUNNING_SUM = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    for (int o = 1; o < 32; o <<= 1) {
        const int below = __shfl_up_sync(0xffffffffu, x, o);
        if (lane >= o) x += below;
    }
#endif
    return x;
"""

_OWNER = """
    int owner = 0;
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1)
        if (__shfl_sync(0xffffffffu, start, owner + o) <= place) owner += o;
#endif
    return owner;
"""

_POPULATION = """
#if defined(__CUDA_ARCH__)
    return __popc(mask);
#else
    return mask != 0;
#endif
"""

_SLOT = """
#if defined(__CUDA_ARCH__)
    return __popc(mask & ((1u << (threadIdx.x & 31)) - 1u));
#else
    return 0;
#endif
"""

_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
"""

_MAX = """
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1) x = max(x, __shfl_xor_sync(0xffffffffu, x, o));
#endif
    return x;
"""

_SUM = """
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1) x += __shfl_down_sync(0xffffffffu, x, o);
#endif
    return x;
"""

# In each step a lane hands over the half of its values that the other lane of a pair will own, and adds what it gets
# to its own half: 16 exchanges instead of the 80 of sixteen separate sums. Lane 2 k ends with the sum of value k, so
# that sixteen lanes add to sixteen neighbouring addresses at once.
GATHER_RECORD = """
    REAL v[16];
    for (int k = 0; k < 4; ++k) {
        v[k] = a.c[k];
        v[4 + k] = b.c[k];
        v[8 + k] = c.c[k];
        v[12 + k] = d.c[k];
    }
"""

_ADD_RECORD = """
    GATHER
    REAL* target = reinterpret_cast<REAL*>(records.data + 4 * (size_t)(unsigned)slot);
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    EXCHANGES
    v[0] += __shfl_xor_sync(0xffffffffu, v[0], 1);
    if (!(lane & 1)) atomicAdd(target + (lane >> 1), v[0]);
#else
    for (int k = 0; k < 16; ++k) target[k] += v[k];
#endif
"""

_EXCHANGE = """
    for (int k = 0; k < HALF; ++k) {
        const REAL given = __shfl_xor_sync(0xffffffffu, lane & (2 * HALF) ? v[k] : v[k + HALF], 2 * HALF);
        v[k] = (lane & (2 * HALF) ? v[k + HALF] : v[k]) + given;
    }
"""

# Written out: the compiler does not unroll a loop over halves, and then keeps v in memory.
EXCHANGES = "".join(_EXCHANGE.replace("HALF", str(half)) for half in (8, 4, 2, 1))

_SUM_VECTOR = """
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1)
        for (int k = 0; k < LENGTH; ++k) x.c[k] += __shfl_down_sync(0xffffffffu, x.c[k], o);
#endif
    return x;
"""


@wp.func_native(_ANY)
def any_in_warp(x: wp.int32) -> wp.int32:
    """Return nonzero in all lanes when x is nonzero in any."""
    ...


@wp.func_native(_LANE)
def lane_index() -> wp.int32:
    """Return the index of this lane, 0 to 31."""
    ...


@wp.func_native(_SIZE)
def warp_size() -> wp.int32:
    """Return the number of threads of a warp."""
    ...


@wp.func_native(_BALLOT)
def ballot(x: wp.int32) -> wp.int32:
    """Return, as bits, the lanes in which x is nonzero."""
    ...


@wp.func_native(_FIRST)
def lowest_lane(mask: wp.int32) -> wp.int32:
    """Return the lowest lane of a ballot that is not empty."""
    ...


@wp.func_native(_FROM_LANE)
def from_lane(x: wp.int32, source: wp.int32) -> wp.int32:
    """Return the value that x has in the lane `source`."""
    ...


@wp.func_native(_RUNNING_SUM)
def warp_running_sum(x: wp.int32) -> wp.int32:
    """Return the sum of x over this lane and those below it."""
    ...


@wp.func_native(_OWNER)
def owner_lane(start: wp.int32, place: wp.int32) -> wp.int32:
    """Return the highest lane whose `start` is at most `place`, where starts do not decrease and lane 0 has 0."""
    ...


@wp.func_native(_POPULATION)
def population(mask: wp.int32) -> wp.int32:
    """Return the number of lanes in a ballot."""
    ...


@wp.func_native(_SLOT)
def lanes_below(mask: wp.int32) -> wp.int32:
    """Return the number of lanes in a ballot that are lower than this one."""
    ...


@wp.func_native(_SYNC)
def sync_warp():
    """Wait for all lanes of the warp, and make what they have written to shared memory visible to each other."""
    ...


@wp.func_native(_MAX)
def warp_max(x: wp.int32) -> wp.int32:
    """Return the largest x of all lanes."""
    ...


@functools.cache
def warp_sum(dtype: type) -> wp.Function:
    """Make a function that returns, in lane 0, the sum of x (a scalar or vector type) over all lanes."""
    length = 0 if dtype in (wp.float32, wp.float64) else dtype._length_

    @wp.func_native(_SUM_VECTOR.replace("LENGTH", str(length)) if length else _SUM)
    def add_up(x: dtype) -> dtype: ...

    return add_up


@functools.cache
def warp_record_sum(real: type) -> wp.Function:
    """Make a function that adds the sum over all lanes of four vec4 to the four of records[slot], (N, 4) contiguous."""
    vec4 = wp.types.vector(length=4, dtype=real)
    name = "float" if real is wp.float32 else "double"

    @wp.func_native(_ADD_RECORD.replace("GATHER", GATHER_RECORD).replace("EXCHANGES", EXCHANGES).replace("REAL", name))
    def add_record(records: wp.array2d(dtype=vec4), slot: wp.int32, a: vec4, b: vec4, c: vec4, d: vec4): ...

    return add_record
