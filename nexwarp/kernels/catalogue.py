"""Every kernel in the builds that rendering and training use, for ahead-of-time compilation and for tests."""

from collections.abc import Iterator, Sequence

import warp as wp

from nexwarp.kernels.activate import activate_kernels
from nexwarp.kernels.adam import adam_kernel
from nexwarp.kernels.antialias import antialias_kernels
from nexwarp.kernels.collect import collect_kernel
from nexwarp.kernels.collect_backward import collect_backward_kernel
from nexwarp.kernels.compose import compose_kernels
from nexwarp.kernels.expose import expose_kernels
from nexwarp.kernels.fused_scatter import SCATTER_THREADS, fused_scatter_kernel
from nexwarp.kernels.fused_texture import (
    BACKWARD_THREADS,
    FORWARD_THREADS,
    fused_kernels,
    half_scale,
    order_gradients,
    pack_matrices,
)
from nexwarp.kernels.hashgrid import hashgrid_kernels
from nexwarp.kernels.limit_depths import limit_depths_kernel
from nexwarp.kernels.photometric import photometric_kernels
from nexwarp.kernels.project import project_kernels
from nexwarp.kernels.reduce import reduce_slots_kernel
from nexwarp.kernels.sh import plain_colors_kernels, textured_colors_kernels
from nexwarp.kernels.splat_error import splat_error_kernel
from nexwarp.kernels.ssim import THREADS as SSIM_THREADS
from nexwarp.kernels.ssim import ssim_kernels
from nexwarp.kernels.surface import surface_kernel
from nexwarp.kernels.surface_backward import surface_backward_kernel
from nexwarp.kernels.tile_lists import depth_keys_kernel, list_kernels, surfel_ids_kernel, tile_offsets_kernel
from nexwarp.kernels.tiles import tile_polygon_kernel
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE, MAX_TEXTURE_SH_DEGREE, types
from nexwarp.kernels.unproject import unproject_kernels


def all_kernels(
    real: type = wp.float32,
    storage: type = wp.float16,
    tile_size: int = 16,
    max_hits: Sequence[int] = range(MAX_HITS + 1),
    cpu: bool = False,
) -> Iterator[wp.Kernel]:
    """Yield each kernel for a scalar type, a texture storage type, a tile size and some K, for CUDA or for a CPU."""
    in_tiles = not cpu and real is wp.float32
    yield from thread_kernels(real, storage, tile_size, cpu=cpu)
    if in_tiles:
        yield from (kernel for kernel, _ in ssim_tile_builds())
    yield from walk_kernels(real, tile_size, max_hits, cpu=cpu)
    if not cpu:
        yield from (kernel for kernel, _ in fused_kernel_builds())
    # What a default training has no use for: the antialiasing of trained surfels, depths and normals.
    yield antialias_kernels(real).backward
    for low_pass in (False, True):
        yield surface_kernel(real, low_pass, tile_size)
        yield from (surface_backward_kernel(real, low_pass, tile_size, fixed) for fixed in {False, not cpu})


def thread_kernels(
    real: type,
    storage: type,
    tile_size: int,
    *,
    degrees: Sequence[int] = range(MAX_SH_DEGREE + 1),
    features: Sequence[int] = (1, 2, 4, 8),
    clamps: Sequence[bool] = (False, True),
    low_passes: Sequence[bool] = (False, True),
    layered: bool = True,
    cpu: bool = False,
    fixed_point: bool = True,
) -> Iterator[wp.Kernel]:
    """Yield the kernels of threads that work alone, in blocks of Warp's own size.

    With `layered` also those of textured colours whose MLP is computed layer by layer.
    """
    yield from (project_kernels(real).forward, project_kernels(real).backward, depth_keys_kernel(real))
    for kernels in (unproject_kernels(real), compose_kernels(real)):
        yield from (kernels.forward, kernels.backward)
    yield from (activate_kernels(real).forward, activate_kernels(real).backward)
    yield from (antialias_kernels(real).forward, limit_depths_kernel(real))
    yield tile_offsets_kernel
    if cpu:  # elsewhere the surfels themselves are sorted
        yield surfel_ids_kernel
    yield from (reduce_slots_kernel(dtype) for dtype in (real, types(real).vec3, types(real).vec4))
    yield adam_kernel()
    if not cpu:
        yield from (expose_kernels(real).forward, expose_kernels(real).backward)
    yield from (photometric_kernels(real).forward, photometric_kernels(real).backward)
    for degree in degrees:
        plain = plain_colors_kernels(real, degree)
        yield from (plain.forward, plain.coefficients_backward, plain.rays_backward)
        if degree > MAX_TEXTURE_SH_DEGREE:
            continue
        for clamp in clamps if layered else ():
            colors = textured_colors_kernels(real, storage, degree, clamp)
            yield from (colors.forward, colors.backward)
    for count in features:
        lookup = hashgrid_kernels(real, storage, count)
        yield from (lookup.forward, lookup.backward)
        if fixed_point and not cpu:
            yield hashgrid_kernels(real, storage, count, fixed_point=True).backward
    for low_pass in low_passes:
        lists = list_kernels(real, low_pass, tile_size)
        yield tile_polygon_kernel(real, low_pass, tile_size)
        yield from (lists.count, lists.emit)


def ssim_tile_builds() -> Iterator[tuple[wp.Kernel, int]]:
    """Yield the kernels of D-SSIM for GPUs in float32, with the threads of their blocks."""
    kernels = ssim_kernels()
    yield from ((kernel, SSIM_THREADS) for kernel in (kernels.score, kernels.gradient))


def fused_kernel_builds(features: Sequence[int] = (2, 4)) -> Iterator[tuple[wp.Kernel, int]]:
    """Yield the kernels of texturing in one kernel each way, for GPUs, with the threads of their blocks."""
    yield from ((kernel, 256) for kernel in (half_scale, pack_matrices, order_gradients))
    for count in features:
        kernels = fused_kernels(count)
        yield kernels.forward, FORWARD_THREADS
        yield kernels.backward, BACKWARD_THREADS
        yield fused_scatter_kernel(count), SCATTER_THREADS


def walk_kernels(
    real: type,
    tile_size: int,
    max_hits: Sequence[int],
    *,
    low_passes: Sequence[bool] = (False, True),
    cpu: bool = False,
    fixed_point: bool = True,
) -> Iterator[wp.Kernel]:
    """Yield the kernels that walk along a tile's list, on CUDA in blocks of `walk.BLOCK_DIM`."""
    for low_pass in low_passes:
        yield splat_error_kernel(real, low_pass, tile_size)
        if fixed_point and not cpu:
            yield splat_error_kernel(real, low_pass, tile_size, fixed_point=True)
        for hits in max_hits:
            yield collect_kernel(real, hits, low_pass, tile_size)
            for with_errors in (False, True):
                yield collect_backward_kernel(real, hits, low_pass, tile_size, with_errors, by_place=cpu)
                if fixed_point and not cpu:
                    yield collect_backward_kernel(real, hits, low_pass, tile_size, with_errors, fixed_point=True)
