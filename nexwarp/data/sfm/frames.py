"""Choice of sharp, distinct frames from a video, as photos for a reconstruction."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nexwarp.data.images import downscale_image
from nexwarp.errors import SceneError
from nexwarp.io.pictures import save_jpeg
from nexwarp.io.video import frame_luma, frame_pixels, read_frames

SIDE = 640  # pixels of the longer side at which sharpness is measured: a blur below two of its pixels hardly shows
THUMBNAIL = 160  # pixels of the longer side at which motion is measured
NEIGHBOURS = 7  # chosen frames on either side that a frame's sharpness is compared with
BLURRED = 0.5  # sharpness, relative to the median of the neighbours, below which a frame is left out
STILL = 0.15  # motion since the frame before, in pixels of a thumbnail, below which a frame is left out
FLAT = 1e-3  # least mean gradient of a thumbnail, grey levels a pixel
FEWEST = 3  # frames that a reconstruction needs
JPEG_QUALITY = 97


@dataclass(frozen=True)
class FrameChoice:
    """The frames of a video that become photos, and those that were left out. Numbers count from 0."""

    frames: int  # number of frames in the video
    seconds: float  # length of the video
    chosen: list[int]  # ascending
    blurred: list[int]  # frames that were the sharpest of their part of the video and still blurred
    duplicates: list[int]  # frames that show nearly the same as the chosen frame before

    def rows(self) -> dict[str, str]:
        """The figures as rows of a table: name -> text."""
        parts = len(self.chosen) + len(self.blurred) + len(self.duplicates)
        return {
            "video": f"{self.frames:,} frames, {self.seconds:.1f} s",
            "frames taken": f"{len(self.chosen)}, the sharpest of each of {parts} parts but for those left out",
            "left out": f"{len(self.blurred)} blurred, {len(self.duplicates)} that repeat the one before",
        }


def sharpness(luma: np.ndarray) -> float:
    """Return the variance of an (H, W) uint8 picture's Laplacian, relative to the variance of its brightness.

    A blur lowers it, as it removes fine detail and keeps coarse contrast; brightness and contrast do not matter.
    """
    from kornia.filters import laplacian

    picture = torch.from_numpy(luma).float()[None, None]
    return float(laplacian(picture, 3).var() / picture.var().clamp_min(1.0))


def photo_luma(pixels: torch.Tensor) -> np.ndarray:
    """Return the (h, w) uint8 brightness of an (H, W, 3) uint8 photo, averaged over blocks if it is twice `SIDE`."""
    red, green, blue = downscale_image(pixels, max(max(pixels.shape) // SIDE, 1)).numpy().transpose(2, 0, 1)
    return ((red.astype(np.uint16) + green + blue) // np.uint16(3)).astype(np.uint8)


def reduced_luma(luma: np.ndarray, longest: int = SIDE) -> np.ndarray:
    """Return an (H, W) uint8 picture reduced to at most `longest` pixels a side."""
    from PIL import Image

    picture = Image.fromarray(luma)
    picture.thumbnail((longest, longest), Image.Resampling.BOX)
    return np.array(picture)


def motion(luma: np.ndarray, before: np.ndarray) -> float:
    """Return about how far, in pixels, one (H, W) uint8 picture has moved against another: |change| / |gradient|."""
    first, second = before.astype(np.float32), luma.astype(np.float32)
    gradient = float(np.mean(np.hypot(*np.gradient(first))))
    return float(np.mean(np.abs(second - first))) / max(gradient, FLAT)


def take_frames(
    path: str | os.PathLike[str], count: int, folder: Path, observe: Callable[[str, int, int], None]
) -> FrameChoice:
    """Divide a video into `count` parts of equal length, and write the sharpest frame of each into a folder.

    A frame is left out if it is much less sharp than its neighbours, or nearly the same as the one before. The files
    are frame_NUMBER.jpg. The video is decoded twice, so that no frame is kept in memory. `observe` is called with the
    stage's name, the number of frames read and their total, which is not known before. FormatError: the file is no
    video, or is damaged. SceneError: fewer than 3 frames are left.
    """
    scores: list[float] = []
    seconds = 0.0
    for frame in read_frames(path):
        scores.append(sharpness(frame_luma(frame, SIDE)))
        seconds = max(seconds, frame.time or 0.0)
        observe("reading the video", len(scores), len(scores))
    total = len(scores)
    count = min(count, total)
    parts = [range(total * k // count, total * (k + 1) // count) for k in range(count)]
    candidates = [max(part, key=scores.__getitem__) for part in parts]
    blurred = []
    for place, index in enumerate(candidates):
        around = candidates[max(place - NEIGHBOURS, 0) : place + NEIGHBOURS + 1]
        if scores[index] < BLURRED * np.median([scores[i] for i in around]):
            blurred.append(index)
    sharp = [index for index in candidates if index not in blurred]
    chosen: list[int] = []
    before: np.ndarray | None = None
    for index, frame in enumerate(read_frames(path)):
        if index in sharp:
            thumbnail = frame_luma(frame, THUMBNAIL)
            if before is None or motion(thumbnail, before) >= STILL:
                save_jpeg(folder / f"frame_{index:06d}.jpg", torch.from_numpy(frame_pixels(frame)), JPEG_QUALITY)
                chosen.append(index)
                before = thumbnail
            observe("writing frames", sharp.index(index) + 1, len(sharp))
            if index == sharp[-1]:
                break
    if len(chosen) < FEWEST:
        raise SceneError(
            f"{path}: expected a video of a moving camera, got {len(scores)} frames, of which {len(chosen)} are sharp "
            "and differ"
        )
    return FrameChoice(len(scores), seconds, chosen, blurred, [index for index in sharp if index not in chosen])
