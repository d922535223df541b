"""Depths of hits within the range of pixel sizes at which training views saw their surfels (not in the paper).

A thread is a slot of a pixel. Read: ids and depths of the hits, and the surfels' smallest and largest depth / focal.
Written: the depths, at most focal * farthest, then at least focal * nearest; those of empty slots as they are.
"""

import functools

import warp as wp


@functools.cache
def limit_depths_kernel(real: type) -> wp.Kernel:
    """Make the kernel."""

    @wp.kernel(enable_backward=False, module="unique")
    def limit_depths(
        first: wp.int32,
        ids: wp.array(dtype=wp.int32),
        depths: wp.array(dtype=real),
        nearest: wp.array(dtype=real),
        farthest: wp.array(dtype=real),
        focals: wp.array(dtype=real),
        # outputs
        limited: wp.array(dtype=real),
    ):
        k = first + wp.tid()
        i = ids[k]
        depth = depths[k]
        if i >= 0:
            # `nearest` is applied last: where no training view saw the texture, it is huge and removes all detail.
            depth = wp.max(wp.min(depth, focals[0] * farthest[i]), focals[0] * nearest[i])
        limited[k] = depth

    return limit_depths
