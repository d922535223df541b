"""D-SSIM and its derivative: a blur down the columns, then one along the rows that goes on to the result; no atomics.

With x, y the image and the target, mx, my their blurs, q = blur((x^2 + y^2) / 2) and p = blur(x y), the map of SSIM is
    s = a b / (c d),   a = mx my + C1 / 2,   b = p - mx my + C2 / 2,
    c = (mx^2 + my^2) / 2 + C1 / 2,   d = q - (mx^2 + my^2) / 2 + C2 / 2,
so that four blurs suffice, and its derivatives are
    ds/dmx = my (b - a) / (c d) + mx (s / d - s / c),   ds/dq = -s / d,   ds/dp = a / (c d).
The blur is its own adjoint, hence dS/dx = blur(ds/dmx) + x blur(ds/dq) + y blur(ds/dp).

Images are read as they lie, rows of `width` = 3 W values, so that a neighbour in the same channel is 3 values away.
What is blurred down the columns is written to padded rows, with PAD zeros on either side.

A thread takes a block of `length` neighbouring values of a row. On CUDA that is 1, which makes neighbouring threads
read neighbouring addresses, and 4 rows of them, which share what they read down the columns. On a CPU it is SIMD_WIDTH,
which the compiler turns into vector instructions. Arrays of blocks overlap: there is a block at every address. The last
block of a row ends where the row ends, and agrees with the one before it where both write.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types

SIMD_WIDTH = 16
# A multiple of SIMD_WIDTH, at least the 5 pixels of 3 values by which the window reaches past the end of a row.
PAD = 16

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
_REACH = WINDOW_SIZE // 2
_GAUSSIAN = [math.exp(-((i - _REACH) ** 2) / (2.0 * WINDOW_SIGMA**2)) for i in range(WINDOW_SIZE)]


def tap(i: int) -> float:
    """Weight i of the window, which sums to 1; zero outside."""
    return _GAUSSIAN[i] / sum(_GAUSSIAN) if 0 <= i < WINDOW_SIZE else 0.0


def rows_a_thread(length: int) -> int:
    """Rows that a thread blurs down the columns: more save reading, but must fit in registers."""
    return 4 if length == 1 else 1


@functools.cache
def ssim_kernels(real: type, length: int) -> SimpleNamespace:
    """Make the kernels `moments` and `score` of the forward pass, `blur` and `gradient` of the backward pass.

    Args:
        real: scalar type.
        length: values of a block, 1 or SIMD_WIDTH.
    """
    t = types(real)
    HALF, ONE, ZERO = t.HALF, t.ONE, t.ZERO
    HALF_C1, HALF_C2 = wp.constant(real(C1 / 2.0)), wp.constant(real(C2 / 2.0))
    vec = wp.types.vector(length=length, dtype=real)
    rows = rows_a_thread(length)

    @wp.func
    def padded_block(thread: wp.int32, width: wp.int32):
        """Which `rows` rows a thread has, and where its block starts in a row: in [0, width), or else in the pads."""
        count = (width + length - 1) // length
        padded = count + wp.static(2 * PAD // length)
        block = thread % padded - wp.static(PAD // length)
        start = block * length
        if block >= 0:
            start = wp.min(start, width - length)
        if block >= count:
            start = width + (block - count) * length
        return (thread // padded) * wp.static(rows), start

    @wp.func
    def inner_block(thread: wp.int32, width: wp.int32):
        """Where a thread's block lies: the address in rows without pads, and that of its window in padded rows."""
        count = (width + length - 1) // length
        row = thread // count
        at = row * width + wp.min((thread % count) * length, width - length)
        return at, at + row * wp.static(2 * PAD) + wp.static(PAD - 3 * _REACH)

    def column_blur(count: int) -> wp.Kernel:
        """Make the kernel that blurs 4 moments of 2 images, or 3 maps, down the columns."""
        mat = wp.types.matrix(shape=(count * rows, length), dtype=real)
        of_images = count == 4

        @wp.kernel(enable_backward=False, module="unique")
        def blur_columns(
            first: wp.int32,
            plane0: wp.array(dtype=vec),
            plane1: wp.array(dtype=vec),
            plane2: wp.array(dtype=vec),
            height: wp.int32,
            width: wp.int32,
            # outputs
            blurred: wp.array2d(dtype=vec),
        ):
            top, start = padded_block(first + wp.tid(), width)
            sums = mat()
            if start >= 0 and start < width:
                for i in range(wp.static(rows + WINDOW_SIZE - 1)):
                    # A row outside the image weighs nothing. It reads the nearest one instead, which is in the window
                    # too, so that an infinity spreads no further; without branches all the reads go out at once.
                    row = top + i - wp.static(_REACH)
                    near = wp.clamp(row, 0, height - 1)
                    at = near * width + start
                    x = plane0[at]
                    y = plane1[at]
                    if wp.static(of_images):
                        q = (wp.cw_mul(x, x) + wp.cw_mul(y, y)) * HALF
                        p = wp.cw_mul(x, y)
                    else:
                        q = plane2[at]
                    for j in range(wp.static(rows)):
                        if wp.static(tap(i - j) > 0.0):
                            weight = wp.where(row == near, wp.static(real(tap(i - j))), ZERO)
                            sums[wp.static(count) * j] += x * weight
                            sums[wp.static(count) * j + 1] += y * weight
                            sums[wp.static(count) * j + 2] += q * weight
                            if wp.static(of_images):
                                sums[wp.static(count) * j + 3] += p * weight
            for j in range(wp.static(rows)):
                if top + j < height:
                    at = (top + j) * (width + wp.static(2 * PAD)) + wp.static(PAD) + start
                    for k in range(wp.static(count)):
                        blurred[k, at] = sums[wp.static(count) * j + k]

        return blur_columns

    @wp.kernel(enable_backward=False, module="unique")
    def score(
        first: wp.int32,
        moments: wp.array2d(dtype=vec),
        width: wp.int32,
        scale: real,
        # outputs
        losses: wp.array(dtype=vec),
        derivatives: wp.array2d(dtype=vec),
    ):
        """(1 - s) scale, and ds/dmx, ds/dq, ds/dp unless `derivatives` is null."""
        at, window = inner_block(first + wp.tid(), width)
        mx = vec()
        my = vec()
        q = vec()
        p = vec()
        for i in range(wp.static(WINDOW_SIZE)):
            weight = wp.static(real(tap(i)))
            mx += moments[0, window + 3 * i] * weight
            my += moments[1, window + 3 * i] * weight
            q += moments[2, window + 3 * i] * weight
            p += moments[3, window + 3 * i] * weight
        product = wp.cw_mul(mx, my)
        square = (wp.cw_mul(mx, mx) + wp.cw_mul(my, my)) * HALF
        variance = q - square
        for i in range(length):  # rounding can take a variance below zero; wp.max would hide NaN
            variance[i] = wp.where(variance[i] < ZERO, ZERO, variance[i])
        a = product + vec(HALF_C1)
        b = p - product + vec(HALF_C2)
        c = square + vec(HALF_C1)
        d = variance + vec(HALF_C2)
        ds_dp = wp.cw_div(a, wp.cw_mul(c, d))
        s = wp.cw_mul(ds_dp, b)
        losses[at] = (vec(ONE) - s) * scale
        if derivatives:
            s_d = wp.cw_div(s, d)
            derivatives[0, at] = wp.cw_mul(wp.cw_div(b - a, wp.cw_mul(c, d)), my) + wp.cw_mul(s_d - wp.cw_div(s, c), mx)
            derivatives[1, at] = -s_d
            derivatives[2, at] = ds_dp

    @wp.kernel(enable_backward=False, module="unique")
    def gradient(
        first: wp.int32,
        blurred: wp.array2d(dtype=vec),
        image: wp.array(dtype=vec),
        target: wp.array(dtype=vec),
        width: wp.int32,
        scale: real,
        grad_loss: wp.array(dtype=real),
        # outputs
        grad_image: wp.array(dtype=vec),
    ):
        at, window = inner_block(first + wp.tid(), width)
        dmx = vec()
        dq = vec()
        dp = vec()
        for i in range(wp.static(WINDOW_SIZE)):
            weight = wp.static(real(tap(i)))
            dmx += blurred[0, window + 3 * i] * weight
            dq += blurred[1, window + 3 * i] * weight
            dp += blurred[2, window + 3 * i] * weight
        change = dmx + wp.cw_mul(dq, image[at]) + wp.cw_mul(dp, target[at])
        grad_image[at] = change * (-scale * grad_loss[0])

    return SimpleNamespace(moments=column_blur(4), score=score, blur=column_blur(3), gradient=gradient)
