"""Every kernel in the builds that rendering and training use, for ahead-of-time compilation and for tests."""

from collections.abc import Iterator

import warp as wp

from nexwarp.kernels.collect import (
    collect_backward_kernel,
    collect_kernel,
    reduce_rows_kernel,
    splat_error_kernel,
)
from nexwarp.kernels.compose import compose_kernel
from nexwarp.kernels.hashgrid import hashgrid_kernels
from nexwarp.kernels.project import project_kernel
from nexwarp.kernels.sh import plain_colors_kernel, textured_colors_kernels
from nexwarp.kernels.tiles import depth_keys_kernel, list_kernels, surfel_ids_kernel, tile_offsets_kernel
from nexwarp.kernels.types import MAX_HITS, types
from nexwarp.kernels.unproject import unproject_kernel


def all_kernels(
    real: type = wp.float32,
    storage: type = wp.float16,
    tile_size: int = 16,
    max_hits: range = range(MAX_HITS + 1),
) -> Iterator[wp.Kernel]:
    """Yield each kernel for a scalar type, a texture storage type, a tile size and a range of K."""
    yield from (project_kernel(real), unproject_kernel(real), compose_kernel(real), depth_keys_kernel(real))
    yield from (surfel_ids_kernel, tile_offsets_kernel)
    yield from (reduce_rows_kernel(dtype) for dtype in (real, types(real).vec3, types(real).vec4))
    for degree in range(4):
        yield plain_colors_kernel(real, degree)
        for clamp in (False, True):
            colors = textured_colors_kernels(real, storage, degree, clamp)
            yield from (colors.forward, colors.backward)
    for features in (1, 2, 4, 8):
        lookup = hashgrid_kernels(real, storage, features)
        yield from (lookup.forward, lookup.backward)
    for low_pass in (False, True):
        lists = list_kernels(real, low_pass, tile_size)
        yield from (lists.count, lists.emit, splat_error_kernel(real, low_pass, tile_size))
        for hits in max_hits:
            yield collect_kernel(real, hits, low_pass, tile_size)
            for watch in (False, True):
                yield collect_backward_kernel(real, hits, low_pass, tile_size, watch)
