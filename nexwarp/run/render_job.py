"""Rendering of a run: still views, camera paths, videos and buffers."""

import math
import re
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.nerfstudio import load_camera_path
from nexwarp.cameras.paths import PATHS
from nexwarp.errors import RunError, SettingError
from nexwarp.io.pictures import save_png, to_uint8
from nexwarp.io.video import check_video, video_writer
from nexwarp.model.buffers import render_buffers, save_buffers
from nexwarp.model.model import Model
from nexwarp.model.options import Exposure, RenderChanges
from nexwarp.ops.tiles import Order
from nexwarp.run.contents import FILE_PATH, RENDERS_FOLDER, TEST, TRAIN, frame_name, picture_name
from nexwarp.run.opened import OpenedModel
from nexwarp.run.optics import PLAIN, Optics

FRAMES, FPS = 120, 30.0

SETS = {"test": (TEST,), "train": (TRAIN,), "all": (TRAIN, TEST), None: ()}

LARGEST_SIDE = 16384  # pixels


@dataclass(frozen=True)
class PictureJob:
    """One image to render.

    Attributes:
        file: PNG file to write.
        camera: the camera.
        is_frame: whether the image is a frame of the camera path.
        buffers: whether to write its buffers, too.
        following: camera of the path's next frame; None where there is none.
    """

    file: Path
    camera: Camera
    is_frame: bool
    buffers: bool
    following: Camera | None = None


@dataclass(frozen=True)
class RenderJob:
    """Images to render, and the video of their frames.

    Attributes:
        pictures: the images, in the order of rendering.
        video: video file to write; None writes none.
        fps: frames per second.
        exposure, order: see `RenderOptions`; None is that of the model.
        optics: what the pictures are taken with.
    """

    pictures: list[PictureJob]
    video: Path | None
    fps: float
    exposure: Exposure | None = None
    optics: Optics = PLAIN
    order: Order | None = None

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def seconds(self) -> float:
        """Duration of the path in seconds."""
        return sum(picture.is_frame for picture in self.pictures) / self.fps

    @torch.no_grad()
    def render(self, model: Model, done: Callable[[], object] = lambda: None) -> None:
        """Render and write all images and the video. An incomplete video is deleted.

        Args:
            model: the model, on the device to render on.
            done: called after each image.
        """
        frames = [picture for picture in self.pictures if picture.is_frame]
        changes: RenderChanges = {} if self.exposure is None else {"exposure": self.exposure}
        if self.order is not None:
            changes["order"] = self.order
        with ExitStack() as stack:
            append = None
            if self.video is not None:  # before any rendering, which would be lost if the file cannot be written
                size = (frames[0].camera.width, frames[0].camera.height)
                append = stack.enter_context(video_writer(self.video, *size, self.fps))
            for picture in self.pictures:
                camera = picture.camera
                if picture.buffers:
                    buffers = render_buffers(model, camera, **changes)
                    save_buffers(picture.file.with_suffix(".exr"), buffers)
                    image = buffers.image
                else:
                    image = self.optics.image(model, camera, picture.following, **changes)
                pixels = to_uint8(image).cpu()
                save_png(picture.file, pixels)
                if append is not None and picture.is_frame:
                    append(pixels)
                done()
        if frames:
            _remove_frames(frames[0].file.parent, len(frames))


@dataclass(frozen=True)
class RenderOrder:
    """The options of `nexwarp render`.

    Attributes:
        path: "ellipse", "interpolate", "spiral" or a JSON file; None renders no path.
        video: video file of the path; None writes none.
        frames: number of frames of the path; None is 120, or that of the JSON file.
        fps: frames per second of the video; None is 30, or that of the JSON file.
        views: "test", "train" or "all"; None renders no still views.
        buffers: also write the buffers of the still views or, without still views, of the frames.
        size: "WIDTHxHEIGHT" in pixels; None keeps the size of the cameras.
        scale: factor on the size of the cameras.
        exposure, order: see `RenderOptions`; None is that of the model.
        optics: what the pictures are taken with.

    Raises:
        ValueError: the message names the option.
    """

    path: str | None
    video: Path | None = None
    frames: int | None = None
    fps: float | None = None
    views: str | None = None
    buffers: bool = False
    size: str | None = None
    scale: float = 1.0
    exposure: str | None = None
    optics: Optics = PLAIN
    order: str | None = None

    def __post_init__(self) -> None:
        if self.views not in SETS:
            raise SettingError(f"--set: expected test, train or all, got {self.views!r}")
        if self.path is not None and self.path not in PATHS and not self.path.lower().endswith(".json"):
            raise SettingError(f"--path: expected {', '.join(PATHS)} or a file ending in .json, got {self.path!r}")
        if self.frames is not None and self.frames < 0:
            raise SettingError(f"--frames: expected at least 0, got {self.frames}")
        if self.frames == 0 and (self.video is not None or self.views is None):
            raise SettingError("--frames: expected at least 1 for a path or a video, got 0")
        if self.path is None and self.frames:
            raise SettingError("--frames: expected together with --path or --video, got --set alone")
        if self.fps is not None and self.video is None:
            raise SettingError("--fps: expected together with --video, got no --video")
        if self.exposure not in (None, *get_args(Exposure)):
            raise SettingError(f"--exposure: expected {' or '.join(get_args(Exposure))}, got {self.exposure!r}")
        if self.order not in (None, *get_args(Order)):
            raise SettingError(f"--order: expected {' or '.join(get_args(Order))}, got {self.order!r}")
        if self.order is not None and self.optics.kind != "pinhole":
            raise SettingError(f"--order: expected together with --camera pinhole, got --camera {self.optics.kind}")
        if self.buffers and not self.optics.plain:
            raise SettingError("--buffers: expected without --camera, --aperture and --shutter, got one of them")
        if self.optics.shutter > 0 and self.path is None:
            raise SettingError("--shutter: expected together with a path, whose camera moves, got --set alone")
        self._size()
        if self.video is not None:
            _check_video(self.video, FPS if self.fps is None else self.fps)

    def prepare(self, opened: OpenedModel) -> RenderJob:
        """Choose the cameras and the files; write nothing.

        Args:
            opened: the run or model; one without cameras has no still views, and its paths lead around its surfels.

        Raises:
            ValueError, FileNotFoundError: the message names the option or file.
        """
        size = self._size()
        cameras = opened.cameras
        renders, pictures = opened.folder / RENDERS_FOLDER, []
        if self.optics.kind != "pinhole":
            renders = renders / self.optics.kind
        for group in SETS[self.views]:
            for name, camera in cameras.get(group, {}).items():
                file = renders / group / picture_name(name)
                pictures.append(PictureJob(file, size(camera), False, self.buffers))
        fps = FPS
        if self.path is not None and self.frames != 0:
            folder, path, fps = self._path(opened, renders)
            first = size(path[0])
            path = [resized(size(camera), first.width, first.height) for camera in path]
            for i, camera in enumerate(path):
                following = path[i + 1] if i + 1 < len(path) else None
                wanted = self.buffers and self.views is None
                pictures.append(PictureJob(folder / frame_name(i), camera, True, wanted, following))
        if not pictures:
            raise RunError(
                f"{opened.folder / CAMERAS_FILE}: expected {self.views} views to render, found none; see --path"
            )
        fps = fps if self.fps is None else self.fps
        chosen = (cast(Exposure | None, self.exposure), self.optics, cast(Order | None, self.order))
        return RenderJob(pictures, self.video, fps, *chosen)

    def _path(self, opened: OpenedModel, renders: Path) -> tuple[Path, list[Camera], float]:
        """Return the folder of the frames, their cameras, and the frames per second."""
        assert self.path is not None
        if self.path not in PATHS:
            file = Path(self.path)
            if self.frames is not None:
                raise SettingError(f"--frames: expected no value with {file}, which sets it, got {self.frames}")
            near = next((c.near for group in opened.cameras.values() for c in group.values()), opened.near)
            path = load_camera_path(file, near)
            return renders / FILE_PATH.format(file.stem), path.cameras, path.fps or FPS
        count = FRAMES if self.frames is None else self.frames
        cameras = opened.path_cameras()
        views = cameras.get(TRAIN, {})
        if self.path == "interpolate":
            views = dict(sorted((views | cameras.get(TEST, {})).items()))
        try:
            return renders / self.path, PATHS[self.path](list(views.values()), count), FPS
        except ValueError as error:
            hint = "; --frames 0 renders the still views alone" if self.views is not None else ""
            raise SettingError(f"--path {self.path}: {error}{hint}") from None

    def _size(self) -> Callable[[Camera], Camera]:
        """Return the function that resizes a camera's image as --size or --scale specify."""
        if not 0 < self.scale < math.inf:
            raise SettingError(f"--scale: expected a number above 0, got {self.scale:g}")
        if self.size is None:
            return self._scaled
        if self.scale != 1.0:
            raise SettingError("--size, --scale: expected at most one of them, got both")
        match = re.fullmatch(r"(\d+)[xX](\d+)", self.size)
        sides = tuple(int(side) for side in match.groups()) if match else ()
        if not sides or not all(1 <= side <= LARGEST_SIDE for side in sides):
            raise SettingError(f"--size: expected WIDTHxHEIGHT of 1 to {LARGEST_SIDE} pixels each, got {self.size!r}")
        return lambda camera: resized(camera, sides[0], sides[1])

    def _scaled(self, camera: Camera) -> Camera:
        camera = self.optics.resized(camera)
        sides = [max(round(side * self.scale), 1) for side in (camera.width, camera.height)]
        if max(sides) > LARGEST_SIDE:
            raise SettingError(
                f"--scale: expected at most {LARGEST_SIDE} pixels a side, got {sides[0]}x{sides[1]} with {self.scale:g}"
            )
        return resized(camera, *sides)


def _check_video(path: Path, fps: float) -> None:
    try:
        check_video(path, fps)
    except ValueError as error:
        option = "--fps" if str(error).startswith("fps: ") else "--video"
        raise SettingError(f"{option}: {str(error).removeprefix('fps: ')}") from None


def _remove_frames(folder: Path, count: int) -> None:
    """Remove the frames numbered `count` and up, which an earlier, longer path left in the folder."""
    for file in folder.iterdir():
        if re.fullmatch(r"\d{4,}\.(png|exr)", file.name) and int(file.stem) >= count:
            file.unlink()
