"""Every kernel of the catalogue, forward and backward, on small images of odd sizes; `benchmarks.sanitize` runs it.

python -m benchmarks.sanitize --device cpu --sweep      # without compute-sanitizer, which sees CUDA alone
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
import warp as wp

import nexwarp as nw
from nexwarp.kernels import launch as launching
from nexwarp.kernels.catalogue import all_kernels, fused_kernel_builds, ssim_tile_builds
from nexwarp.kernels.rays import collect_rays_kernel, ray_list_kernels
from nexwarp.kernels.reduce import reduce_slots_kernel
from nexwarp.kernels.tsdf import fuse_kernel
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE, MAX_TEXTURE_SH_DEGREE, types
from nexwarp.kernels.walk import BLOCK_DIM
from nexwarp.machine import deterministic
from nexwarp.ops._interop import array, launch
from nexwarp.ops.expose import expose
from nexwarp.ops.photometric import photometric_terms
from nexwarp.ops.rays import TILE_SIZE
from nexwarp.ops.ssim import weighted_dssim
from nexwarp.ops.tsdf import DistanceField
from nexwarp.run.warmup import Build, compile_all
from nexwarp.train.adam import FusedAdam

# Width and height: one pixel, less than a tile, whole tiles, a row, and parts of tiles in both directions.
SIZES = ((1, 1), (17, 33), (31, 7), (16, 16), (50, 1), (5, 64), (33, 47))
SURFELS = 60
FEATURES = (1, 2, 4, 8)  # of an entry of the hash grid


@dataclass(frozen=True)
class Sweep:
    """The result of a sweep.

    Attributes:
        renderings: number of renderings, each with its gradients.
        kernels: number of kernels of the catalogue that were launched.
        missing: kernels of the catalogue that were not.
    """

    renderings: int
    kernels: int
    missing: list[str]


def catalogue(device: torch.device, hits: Sequence[int]) -> list[wp.Kernel]:
    """Return the kernels of a device for some K, those of cameras of any rays and of meshes included."""
    cpu = device.type == "cpu"
    kernels = list(all_kernels(wp.float32, wp.float32 if cpu else wp.float16, max_hits=hits, cpu=cpu))
    rays = [collect_rays_kernel(wp.float32, K, TILE_SIZE) for K in hits]
    return [*kernels, *rays, ray_list_kernels(wp.float32).lists, fuse_kernel()]


def compile_catalogue(device: torch.device, hits: Sequence[int] = range(MAX_HITS + 1)) -> None:
    """Compile the kernels, several at a time, so that a sweep only launches them."""
    wp.init()
    walks = ("collect", "splat_error", "surface")
    own_blocks = (*fused_kernel_builds(), *ssim_tile_builds())
    blocks = {kernel.module.name: threads for kernel, threads in own_blocks}
    builds = [
        Build(k, blocks.get(k.module.name, BLOCK_DIM if k.key.startswith(walks) else 256))
        for k in catalogue(device, hits)
    ]
    compile_all(builds, device)


def sweep(
    device: torch.device,
    hits: Sequence[int] = range(MAX_HITS + 1),
    sizes: Sequence[tuple[int, int]] = SIZES,
    part: tuple[int, int] = (0, 1),
) -> Sweep:
    """Launch every kernel of the catalogue.

    Args:
        device: CUDA or CPU.
        hits: K.
        sizes: widths and heights, in turns.
        part: (i, n) does every n-th rendering from the i-th on.

    Raises:
        RuntimeError: a result is not finite.
    """
    first, parts = part
    renderings = 0
    with _launched() as launched:
        for job in itertools.islice(_jobs(device, hits, sizes), first, None, parts):
            renderings += job()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
    names = {kernel.module.name for kernel in catalogue(device, hits)}
    return Sweep(renderings, len(names & launched), sorted(names - launched))


def _jobs(device: torch.device, hits: Sequence[int], sizes: Sequence[tuple[int, int]]) -> Iterator[Callable[[], int]]:
    """Yield what a sweep does; each returns how many renderings it was."""
    size = itertools.cycle(sizes)
    fixed_points = (False, True) if device.type == "cuda" else (False,)

    def render(fixed: bool, size: tuple[int, int], max_hits: int, **options: Any) -> int:
        with deterministic(fixed):
            _render(device, size, max_hits, **options)
        return 1

    for fixed, low_pass, errors, K in itertools.product(fixed_points, (False, True), (False, True), hits):
        yield partial(render, fixed, next(size), K, low_pass=low_pass, errors=errors)
    for (degree, features), clamp in itertools.product(enumerate(FEATURES), (False, True)):
        for fixed in fixed_points:
            yield partial(render, fixed, next(size), 2, degree=degree, features=features, clamp=clamp)
    for degree in range(MAX_TEXTURE_SH_DEGREE + 1, MAX_SH_DEGREE + 1):
        yield partial(render, False, next(size), 2, degree=degree)
    for width, height in sizes:
        yield partial(_losses, device, width, height)
        yield partial(render, False, (width, height), 2, surfels=0)
    for K in hits:
        yield partial(_rays, device, next(size), K)
    yield partial(_fuse, device, 33, 47)
    if device.type == "cuda":  # where renderings add by atomics instead
        yield partial(_reduce, device)
    # Above, directions have gradients, for which colours are computed layer by layer.
    for features, degree in ((2, 3), (4, 3)) if device.type == "cuda" else zip((2,) * 4, range(4), strict=True):
        yield partial(_texture, device, next(size), features, degree)


@contextmanager
def _launched() -> Iterator[set[str]]:
    """Collect the names of the modules whose kernels a block launches; each kernel has a module of its own."""
    names: set[str] = set()
    original = launching.launch

    def launch_and_note(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> None:
        names.add(kernel.module.name)
        original(kernel, *args, **kwargs)

    with patch.object(launching, "launch", launch_and_note):
        yield names


def _scene(device: torch.device, width: int, height: int, surfels: int) -> tuple[nw.Surfels, nw.Camera]:
    """Surfels of many sizes and shapes around the view of a turned camera, some of them behind it."""
    generator = torch.Generator().manual_seed(surfels + width)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
        return (low + (high - low) * torch.rand(*shape, generator=generator)).to(device)

    scales = 10 ** uniform(surfels, 2, low=-3.0, high=0.3)
    means = uniform(surfels, 3, low=-1.5, high=1.5) + torch.tensor([0.0, 0.0, 1.5], device=device)
    quats = torch.randn(surfels, 4, generator=generator).to(device) + 1e-3
    opacities, gammas = uniform(surfels, low=0.05, high=1.0), uniform(surfels, 2, low=1.0, high=6.0)
    made = nw.Surfels.from_activated(
        means, quats, scales, opacities, gammas, uniform(surfels, (MAX_SH_DEGREE + 1) ** 2, 3, low=-0.5)
    )
    viewmat = torch.tensor([[0.8, 0.0, 0.6, 0.1], [0.0, 1.0, 0.0, 0.0], [-0.6, 0.0, 0.8, 1.0], [0.0, 0.0, 0.0, 1.0]])
    focal = float(max(width, height))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return made, nw.Camera(viewmat.to(device).requires_grad_(), K.to(device), width, height)


def _render(
    device: torch.device,
    size: tuple[int, int],
    max_hits: int,
    *,
    low_pass: bool = False,
    errors: bool = False,
    degree: int = 3,
    features: int = 2,
    clamp: bool = False,
    surfels: int = SURFELS,
) -> None:
    """Render an image, with all further buffers, and differentiate it with respect to everything."""
    made, camera = _scene(device, *size, surfels)
    texture = nw.NeuralTexture(4, 2**8, features, 1.0, 6.0, 16, 1, min(degree, MAX_TEXTURE_SH_DEGREE)).to(device)
    depths = 1.5 + torch.rand(2, surfels, generator=torch.Generator().manual_seed(0))
    limits = nw.DetailLimits(*(depths / camera.focal).to(device))
    background = torch.tensor([0.2, 0.5, 0.8], device=device, requires_grad=True)
    out = nw.render(
        made, texture, camera, max_hits, background, degree, low_pass, clamp, 0.1, detail_limits=limits
    )  # fmt: skip
    request = out.request_splat_error(out.alpha) if errors else None
    surface = (out.expected_depth, out.median_depth, out.top_depth, out.normals, out.distortion)
    buffers = (out.image, out.plain, out.textured, out.depths, out.weights, out.alpha, *surface)
    total = sum(x.square().sum() for x in buffers)
    assert isinstance(total, torch.Tensor)
    total.backward()
    parameters = [*made.parameters(), *texture.parameters(), camera.viewmat, background]
    found = [total, *surface, out.colors, out.splat_error(out.alpha.detach())]
    found += [x.grad for x in parameters if x.grad is not None]
    if request is not None and request.sums_after_backward is not None:
        found.append(request.sums_after_backward)
    if not all(bool(torch.isfinite(x).all()) for x in found):
        raise RuntimeError(f"a result is not finite: {size[0]}x{size[1]}, K = {max_hits}")


def _rays(device: torch.device, size: tuple[int, int], max_hits: int) -> int:
    """Render with a camera of each kind of rays; returns how many."""
    width, height = size
    made, pinhole = _scene(device, width, height, SURFELS)
    viewmat = pinhole.viewmat.detach()
    texture = nw.NeuralTexture(4, 2**8, 2, 1.0, 6.0, 16, 1, 1).to(device)
    model = nw.Model(made, texture, options=nw.RenderOptions(max_hits=max_hits))
    cameras = (
        nw.RayCamera.pinhole(dataclasses.replace(pinhole, viewmat=viewmat)),
        nw.RayCamera.fisheye(viewmat, pinhole.K, (0.1, 0.0, 0.0, 0.0), width, height),
        nw.RayCamera.panorama(viewmat, 2 * max(height, 2)),
        nw.RayCamera.orthographic(viewmat, width, height, 3.0 / max(width, height)),
    )
    with torch.no_grad():
        for camera in cameras:
            out = model.render(camera)
            found = (out.image, out.alpha, out.depths, out.weights, out.normals, out.expected_depth, out.median_depth)
            if not all(bool(torch.isfinite(x).all()) for x in found):
                raise RuntimeError(f"a result is not finite: rays, {size[0]}x{size[1]}, K = {max_hits}")
    return len(cameras)


def _fuse(device: torch.device, width: int, height: int) -> int:
    """Fuse a depth image with holes into a distance field; returns 0 renderings."""
    _, camera = _scene(device, width, height, 0)
    camera = dataclasses.replace(camera, viewmat=camera.viewmat.detach())
    depths = 1.0 + torch.rand(height, width, generator=torch.Generator().manual_seed(0)).to(device)
    depths[::5] = 0.0
    field = DistanceField(0.1, 0.4, device)
    field.reserve(camera, depths, 10_000)
    field.allocate()
    for _ in range(2):
        field.fuse(camera, depths, depths[..., None].expand(height, width, 3).contiguous() * 0.5)
    if not (bool(torch.isfinite(field.distances).all()) and float(field.weights.max()) == 2.0):
        raise RuntimeError("a depth image is not fused")
    return 0


def _losses(device: torch.device, width: int, height: int) -> int:
    """Differentiate the losses that have kernels, on images of noise; returns 0 renderings."""
    generator = torch.Generator().manual_seed(0)
    image, textured, target = torch.rand(3, height, width, 3, generator=generator).to(device)
    weights = torch.rand(height, width, 2, generator=generator).to(device)
    leaves = image, textured, weights = [x.clone().requires_grad_() for x in (image, textured, weights)]
    if device.type == "cuda":  # elsewhere torch takes images to exposures
        image, textured = expose(image, textured, target.new_full((3,), 1.1), target, 0.9)
    terms = photometric_terms(image, textured, weights, target, l1=1.0, texture=1.0, alpha=1.0)
    total = weighted_dssim(image, target, 0.2)
    for term in terms:
        assert term is not None
        total = total + term
    total.backward()
    if not all(x.grad is not None and bool(torch.isfinite(x.grad).all()) for x in leaves):
        raise RuntimeError(f"a gradient of the losses is not finite: {width}x{height}")
    return 0


def _texture(device: torch.device, size: tuple[int, int], features: int, degree: int) -> int:
    """Look points up in a texture that the fused kernels take, differentiate, take a step of Adam; 0 renderings."""
    width, height = size
    texture = nw.NeuralTexture(32 // features, 2**8, features, 1.0, 6.0, sh_degree=degree).to(device)
    generator = torch.Generator().manual_seed(0)
    positions, depths = (torch.rand(height, width, 2, *n, generator=generator).to(device) for n in ((3,), ()))
    directions = torch.nn.functional.normalize(torch.randn(height, width, 3, generator=generator), dim=-1).to(device)
    rates = [{"params": [x], "lr": torch.tensor(1e-3, device=device)} for x in texture.parameters()]
    optimizer = FusedAdam(rates, eps=1e-15)
    optimizer.regularise(texture, texture.resolutions)
    texture.colors(positions.requires_grad_(), depths, directions, 100.0).square().sum().backward()
    optimizer.step()
    found = [positions.grad, optimizer.grid_loss, *texture.parameters()]
    if not all(x is not None and bool(torch.isfinite(x).all()) for x in found):
        raise RuntimeError(f"a result of the fused texture is not finite: {width}x{height}, F = {features}")
    return 0


def _reduce(device: torch.device) -> int:
    """Launch the kernels that add up slots, for elements of every type; returns 0 renderings."""
    real = wp.float32
    order = torch.tensor([2, 0, 1], dtype=torch.int32, device=device)
    ends = torch.tensor([3, 3, 8], dtype=torch.int32, device=device)
    for dtype, tail in ((real, ()), (types(real).vec3, (3,)), (types(real).vec4, (4,))):
        slots, sums = torch.ones(8, 2, *tail, device=device), torch.zeros(3, 2, *tail, device=device)
        inputs = [array(order, wp.int32), array(ends, wp.int32), array(slots, dtype), 2]
        launch(slots, reduce_slots_kernel(dtype), 3, inputs, [array(sums, dtype)])
        if not torch.equal(sums.flatten(1)[:, 0].cpu(), torch.tensor([0.0, 5.0, 3.0])):
            raise RuntimeError("slots are not added up")
    return 0
