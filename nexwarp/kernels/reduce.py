"""Adds up gradient slots in a fixed order."""

import functools

import warp as wp


@functools.cache
def reduce_rows_kernel(dtype: type) -> wp.Kernel:
    """Make the kernel that adds up each surfel's entry slots to `sums`, one thread a surfel, in a fixed order."""

    @wp.kernel(enable_backward=False, module="unique")
    def reduce_rows(
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

    return reduce_rows
