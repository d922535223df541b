"""Loads the kernels of a training ahead of their first launches, in threads, which compile what the cache lacks."""

import torch
import warp as wp

from nexwarp.kernels import activate, compose, detail, photometric, project, sh, ssim, tile_lists, unproject
from nexwarp.kernels.adam import adam_step
from nexwarp.kernels.collect import collect
from nexwarp.kernels.collect_backward import collect_backward, reduce_slots
from nexwarp.kernels.fused_scatter import SCATTER_THREADS, fused_scatter_kernel
from nexwarp.kernels.fused_texture import BACKWARD_THREADS, FORWARD_THREADS, fused_kernels, half_scale, pack_matrices
from nexwarp.kernels.hashgrid import hashgrid, hashgrid_backward
from nexwarp.kernels.launch import LAUNCH_THREADS, load_ahead
from nexwarp.kernels.tiles import tile_polygon
from nexwarp.kernels.types import types
from nexwarp.native.staging import BLOCK_DIM
from nexwarp.ops import fused_texture
from nexwarp.ops._interop import Kernel, start_warp

# In the order of their first launches.
FIRST: tuple[Kernel, ...] = (activate.activate, sh.plain_colors, project.project, tile_polygon, tile_lists.depth_keys)
FIRST += (tile_lists.count, tile_lists.emit, collect, unproject.unproject)
LAST: tuple[Kernel, ...] = (compose.compose, photometric.photometric, photometric.depth_errors)
LAST += (photometric.depth_errors_backward, photometric.photometric_backward, compose.compose_backward)
LAST += (unproject.unproject_backward, collect_backward, project.project_backward, sh.plain_coefficients_backward)
LAST += (sh.plain_rays_backward, activate.activate_backward, adam_step, detail.antialias, detail.limit_depths)
# In between.
ON_GPU: tuple[Kernel, ...] = (photometric.expose, ssim.score, ssim.gradient, photometric.expose_backward)
TEXTURE_ON_CPU: tuple[Kernel, ...] = (hashgrid, sh.textured_colors, sh.textured_colors_backward, hashgrid_backward)
BLOCKS: dict[Kernel, int] = {collect: BLOCK_DIM, collect_backward: BLOCK_DIM}
BLOCKS |= {ssim.score: ssim.THREADS, ssim.gradient: ssim.THREADS}


def load_training_kernels(
    device: torch.device, *, max_hits: int, features: int, fused: bool, deterministic: bool
) -> None:
    """Load what a float32 training with K = `max_hits` launches on a device; returns at once.

    Its texture has so many features an entry; on a GPU without fused kernels, its own are loaded when launched.
    """
    start_warp()
    device, blocks = torch.empty(0, device=device).device, BLOCKS  # with its index
    on_gpu, real = device.type == "cuda", wp.float32
    chosen = [*FIRST, *(ON_GPU if on_gpu else (*TEXTURE_ON_CPU, reduce_slots)), *LAST]
    if on_gpu:
        _ = wp.get_device(str(device)).stream  # Warp's context, which the threads would make several times at once
    if fused and not deterministic and fused_texture.runs_on(device):
        kernels, scatter = fused_kernels(features), fused_scatter_kernel(features)
        chosen[len(FIRST) : len(FIRST)] = [pack_matrices, kernels.forward, half_scale, kernels.backward, scatter]
        blocks = blocks | {kernels.forward: FORWARD_THREADS, kernels.backward: BACKWARD_THREADS}
        blocks |= {scatter: SCATTER_THREADS}
    values = {"max_hits": max_hits, "features": features, "storage": real, "clamp": False, "wide": False}
    values |= {"by_place": not on_gpu, "fixed_point": on_gpu and deterministic}
    wanted: list[tuple[wp.Kernel, int]] = []
    for variant in ({"with_errors": True, "dtype": types(real).vec4}, {"with_errors": False, "dtype": real}):
        known = values | variant
        for kernel in chosen:
            block_dim = blocks.get(kernel, LAUNCH_THREADS)
            if not isinstance(kernel, wp.Kernel):
                kernel = kernel(real, **{name: known[name] for name in kernel.names or ()})
            wanted.append((kernel, block_dim))
    load_ahead(wanted, str(device))
