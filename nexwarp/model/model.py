"""The model: a trained scene with the options of its rendering."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import overload

import torch
from torch import nn
from typing_extensions import Unpack

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import WORLD, origin_of
from nexwarp.cameras.ray_camera import RayCamera
from nexwarp.errors import check_type
from nexwarp.io.json_files import Json
from nexwarp.model import graphs
from nexwarp.model.exposures import Exposures
from nexwarp.model.faces import draw_faces
from nexwarp.model.options import Color, RenderChanges, RenderOptions
from nexwarp.model.render import Rendering
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import DetailLimits, Texture


class Model(nn.Module):
    """A trained scene: surfels, texture, exposures, detail limits, and the options of its rendering.

    `save` and `nexwarp.load` keep everything; `state_dict` has the tensors only, without `options` and `meta`.

    Attributes:
        surfels: the N surfels, float32.
        texture: a `NeuralTexture`, or one of your own, float32; None for a model without texture.
        exposures: gains of the training photos and the falloff of their lens; None renders at the mean exposure.
        detail_limits: detail limits of the N surfels; None limits nothing.
        options: the options of its rendering.
        meta: further facts, as JSON values: `near` [world units], `scene_scale` [world units], `preset`, `iteration`;
            `origin` (see the property), where it is not (0, 0, 0); `white`, the linear light that is white, where
            photos hold linear light; a finished model also has `smooth_sh`.

    Raises:
        TypeError, ValueError: the message names the argument.
    """

    surfels: Surfels
    texture: Texture | None
    exposures: Exposures | None
    detail_limits: DetailLimits | None

    def __init__(
        self,
        surfels: Surfels,
        texture: Texture | None,
        exposures: Exposures | None = None,
        detail_limits: DetailLimits | None = None,
        options: RenderOptions | None = None,
        meta: Mapping[str, Json] | None = None,
    ) -> None:
        super().__init__()
        check_type("surfels", surfels, Surfels)
        check_type("texture", texture, Texture, optional=True)
        check_type("exposures", exposures, Exposures, optional=True)
        check_type("detail_limits", detail_limits, DetailLimits, optional=True)
        check_type("options", options, RenderOptions, optional=True)
        if detail_limits is not None and len(detail_limits) != len(surfels):
            raise ValueError(f"detail_limits: expected limits of {len(surfels)} surfels, got {len(detail_limits)}")
        self.surfels = surfels
        self.texture = texture
        self.exposures = exposures
        self.detail_limits = detail_limits
        self.options = RenderOptions() if options is None else options
        self.meta: dict[str, Json] = dict(meta or {})

    @property
    def device(self) -> torch.device:
        """Device of the surfels."""
        return self.surfels.device

    @property
    def origin(self) -> tuple[float, float, float] | None:
        """World coordinates of the origin of the surfels' frame, whose axes are the world's; None if it is unknown.

        Not (0, 0, 0) for scenes far from their world's origin only: see `Scene.origin`.
        """
        return WORLD if "origin" not in self.meta and "scene_scale" in self.meta else origin_of(self.meta)

    @overload
    def render(
        self, camera: Camera | RayCamera, *, background: Color | None = ..., **changes: Unpack[RenderChanges]
    ) -> Rendering: ...

    @overload
    def render(
        self, camera: Sequence[Camera], *, background: Color | None = ..., **changes: Unpack[RenderChanges]
    ) -> list[Rendering]: ...

    def render(
        self,
        camera: Camera | RayCamera | Sequence[Camera],
        *,
        background: Color | None = None,
        **changes: Unpack[RenderChanges],
    ) -> Rendering | list[Rendering]:
        """Render the scene as `nexwarp render` does, with exposures and detail limits. Differentiable.

        Args:
            camera: one camera, or several, which may differ in size. Cameras are moved to the model's device, and to
                its frame where they have an `origin`. What a `RayCamera` renders is not differentiable.
            background: see `nexwarp.render`; None takes that of the options.
            changes: fields of `RenderOptions` to change for this rendering, such as `exposure="mean"`.

        Returns:
            The rendering of the camera, or a list with one rendering for each camera.

        Raises:
            TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
        """
        if torch.compiler.is_compiling():  # one break of the graph, instead of one at each kernel
            return torch.compiler.disable(self.render)(camera, background=background, **changes)
        if isinstance(camera, Sequence) and not isinstance(camera, str):
            return [self.render(item, background=background, **changes) for item in camera]
        if not isinstance(camera, (Camera, RayCamera)):
            raise TypeError(f"camera: expected a nexwarp.Camera or a sequence of them, got {type(camera).__name__}")
        if isinstance(camera, RayCamera):
            return draw_faces(camera.to(self.device), lambda face: self._frame(face, background, changes))
        return graphs.render(self._frame(camera, background, changes))

    def render_image(
        self, camera: Camera, *, background: Color | None = None, **changes: Unpack[RenderChanges]
    ) -> torch.Tensor:
        """Return only the image of `render`, without gradients. On a GPU, the other buffers do not stay in memory.

        Args:
            camera: see `render`; one `Camera`, neither several nor a `RayCamera`.
            background: see `render`.
            changes: see `render`.

        Returns:
            (H, W, 3) float32, the bits of `render(camera, ...).image`.

        Raises:
            TypeError, ValueError: a type, shape or device does not fit; the message names the argument.
        """
        if torch.compiler.is_compiling():
            return torch.compiler.disable(self.render_image)(camera, background=background, **changes)
        check_type("camera", camera, Camera)
        with torch.no_grad():
            return graphs.render(self._frame(camera, background, changes), whole=False).image

    def _frame(self, camera: Camera, background: Color | None, changes: RenderChanges) -> graphs.GraphFrame:
        options = self.options.changed(**changes)
        texture = self.texture if options.max_hits else None
        color = options.background if background is None else background
        if camera.origin not in (None, self.origin) and self.origin is not None:
            camera = camera.moved(self.origin).to(self.surfels.means.dtype)
        return graphs.GraphFrame(self.surfels, texture, camera, options, color, self.exposures, self.detail_limits)

    def bare(self, **changes: Unpack[RenderChanges]) -> "Model":
        """Return a model with the same surfels, but without texture, exposures and detail limits.

        Args:
            changes: fields of `RenderOptions` to change.
        """
        return Model(self.surfels, None, options=self.options.changed(**changes), meta=self.meta)

    def save(self, path: str | os.PathLike[str], *, compact: bool | float = False) -> Path:
        """Write the model; `nexwarp.load` reads it.

        Args:
            path: a file name that ends in `.safetensors`; otherwise a folder, created if it does not exist, in which
                `model.safetensors` is written.
            compact: round and entropy-code the numbers: a fifth of the size. A number instead of True is the noise that
                this may give pictures, its standard deviation of 1; True means 0.002.

        Returns:
            The file that was written.

        Raises:
            OSError: the file cannot be written; an existing file stays unchanged.
            TypeError, ValueError: `compact` is out of range, or the texture is of your own, and `load` could not make
                it again; see `nexwarp.register_texture`.
        """
        from nexwarp.model.model_file import save_model

        return save_model(path, self, compact=compact)
