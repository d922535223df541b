"""Fusion of depth images into a truncated signed distance field (Curless and Levoy 1996), in blocks of voxels.

A thread is a voxel of a block. Read: a view's z-depths, 0 where there are none, and colours. A voxel that projects
into the image, and is not farther behind the surface than the truncation, takes the view's distance

    min(depth - z, truncation) / truncation

and near the surface its colour, into running means. A view for which the voxel is free space, nearer than the
truncation, counts with a smaller weight: beside thin surfaces and where depths disagree, such views would otherwise
outvote those that see a surface. Nothing is differentiated.
"""

import warp as wp

BLOCK_SIDE = 16  # voxels
FREE_WEIGHT = 0.2  # of a view for which a voxel is free space, beside 1 of one that sees a surface there
CELLS = BLOCK_SIDE * BLOCK_SIDE * BLOCK_SIDE


@wp.kernel(enable_backward=False, module="unique")
def fuse(  # noqa: PLR0913  # a kernel entry point
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    voxel: wp.float32,
    truncation: wp.float32,
    viewmats: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,
    size: wp.vec2i,
    near: wp.float32,
    depths: wp.array2d(dtype=wp.float32),
    colors: wp.array2d(dtype=wp.vec3),
    # outputs, read and written
    distances: wp.array2d(dtype=wp.float32),
    weights: wp.array2d(dtype=wp.float32),
    means: wp.array2d(dtype=wp.vec4),
):
    thread = first + wp.tid()
    b = thread // CELLS
    local = thread % CELLS
    corner = blocks[b]
    x = wp.vec3(
        wp.float32(corner[0] * BLOCK_SIDE + local // (BLOCK_SIDE * BLOCK_SIDE)) * voxel,
        wp.float32(corner[1] * BLOCK_SIDE + (local // BLOCK_SIDE) % BLOCK_SIDE) * voxel,
        wp.float32(corner[2] * BLOCK_SIDE + local % BLOCK_SIDE) * voxel,
    )
    viewmat = viewmats[0]
    c = viewmat * wp.vec4(x[0], x[1], x[2], 1.0)
    if not (c[2] > near):
        return
    column = wp.floor(intrinsics[0] * c[0] / c[2] + intrinsics[2])
    row = wp.floor(intrinsics[1] * c[1] / c[2] + intrinsics[3])
    if not (column >= 0.0 and row >= 0.0 and column < wp.float32(size[0]) and row < wp.float32(size[1])):
        return
    depth = depths[int(row), int(column)]
    if not (depth > 0.0):
        return
    distance = depth - c[2]
    if distance < -truncation:
        return
    share = wp.where(distance < truncation, 1.0, wp.static(FREE_WEIGHT))
    weight = weights[b, local] + share
    weights[b, local] = weight
    seen = wp.min(distance / truncation, 1.0)
    distances[b, local] += (seen - distances[b, local]) * share / weight
    if distance < truncation:
        color = colors[int(row), int(column)]
        mean = means[b, local]
        count = mean[3] + 1.0
        means[b, local] = wp.vec4(
            mean[0] + (color[0] - mean[0]) / count,
            mean[1] + (color[1] - mean[1]) / count,
            mean[2] + (color[2] - mean[2]) / count,
            count,
        )
