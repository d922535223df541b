"""D-SSIM and its derivative on GPUs, in float32: one kernel each way, without maps of blurs in memory; no atomics.

With x the image, clamped to [0, 1], y the target, mx, my their blurs, q = blur((x^2 + y^2) / 2) and p = blur(x y), the
map of SSIM is
    s = a b / (c d),   a = mx my + C1 / 2,   b = p - mx my + C2 / 2,
    c = (mx^2 + my^2) / 2 + C1 / 2,   d = q - (mx^2 + my^2) / 2 + C2 / 2,
so that four blurs suffice, and its derivatives are
    ds/dmx = my (b - a) / (c d) + mx (s / d - s / c),   ds/dq = -s / d,   ds/dp = a / (c d).
The blur is its own adjoint, hence dS/dx = blur(ds/dmx) + x blur(ds/dq) + y blur(ds/dp).

Images are read as they lie, rows of `width` = 3 W values, so that a neighbour in the same channel is 3 values away. A
block of threads has a strip of PIXELS x ROWS pixels. A thread blurs one column of the strip, or of the 5 pixels on
either side, down the rows; the result goes to shared memory, from where a thread blurs GROUP neighbours of one channel
along a row; and what comes of that goes through shared memory again, so that neighbouring threads write neighbours.
"""

import math

import warp as wp

from nexwarp.kernels.photometric import clamped, clamped_backward
from nexwarp.kernels.types import types
from nexwarp.native.warp import lane_index, warp_size, warp_sum

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
REACH = WINDOW_SIZE // 2
reals, real_rows = types(wp.float32).reals, types(wp.float32).real_rows
_GAUSSIAN = [math.exp(-((i - REACH) ** 2) / (2.0 * WINDOW_SIGMA**2)) for i in range(WINDOW_SIZE)]

PIXELS, ROWS = 64, 8
GROUP = ROWS
READ = ROWS + 2 * REACH
COLUMNS = 3 * PIXELS
# Columns that are read, and what fills up the last warp.
THREADS = 224
MOMENTS = 4

assert COLUMNS + 6 * REACH <= THREADS and COLUMNS == ROWS * 3 * (PIXELS // GROUP)


def tap(i: int) -> float:
    """Weight i of the window, which sums to 1; zero outside."""
    return _GAUSSIAN[i] / sum(_GAUSSIAN) if 0 <= i < WINDOW_SIZE else 0.0


# A shared array belongs to the function that declares it: one function writes and reads.
_CELL = f"""
#if defined(__CUDA_ARCH__)
    __shared__ float cells[{MOMENTS * ROWS * THREADS}];
    if (write) cells[at] = x;
    return cells[at];
#else
    return x;
#endif
"""

_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""


# With wp.static of a loop's number, Warp would generate a kernel's code at each start, to hash it.
_SPREAD = f"""
    constexpr float taps[] = {{{", ".join(f"{tap(i)!r}f" for i in range(WINDOW_SIZE))}}};
    #pragma unroll
    for (int at = 0; at < {ROWS}; ++at)
        if (i - at >= 0 && i - at < {WINDOW_SIZE}) sums.c[at] += x * taps[i - at];
    return sums;
"""
Sums = wp.types.vector(length=ROWS, dtype=wp.float32)
Planes = wp.types.matrix(shape=(MOMENTS, ROWS), dtype=wp.float32)


@wp.func_native(_SPREAD)
def spread(i: wp.int32, x: wp.float32, sums: Sums) -> Sums:
    """Add a value's part, i - REACH places from the first of neighbours, to the sums of their windows.

    i is a constant, so that the weights are, too.
    """
    ...


@wp.func
def spread_all(i: wp.int32, values: wp.vec4, planes: Planes):
    """`spread` each of four values to its plane."""
    for k in range(wp.static(MOMENTS)):
        planes[k] = spread(i, values[k], planes[k])
    return planes


@wp.func_native(_CELL)
def cell(write: wp.bool, at: wp.int32, x: wp.float32) -> wp.float32:
    """Write to one of the block's cells, or read it."""
    ...


@wp.func_native(_SYNC)
def sync_block():
    """Wait for all threads of the block, and make their cells visible to each other."""
    ...


def blocks_of(height: int, width: int) -> int:
    """Return the number of blocks for rows of `width` values, 3 a pixel."""
    return -(-width // COLUMNS) * -(-height // ROWS)


HALF_C1, HALF_C2 = wp.constant(C1 / 2.0), wp.constant(C2 / 2.0)


@wp.func
def place(thread: int, width: int):
    """(thread of its block, left column, top row) of the block's strip."""
    block = thread // THREADS
    strips = (width + COLUMNS - 1) // COLUMNS
    return thread % THREADS, (block % strips) * COLUMNS, (block // strips) * ROWS


@wp.func
def blurred_moments(image: reals, target: reals, column: int, top: int, height: int, width: int):
    """Blurs down a column of x, y, (x^2 + y^2) / 2 and x y, in the rows from `top`."""
    sums = Planes()
    if column >= 0 and column < width:
        for i in range(wp.static(READ)):
            row = top + i - REACH
            x = float(0.0)
            y = float(0.0)
            if row >= 0 and row < height:
                x = clamped(image[row * width + column])
                y = target[row * width + column]
            sums = spread_all(i, wp.vec4(x, y, 0.5 * (x * x + y * y), x * y), sums)
    return sums


@wp.func
def blurred_slopes(derivatives: real_rows, column: int, top: int, height: int, width: int):
    """Blurs down a column of the three derivatives, likewise; the fourth plane is unused."""
    sums = Planes()
    if column >= 0 and column < width:
        for i in range(wp.static(READ)):
            row = top + i - REACH
            values = wp.vec4()
            if row >= 0 and row < height:
                for k in range(3):
                    values[k] = derivatives[k, row * width + column]
            sums = spread_all(i, values, sums)
    return sums


@wp.func
def put(plane: int, lane: int, values: Sums):
    """Share a column's values."""
    for j in range(wp.static(ROWS)):
        cell(True, (plane * ROWS + j) * THREADS + lane, values[j])


@wp.func
def put_group(plane: int, lane: int, values: Sums):
    """Share a group's values, at the columns that they are for."""
    for o in range(wp.static(GROUP)):
        cell(True, plane * wp.static(ROWS * THREADS) + group_start(lane) + 3 * o, values[o])


@wp.func
def group_start(lane: int):
    """Where in a plane a thread's group begins: a row, and a column relative to the strip's left."""
    return (lane // wp.static(COLUMNS // GROUP)) * THREADS + group_column(lane)


@wp.func
def group_column(lane: int):
    return lane % 3 + (lane // 3) % wp.static(PIXELS // GROUP) * wp.static(3 * GROUP)


@wp.func
def blur(plane: int, lane: int):
    """Blur a thread's group of a plane along its row."""
    start = plane * wp.static(ROWS * THREADS) + group_start(lane)
    sums = Sums()
    for i in range(wp.static(READ)):
        sums = spread(i, cell(False, start + 3 * i, 0.0), sums)
    return sums


@wp.func
def write_columns(derivatives: real_rows, lane: int, column: int, top: int, height: int, width: wp.int32):
    """Write a thread's column of the three shared planes to the maps."""
    if lane < COLUMNS and column < width:
        for j in range(wp.static(ROWS)):
            row = top + j
            if row < height:
                for k in range(wp.static(3)):
                    derivatives[k, row * width + column] = cell(False, (k * ROWS + j) * THREADS + lane, 0.0)


@wp.func
def ssim(mx: wp.float32, my: wp.float32, q: wp.float32, p: wp.float32):
    """(s, ds/dmx, ds/dq, ds/dp)."""
    product = mx * my
    mean = 0.5 * (mx * mx + my * my)
    variance = q - mean
    variance = wp.where(variance < 0.0, 0.0, variance)  # rounding; wp.max would hide NaN
    a = product + HALF_C1
    b = p - product + HALF_C2
    c = mean + HALF_C1
    d = variance + HALF_C2
    inverse = 1.0 / (c * d)
    s = a * b * inverse
    return wp.vec4(s, (b - a) * inverse * my + (s / d - s / c) * mx, -s / d, a * inverse)


OPTIONS = {
    "enable_backward": False,
    "grid_stride": False,
    "module": "unique",
    "launch_bounds": THREADS,
    "module_options": {"max_unroll": READ},
}


@wp.kernel(**OPTIONS)
def score(
    first: int,
    image: reals,
    target: reals,
    height: int,
    width: int,
    scale: wp.float32,
    # outputs
    losses: reals,
    derivatives: real_rows,
):
    """Sums of (1 - s) scale, one a warp, and ds/dmx, ds/dq, ds/dp unless `derivatives` is null."""
    thread = first + wp.tid()
    lane, left, top = place(thread, width)
    moments = blurred_moments(image, target, left - 3 * REACH + lane, top, height, width)
    for k in range(wp.static(MOMENTS)):
        put(k, lane, moments[k])
    sync_block()
    total = float(0.0)
    slopes = Planes()
    if lane < COLUMNS:
        for k in range(wp.static(MOMENTS)):
            moments[k] = blur(k, lane)
        row = top + lane // wp.static(COLUMNS // GROUP)
        for o in range(wp.static(GROUP)):
            s = ssim(moments[0, o], moments[1, o], moments[2, o], moments[3, o])
            for k in range(3):
                slopes[k, o] = s[k + 1]
            if row < height and left + group_column(lane) + 3 * o < width:
                total += (1.0 - s[0]) * scale
    total = warp_sum(total)
    if lane_index() == 0:
        losses[thread // warp_size()] = total
    if not derivatives:
        return
    sync_block()
    if lane < COLUMNS:
        for k in range(3):
            put_group(k, lane, slopes[k])
    sync_block()
    write_columns(derivatives, lane, left + lane, top, height, width)


@wp.kernel(**OPTIONS)
def gradient(  # noqa: PLR0913  # a kernel entry point
    first: int,
    derivatives: real_rows,
    image: reals,
    target: reals,
    height: int,
    width: int,
    scale: wp.float32,
    grad_loss: reals,
    # outputs
    grad_image: reals,
):
    lane, left, top = place(first + wp.tid(), width)
    slopes = blurred_slopes(derivatives, left - 3 * REACH + lane, top, height, width)
    for k in range(3):
        put(k, lane, slopes[k])
    sync_block()
    if lane < COLUMNS:
        for k in range(3):
            slopes[k] = blur(k, lane)
    sync_block()
    if lane < COLUMNS:
        for k in range(3):
            put_group(k, lane, slopes[k])
    sync_block()
    column = left + lane
    if lane < COLUMNS and column < width:
        factor = -scale * grad_loss[0]
        for j in range(wp.static(ROWS)):
            row = top + j
            if row < height:
                k = row * width + column
                cells = j * THREADS + lane
                x = image[k]
                change = cell(False, cells, 0.0) + cell(False, cells + wp.static(ROWS * THREADS), 0.0) * clamped(x)
                change += cell(False, cells + wp.static(2 * ROWS * THREADS), 0.0) * target[k]
                grad_image[k] = clamped_backward(x, change * factor)
