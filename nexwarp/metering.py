"""Automatic exposure: what a camera elsewhere would have set, looking at the trained scene.

A camera with automatic exposure sets its gains by how bright what it sees is. Where the training photos' gains follow
the brightness that the trained scene has before their cameras, they tell those of other cameras better than the photos
around do, most where photos are far: there are renderings to meter.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from nexwarp.camera import Camera
from nexwarp.exposures import MOST_PHOTOS, Exposures, predict
from nexwarp.paths import between, reduced
from nexwarp.render import render
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture

PLACES = 240  # between the cameras, that are metered, at least
HEIGHT = 64  # of the renderings that tell brightness, pixels
LINEAR = 2.2  # sRGB to light, as an exponent
DARKEST = 1e-3  # mean colour that is told from darker ones


@torch.no_grad()
def metered(
    exposures: Exposures,
    surfels: Surfels,
    texture: NeuralTexture | None,
    cameras: Sequence[Camera],
    *,
    options: dict[str, Any],
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Exposures:
    """Return exposures that know, beside the photos', the gains of places between them.

    Those that were given come back where the scene's brightness tells the photos' gains no better than poses do, where
    photos are few, and where so many count already that other places do not fit (1,000 in all).

    Args:
        exposures: of the photos alone.
        surfels: the trained ones.
        texture: their texture, or None.
        cameras: of all training views, on any device.
        options: keyword arguments of `nexwarp.render`.
        progress: called with how many renderings are done and of how many, of which those of other places are asked
            for only where brightness tells gains.
    """
    cameras = cameras[:: -(-len(cameras) // MOST_PHOTOS)]
    room = MOST_PHOTOS - len(cameras)
    if room < PLACES:
        return exposures
    generator, places = torch.Generator().manual_seed(0), []
    for _ in range(math.ceil(PLACES / len(cameras))):
        places += between(cameras, [math.inf] * len(cameras), generator)
    places = places[:: -(-len(places) // room)]
    done, count = itertools.count(1), len(cameras) + len(places)

    def meter(each: Sequence[Camera]) -> torch.Tensor:
        return brightness(surfels, texture, each, options=options, progress=lambda: progress(next(done), count))

    gains = exposures.log_gains
    there = predict(gains, cameras, meter(cameras), places, lambda: meter(places))
    if there is None:
        return exposures
    # As exact as the photos' own, though they are not: what the process makes of both varies as smoothly as they do.
    return Exposures.of(torch.cat([gains.cpu().double(), there]), [*cameras, *places], exposures.falloff.tolist())


@torch.no_grad()
def brightness(
    surfels: Surfels,
    texture: NeuralTexture | None,
    cameras: Sequence[Camera],
    *,
    options: dict[str, Any],
    progress: Callable[[], object] = lambda: None,
) -> torch.Tensor:
    """Log mean colours (M, 3) float64, of light, that cameras see at the photos' mean exposure, on the CPU.

    `progress` is called after each camera.
    """
    kept, surfels.exposures = surfels.exposures, None
    try:
        found = []
        for camera in cameras:
            image = render(surfels, texture, reduced(camera, HEIGHT).to(surfels.device), **options).image
            found.append(image.clamp(0, 1).double().pow(LINEAR).mean((0, 1)).pow(1 / LINEAR))
            progress()
    finally:
        surfels.exposures = kept
    return torch.stack(found).clamp_min(DARKEST).log().cpu()
