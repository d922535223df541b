import dataclasses
import json
from pathlib import Path

import pytest

import nexwarp as nw
from benchmarks import __main__ as command
from benchmarks import paper
from benchmarks.gpu_time import busy
from benchmarks.quality.__main__ import main
from benchmarks.quality.jobs import FOLDS, TrainingJob, scene_of
from benchmarks.timing import ROOT, Measurement
from tests.scene_writers import write_demo


def test_the_command_writes_a_measurement_a_line(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    assert command.main(["--quick", "--device", "cpu", "--only", "collect", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(lines) == 4 and all(line.keys() == Measurement.__dataclass_fields__.keys() for line in lines)
    assert all(0 < line["p10"] <= line["median"] <= line["p90"] for line in lines)


def test_time_of_a_gpu_counts_kernels_side_by_side_once_and_gaps_never() -> None:
    assert busy([(5.0, 7.0), (0.0, 2.0), (1.0, 3.0), (5.5, 6.0)]) == 5.0 and busy([]) == 0.0


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


@pytest.mark.usefixtures("restore_threads")
def test_a_training_is_done_once(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_the_documents_have_the_kept_figures(tmp_path: Path) -> None:
    results = ROOT / "benchmarks" / "results" / "quality.jsonl"
    for name in ("README.md", "docs/quality.md"):
        page = tmp_path / Path(name).name
        page.write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
        assert main(["publish", str(results), "--page", str(page)]) == 0
        assert page.read_text(encoding="utf-8") == (ROOT / name).read_text(encoding="utf-8"), name


def test_one_command_trains_what_is_there_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_demo(tmp_path / "data" / "kitchen", width=48, height=36, views=12, points=200)
    (scene / "images").rename(scene / "images_2")
    out = tmp_path / "results.jsonl"
    command = ["--data", str(tmp_path / "data"), "--out", str(out), "--sizes", "40000", "--iterations", "2"]
    assert paper.main(command) == 0
    (line,) = out.read_text().splitlines()
    result = json.loads(line)
    assert (result["row"], result["images"], result["pixels"]) == ("paper", "images_2", "48x36")
    first = capsys.readouterr().out
    row = f"| kitchen | 40,000 | 29.62 / 0.901 / 0.146 | {result['psnr']:.2f} / {result['ssim']:.3f} / "
    assert "1 of 1 trainings to do" in first and row in first and f"| {result['psnr'] - 29.62:+.2f} / " in first
    assert (paper.NO_LPIPS in first) == (result["lpips"] is None)
    assert paper.main(command) == 0 and out.read_text() == line + "\n"
    again = capsys.readouterr().out
    assert "0 of 1 trainings to do" in again and row in again
