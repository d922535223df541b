"""The quality benchmark: its rows, its trainings from end to end, its tables."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

import nexwarp as nw
from benchmarks.quality import curve
from benchmarks.quality.__main__ import main
from benchmarks.quality.documents import MISSING, blocks
from benchmarks.quality.jobs import FOLDS, PEERS, Row, TrainingJob, config_of, scene_of
from benchmarks.quality.results import Results, read_results, table
from benchmarks.timing import ROOT
from nexwarp.run.evaluate import evaluate
from nexwarp.train.stages import StageRunner
from tests.narrowing import present
from tests.scene_writers import write_demo

EXAMPLE, EXPOSED = PEERS[0].name, PEERS[2].name


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes")
    write_demo(path / "tiny", width=48, height=36, views=12, points=200)
    return path


def test_validation_views_are_training_views(folder: Path) -> None:
    job = TrainingJob("tiny", "", "default", 60, 0, 10)
    names = [view.name for view in scene_of(job, folder).train]
    folds = [scene_of(dataclasses.replace(job, variant=fold), folder) for fold in FOLDS]
    for fold in folds:
        assert sorted(view.name for view in (*fold.test, *fold.train)) == names
    assert sorted(view.name for fold in folds for view in fold.test) == names


def test_a_training_is_done_once(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    settings = {"texture.levels": 4, "texture.table_size": 1024}
    out = tmp_path / "out.jsonl"
    command = ["train", "--row", f"mine:default:{json.dumps(settings)}", "--scenes", "tiny", "--seeds", "0"]
    command += ["--size", "60", "--iterations", "4", "--data", str(folder), "--out", str(out)]
    command += ["--pictures", str(tmp_path / "pictures"), "--models", str(tmp_path / "models"), "--downscale", "2"]
    assert main(command) == 0
    (line,) = out.read_text().splitlines()
    result = json.loads(line)
    assert (result["scene"], result["row"], result["settings"], result["downscale"]) == ("tiny", "mine", settings, 2)
    assert set(result["views"]) == {view.name for view in nw.load_scene(folder / "tiny").test}
    mean = sum(view["psnr"] for view in result["views"].values()) / len(result["views"])
    assert result["psnr"] == pytest.approx(mean) and result["primitives"] <= 60 and result["flip"] > 0
    assert len(list((tmp_path / "pictures").iterdir())) == len(result["views"])
    (model,) = (tmp_path / "models").glob("*/model.safetensors")
    assert result["megabytes"] == pytest.approx(model.stat().st_size / 1e6) and nw.load(model).texture is not None
    assert main(command) == 0
    assert "0 of 1 trainings to do" in capsys.readouterr().out
    with pytest.raises(ValueError, match="--row: expected a name that no other row has, got paper"):
        main([word.replace("mine:", "paper:") for word in command])
    assert main(["table", str(out)]) == 0
    assert "| tiny, photos reduced by 2 | 60 | 4 | mine |" in capsys.readouterr().out
    torch.set_num_threads(threads)


@pytest.mark.filterwarnings("ignore:LPIPS is left out")
def test_a_curve_has_points_at_its_times_and_at_the_end(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Teachers' steps count, and what it takes to look does not."""
    clock = iter(range(10_000))  # each reading of the clock is a second later
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    watch = curve.Curve(nw.load_scene(folder / "tiny"), begin=0.0)
    job = TrainingJob("tiny", "", "mine", 60, 0, 20)
    config = config_of(job, Row("mine", settings={"texture.levels": 4, "texture.table_size": 1024, "teachers": 1}))
    runner = StageRunner(watch.scene, config, "cpu", curve.WatchedStages(watch))
    runner.train()
    model = runner.finish()
    watch.look(lambda: lambda camera: model.render(camera).image, last=True)
    seconds = [present(point["seconds"]) for point in watch.points]
    assert len(seconds) > 4 and seconds[-1] < next(clock) - len(seconds)
    for before, after in pairwise([0.0, *seconds[:-1]]):
        assert any(before < mark <= after for mark in curve.TIMES)
    last = watch.points[-1]["psnr"]
    assert last == pytest.approx(evaluate(model, watch.scene.test)["psnr"])
    out = tmp_path / "curves.png"
    curve.draw([{"scene": "tiny", "row": "mine", "size": 60, "curve": watch.points}], out)
    with Image.open(out) as picture:
        assert picture.size[0] == 400
    with pytest.raises(ValueError, match="results: expected trainings with --curve, got none"):
        curve.draw([], out)


def line(scene: str, row: str, size: int, psnr: float, seed: int = 0) -> dict[str, Any]:
    figures: dict[str, object] = {"psnr": psnr, "ssim": 0.9, "flip": 0.1, "lpips": None, "megabytes": 2.0}
    facts: dict[str, object] = {"date": "2026-11-25", "device": "H200", "seconds": 5.0}
    return dataclasses.asdict(TrainingJob(scene, "", row, size, seed, 30_000)) | figures | facts


def read(lines: list[dict[str, Any]], path: Path) -> Results:
    path.write_text("".join(json.dumps(each) + "\n" for each in lines))
    return read_results([path])


def rows_of(text: str) -> dict[str, list[str]]:
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in text.splitlines() if row.startswith("|")]
    return {row[0]: row[1:] for row in reversed(cells)}  # of two rows, the first


def test_the_best_gsplat_row_of_each_scene_is_the_peer(tmp_path: Path) -> None:
    lines = [line("fox", "default", 40_000, 32.5), line("fox", "default", 40_000, 32.3, seed=1)]
    lines += [line("fox", EXAMPLE, 40_000, 31.5), line("fox", EXPOSED, 40_000, 32.0)]
    lines += [line("saharov", "default", 40_000, 22.0), line("saharov", EXAMPLE, 40_000, 20.0)]
    results = read(lines, tmp_path / "x.jsonl")
    tables = blocks(results)
    own = "32.40, 0.9000, 0.1000"
    peers = rows_of(tables["peers"])
    assert peers["fox"] == ["40,000", own, "31.50, 0.9000, 0.1000", "32.00, 0.9000, 0.1000", "+0.40 dB"]
    assert peers["saharov"][-1] == "+2.00 dB" and peers["train"] == ["40,000", *[MISSING] * 4]
    assert rows_of(tables["readme"])["fox"] == ["32.40", "0.9000", "0.1000", "2.0", "32.00", "0.9000", "0.1000", "2.0"]
    assert "H200, 2026-11-25" in tables["readme"]
    assert "| fox | 40,000 | 30,000 | default | 32.40 ± 0.14 |" in table(results)


def test_the_documents_have_the_kept_figures(tmp_path: Path) -> None:
    """The pages are what `publish` makes of the kept results."""
    results = ROOT / "benchmarks" / "results" / "quality.jsonl"
    for name in ("README.md", "docs/quality.md"):
        page = tmp_path / Path(name).name
        page.write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
        assert main(["publish", str(results), "--page", str(page)]) == 0
        assert page.read_text(encoding="utf-8") == (ROOT / name).read_text(encoding="utf-8"), name
