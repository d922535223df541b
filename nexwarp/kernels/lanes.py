"""Sums and votes over the 32 lanes of a CUDA warp; on a CPU a warp is one thread.

Used by backward passes to add up what neighbouring pixels give to one surfel before any atomic.
All lanes of a warp must reach these calls together.
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

_SUM = """
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1) x += __shfl_down_sync(0xffffffffu, x, o);
#endif
    return x;
"""

_SUM_VECTOR = """
#if defined(__CUDA_ARCH__)
    for (int o = 16; o > 0; o >>= 1)
        for (int k = 0; k < LENGTH; ++k) x.c[k] += __shfl_down_sync(0xffffffffu, x.c[k], o);
#endif
    return x;
"""


@wp.func_native(_ANY)
def any_lane(x: wp.int32) -> wp.int32:
    """Return nonzero in all lanes when x is nonzero in any."""
    ...


@wp.func_native(_LANE)
def lane() -> wp.int32:
    """Return the index of this lane, 0 to 31."""
    ...


@functools.cache
def lane_sum(dtype: type) -> wp.Function:
    """Make a function that returns, in lane 0, the sum of x (a scalar or vector type) over all lanes."""
    length = 0 if dtype in (wp.float32, wp.float64) else dtype._length_

    @wp.func_native(_SUM_VECTOR.replace("LENGTH", str(length)) if length else _SUM)
    def add_up(x: dtype) -> dtype: ...

    return add_up
