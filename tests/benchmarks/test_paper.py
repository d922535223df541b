import json
from pathlib import Path

import pytest

from benchmarks.paper import NO_LPIPS, main
from tests.scene_writers import write_demo


def test_one_command_trains_what_is_there_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_demo(tmp_path / "data" / "kitchen", width=48, height=36, views=12, points=200)
    (scene / "images").rename(scene / "images_2")
    out = tmp_path / "results.jsonl"
    command = ["--data", str(tmp_path / "data"), "--out", str(out), "--sizes", "40000", "--iterations", "2"]
    assert main(command) == 0
    (line,) = out.read_text().splitlines()
    result = json.loads(line)
    assert (result["row"], result["images"], result["pixels"]) == ("paper", "images_2", "48x36")
    first = capsys.readouterr().out
    row = f"| kitchen | 40,000 | 29.62 / 0.901 / 0.146 | {result['psnr']:.2f} / {result['ssim']:.3f} / "
    assert "1 of 1 trainings to do" in first and row in first and f"| {result['psnr'] - 29.62:+.2f} / " in first
    assert (NO_LPIPS in first) == (result["lpips"] is None) and main(command) == 0 and out.read_text() == line + "\n"
    again = capsys.readouterr().out
    assert "0 of 1 trainings to do" in again and row in again
