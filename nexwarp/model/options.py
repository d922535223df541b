"""Options of a model's rendering, and the colour behind everything."""

import dataclasses
import numbers
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, cast, get_args

import torch
from typing_extensions import Unpack

from nexwarp.errors import check_finite, check_integer, check_range
from nexwarp.io.files import one_line
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.ops.tiles import Order, check_order

Exposure = Literal["photos", "mean"]
Color = float | Sequence[float] | torch.Tensor
LARGEST_COLOR = 1e6


class RenderChanges(TypedDict, total=False):
    """Fields of `RenderOptions`, without the background, that one rendering may change."""

    max_hits: int
    sh_degree: int
    clamp_texture: bool
    exposure: Exposure
    detail_limits: bool
    order: Order


@dataclass(frozen=True)
class RenderOptions:
    """Options of a model's rendering; a trained model has those of its training.

    Attributes:
        max_hits: K, number of hits textured in each pixel, 0 to 8.
        background: sRGB colour behind the surfels, weighted by the final transmittance.
        sh_degree: largest SH degree of the colours, 0 to 3.
        clamp_texture: clamp textured colours to >= 0; not for residual textures.
        exposure: "photos" predicts the gains from the training photos near the camera, and applies the falloff of their
            lens; "mean" renders every camera at the photos' mean exposure.
        detail_limits: limit the texture's detail closer than the training views, and also blur surfels farther than
            them (see `DetailLimits`).
        order: "depth" blends surfels by their centres' z-depth, as in training; "distance" by their distance, so that
            pictures from one place agree where they overlap, and with panoramas.

    Raises:
        TypeError, ValueError: the message names the field.
    """

    max_hits: int = 2
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3
    clamp_texture: bool = False
    exposure: Exposure = "photos"
    detail_limits: bool = True
    order: Order = "depth"

    def __post_init__(self) -> None:
        check_integer("max_hits", self.max_hits, 0, MAX_HITS)
        check_integer("sh_degree", self.sh_degree, 0, MAX_SH_DEGREE)
        for name in ("clamp_texture", "detail_limits"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name}: expected True or False, got {getattr(self, name)!r:.60}")
        if self.exposure not in get_args(Exposure):
            raise ValueError(f"exposure: expected {' or '.join(get_args(Exposure))}, got {self.exposure!r:.60}")
        check_order(self.order)
        if not isinstance(self.background, tuple):
            raise ValueError(f"background: expected three numbers, got {self.background!r:.60}")
        for value in color_numbers(self.background):
            check_range("background", value, -LARGEST_COLOR, LARGEST_COLOR)

    def changed(self, **changes: Unpack["RenderChanges"]) -> "RenderOptions":
        """Return a copy with some fields changed; a TypeError or ValueError names the field."""
        known = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                raise TypeError(f"{one_line(name, 60)}: expected one of the options {', '.join(known)}")
        return dataclasses.replace(self, **changes) if changes else self


def check_removed(values: dict[str, Any]) -> None:
    """Take options that went after 7f7bd6c out of a file's values; raise ValueError where one was used."""
    if values.pop("low_pass", False) is not False:
        raise ValueError("low_pass: expected false: the screen-space low-pass was removed after 7f7bd6c")
    degree = values.get("sh_degree")
    if isinstance(degree, int) and MAX_SH_DEGREE < degree <= 6:
        raise ValueError(f"sh_degree: expected at most 3, got {degree}: higher degrees were removed after 7f7bd6c")


def color_tensor(background: Color, like: torch.Tensor, channels: int = 3) -> torch.Tensor:
    """Return the background as a (channels,) tensor; a tensor keeps its graph."""
    if isinstance(background, torch.Tensor):
        if background.device.type == "cpu":
            check_finite("background", background.detach())
        return background.expand(channels) if background.ndim == 0 else background
    values = color_numbers(background, channels)
    for value in values:
        if not abs(value) <= torch.finfo(like.dtype).max:
            raise ValueError(f"background: expected finite values, got {value}")
    return torch.stack([like.new_full((), value) for value in values])


def color_numbers(background: float | Sequence[float], channels: int = 3) -> list[float]:
    """Return a background that is no tensor as numbers; raise TypeError or ValueError where it is none."""
    values: Sequence[object]
    if isinstance(background, numbers.Real):
        values = [background] * channels
    elif isinstance(background, Iterable) and not isinstance(background, str):
        values = list(background)
    else:
        raise TypeError(f"background: expected numbers or a tensor, got {type(background).__name__}")
    if len(values) != channels:
        raise ValueError(f"background: expected {channels} values, got {len(values)}")
    if not all(isinstance(x, numbers.Real) and not isinstance(x, bool) for x in values):
        raise TypeError(f"background: expected numbers or a tensor, got {values}")
    return cast(list[float], values)
