"""Videos through PyAV: written atomically as H.264, or as VP9 for .webm; read from common containers."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from nexwarp.errors import FormatError, check_package, check_range, require
from nexwarp.io.files import one_line, written_aside

if TYPE_CHECKING:
    import av

KINDS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".webm": "webm"}  # suffix -> container
# Encoders and their options: constant quality, without visible artefacts.
H264 = ("libx264", {"crf": "16", "preset": "medium"})
VP9 = ("libvpx-vp9", {"crf": "24", "b": "0"})

LARGEST_SIDE = 16384
# Codes of ISO/IEC 23091-2.
BT709, UNSPECIFIED, BT601, BT2020 = 1, 2, 6, 9
LIMITED_RANGE = 1
HDR = (16, 18)  # transfer functions PQ and HLG
HD = (720, 1280)  # lines and columns from which players take an untagged video for BT.709
FASTEST = 1000.0  # frames a second

CONTAINERS = ("mov", "mp4", "matroska", "webm", "avi", "mpegts")  # FFmpeg's names of those that are read
READ_OPTIONS = {"format_whitelist": ",".join(CONTAINERS), "protocol_whitelist": "file"}
LARGEST_FRAME = 40_000_000  # pixels; 8K has 33 million


def check_video(path: str | os.PathLike[str], fps: float) -> None:
    """Raise SettingError unless the suffix of `path` and `fps` are valid for a video and PyAV is installed."""
    suffix = Path(path).suffix.lower()
    known = ", ".join(KINDS)
    require(suffix in KINDS, f"{path}: expected a video ending in {known}, got {suffix or 'no suffix'}")
    require(0 < fps <= FASTEST, f"fps: expected more than 0 and at most {FASTEST:g} frames a second, got {fps:g}")
    check_av(path)


def check_av(path: str | os.PathLike[str]) -> None:
    """Raise SettingError unless PyAV is installed; `path` is the video that needs it."""
    check_package(str(path), "av", "video")


@contextmanager
def video_writer(
    path: str | os.PathLike[str], width: int, height: int, fps: float = 30.0
) -> Iterator[Callable[[torch.Tensor], None]]:
    """Yield a function that appends an (H, W, 3) uint8 frame; the video is complete at `path` when the block ends.

    The file is .mp4, .mov, .mkv (H.264) or .webm (VP9), written atomically, of BT.709 colours and 4:2:0 chroma, which
    all players support. 4:2:0 needs even sizes: the last column or row of an odd size is cropped.

    ValueError: an invalid suffix, size or rate, PyAV (extra `video`) is missing, or the block appended no frame.
    OSError: `path` cannot be written.
    """
    check_video(path, fps)
    import av
    from av.video.reformatter import ColorRange, Colorspace

    check_range("width", width, 2, LARGEST_SIDE)
    check_range("height", height, 2, LARGEST_SIDE)
    kind = KINDS[Path(path).suffix.lower()]
    encoder, options = VP9 if kind == "webm" else H264
    while_it_loads = {"movflags": "faststart"} if kind in ("mp4", "mov") else {}  # a browser can play it
    even = (height // 2 * 2, width // 2 * 2)
    count = 0
    with written_aside(path) as temporary:
        with av.open(str(temporary), "w", format=kind, options=while_it_loads) as container:
            rate = Fraction(fps).limit_denominator(1001)
            stream = container.add_stream(encoder, rate=rate, options=options)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height, stream.pix_fmt = even[1], even[0], "yuv420p"
            context = stream.codec_context
            context.color_primaries = context.color_trc = context.colorspace = BT709
            context.color_range = LIMITED_RANGE

            def append(frame: torch.Tensor) -> None:
                nonlocal count
                pixels = frame[: even[0], : even[1]].cpu().contiguous().numpy()
                picture = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(
                    format="yuv420p",
                    dst_colorspace=Colorspace.ITU709,
                    src_color_range=ColorRange.JPEG,
                    dst_color_range=ColorRange.MPEG,
                )
                picture.pts, picture.time_base = count, 1 / rate
                container.mux(stream.encode(picture))
                count += 1

            yield append
            if not count:
                raise ValueError(f"{path}: expected at least one frame, got none")
            container.mux(stream.encode())


def read_frames(path: str | os.PathLike[str]) -> Iterator["av.VideoFrame"]:
    """Decode the frames of a video's first video stream, in the order in which they are shown.

    SettingError: PyAV (extra `video`) is missing. FormatError: the file is no video in MP4, MOV, Matroska, WebM, AVI or
    MPEG-TS, has no video stream, is damaged, or has more than 40 megapixels.
    """
    check_av(path)
    import av

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file, expected a video")
    try:
        # "file:" and the lists: what a file names, such as the parts of a playlist, is not opened.
        with av.open(f"file:{os.path.abspath(path)}", options=READ_OPTIONS) as container:
            if not container.streams.video:
                raise FormatError(f"{path}: expected a video, but the file has no video stream")
            stream = container.streams.video[0]
            if stream.width * stream.height > LARGEST_FRAME:
                most = f"at most {LARGEST_FRAME // 10**6} megapixels, got {stream.width}x{stream.height}"
                raise FormatError(f"{path}: expected a video of {most}; reduce it")
            stream.codec_context.options = {"max_pixels": str(LARGEST_FRAME)}
            stream.thread_type = "AUTO"
            yield from container.decode(stream)
    except av.error.FFmpegError as error:
        known = f"; the formats {', '.join(CONTAINERS)} are read"
        raise FormatError(f"{path}: expected a video, could not decode it ({one_line(error)}){known}") from None


def frame_pixels(frame: "av.VideoFrame") -> np.ndarray:
    """Return a frame as (H, W, 3) uint8 sRGB, upright as players show it.

    Matrix and range are the frame's; a frame without is BT.709 from 720 lines or 1280 columns on, else BT.601. HDR (HLG
    and PQ) is converted so that its reference white, 203 nits, becomes white; what is brighter is clipped.
    """
    converted = frame
    if frame.color_trc in HDR:
        if frame.colorspace == UNSPECIFIED:
            frame.colorspace = BT2020
        if frame.color_primaries == UNSPECIFIED:
            frame.color_primaries = BT2020
        graph = _hdr_graph(frame.width, frame.height, frame.format.name, frame.color_trc)
        graph.push(frame)
        converted = cast("av.VideoFrame", graph.pull())  # of 16 bits a channel
    elif frame.colorspace == UNSPECIFIED and "yuv" in frame.format.name:
        frame.colorspace = BT709 if frame.height >= HD[0] or frame.width >= HD[1] else BT601
    return _upright(frame, converted.to_ndarray(format="rgb24"))


@lru_cache(maxsize=1)  # building its tables takes seconds
def _hdr_graph(width: int, height: int, pixel_format: str, transfer: int) -> "av.filter.Graph":
    """Return FFmpeg's filters from HDR frames of this kind to sRGB."""
    import av.filter

    graph = av.filter.Graph()
    graph.link_nodes(
        graph.add_buffer(width=width, height=height, format=av.VideoFormat(pixel_format), time_base=Fraction(1, 1000)),
        graph.add("scale", "out_transfer=iec61966-2-1:out_primaries=bt709:out_range=pc:intent=relative_colorimetric"),
        graph.add("format", "pix_fmts=rgb48le"),
        graph.add("buffersink"),
    ).configure()
    return graph


def frame_luma(frame: "av.VideoFrame", longest: int) -> np.ndarray:
    """Return a frame's brightness as (H, W) uint8, upright and reduced to at most `longest` pixels a side."""
    scale = min(1.0, longest / max(frame.width, frame.height))
    size = (max(round(frame.width * scale), 2), max(round(frame.height * scale), 2))
    return _upright(frame, frame.reformat(*size, format="gray", interpolation="AREA").to_ndarray())


def _upright(frame: "av.VideoFrame", pixels: np.ndarray) -> np.ndarray:
    """Rotate pixels by the angle that a phone stores beside the frames, counterclockwise in degrees."""
    return np.rot90(pixels, round(frame.rotation / 90) % 4).copy() if frame.rotation else pixels
