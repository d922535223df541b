"""Videos, judged by decoding them: frames, size, rate, colours."""

import builtins
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import torch

from nexwarp.io.video import check_video, video_writer

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
    with video_writer(tmp_path / "a.mp4", 51, 37) as append:
        append(frames(1, 51, 37)[0])
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
    for name in ("a.avi", "a", ".mp4"):
        with pytest.raises(ValueError, match=r"expected a video ending in \.mp4, \.mov, \.mkv, \.webm, got"):
            check_video(tmp_path / name, 30.0)
    for fps in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="fps: expected more than 0 and at most 1000 frames a second"):
            check_video(tmp_path / "a.mp4", fps)
    with pytest.raises(ValueError, match="height: expected at least 2"), video_writer(tmp_path / "a.mp4", 32, 1):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"), video_writer(tmp_path / "file" / "a.mp4", 32, 32):
        pass
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


def test_without_the_extra_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def absent(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "av":
            raise ImportError("no av")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ValueError, match=r"a\.mp4: videos need PyAV.*pip install 'nexwarp\[video\]'"):
        check_video(tmp_path / "a.mp4", 30.0)
