"""Fit of what a baked file holds to the photos, and to the model's own renderings. Not in the paper.

The file's own drawing is differentiated, so that texels, SH and opacities make up for what the form cannot show.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import between
from nexwarp.data import View
from nexwarp.export.baked_scene import BakedScene
from nexwarp.kernels.types import ALPHA_MAX
from nexwarp.model.model import Model
from nexwarp.ops.atlas import Cut
from nexwarp.train.losses import SATURATION

WINDOW = {"cuda": 1024, "cpu": 256}  # largest width and height that one step draws
PASSES = 12.0  # over the views' pixels
FEWEST_STEPS = 400
MOST_STEPS = {"cuda": 20_000, "cpu": 2000}
RATES = {"texels": 0.02, "logits": 0.02, "sh0": 5e-3, "shN": 2e-3}
LAST_RATE = 0.05  # relative to the first
BETAS, SMALLEST = (0.9, 0.99), 1e-12  # of Adam
STEEPNESS = 40.0, 400.0  # of the coverage of cut-outs, first and last
LAYERS = 4


Views = Sequence[View] | Sequence[Camera]  # photos, or cameras alone


def cameras_of(views: Views) -> list[Camera]:
    """Return the cameras of views."""
    return [view.camera if isinstance(view, View) else view for view in views]


@dataclass(frozen=True)
class Window:
    """A part of a view to be drawn: its camera, the image (H, W, 3), its exposure, which pixels count.

    `clipped` is a photo, in which what is bright may be brighter.
    """

    camera: Camera
    image: torch.Tensor
    factors: torch.Tensor | None = None
    mask: torch.Tensor | None = None
    clipped: bool = False


def fit(
    scene: BakedScene,
    model: Model,
    views: Views,
    steps: int | None = None,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> BakedScene:
    """Fit texels, and of surfels SH and opacities, to views by least squares: Adam, a window of one view a step.

    Every other step compares with the photo of a view, without photos with the model's rendering of it; the others with
    the model's rendering from a new camera beside the view, so that no photo is learnt by heart. The number of steps
    follows from that of pixels unless it is given.
    """
    device = scene.texels.device.type
    largest = WINDOW[device]
    if steps is None:
        sizes = [(camera.width, camera.height) for camera in cameras_of(views)]
        pixels = sum(width * height for width, height in sizes)
        drawn = sum(min(width, largest) * min(height, largest) for width, height in sizes) / max(len(sizes), 1)
        steps = round(PASSES * pixels / max(drawn, WINDOW["cpu"] ** 2))
        steps = min(max(steps, FEWEST_STEPS), MOST_STEPS[device])
    start = {"texels": scene.texels.flatten(0, 1)}
    if scene.harmonics is not None:
        start |= {"sh0": scene.harmonics[0], "shN": scene.harmonics[1]}
        start["logits"] = torch.logit(scene.shape.opacities, 1e-6)
    trained = {name: x.detach().clone().requires_grad_() for name, x in start.items()}
    groups = [{"params": [x], "lr": RATES[name]} for name, x in trained.items() if x.numel()]
    optimizer = RestingAdam(groups, {})
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, LAST_RATE ** (1 / max(steps, 1)))
    scene = replace(scene, exposures=None)
    for done, window in zip(range(1, steps + 1), _windows(model, views, largest), strict=False):
        shown = _drawn(scene, trained, done / steps)
        image = shown.render_at_mean(window.camera, model.options.background)
        if window.factors is not None:
            image = image * window.factors
        if window.clipped:
            image = image.where((window.image < SATURATION) | (image < window.image), window.image)
        errors = (image - window.image).square()
        loss = errors.mean() if window.mask is None else (errors * window.mask[..., None]).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        if scene.harmonics is None:
            with torch.no_grad():
                trained["texels"].clamp_(0, 1)[:, 3].clamp_(max=ALPHA_MAX)
        progress(done, steps)
    return _drawn(scene, {name: x.detach() for name, x in trained.items()}, None)


class RestingAdam(torch.optim.Optimizer):
    """Adam whose moments rest, by rows, while the gradient is 0: no window shows the texel or surfel.

    Its next step would else be one of the sign alone. `torch.optim.SparseAdam` does the same, but sorts all rows.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]  # nothing is evaluated again
        """Do a step."""
        for group in self.param_groups:
            (x,) = group["params"]
            if x.grad is None:
                continue
            state = self.state[x]
            if not state:
                state.update(step=0, mean=torch.zeros_like(x), square=torch.zeros_like(x))
            state["step"] += 1
            rows = x.grad.reshape(len(x), -1).any(1).nonzero()[:, 0]
            grad = x.grad[rows]
            mean = state["mean"][rows].lerp(grad, 1 - BETAS[0])
            square = state["square"][rows].lerp(grad.square(), 1 - BETAS[1])
            state["mean"][rows], state["square"][rows] = mean, square
            first, second = (1 - beta ** state["step"] for beta in BETAS)
            x[rows] -= group["lr"] / first * mean / ((square / second).sqrt() + SMALLEST)


def _drawn(scene: BakedScene, trained: dict[str, torch.Tensor], share: float | None) -> BakedScene:
    """Return the scene with trained values, its cut-outs as soft as after a share of the steps; None is as shown."""
    scene = replace(scene, texels=trained["texels"].view_as(scene.texels))
    if scene.cut is not None and share is not None:
        first, last = STEEPNESS
        scene = replace(scene, cut=Cut(scene.cut.cutoff, first * (last / first) ** share, LAYERS))
    if scene.harmonics is None:
        return scene
    shape = scene.shape._replace(opacities=trained["logits"].sigmoid())
    return replace(scene, shape=shape, harmonics=(trained["sh0"], trained["shN"]))


def _windows(model: Model, views: Views, largest: int) -> Iterator[Window]:
    """Yield windows of all views in a random order, over and over, each followed by one of a new camera beside it."""
    order = torch.Generator().manual_seed(0)
    while views:
        beside = between(cameras_of(views), order)
        for index in torch.randperm(len(views), generator=order).tolist():
            view = views[index]
            if isinstance(view, View):
                yield _photo_window(model, view, largest, order)
            else:
                yield _rendered_window(model, view, largest, order)
            yield _rendered_window(model, beside[index], largest, order)


def _photo_window(model: Model, view: View, largest: int, order: torch.Generator) -> Window:
    device = model.device
    camera, rows, columns = _crop(view.camera, largest, order)
    image = view.image[rows, columns].to(device).float() / 255
    exposures = model.exposures if model.options.exposure == "photos" else None
    factors = None if exposures is None else exposures.factors(view.camera.to(device))
    if factors is not None and factors.ndim == 3:
        factors = factors[rows, columns]
    mask = None if view.mask is None else view.mask[rows, columns].to(device)
    return Window(camera, image, factors, mask, clipped=True)


def _rendered_window(model: Model, camera: Camera, largest: int, order: torch.Generator) -> Window:
    window, _, _ = _crop(camera, largest, order)
    return Window(window, model.render_image(window.to(model.device), exposure="mean").detach())


def _crop(camera: Camera, largest: int, order: torch.Generator) -> tuple[Camera, slice, slice]:
    """Return the camera of a random window of an image, its rows and its columns."""
    width, height = min(camera.width, largest), min(camera.height, largest)
    left = int(torch.randint(camera.width - width + 1, (1,), generator=order))
    top = int(torch.randint(camera.height - height + 1, (1,), generator=order))
    return camera.crop(left, top, width, height), slice(top, top + height), slice(left, left + width)
