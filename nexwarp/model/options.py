"""Options of a model's rendering."""

import dataclasses
import numbers
from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

from typing_extensions import Unpack

from nexwarp.errors import check_range
from nexwarp.io.files import one_line
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.ops.tiles import Order, check_order

Exposure = Literal["photos", "mean"]
LARGEST_COLOR = 1e6


class RenderChanges(TypedDict, total=False):
    """Fields of `RenderOptions`, without the background, that one rendering may change."""

    max_hits: int
    sh_degree: int
    low_pass: bool
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
        sh_degree: largest SH degree of the plain colours, 0 to 6, and of the textured ones, which have 3 at most.
        low_pass: give surfels smaller than a pixel a screen-space Gaussian (the low-pass filter of 2DGS).
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
    low_pass: bool = False
    clamp_texture: bool = False
    exposure: Exposure = "photos"
    detail_limits: bool = True
    order: Order = "depth"

    def __post_init__(self) -> None:
        for name, high in (("max_hits", MAX_HITS), ("sh_degree", MAX_SH_DEGREE)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int):
                raise TypeError(f"{name}: expected an int, got {value!r:.60}")
            check_range(name, value, 0, high)
        for name in ("low_pass", "clamp_texture", "detail_limits"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name}: expected True or False, got {getattr(self, name)!r:.60}")
        if self.exposure not in get_args(Exposure):
            raise ValueError(f"exposure: expected {' or '.join(get_args(Exposure))}, got {self.exposure!r:.60}")
        check_order(self.order)
        if not isinstance(self.background, tuple) or len(self.background) != 3:
            raise ValueError(f"background: expected three numbers, got {self.background!r:.60}")
        for value in self.background:
            if isinstance(value, bool) or not isinstance(value, numbers.Real):
                raise TypeError(f"background: expected three numbers, got {self.background!r:.60}")
            check_range("background", value, -LARGEST_COLOR, LARGEST_COLOR)

    def changed(self, **changes: Unpack["RenderChanges"]) -> "RenderOptions":
        """Return a copy with some fields changed; a TypeError or ValueError names the field."""
        known = [field.name for field in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                raise TypeError(f"{one_line(name, 60)}: expected one of the options {', '.join(known)}")
        return dataclasses.replace(self, **changes)
