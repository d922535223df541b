"""Automatic exposure: what a camera elsewhere would have set, looking at the trained scene.

A camera with automatic exposure sets its gains by how bright what it sees is. Where the training photos' gains follow
the brightness that the trained scene has before their cameras, they tell those of other cameras better than the photos
around do, most where photos are far: there are renderings to meter.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import torch

from nexwarp.camera import Camera, reduced
from nexwarp.cameras.between import between
from nexwarp.determinism import one_thread
from nexwarp.model.model import Model
from nexwarp.representation.exposures import (
    DECIMALS,
    LENGTHS,
    MOST_PHOTOS,
    NOISES,
    TINY,
    Exposures,
    _apart,
    _fit,
    _matern,
    _poses,
)


@one_thread()
def predict(
    log_gains: torch.Tensor,
    cameras: Sequence[Camera],
    brightness: torch.Tensor,
    others: Sequence[Camera],
    others_brightness: Callable[[], torch.Tensor],
) -> torch.Tensor | None:
    """Predict other cameras' log gains (M, 3) float64, as automatic exposure has them: by what they see.

    A process of the pose, as `Exposures`, and beside it linear in the brightness: each channel in those of all three.
    None where that predicts each photo from the others no better than the pose alone, by Akaike's criterion, corrected
    for few photos. Channels are not independent there: what goes wrong with a photo (its exposure was set by hand, the
    scene learnt it by heart) goes wrong with all of them.

    Args:
        log_gains: (V, 3) of photos.
        cameras: of those.
        brightness: (V, 3) float64 on the CPU, logarithms, of what is before them (`brightness`).
        others: M cameras.
        others_brightness: gives (M, 3), likewise; not called where there is nothing to predict.
    """
    values = log_gains.cpu().double()
    here, there = (_poses(torch.stack([c.viewmat.cpu().double() for c in each])) for each in (cameras, others))
    size, squares = _apart(*here)
    seen = brightness - brightness.mean(0)
    poses = [(_matern(squares, length * size), length * size) for length in LENGTHS]
    alone = min((_fit(kernel, values, noise) for kernel, _ in poses for noise in NOISES), key=lambda fit: fit[0])
    # Slopes as large as the process is, a priori.
    fits = [(*_fit(kernel + seen @ seen.T, values, noise), length) for kernel, length in poses for noise in NOISES]
    _, errors, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
    if not _better(errors, alone[1], seen.shape[1]):
        return None
    points, more = (torch.cat([position, size * direction], 1) for position, direction in (here, there))
    kernel = _matern(torch.cdist(more, points).square(), length)
    found = mean + (kernel + (others_brightness() - brightness.mean(0)) @ seen.T) @ coefficients
    return found.clamp(values.amin(0), values.amax(0)).round(decimals=DECIMALS)


def _better(errors: torch.Tensor, others: torch.Tensor, slopes: int) -> bool:
    """Whether errors (V, 3), of a fit with so many slopes a channel, are less than others (V, 3) by Akaike's criterion.

    Of errors that are normal, and dependent from channel to channel, with the correction for few photos (Bedrick and
    Tsai 1994, Model selection for multivariate regression in small samples).
    """
    photos, channels = errors.shape

    def criterion(errors: torch.Tensor, regressors: int) -> float:
        left = photos - regressors - channels - 1
        if left <= 0:
            return math.inf
        squares = errors.T @ errors + TINY * torch.eye(channels, dtype=errors.dtype)
        parameters = channels * regressors + channels * (channels + 1) / 2
        return photos * torch.logdet(squares).item() + 2 * parameters * photos / left

    return criterion(errors, 1 + slopes) < criterion(others, 1)


PLACES = 240  # between the cameras, that are metered, at least
HEIGHT = 64  # of the renderings that tell brightness, pixels
LINEAR = 2.2  # sRGB to light, as an exponent
DARKEST = 1e-3  # mean colour that is told from darker ones


@torch.no_grad()
def with_auto_exposure(
    exposures: Exposures,
    model: Model,
    cameras: Sequence[Camera],
    *,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Exposures:
    """Return exposures that hold, beside the photos' gains, those predicted for places between the cameras.

    The given exposures are returned where the scene's brightness predicts the photos' gains no better than poses do,
    where photos are few, and where there are so many that other places do not fit (1,000 in all).

    Args:
        exposures: of the photos alone.
        model: the trained scene.
        cameras: of all training views, on any device.
        progress: called with how many renderings are done and of how many; those of other places follow only where
            brightness predicts gains.
    """
    cameras = cameras[:: -(-len(cameras) // MOST_PHOTOS)]
    room = MOST_PHOTOS - len(cameras)
    if room < PLACES:
        return exposures
    generator = torch.Generator().manual_seed(0)
    places: list[Camera] = []
    for _ in range(math.ceil(PLACES / len(cameras))):
        places += between(cameras, [math.inf] * len(cameras), generator)
    places = places[:: -(-len(places) // room)]
    done, count = itertools.count(1), len(cameras) + len(places)

    def measure(each: Sequence[Camera]) -> torch.Tensor:
        return brightness(model, each, progress=lambda: progress(next(done), count))

    gains = exposures.log_gains
    predicted = predict(gains, cameras, measure(cameras), places, lambda: measure(places))
    if predicted is None:
        return exposures
    # The process takes both as equally exact, which predictions are not; it varies as smoothly as the photos do.
    return Exposures.of(torch.cat([gains.cpu().double(), predicted]), [*cameras, *places], exposures.falloff.tolist())


@torch.no_grad()
def brightness(
    model: Model, cameras: Sequence[Camera], *, progress: Callable[[], object] = lambda: None
) -> torch.Tensor:
    """Log mean colours (M, 3) float64, of light, that cameras see at the photos' mean exposure, on the CPU.

    `progress` is called after each camera.
    """
    found = []
    for camera in cameras:
        image = model.render(reduced(camera, HEIGHT), exposure="mean").image
        found.append(image.clamp(0, 1).double().pow(LINEAR).mean((0, 1)).pow(1 / LINEAR))
        progress()
    return torch.stack(found).clamp_min(DARKEST).log().cpu()
