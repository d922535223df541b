from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nexwarp.errors import FormatError
from nexwarp.io import video
from nexwarp.io.video import frame_pixels, read_frames, video_writer

av = pytest.importorskip("av", reason="videos need PyAV (extra `video`)")


def frames(count: int, width: int, height: int) -> list[torch.Tensor]:
    """A bright bar moves from left to right over a slope of colours."""
    out = []
    for i in range(count):
        frame = torch.full((height, width, 3), 40, dtype=torch.uint8)
        frame[..., 0] = torch.linspace(30, 220, width).to(torch.uint8)
        frame[:, i * width // count : (i + 1) * width // count] = torch.tensor([240, 200, 20], dtype=torch.uint8)
        out.append(frame)
    return out


def write_frames(path: Path, count: int = 1, width: int = 32, height: int = 32) -> None:
    with video_writer(path, width, height) as append:
        for frame in frames(count, width, height):
            append(frame)


def decode(path: Path) -> tuple[list[torch.Tensor], Any]:
    with av.open(str(path)) as container:
        (stream,) = container.streams.video
        pictures = [torch.from_numpy(f.to_ndarray(format="rgb24")) for f in container.decode(stream)]
        return pictures, (stream.average_rate, stream.codec_context.name, stream.codec_context.pix_fmt)


@pytest.mark.parametrize(
    ("name", "fps", "rate", "codec"),
    [
        ("a.mp4", 30.0, Fraction(30), "h264"),
        ("a.MOV", 24, Fraction(24), "h264"),
        ("a.mkv", 30000 / 1001, Fraction(30000, 1001), "h264"),
        ("a.webm", 12.5, Fraction(25, 2), "vp9"),
    ],
)
def test_video_holds_the_frames(tmp_path: Path, name: str, fps: float, rate: Fraction, codec: str) -> None:
    given = frames(8, 96, 64)
    with video_writer(tmp_path / "new" / name, 96, 64, fps) as append:
        for frame in given:
            append(frame)
    decoded, facts = decode(tmp_path / "new" / name)
    assert len(decoded) == 8 and facts == (rate, codec, "yuv420p")
    for mine, theirs in zip(decoded, given, strict=True):
        assert mine.shape == (64, 96, 3)
        # Chroma has half the resolution: colours blur at edges, not elsewhere.
        assert (mine.int() - theirs.int()).abs().float().mean() < 3.0
    assert [f.name for f in (tmp_path / "new").iterdir()] == [name]


def test_odd_sizes_lose_one_row_and_column(tmp_path: Path) -> None:
    write_frames(tmp_path / "a.mp4", 1, 51, 37)
    decoded, (rate, _, _) = decode(tmp_path / "a.mp4")
    assert [x.shape for x in decoded] == [(36, 50, 3)] and rate == 30


def test_failure_leaves_the_old_video_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="half way"), video_writer(path, 32, 32) as append:
        append(frames(1, 32, 32)[0])
        raise RuntimeError("half way")
    with pytest.raises(ValueError, match=r"a\.mp4: expected at least one frame, got none"), video_writer(path, 32, 32):
        pass
    assert path.read_bytes() == b"old" and [f.name for f in tmp_path.iterdir()] == ["a.mp4"]


def test_wrong_inputs_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="height: expected at least 2"), video_writer(tmp_path / "a.mp4", 32, 1):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"), video_writer(tmp_path / "file" / "a.mp4", 32, 32):
        pass
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


PATCHES = np.array(
    [[200, 40, 40], [40, 200, 40], [40, 40, 200], [220, 220, 220], [128, 128, 128], [30, 30, 30], [200, 180, 60]]
)
LUMA = {1: (0.2126, 0.0722), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}  # matrix -> weights of red and blue
BT2020_OF_BT709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
SDR, PQ, HLG = 1, 16, 18


def encoded(transfer: int) -> np.ndarray:
    """(7, 3) signals in [0, 1] of the patches, with sRGB's white at 203 nits in HDR (BT.2408)."""
    values = PATCHES / 255.0
    if transfer == SDR:
        return values
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4) @ BT2020_OF_BT709.T
    if transfer == PQ:  # BT.2100, table 4
        power = (linear * 203.0 / 10000.0) ** (2610 / 16384)
        return ((3424 / 4096 + power * 2413 / 128) / (1.0 + power * 2392 / 128)) ** (2523 / 32)
    display = linear * 203.0 / 1000.0  # BT.2100, table 5: display light of 1,000 nits, system gamma 1.2
    scene = display * (display @ [0.2627, 0.6780, 0.0593])[:, None] ** (1.0 / 1.2 - 1.0)
    with np.errstate(invalid="ignore"):
        high = 0.17883277 * np.log(12.0 * scene - 0.28466892) + 0.55991073
        return np.where(scene <= 1 / 12, np.sqrt(3.0 * scene), high)


def write_patches(
    path: Path, matrix: int, transfer: int, full: bool, bits: int, size: tuple[int, int], tagged: bool
) -> None:
    """Write one lossless frame of the patches, side by side."""
    signal = encoded(transfer)
    red, blue = LUMA[matrix]
    luma = signal @ [red, 1.0 - red - blue, blue]
    chroma = [(signal[:, c] - luma) / (2.0 - 2.0 * weight) for c, weight in ((2, blue), (0, red))]
    unit = 2 ** (bits - 8)
    scale, low, wide = (2**bits - 1, 0, 2**bits - 1) if full else (219 * unit, 16 * unit, 224 * unit)
    planes = [luma * scale + low, *(c * wide + 128 * unit for c in chroma)]
    kind = "yuv444p" if bits == 8 else "yuv444p10le"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = *size, kind
        frame = av.VideoFrame(*size, kind)
        for plane, values in zip(frame.planes, planes, strict=True):
            row = np.repeat(values.round(), -(-size[0] // len(values)))[: size[0]].astype("u1" if bits == 8 else "<u2")
            padded = np.zeros((size[1], plane.line_size // row.itemsize), row.dtype)
            padded[:, : size[0]] = row
            plane.update(padded.tobytes())
        if tagged:
            context = stream.codec_context
            context.color_primaries = frame.color_primaries = 1 if transfer == SDR else 9
            context.color_trc = frame.color_trc = transfer
            context.colorspace = frame.colorspace = matrix
            context.color_range = frame.color_range = 2 if full else 1
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize(
    ("matrix", "transfer", "full", "bits", "size", "tagged"),
    [
        (9, HLG, False, 10, (140, 64), True),
        (9, PQ, False, 10, (140, 64), True),
        (9, PQ, True, 10, (140, 64), True),
        (1, SDR, False, 8, (140, 64), True),
        (1, SDR, True, 10, (140, 64), True),
        (6, SDR, False, 10, (1280, 64), True),
        (6, SDR, False, 8, (140, 64), False),
        (1, SDR, False, 8, (140, 720), False),
        (1, SDR, False, 10, (1280, 64), False),
    ],
)
def test_colours_of_every_kind_of_video_are_right(tmp_path: Path, matrix, transfer, full, bits, size, tagged) -> None:
    write_patches(tmp_path / "a.mkv", matrix, transfer, full, bits, size, tagged)
    (frame,) = read_frames(tmp_path / "a.mkv")
    width = -(-size[0] // len(PATCHES))
    assert np.abs(frame_pixels(frame)[size[1] // 2, width // 2 :: width].astype(int) - PATCHES).max() <= 3


PLAYLISTS = {
    "m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{clip}\n",  # without an end: players wait for more
    "ffconcat": "ffconcat version 1.0\nfile {clip}\n",
}


@pytest.mark.parametrize("kind", PLAYLISTS)
@pytest.mark.timeout(60)
def test_playlists_behind_the_name_of_a_video_are_not_followed(tmp_path: Path, kind: str) -> None:
    write_frames(tmp_path / "clip.mp4")
    (tmp_path / "walk.mp4").write_text(PLAYLISTS[kind].format(clip="clip.mp4"))
    message = r"walk\.mp4: expected a video, could not decode it .*; the formats mov, mp4, .* are read"
    with pytest.raises(FormatError, match=message):
        next(read_frames(tmp_path / "walk.mp4"))


def test_videos_have_a_largest_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_frames(tmp_path / "a.mp4", 5)
    monkeypatch.setattr(video, "LARGEST_FRAME", 10**3)
    with pytest.raises(FormatError, match="expected a video of at most 0 megapixels, got 32x32; reduce it"):
        list(read_frames(tmp_path / "a.mp4"))
