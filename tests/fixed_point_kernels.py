"""Kernel for test_fixed_point, in a file of its own: to a type checker a kernel's Python is another language."""

import warp as wp

from nexwarp.native.fixed_point import fixed_point_add


@wp.kernel(module="unique", enable_backward=False)
def add_in_order(
    order: wp.array(dtype=wp.int32),
    terms: wp.array(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.int64),
    bad: wp.array(dtype=wp.int32),
):
    fixed_point_add(sums, 0, terms[order[wp.tid()]], bad)
