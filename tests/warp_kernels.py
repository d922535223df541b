"""Kernels of tests, in a file of their own: to a type checker a kernel's Python is another language."""

import warp as wp

from nexwarp.kernels.shape import alpha_at
from nexwarp.kernels.surfel import hit
from nexwarp.kernels.types import ALPHA_MIN, types
from nexwarp.kernels.walk import HALF_HEIGHT, HALF_WIDTH, misses_block
from nexwarp.native.fixed_point import fixed_point_add

REAL = wp.float64
FLOAT32 = types(wp.float32)
INTS, FLOATS = wp.array(dtype=wp.int32), wp.array(dtype=wp.float32)
# Of the camera of `visit_blocks`.
FOCAL, WIDTH, HEIGHT, NEAR = 60.0, 80, 56, 0.01


@wp.kernel(enable_backward=False, module="unique")
def scaled_sum(first: wp.int32, a: FLOATS, b: FLOATS, shift: wp.vec2i, scale: wp.float32, negate: wp.bool, out: FLOATS):
    """out = +-(scale * a + b + shift[0] + 10 shift[1]), without b where it is a null array."""
    i = first + wp.tid()
    x = scale * a[i] + float(shift[0] + 10 * shift[1])
    if b:
        x += b[i]
    out[i] = wp.where(negate, -x, x)


@wp.kernel(module="unique", enable_backward=False)
def add_in_order(order: INTS, terms: FLOATS, sums: wp.array2d(dtype=wp.int64), bad: INTS):
    fixed_point_add(sums, 0, terms[order[wp.tid()]], bad)


@wp.kernel(module="unique")
def weighted_sum(
    image: wp.array(dtype=types(REAL).vec3), weights: wp.array(dtype=types(REAL).vec3), loss: wp.array(dtype=REAL)
):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(image[i], weights[i]))


@wp.kernel(enable_backward=False, module="unique")
def visit_blocks(surfels: FLOAT32.Surfels, culled: wp.array2d(dtype=wp.int32), hits: wp.array2d(dtype=wp.int32)):
    """Whether each block culls each surfel, and how many of its 32 pixels hit it."""
    i, block = wp.tid()
    x = float(block % (WIDTH // 8)) * 8.0 - float(WIDTH // 2)
    y = float(block // (WIDTH // 8)) * 4.0 - float(HEIGHT // 2)
    middle = wp.vec2((x + 4.0) / FOCAL, (y + 2.0) / FOCAL)
    if misses_block(i, surfels, middle, wp.vec2(float(HALF_WIDTH) / FOCAL, float(HALF_HEIGHT) / FOCAL)):
        culled[i, block] = 1
    r = surfels.records
    for p in range(32):
        d = wp.vec2((x + float(p % 8) + 0.5) / FOCAL, (y + float(p // 8) + 0.5) / FOCAL)
        u, v, depth = hit(r[i, 0], r[i, 1], r[i, 2], r[i, 3][3], d)
        if alpha_at(u, v, r[i, 0][3], r[i, 1][3], r[i, 2][3]) >= ALPHA_MIN and depth > NEAR:
            hits[i, block] += 1
