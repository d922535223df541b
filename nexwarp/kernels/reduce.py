"""Sum of each surfel's gradient slots, in a fixed order: the second half of a backward pass on a CPU.

A thread is a surfel. Read: `slots` (M, columns), one for each (tile, surfel) entry in the order of emission, in which
the entries of the surfel order[rank] lie together and end at ends[rank]. Added to: `sums` (N, columns). A CPU has no
atomics, and a slot has one owner, so this gives the same bits whatever the number of threads.
"""

import functools

import warp as wp


@functools.cache
def reduce_slots_kernel(dtype: type) -> wp.Kernel:
    """Make the kernel for elements of a type."""

    @wp.kernel(enable_backward=False, module="unique")
    def reduce_slots(
        first: wp.int32,
        order: wp.array(dtype=wp.int32),
        ends: wp.array(dtype=wp.int32),
        slots: wp.array2d(dtype=dtype),
        columns: wp.int32,
        # outputs
        sums: wp.array2d(dtype=dtype),
    ):
        rank = first + wp.tid()
        start = int(0)
        if rank > 0:
            start = ends[rank - 1]
        for c in range(columns):
            for e in range(start, ends[rank]):
                sums[order[rank], c] += slots[e, c]

    return reduce_slots
