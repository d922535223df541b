"""From trained surfels to a finished model: SH smoothing and detail limits. Neither is in the paper.

A surfel's SH are trained only in the directions of the photos that show it, often few and close to each other. In other
directions the colour is arbitrary, and with degree 3 it can become pink or green. After training, a ridge regression
replaces each surfel's coefficients c by

    argmin over x of  sum_v w_v |Y(d_v) (x - c)|^2 / sum_v w_v  +  strength |D x|^2,

where w_v is the sum of the surfel's blending weights in training view v, textured hits included; d_v its direction in
that view; Y the harmonics, before colours are clamped to >= 0; and D the Laplacian on the sphere, -l (l + 1) for degree
l, divided by that of degree 3. The colours in the training views change little; all others become as even as possible.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.kernels.types import ALPHA_MIN
from nexwarp.machine import deterministic
from nexwarp.model.exposures import Exposures
from nexwarp.model.graphs import on_each_camera
from nexwarp.model.model import Model
from nexwarp.model.render import Frame, draw
from nexwarp.model.surfels import Surfels, harmonics
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.ops import ListCapacity
from nexwarp.train.recipe import Config

SOLVED = 2**21  # values of the matrices solved at once, several times
LEAST = 1e-6  # least sum of weights over all views, in pixels, of a surfel that is seen
FinishObserver = Callable[[str, int, int], None]
Progress = Callable[[int, int], object]  # is told how many views are rendered, and of how many


def finish_model(
    model: Model, views: Sequence[View], exposures: Exposures | None, config: Config, observe: FinishObserver
) -> Model:
    """Return a finished model with surfels of its own: smooth SH, detail limits and exposures.

    The texture is shared. The cameras of the training views are those whose poses are corrected. `observe` is called
    with each stage's name, how many views of it are rendered, and of how many.
    """
    raw = {name: value.detach().clone() for name, value in model.surfels.state_dict().items()}
    finished = Model(Surfels(raw), model.texture, options=model.options)
    if config.smooth_sh > 0:
        # Detail limits are the same whatever the order of threads.
        with deterministic(config.deterministic and model.device.type == "cuda"):
            sh0, shN = smooth_sh(finished, views, config.smooth_sh, partial(observe, "smoothing SH"))
        finished.surfels.sh0.data, finished.surfels.shN.data = sh0, shN
    if config.footprints:
        cameras = [view.camera for view in views]
        finished.detail_limits = measure_detail_limits(finished, cameras, partial(observe, "measuring detail limits"))
    if exposures is not None:
        finished.exposures = copy.deepcopy(exposures).to(model.device)
    finished.meta = model.meta | {"smooth_sh": config.smooth_sh}
    return finished


@torch.no_grad()
def measure_detail_limits(
    model: Model, cameras: Sequence[Camera], progress: Progress = lambda *_: None
) -> DetailLimits:
    """Return the detail limits of a model's surfels: the pixel sizes (depth / focal) at which cameras saw them."""
    bare = model.bare(max_hits=max(model.options.max_hits, 1))
    surfels = bare.surfels
    nearest = surfels.means.new_full((len(surfels),), NEVER)
    if not len(surfels):
        return DetailLimits(nearest, nearest.clone())
    farthest, front = torch.zeros_like(nearest), torch.zeros_like(nearest)
    for done, camera in enumerate(cameras, 1):
        camera = camera.to(surfels.device)
        out = bare.render(camera)
        seen, ids = out.weights >= ALPHA_MIN, out.ids.clamp_min(0).long()
        centres = camera.project(surfels.means)[1]
        front = torch.maximum(front, centres.where(centres > camera.near, 0.0) / camera.focal)
        near = (out.depths / camera.focal).where(seen, NEVER)
        far = (torch.maximum(out.depths, centres[ids]) / camera.focal).where(seen, 0.0)
        nearest.scatter_reduce_(0, ids.flatten(), near.flatten(), "amin")
        farthest.scatter_reduce_(0, ids.flatten(), far.flatten(), "amax")
        progress(done, len(cameras))
    # Surfels without a visible texture have the limit of their centres in the views that they are in front of.
    farthest = farthest.where(farthest > 0, front)
    return DetailLimits(nearest, farthest.where(farthest > 0, NEVER))


@torch.no_grad()
def smooth_sh(
    model: Model, views: Sequence[View], strength: float, progress: Progress = lambda *_: None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return smoothed coefficients `sh0` (N, 1, 3) and `shN` (N, C - 1, 3); masked pixels do not count.

    A surfel that no view shows gets one colour for all directions, that of its `sh0`. Coefficients above the rendered
    degree do not change.
    """
    surfels = model.surfels
    sh0, shN = surfels.sh0.detach(), surfels.shN.detach()
    count = _count(model)
    if count == 1 or not len(surfels):
        return sh0.clone(), shN.clone()
    every = torch.cat([sh0, shN], dim=1)
    rendered = every[:, :count]
    products, total = seen_directions(model, views, progress)
    for ids in torch.arange(len(surfels), device=surfels.device).split(SOLVED // count**2):
        known = total[ids] > LEAST
        seen = ids[known]
        _smooth(rendered, seen, products[seen] / total[seen, None], strength)
        rendered[ids[~known], 1:] = 0.0
    return every[:, :1].contiguous(), every[:, 1:].contiguous()


def _smooth(coefficients: torch.Tensor, ids: torch.Tensor, equations: torch.Tensor, strength: float) -> None:
    """Smooth some surfels' coefficients (N, C, 3) in place, given their normal equations, divided by their weight."""
    count, device = coefficients.shape[1], coefficients.device
    degrees = torch.arange(count, device=device, dtype=torch.float64).sqrt().floor()
    penalty = strength * (degrees * (degrees + 1) / 12).square()
    row, column = torch.triu_indices(count, count, device=device).unbind()
    left = equations.new_zeros(len(ids), count, count)
    left[:, row, column] = left[:, column, row] = equations
    left += torch.diag(penalty)
    # Of what is to be taken away, which is nothing where training views tell all.
    rough = penalty[:, None] * coefficients[ids].double()
    coefficients[ids] -= torch.linalg.solve(left, rough).to(coefficients)


@torch.no_grad()
def seen_directions(
    model: Model, views: Sequence[View], progress: Progress = lambda *_: None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the normal equations of the N surfels: sum_v w_v Y_i(d_v) Y_j(d_v), (N, P), and sum_v w_v, (N,).

    Of C coefficients there are P = C (C + 1) / 2 pairs i <= j, row by row of a matrix's upper triangle. Both are
    float64: the rounding of sums in float32 would exceed the term of a weak smoothing.
    """
    surfels, count = model.surfels, _count(model)
    step = SOLVED // count**2
    parts = [slice(start, start + step) for start in range(0, len(surfels), step)]
    row, column = torch.triu_indices(count, count, device=surfels.device).unbind()
    products = torch.zeros(len(surfels), len(row), dtype=torch.float64, device=surfels.device)
    total = products.new_zeros(len(surfels))
    background = surfels.means.new_zeros(3)
    # Which pixels count in the view at hand, by the size of views: a graph reads them where they are.
    counted: dict[tuple[int, int], torch.Tensor] = {}

    def cameras() -> Iterator[Camera]:
        for number, view in enumerate(views, 1):
            size = view.camera.height, view.camera.width
            pixels = counted.setdefault(size, background.new_empty(size))
            if view.mask is None:
                pixels.fill_(1)  # a copy would wait for the GPU
            else:
                pixels.copy_(view.mask)
            yield view.camera
            progress(number, len(views))

    def add(camera: Camera) -> ListCapacity:
        out = draw(Frame(surfels, None, camera, model.options, background))
        weights = out.splat_error(counted[camera.height, camera.width]).double()
        for part in parts:
            basis = harmonics(surfels.means.detach()[part], camera.position, count).double()
            products[part] += weights[part, None] * basis[:, row] * basis[:, column]
        total.add_(weights)
        return out.intermediates.tiles.room

    on_each_camera(add, cameras(), surfels.device)
    return products, total


def _count(model: Model) -> int:
    """Return the number of coefficients per channel that are rendered."""
    return min(model.surfels.shN.shape[1] + 1, (model.options.sh_degree + 1) ** 2)
