"""Rendering of a run: still views, camera paths, videos and buffers."""

import dataclasses
import math
import re
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias, cast, get_args

import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.cameras.cameras_file import CAMERAS_FILE, WORLD
from nexwarp.cameras.nerfstudio import load_camera_path
from nexwarp.cameras.paths import PATHS, suited_path
from nexwarp.cameras.ray_camera import MAX_SIDE, RayCamera
from nexwarp.cameras.similarity import Similarity
from nexwarp.data.option import Flag_, option
from nexwarp.errors import RunError, SettingError, naming, require
from nexwarp.io.pictures import linear_light, png_files, save_exr, to_uint8
from nexwarp.io.video import FASTEST, check_video, video_writer
from nexwarp.model.buffers import render_buffers, save_buffers
from nexwarp.model.edit import moved_buffers
from nexwarp.model.model import Model
from nexwarp.model.options import Exposure, RenderChanges
from nexwarp.ops.tiles import Order
from nexwarp.run.folder import FILE_PATH, RENDERS_FOLDER, TEST, TRAIN, OpenedModel, near_depth, picture_name

FRAMES = 120
FPS = 30.0
PROJECTIONS = (PINHOLE, PANORAMA, FISHEYE) = ("pinhole", "panorama", "fisheye")
SETS = {"test": (TEST,), "train": (TRAIN,), "all": (TRAIN, TEST), None: ()}
LARGEST_SIDE = 16384  # pixels

Picture: TypeAlias = tuple[Path, Camera]  # a PNG file; a pinhole at the pose, and of the size, of the image


@dataclass(frozen=True)
class RenderOrder:
    """What `nexwarp render` shows, and how."""

    path: Annotated[str | None, option("PATH", "ellipse or interpolate")] = None
    """Camera path: ellipse, interpolate, or FILE.json, a camera path of nerfstudio. By default an ellipse if the
    cameras surround what they look at, otherwise interpolate."""
    video: Annotated[Path | None, option("FILE", "none")] = None
    """Also write the path as a video: .mp4, .mov, .mkv (H.264) or .webm (VP9). Needs the extra `video`."""
    frames: Annotated[int | None, option("N", "120, or that of FILE.json")] = None
    """Number of frames of the path; 0 renders no path."""
    fps: Annotated[float | None, option("N", "30, or that of FILE.json")] = None
    """Frames per second of the video."""
    set: Annotated[str | None, option("{test,train,all}", "test without --path and --video")] = None
    """Still views to render."""
    buffers: Flag_ = False
    """Also write all buffers (depths, normals, weights ...) of the still views, else of the frames, as OpenEXR."""
    format: Annotated[str, option("{png,exr}")] = "png"
    """Files of the pictures; OpenEXR holds linear light, in the unit of the photos' (docs/scenes.md)."""
    size: Annotated[str | None, option("WIDTHxHEIGHT", "that of the photos")] = None
    """Image size in pixels, such as 1920x1080; keeps the vertical field of view."""
    scale: Annotated[float, option("FACTOR")] = 1.0
    """Factor on the size of the photos, instead of --size."""
    camera: Annotated[str, option("NAME")] = PINHOLE
    """pinhole, panorama or fisheye (docs/cameras.md)."""
    fov: Annotated[float, option("DEGREES")] = 180.0
    """Angle that the smaller side of a fisheye image shows."""
    exposure: Annotated[str | None, option("{photos,mean}", "that of the model")] = None
    """Exposure and white balance: of the photos near each camera, or their mean for all images."""
    order: Annotated[str | None, option("{depth,distance}", "that of the model")] = None
    """Blend surfels by z-depth, or by distance from the camera, which suits panoramas (docs/cameras.md)."""

    def check(self) -> None:
        """Raise SettingError unless the options fit together."""
        is_path = self.path is None or self.path in PATHS or self.path.lower().endswith(".json")
        needs_frames = self.video is not None or self.views is None
        fps = FPS if self.fps is None else self.fps
        require(self.set in SETS, f"--set: expected test, train or all, got {self.set!r}")
        require(is_path, f"--path: expected {', '.join(PATHS)} or a file ending in .json, got {self.path!r}")
        require(self.frames is None or self.frames >= 0, f"--frames: expected at least 0, got {self.frames}")
        require(self.frames != 0 or not needs_frames, "--frames: expected at least 1 for a path or a video, got 0")
        alone = "--frames: expected together with --path or --video, got --set alone"
        require(self.has_path or not self.frames, alone)
        require(self.fps is None or self.video is not None, "--fps: expected together with --video, got no --video")
        require(0 < fps <= FASTEST, f"--fps: expected more than 0 and at most {FASTEST:g} frames a second, got {fps:g}")
        require(self.format in ("png", "exr"), f"--format: expected png or exr, got {self.format!r}")
        drawn = "--buffers: expected together with --format png, got exr"
        require(self.format == "png" or not self.buffers, drawn)
        require(self.camera in PROJECTIONS, f"--camera: expected {', '.join(PROJECTIONS)}, got {self.camera!r}")
        require(1 <= self.fov <= 360, f"--fov: expected 1 to 360 degrees, got {self.fov:g}")
        fisheye = f"--fov: expected together with --camera fisheye, got --camera {self.camera}"
        require(self.fov == 180.0 or self.camera == FISHEYE, fisheye)
        for name, value, kind in (("exposure", self.exposure, Exposure), ("order", self.order, Order)):
            known = get_args(kind)
            require(value in (None, *known), f"--{name}: expected {' or '.join(known)}, got {value!r}")
        for name, asked in (("order", self.order is not None), ("buffers", self.buffers)):
            pinhole = f"--{name}: expected together with --camera pinhole, got --camera {self.camera}"
            require(self.camera == PINHOLE or not asked, pinhole)
        require(0 < self.scale < math.inf, f"--scale: expected a number above 0, got {self.scale:g}")
        require(self.size is None or self.scale == 1.0, "--size, --scale: expected at most one of them, got both")
        fits = self.size is None or 1 <= min(self._sides) <= max(self._sides) <= LARGEST_SIDE
        require(fits, f"--size: expected WIDTHxHEIGHT of 1 to {LARGEST_SIDE} pixels each, got {self.size!r}")
        if self.video is not None:
            with naming("--video"):
                check_video(self.video, fps)

    @property
    def has_path(self) -> bool:
        """Whether there is a path to render: without any selection, show everything that the run can show."""
        return self.path is not None or self.video is not None or self.set is None

    @property
    def views(self) -> str | None:
        """The still views to render, if any."""
        return self.set or ("test" if self.path is None and self.video is None else None)

    def prepare(self, opened: OpenedModel) -> "RenderJob":
        """Choose the cameras and the files; a model without cameras has no still views."""
        self.check()
        renders = opened.folder / RENDERS_FOLDER
        if self.camera != PINHOLE:
            renders = renders / self.camera
        stills = [
            (renders / group / picture_name(name), self._sized(camera))
            for group in SETS[self.views]
            for name, camera in opened.cameras.get(group, {}).items()
        ]
        frames: list[Picture] = []
        fps, name = FPS, None
        if self.has_path and self.frames != 0:
            name = self.path or suited_path(list(opened.path_cameras().get(TRAIN, {}).values()))
            folder, path, fps = self._path(name, opened, renders)
            first, *others = (self._sized(camera) for camera in path)
            alike = [first, *(resized(camera, first.width, first.height) for camera in others)]
            frames = [(folder / f"{index:04d}.png", camera) for index, camera in enumerate(alike)]
        if not stills and not frames:
            file = opened.folder / CAMERAS_FILE
            raise RunError(f"{file}: expected {self.views} views to render, found none; see --path")
        return RenderJob(self, stills, frames, fps if self.fps is None else self.fps, name, opened.frame)

    def _path(self, name: str, opened: OpenedModel, renders: Path) -> tuple[Path, list[Camera], float]:
        """Return the folder of the frames, their cameras, and the frames per second."""
        if name not in PATHS:
            file = Path(name)
            if self.frames is not None:
                raise SettingError(f"--frames: expected no value with {file}, which sets it, got {self.frames}")
            near = next((camera.near for camera in opened.views.values()), near_depth(opened.model))
            frame = opened.frame
            origin = (opened.model.origin if frame.is_identity else None) or WORLD
            path = load_camera_path(file, near * frame.scale, origin)
            cameras = [frame.inverse().camera(camera) for camera in path.cameras]
            return renders / FILE_PATH.format(file.stem), cameras, path.fps or FPS
        count = FRAMES if self.frames is None else self.frames
        groups = opened.path_cameras()
        views = groups.get(TRAIN, {})
        if name == "interpolate":
            views = dict(sorted((views | groups.get(TEST, {})).items()))
        try:
            return renders / name, PATHS[name](list(views.values()), count), FPS
        except ValueError as error:
            hint = "; --frames 0 renders the still views alone" if self.views is not None else ""
            raise SettingError(f"--path {name}: {error}{hint}") from None

    @property
    def _sides(self) -> tuple[int, int]:
        """Width and height of --size, zeros where it has none."""
        match = re.fullmatch(r"(\d+)[xX](\d+)", self.size or "")
        return (0, 0) if match is None else (int(match[1]), int(match[2]))

    def _sized(self, camera: Camera) -> Camera:
        """Resize an image as --size or --scale specify.

        By --scale, a panorama's pixels are as large as the photos', and a fisheye image is a square.
        """
        if self.size is not None:
            return resized(camera, *self._sides)
        width = camera.width
        height = camera.height
        if self.camera == PANORAMA:
            height = max(min(round(math.pi * camera.focal), MAX_SIDE // 2), 2)
            width = 2 * height
        elif self.camera == FISHEYE:
            width = height
        camera = dataclasses.replace(camera, width=width, height=height)
        width, height = (max(round(side * self.scale), 1) for side in (width, height))
        got = f"{width}x{height} with {self.scale:g}"
        fits = max(width, height) <= LARGEST_SIDE
        require(fits, f"--scale: expected at most {LARGEST_SIDE} pixels a side, got {got}")
        return resized(camera, width, height)


@dataclass(frozen=True)
class RenderJob:
    """Still views and frames of a path to render, in this order, and the video of the frames."""

    order: RenderOrder
    stills: list[Picture]
    frames: list[Picture]
    fps: float
    path: str | None  # name of the path, if any
    frame: Similarity  # from that of the cameras to the coordinates of the buffers

    @property
    def seconds(self) -> float:
        """Duration of the path in seconds."""
        return len(self.frames) / self.fps

    @torch.no_grad()
    def render(self, model: Model, progress: Callable[[int, int], object]) -> None:
        """Render all images, and write them and the video. An incomplete video is deleted.

        `progress` is called with the number of images that are done, and their total.
        """
        pictures, frames = [*self.stills, *self.frames], self.frames
        asked = {"exposure": self.order.exposure, "order": self.order.order}
        changes = cast(RenderChanges, {name: value for name, value in asked.items() if value is not None})
        white = w if isinstance(w := model.meta.get("white"), float) else 1.0
        with ExitStack() as stack:
            append = None
            if self.order.video is not None:  # before any rendering, which would be lost if it cannot be written
                size = (frames[0][1].width, frames[0][1].height)
                append = stack.enter_context(video_writer(self.order.video, *size, self.fps))
            save = stack.enter_context(png_files())
            for number, (file, camera) in enumerate(pictures, 1):
                is_frame = number > len(self.stills)
                if self.order.buffers and is_frame == (self.order.views is None):
                    buffers = render_buffers(model, camera, **changes)
                    save_buffers(file.with_suffix(".exr"), moved_buffers(buffers, self.frame))
                    image = buffers.image
                else:
                    image = model.render(projected(self.order, camera), **changes).image
                pixels = to_uint8(image).cpu()
                if self.order.format == "png":
                    save(file, pixels)
                else:
                    light = linear_light(image.cpu().clamp_min(0)) * white
                    save_exr(file.with_suffix(".exr"), {"image": light})
                if append is not None and is_frame:
                    append(pixels)
                progress(number, len(pictures))
        if frames:  # an earlier, longer path may have left others
            for file in frames[0][0].parent.iterdir():
                if re.fullmatch(r"\d{4,}\.(png|exr)", file.name) and int(file.stem) >= len(frames):
                    file.unlink()


def projected(order: RenderOrder, camera: Camera) -> Camera | RayCamera:
    """Return the camera of an order's projection, at the pose of a pinhole of the picture's size."""
    viewmat = camera.viewmat.float()
    size = (camera.width, camera.height)
    if order.camera == PANORAMA:
        return RayCamera.panorama(viewmat, *size, near=camera.near)
    if order.camera == FISHEYE:
        focal = min(size) / math.radians(order.fov)
        K = torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
        return RayCamera.fisheye(viewmat, K.to(viewmat), (0, 0, 0, 0), *size, near=camera.near)
    return camera
