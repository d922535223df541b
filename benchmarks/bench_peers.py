"""gsplat's 2DGS rasterisation on the same surfels, camera and image size, gamma = 1, in the same process.

gsplat is optional: `pip install gsplat==1.5.3`, with a CUDA compiler to build it. Its forward pass does what our
collection stage does (project, tiles, blending), so the whole calls are compared. It is called as its users call it:
one camera, RGB of given colours, not packed, without the distortion loss.
"""

import sys
from collections.abc import Callable

import torch

from benchmarks import suite
from benchmarks.bench_collect import stage
from benchmarks.scenes import Geometry, SurfelScene, garden, geometry, random_like
from benchmarks.suite import Options
from benchmarks.timing import Measurement, ratio

Rasterize = Callable[[], tuple[torch.Tensor, ...]]


def run(options: Options) -> list[Measurement]:
    if not options.cuda:
        return []
    try:
        import gsplat
    except ImportError as error:
        print(f"no peers: {error}", file=sys.stderr)
        return []
    scene = garden(20_000, 400, 259, options.data) if options.quick else garden(data=options.data)
    scene = scene.to(options.device)
    theirs = gsplat_2dgs(scene, options, gsplat)
    ours = stage(scene, options)
    names = ("forward", "forward + backward")
    ratios = [
        ratio(f"ours over gsplat 2DGS, {name}", mine, other, f"gsplat {gsplat.__version__}")
        for name, mine, other in zip(names, ours, theirs, strict=True)
    ]
    return [*ours, *theirs, *ratios]


def gsplat_2dgs(scene: SurfelScene, options: Options, gsplat) -> list[Measurement]:
    rasterize, leaves = gsplat_call(geometry(scene), gsplat)
    with torch.no_grad():
        signals = random_like(rasterize())
        forward = options.time("gsplat 2DGS, forward", rasterize, **scene.facts)
    both = options.time(
        "gsplat 2DGS, forward + backward",
        lambda: torch.autograd.grad(rasterize(), leaves, signals),
        **scene.facts,
    )
    return [forward, both]


def gsplat_call(g: Geometry, gsplat) -> tuple[Rasterize, list[torch.Tensor]]:
    """Return a function that renders with gsplat, and its leaf tensors.

    The function returns (1, H, W, 3) colours and (1, H, W, 1) alphas. Colours that are not spherical harmonics need a
    camera dimension: gsplat's check accepts (N, 3), but its rasterisation then fails.
    """
    means, quats, scales, opacities, _ = (x.detach() for x in g.shape)
    # A surfel has no third scale; 2DGS ignores it.
    scales = torch.cat([scales, torch.ones_like(scales[:, :1])], dim=1)
    leaves = [x.clone().requires_grad_() for x in (means, quats, scales, opacities, g.colors.detach()[None])]
    p = g.pinhole
    call = {"viewmats": g.viewmat[None], "Ks": p.K[None], "width": p.width, "height": p.height, "near_plane": p.near}

    def rasterize() -> tuple[torch.Tensor, ...]:
        return gsplat.rasterization_2dgs(*leaves, **call)[:2]

    return rasterize, leaves


if __name__ == "__main__":
    sys.exit(suite.main({"peers": run}))
