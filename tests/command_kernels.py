"""Kernel for test_commands, in a file of its own: to a type checker a kernel's Python is another language."""

import warp as wp


@wp.kernel(enable_backward=False, module="unique")
def scaled_sum(
    first: wp.int32,
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    shift: wp.vec2i,
    scale: wp.float32,
    negate: wp.bool,
    # outputs
    out: wp.array(dtype=wp.float32),
):
    """out = +-(scale * a + b + shift[0] + 10 shift[1]), without b where it is a null array."""
    i = first + wp.tid()
    x = scale * a[i] + float(shift[0] + 10 * shift[1])
    if b:
        x += b[i]
    out[i] = wp.where(negate, -x, x)
