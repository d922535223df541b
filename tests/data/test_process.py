import json
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, shift

from nexwarp.cli import main as cli
from nexwarp.data import load_scene
from nexwarp.data.sfm.frames import motion, sharpness, take_frames
from nexwarp.data.sfm.process import process
from nexwarp.io.video import frame_luma, frame_pixels, video_writer
from tests.cli.support import refused

pytest.importorskip("av", reason="PyAV is not installed (pip install 'nexwarp[video]')")

SIZE = (160, 120)
Change = Callable[[int, np.ndarray], np.ndarray]


def silent(stage: str, done: int, total: int) -> None:
    """Observe nothing."""


def texture() -> np.ndarray:
    """A smooth random picture, (160, 320) float in 0 to 255."""
    noise = gaussian_filter(np.random.default_rng(1).random((160, 320)), 1.5)
    return (noise - noise.min()) / (noise.max() - noise.min()) * 255.0


def clip(path: Path, count: int, change: Change = lambda i, x: x, step: int = 2) -> Path:
    """A video of a window that moves over the texture by `step` pixels a frame."""
    picture = texture()
    with video_writer(path, *SIZE, 24.0) as append:
        for index in range(count):
            window = change(index, picture[20:140, step * index : step * index + 160])
            pixels = np.repeat(window.round().astype(np.uint8)[..., None], 3, axis=-1)
            append(torch.from_numpy(np.ascontiguousarray(pixels)))
    return path


def test_sharpness_is_the_share_of_the_laplacians_variance() -> None:
    picture = np.random.default_rng(0).integers(256, size=(9, 13)).astype(np.uint8)
    padded = np.pad(picture.astype(float), 1, mode="reflect")
    near = sum(padded[1 + y : 10 + y, 1 + x : 14 + x] for y in (-1, 0, 1) for x in (-1, 0, 1))
    expected = ((near - 9.0 * picture) / 16).var(ddof=1) / picture.astype(float).var(ddof=1)
    assert sharpness(picture) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("pixels", [0.25, 0.5, 1.0])
def test_motion_is_measured_in_pixels(pixels: float) -> None:
    picture = texture()
    moved = shift(picture, (0.0, pixels), order=3, mode="nearest")
    # A shift along one axis changes the picture by its gradient along that axis, 2 / pi of the whole one on average.
    assert motion(moved.astype(np.uint8), picture.astype(np.uint8)) == pytest.approx(pixels * 2 / np.pi, rel=0.25)


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    sharp = {3, 8, 14, 17, 23}
    path = clip(tmp_path / "a.mp4", 25, lambda i, x: x if i in sharp else gaussian_filter(x, 1.0))
    folder = tmp_path / "frames"
    folder.mkdir()
    choice = take_frames(path, 5, folder, silent)
    assert set(choice.chosen) == sharp and (choice.frames, choice.blurred, choice.duplicates) == (25, [], [])
    assert sorted(f.name for f in folder.iterdir()) == [f"frame_{i:06d}.jpg" for i in sorted(sharp)]
    assert len(take_frames(path, 1000, tmp_path, silent).chosen) <= 25


def test_no_pictures_of_frames_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive: weakref.WeakValueDictionary[int, np.ndarray] = weakref.WeakValueDictionary()
    most = 0

    def counted(frame: Any, longest: int) -> np.ndarray:
        nonlocal most
        picture = frame_luma(frame, longest)
        alive[len(alive) and max(alive) + 1] = picture
        most = max(most, len(alive))
        return picture

    monkeypatch.setattr("nexwarp.data.sfm.frames.frame_luma", counted)
    take_frames(clip(tmp_path / "a.mp4", 30), 30, tmp_path, silent)
    assert most <= 3


def test_blurred_and_repeated_frames_are_left_out_and_named(tmp_path: Path) -> None:
    picture = texture()[20:140, :160]
    path = clip(tmp_path / "a.mp4", 24, lambda i, x: gaussian_filter(x, 5.0) if i in (9, 10) else x)
    assert take_frames(path, 24, tmp_path, silent).blurred == [9, 10]
    still = clip(tmp_path / "b.mp4", 12, lambda i, x: picture if i < 6 else x, step=4)
    choice = take_frames(still, 12, tmp_path, silent)
    assert choice.duplicates == [1, 2, 3, 4, 5] and choice.chosen == [0, *range(6, 12)]


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_frames_stand_upright(turn: int) -> None:
    class Frame:
        rotation, color_trc, colorspace = turn, 1, 1  # BT.709

        @staticmethod
        def to_ndarray(format: str) -> np.ndarray:
            assert format == "rgb24"
            return np.arange(24, dtype=np.uint8).reshape(2, 4, 3)

    expected = np.rot90(Frame.to_ndarray("rgb24"), turn // 90)
    assert np.array_equal(frame_pixels(Frame()), expected)  # type: ignore[arg-type]  # what it reads of a frame


def test_bad_videos_are_one_line_and_leave_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken, scene = tmp_path / "broken.mp4", tmp_path / "scenes" / "scene"
    broken.write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(100))
    refused(capsys, ["process", str(broken), str(scene)], "broken.mp4: expected a video, could not decode it")
    refused(capsys, ["process", str(tmp_path / "no.mp4"), str(scene)], "no.mp4", "no such")
    # A training's settings are checked before the video is decoded.
    command = ["train", str(broken), "--run", str(tmp_path / "run"), "--set", "typo=1"]
    refused(capsys, command, "typo: expected a setting")
    picture = texture()[20:140, :160]
    still = clip(tmp_path / "still.mp4", 10, lambda i, x: picture)
    refused(capsys, ["process", str(still), str(scene)], "expected a video of a moving camera, got 10 frames", "1 are")
    refused(capsys, ["process", str(still), str(scene), "--frames", "2"], "--frames: expected at least 3, got 2")
    refused(capsys, ["train", str(tmp_path / "no.mp4")], "no.mp4: no such file, expected a video")
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(still.read_bytes()[: still.stat().st_size // 2])
    assert cli.main(["process", str(cut), str(scene)]) == 2
    assert not scene.exists() and not scene.parent.exists()


@pytest.mark.slow
def test_a_clip_becomes_a_scene(tmp_path: Path) -> None:
    report = process(Path(__file__).parent / "photos" / "walk.mp4", tmp_path / "scene", 12)
    assert report.frames is not None and len(report.registered) >= 0.9 * len(report.frames.chosen) >= 0.9 * 12
    scene = load_scene(tmp_path / "scene")
    assert len(scene.train) + len(scene.test) == len(report.registered)
    notes = json.loads((tmp_path / "scene" / "sfm.json").read_text())
    assert notes["video"]["name"] == "walk.mp4" and notes["frames"]["chosen"] == report.frames.chosen
