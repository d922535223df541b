"""What a frame needs: the parts of a model, options, a camera and a background."""

import dataclasses
from collections.abc import Callable, Hashable
from functools import cached_property
from typing import NamedTuple

import torch
from torch import nn

from nexwarp.cameras.camera import Camera
from nexwarp.model.background import Color
from nexwarp.model.detail_limits import DetailLimits
from nexwarp.model.exposures import Exposures
from nexwarp.model.options import RenderOptions
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import NeuralTexture


class Parts(NamedTuple):
    """What a frame reads beside its camera and background."""

    surfels: Surfels
    texture: NeuralTexture | None
    exposures: Exposures | None
    detail_limits: DetailLimits | None

    def tensors(self) -> list[torch.Tensor]:
        """Return parameters and buffers of all parts."""
        return [x for part in self if part is not None for x in _tensors_of(part)]

    def state(self, tensors: list[torch.Tensor]) -> Hashable:
        """What the launches of a frame depend on beside its kind; changes of values in place do not count."""
        texture, exposures, products = self.texture, self.exposures, torch.backends.cuda.matmul
        return (
            *((x.data_ptr(), x.shape) for x in tensors),
            texture and (texture.half_precision, texture.residual, texture.down_weighting, texture.sh_degree),
            # Brought up to date here: a graph reads the copy, where there is one, and not the grid.
            texture and texture.half_copy_key() and texture.half_copy().data_ptr(),
            exposures and exposures.lens,
            self.detail_limits is None,
            torch.are_deterministic_algorithms_enabled(),
            products.allow_tf32,
            products.allow_fp16_reduced_precision_reduction,
        )


@dataclasses.dataclass(frozen=True)
class FrameRequest:
    """What a frame renders. Only frames without gradients and without depth jitter can be captured.

    Attributes:
        work: renders for a camera and a background, by the parts and options.
        parts: of the model.
        options: of the rendering; the background counts instead of theirs.
        camera: on the GPU or the CPU.
        background: of the frame.
    """

    work: Callable[[Camera, Color], Rendering]
    parts: Parts
    options: RenderOptions
    camera: Camera
    background: Color

    @cached_property
    def tensors(self) -> list[torch.Tensor]:
        """Parameters and buffers of the parts."""
        return self.parts.tensors()

    @cached_property
    def state(self) -> Hashable:
        """Whatever the launches depend on beside the kind."""
        return self.parts.state(self.tensors)

    def kind(self) -> tuple[Hashable, ...]:
        """Whose frame it is, and what it has in common with the next ones."""
        options, camera = self.options, self.camera
        there = tuple(part is not None for part in self.parts)
        rendered = (options.max_hits, options.sh_degree, options.low_pass, options.clamp_texture, options.order, there)
        return id(self.parts.surfels), rendered, camera.width, camera.height, camera.near


def _tensors_of(module: nn.Module) -> list[torch.Tensor]:
    """Return parameters and buffers; torch's own iterators take a tenth of a small frame's time."""
    found = [x for x in (*module._parameters.values(), *module._buffers.values()) if x is not None]
    for child in module._modules.values():
        if child is not None:
            found += _tensors_of(child)
    return found
