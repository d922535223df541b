"""Auto exposure: predicts the gains of cameras without a photo from the brightness that they see.

A camera with automatic exposure sets its gains by the brightness of the scene. If the gains of the training photos
depend on the brightness of renderings at their cameras, renderings at other cameras predict the gains there. That is
better than interpolating between photos, above all far from them.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import torch

from nexwarp.cameras.between import between
from nexwarp.cameras.camera import Camera, reduced
from nexwarp.machine import one_thread
from nexwarp.model.exposures import (
    DECIMALS,
    LENGTHS,
    MOST_PHOTOS,
    NOISES,
    TINY,
    Exposures,
    fit_process,
    matern_kernel,
    pose_distances,
    poses_of,
)
from nexwarp.model.model import Model

PLACES = 240  # cameras between the training cameras whose gains are predicted, at least
HEIGHT = 64  # height of the renderings that measure brightness, pixels
LINEAR = 2.2  # exponent that turns sRGB values into linear light
DARKEST = 1e-3  # least mean colour; darker ones count as this


@one_thread()
def predict(
    log_gains: torch.Tensor,
    cameras: Sequence[Camera],
    brightness: torch.Tensor,
    others: Sequence[Camera],
    others_brightness: Callable[[], torch.Tensor],
) -> torch.Tensor | None:
    """Predict the log gains (M, 3) float64 of other cameras from the brightness that they see.

    The prediction is a Gaussian process of the pose, as in `Exposures`, plus a linear function of the brightness: each
    channel depends on the brightness of all three. It is compared with the process alone by predicting each photo from
    the others, with Akaike's criterion corrected for few photos. The criterion takes the channels of a photo as
    dependent, since a photo that is an outlier is one in all of them.

    Args:
        log_gains: (V, 3) log gains of photos.
        cameras: their V cameras.
        brightness: (V, 3) float64 on the CPU, log brightness at these cameras (`brightness`).
        others: M other cameras.
        others_brightness: returns (M, 3) log brightness at the others; called only if it is needed.

    Returns:
        The log gains; None if brightness does not improve the prediction.
    """
    values = log_gains.cpu().double()
    here, there = (poses_of(torch.stack([c.viewmat.cpu().double() for c in each])) for each in (cameras, others))
    size, squares = pose_distances(*here)
    seen = brightness - brightness.mean(0)
    poses = [(matern_kernel(squares, length * size), length * size) for length in LENGTHS]
    alone = min((fit_process(kernel, values, noise) for kernel, _ in poses for noise in NOISES), key=lambda fit: fit[0])
    # The slopes' prior variance is that of the process.
    fits = [
        (*fit_process(kernel + seen @ seen.T, values, noise), length) for kernel, length in poses for noise in NOISES
    ]
    _, errors, coefficients, mean, length = min(fits, key=lambda fit: fit[0])
    if not _better(errors, alone[1], seen.shape[1]):
        return None
    points, more = (torch.cat([position, size * direction], 1) for position, direction in (here, there))
    kernel = matern_kernel(torch.cdist(more, points).square(), length)
    found = mean + (kernel + (others_brightness() - brightness.mean(0)) @ seen.T) @ coefficients
    return found.clamp(values.amin(0), values.amax(0)).round(decimals=DECIMALS)


def _better(errors: torch.Tensor, others: torch.Tensor, slopes: int) -> bool:
    """Return whether Akaike's criterion prefers a fit with errors (V, 3) and `slopes` per channel to one without.

    The criterion is that of normal errors, dependent between channels, corrected for few photos (Bedrick and Tsai 1994,
    Model selection for multivariate regression in small samples). `others` (V, 3) are the errors without slopes.
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
        places += between(cameras, generator)
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
        image = model.render_image(reduced(camera, HEIGHT), exposure="mean")
        found.append(image.clamp(0, 1).double().pow(LINEAR).mean((0, 1)).pow(1 / LINEAR))
        progress()
    return torch.stack(found).clamp_min(DARKEST).log().cpu()
