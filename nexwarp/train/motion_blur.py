"""Renderings as photos were exposed: with gains, and blurred by the motion of their cameras. Not in the paper.

The light that a moving camera gathers is the mean over the exposure, in linear light. Photos are sRGB-encoded, and so
is what surfels show: renderings from poses on the way are decoded, averaged and encoded again.
"""

import dataclasses
from collections.abc import Sequence

import torch

from nexwarp.kernels.photometric import WEIGHT_EPSILON
from nexwarp.model.model import Model
from nexwarp.model.poses import PoseCorrections
from nexwarp.model.render import Rendering
from nexwarp.train.step_losses import as_taken, clipped, exposed
from nexwarp.train.target import Target

# The sRGB transfer function (IEC 61966-2-1): linear below the threshold, a power above. Negative values stay linear.
THRESHOLD, SLOPE, OFFSET, EXPONENT = 0.0031308, 12.92, 0.055, 2.4


def moments(count: int) -> list[float]:
    """Return the times, from -0.5 to 0.5, of the middles of `count` equal parts of an exposure."""
    return [(index + 0.5) / count - 0.5 for index in range(count)]


def render_target(
    model: Model, target: Target, poses: PoseCorrections | None, count: int, *, plain: bool = True
) -> tuple[Rendering, Rendering]:
    """Render what a step compares with its photo.

    Args:
        model: as it is now.
        target: of the step, its camera corrected.
        poses: which hold the motions; None where there are none.
        count: of poses in an exposure, odd; 1 is a sharp photo.
        plain: whether the plain colours are taken to the photo's exposure, too.

    Returns:
        The rendering from the middle of the exposure, and the same as the photo was taken: `image` and `textured` are
        then those of the whole exposure, all other buffers those of its middle.
    """
    if poses is None or target.view is None or count == 1:
        out = _rendered(model, target)
        return out, as_taken(out, target, plain=plain)
    middle = _rendered(model, target)
    cameras = [poses.moment(target.camera, target.view, time) for time in moments(count) if time != 0.0]
    others = [_rendered(model, dataclasses.replace(target, camera=camera)) for camera in cameras]
    return middle, clipped(blurred([exposed(out, target, plain=plain) for out in (middle, *others)]), target)


def _rendered(model: Model, target: Target) -> Rendering:
    return model.render(target.camera, background=target.background, depth_jitter=target.depth_jitter)


def blurred(renderings: Sequence[Rendering]) -> Rendering:
    """Return the first rendering with the light of all of them, in equal parts; differentiable.

    The textured part is averaged without its weights, and gets those of the first rendering: what the texture loss
    compares with the photo is then the mean of the colours that the renderings would have, were they textured alone.

    Args:
        renderings: from poses of one exposure, the middle first.
    """
    first = renderings[0]
    image = mean_light([out.image for out in renderings])
    if not first.weights.shape[-1]:
        return dataclasses.replace(first, image=image)
    shares = [out.weights.sum(-1, keepdim=True) + WEIGHT_EPSILON for out in renderings]
    colors = mean_light([out.textured / share for out, share in zip(renderings, shares, strict=True)])
    return dataclasses.replace(first, image=image, textured=colors * shares[0])


def mean_light(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return the sRGB-encoded mean light (H, W, 3) of sRGB-encoded images; differentiable."""
    return encoded(torch.stack([decoded(image) for image in images]).mean(0))


def decoded(image: torch.Tensor) -> torch.Tensor:
    """Return the linear light of sRGB-encoded values, of any shape and range."""
    power = ((image.clamp_min(SLOPE * THRESHOLD) + OFFSET) / (1 + OFFSET)) ** EXPONENT
    return torch.where(image <= SLOPE * THRESHOLD, image / SLOPE, power)


def encoded(light: torch.Tensor) -> torch.Tensor:
    """Return the sRGB encoding of linear light, the inverse of `decoded`."""
    power = (1 + OFFSET) * light.clamp_min(THRESHOLD) ** (1 / EXPONENT) - OFFSET
    return torch.where(light <= THRESHOLD, light * SLOPE, power)
