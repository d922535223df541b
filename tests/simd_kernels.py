"""A kernel for test_rows, in a file of its own since Warp reads a kernel's source."""

import warp as wp

from nexwarp.kernels.native.simd import lane_functions


def exp_and_log_kernel(lanes: int) -> wp.Kernel:
    """Make the kernel that writes exp and log of its first argument."""
    f = lane_functions(wp.float32, lanes)
    lane, power_of_e, logarithm = f.lane, f.power_of_e, f.logarithm

    @wp.kernel(enable_backward=False, module="unique")
    def exp_and_log(x: wp.array(dtype=lane), exps: wp.array(dtype=lane), logs: wp.array(dtype=lane)):
        i = wp.tid()
        exps[i] = power_of_e(x[i])
        logs[i] = logarithm(x[i])

    return exp_and_log
