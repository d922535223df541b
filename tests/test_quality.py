"""The quality benchmark: its scenes, its results and its tables; one training from end to end."""

import dataclasses
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from benchmarks.quality.__main__ import main
from benchmarks.quality.curve import curves_of
from benchmarks.quality.jobs import SCENES, TABLES, JobGroup, TrainingJob, group_jobs, table_jobs
from benchmarks.quality.results import Results, drop_unfinished, read_results
from benchmarks.quality.rows import DEFAULT, GSPLAT, ROWS, Row
from benchmarks.quality.run import config_name, file_name, run_job
from benchmarks.quality.scenes import ARC_VIEWS, VARIANTS, held_out_arc, moved
from benchmarks.quality.tables import differences, markdown, summary
from benchmarks.timing import ROOT
from nexwarp.data import Scene
from nexwarp.data.demo import write_demo
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import METRICS as METRIC_FUNCTIONS
from nexwarp.run.metrics import psnr
from nexwarp.train.presets import preset
from nexwarp.train.settings import with_settings
from tests.tolerances import assert_close


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes")
    write_demo(path / "tiny", width=48, height=36, views=12, points=200)
    return path


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return nw.load_scene(folder / "tiny")


def test_every_row_is_a_setting() -> None:
    for row in ROWS.values():
        if row.preset is not None:
            config = with_settings(preset(row.preset), row.settings)
            assert (config != preset(row.preset)) == bool(row.settings), row.name


@pytest.mark.parametrize("table", TABLES)
def test_tables_are_made_of_known_rows(table: str) -> None:
    jobs = list(table_jobs(table, ("fox", "saharov"), (0, 1), 100, 40))
    assert len(jobs) == len(set(jobs)) > 0
    assert all(job.row in ROWS and job.iterations == (1200 if table == "demo" else 100) for job in jobs)
    assert {job.seed for job in jobs} == {0, 1}
    assert all(job.variant in ("", *VARIANTS) for job in jobs)


def test_a_held_out_arc_is_of_neighbours(scene: Scene) -> None:
    names = sorted(view.name for view in (*scene.train, *scene.test))
    part = held_out_arc(scene)
    held = [view.name for view in part.test]
    start = names.index(held[0])
    assert held == names[start : start + ARC_VIEWS]
    assert sorted(view.name for view in part.train) == [name for name in names if name not in held]


def test_moved_scenes_look_the_same(scene: Scene) -> None:
    """Every point falls on the same pixel, its depth scaled."""
    other = moved(scene, factor=100.0, shift=(30.0, -20.0, 10.0))
    assert other.scale == pytest.approx(100 * scene.scale)
    for one, two in zip(scene.train, other.train, strict=True):
        pixels, depths = one.camera.project(scene.points.double().to(one.camera.K.dtype))
        again, scaled = two.camera.project(other.points)
        assert (pixels - again).abs().max() < 0.01
        assert_close(scaled / 100, depths, kind="gradient", name="depths")
        assert two.camera.near == pytest.approx(100 * one.camera.near)
        assert one.points is not None and two.points is not None
        seen, _ = two.camera.project(two.points)
        assert (seen - one.camera.project(one.points)[0]).abs().max() < 0.01


def result(row: str, seed: int, **changes: object) -> dict[str, Any]:
    job = dataclasses.asdict(TrainingJob("fox", "", row, 40, seed, 100))
    figures: dict[str, object] = {
        "psnr": 30.0,
        "ssim": 0.9,
        "flip": 0.1,
        "lpips": None,
        "megabytes": 2.0,
        "seconds": 5.0,
    } | changes
    return job | {"settings": {}, "commit": "abc", "jobs": 1, "peak_mib": 100} | figures


def test_tables_give_means_spreads_and_the_best_first(tmp_path: Path) -> None:
    lines = [
        result("default", 0, psnr=30.0),
        result("default", 1, psnr=99.0),
        result("default", 1, psnr=31.0),  # done again: the later one counts
        result(GSPLAT, 0, psnr=33.0, jobs=4),
    ]
    file = tmp_path / "results.jsonl"
    del lines[-1]["downscale"]  # as before there was such a thing
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    results = read_results([file])
    assert len(results) == 3
    with pytest.raises(FileNotFoundError, match=r"absent\.jsonl"):
        read_results([file, tmp_path / "absent.jsonl"])
    text = markdown(results)
    rows = [line for line in text.splitlines() if line.startswith(("| default", f"| {GSPLAT}"))]
    assert rows[0].startswith(f"| {GSPLAT} | 33.00 |")
    figures = "30.50 ± 0.71 | 0.9000 ± 0.0000 | 0.1000 ± 0.0000 |  |  |  |  | 2.0 ± 0.0"
    assert rows[1] == f"| default | {figures} | 5 ± 0 | 20.0 ± 0.0 | 100 ± 0 | 2 | abc |"
    assert "## fox, 40 primitives, 100 iterations" in text
    assert "LPIPS is left out where the weights of VGG could not be had." in text


def test_rows_of_several_settings_are_told() -> None:
    jobs = [TrainingJob("fox", "", "default", 40, seed, 100) for seed in (0, 1)]
    lines = [result("default", seed, config=f"c{seed}", commit=f"d{seed}", flip=None) for seed in (0, 1)]
    text = markdown(dict(zip(jobs, lines, strict=True)))
    assert "Trained with more than one set of settings: default." in text and "| 2 | d0, d1 |" in text
    assert "FLIP is left out where flip-evaluator was not installed." in text
    assert "more than one set" not in markdown({jobs[0]: lines[0]})


@pytest.mark.parametrize("line", ['{"scene": "fox"', "{}", "[1]", '{"scene": "fox", "psnr": 1.0}', ""])
def test_a_line_that_is_no_result_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps(result("default", 0)) + "\n" + line + "\n" + json.dumps(result("default", 1)) + "\n")
    with pytest.raises(ValueError, match=r"results\.jsonl, line 2: expected the JSON of a training, got"):
        read_results([file])


def test_a_last_line_that_was_not_finished_is_cut_off(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    whole = json.dumps(result("default", 0)) + "\n"
    for text, dropped, left in (
        (whole, False, whole),
        (whole + '{"scene": "fo', True, whole),
        (whole[:-1], False, whole),  # by hand
        ("", False, ""),
        ('{"sc', True, ""),
    ):
        file.write_text(text)
        assert drop_unfinished(file) == dropped and file.read_text() == left


def test_differences_are_means_of_scenes_with_the_error_of_their_seeds() -> None:
    results = {}
    for row, scene, seed, figure, flip in (
        ("default", "fox", 0, 30.0, 0.1),
        ("default", "fox", 1, 32.0, 0.1),
        ("default", "kitchen", 0, 18.0, 0.3),
        ("default", "kitchen", 1, 18.0, 0.3),
        ("no gamma", "fox", 0, 30.0, 0.2),
        ("no gamma", "fox", 1, 30.0, 0.2),
        ("no gamma", "kitchen", 0, 19.0, 0.3),
        ("no gamma", "kitchen", 1, 16.0, 0.5),
        ("K = 3", "fox", 0, 33.0, 0.1),
        ("K = 3", "kitchen", 0, 19.0, 0.3),
        ("K = 4", "fox", 0, 33.0, 0.1),  # on one scene alone: nothing to compare the mean of
        ("K = 1", "fox", 0, 33.0, 0.1),
        ("K = 1", "statue", 0, 19.0, 0.3),  # which the default was not trained on
    ):
        job = TrainingJob(scene, "", row, 40, seed, 100)
        results[job] = result(row, seed, psnr=figure, flip=flip) | dataclasses.asdict(job)
        if row in ("default", "no gamma"):
            results[job]["quarter_psnr"] = 20.5 if row == "no gamma" else 20.0
    results |= {dataclasses.replace(job, variant="moved"): found for job, found in results.items()}
    (group,) = differences(results)
    assert (group["size"], group["downscales"], group["iterations"]) == (40, [1], 100)
    first, second = group["rows"]
    assert (first["row"], first["scenes"], first["psnr"]) == ("K = 3", ["fox", "kitchen"], (1.5, None))
    # fox: -1 with variance 2 / 2; kitchen: -0.5 with 4.5 / 2.
    assert second["row"] == "no gamma" and second["lpips"] is None
    assert second["psnr"] == (pytest.approx(-0.75), pytest.approx((1 + 2.25) ** 0.5 / 2))
    assert second["flip"] == (pytest.approx(0.1), pytest.approx(0.01**0.5 / 2))
    text = markdown(results)
    assert "## Mean of the scenes less that of default, 40 primitives, 100 iterations" in text
    assert "| | PSNR [dB] | SSIM | FLIP | LPIPS | at 1/4 [dB] | scenes |" in text
    assert "| K = 3 | +1.50 | +0.0000 | +0.0000 |  |  | fox, kitchen |" in text
    figures = "-0.75 ± 0.90 | +0.0000 ± 0.0000 | +0.1000 ± 0.0500 |  | +0.50 ± 0.00"
    assert f"| no gamma | {figures} | fox, kitchen |" in text
    (group,) = differences(results, "no gamma")
    found = {row["row"]: row["psnr"] for row in group["rows"]}
    assert found == {"K = 3": (2.25, None), "default": (-second["psnr"][0], second["psnr"][1])}
    text = markdown(results, "no gamma")
    assert "## Mean of the scenes less that of no gamma, 40 primitives, 100 iterations" in text
    assert "| default | +0.75 ± 0.90 |" in text
    # Each scene with itself, however its photos are reduced.
    mixed = {dataclasses.replace(job, downscale=2) if job.scene == "fox" else job: x for job, x in results.items()}
    (again,) = differences(mixed)
    assert again["downscales"] == [1, 2] and again["rows"] == differences(results)[0]["rows"]
    extent = ", photos reduced by 1 and 2, 40 primitives, 100 iterations"
    assert f"## Mean of the scenes less that of default{extent}" in markdown(mixed)


def test_trainings_that_began_together_differ_by_pairs() -> None:
    """Their seeds' spread is common; of another commit, or alone, it is not."""
    alike = {"rows": ["default", "K = 3", "K = 4"], "iterations": 9}
    results: Results = {}
    shared: dict[str, object] = {"together": alike}
    lines: list[tuple[str, int, float, dict[str, object]]] = [
        ("default", 0, 30.0, shared),
        ("default", 1, 34.0, shared),
        ("K = 3", 0, 30.0, shared),
        ("K = 3", 1, 34.2, shared),
        ("K = 4", 0, 30.0, shared | {"commit": "abd"}),
        ("K = 4", 1, 34.2, shared | {"commit": "abd"}),
        ("K = 1", 0, 30.0, {}),
        ("K = 1", 1, 34.2, {}),
    ]
    for scene in ("fox", "kitchen"):
        for row, seed, figure, more in lines:
            job = TrainingJob(scene, "", row, 40, seed, 100)
            results[job] = result(row, seed, psnr=figure) | dataclasses.asdict(job) | more
    (group,) = differences(results)
    errors = {row["row"]: row["psnr"] for row in group["rows"]}
    assert {row: figures[0] for row, figures in errors.items()} == pytest.approx(dict.fromkeys(errors, 0.1))
    # Each scene's differences are 0 and 0.2, of variance 0.02; seeds alone have variances of 8 and 8.82.
    assert errors["K = 3"][1] == pytest.approx((0.02 / 2 * 2) ** 0.5 / 2)
    for row in ("K = 4", "K = 1"):
        assert errors[row][1] == pytest.approx(((8 + 8.82) / 2 * 2) ** 0.5 / 2)
    assert all(row["lpips"] is None for row in group["rows"])


def test_the_table_as_json_has_the_same_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, table = tmp_path / "results.jsonl", tmp_path / "table.json"
    lines = [result("default", 1), result("default", 0, psnr=32.0), result(GSPLAT, 0, jobs=4, commit="abd")]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main(["table", str(file), "--json", str(table)]) == 0
    assert "| default | 31.00 ± 1.41 |" in capsys.readouterr().out
    found = json.loads(table.read_text())
    assert "11x11 Gaussian window" in found["convention"]
    ours, theirs = found["rows"]
    assert (ours["row"], ours["seeds"], ours["commits"]) == ("default", [0, 1], ["abc"])
    assert ours["psnr"] == [31.0, pytest.approx(2**0.5)] and ours["rate"] == [20.0, 0.0] and ours["lpips"] is None
    assert (theirs["row"], theirs["psnr"], theirs["seconds"]) == (GSPLAT, [30.0, None], None)
    assert found["against"] == "default" and found["differences"] == []
    assert main(["table", str(file), "--against", "K = 3", "--out", str(tmp_path / "table.md")]) == 2
    assert f"--against: expected one of default, {GSPLAT}, got K = 3" in capsys.readouterr().out
    assert not (tmp_path / "table.md").exists()


def test_a_training_is_done_once(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    settings = {"texture.levels": 4, "texture.table_size": 1024}
    command = ["train", "--row", f"mine:default:{json.dumps(settings)}", "--scenes", "tiny", "--seeds", "0"]
    command += ["--size", "60", "--iterations", "4", "--data", str(folder), "--out", str(tmp_path / "out.jsonl")]
    command += ["--pictures", str(tmp_path / "pictures"), "--models", str(tmp_path / "models"), "--downscale", "2"]
    assert main(command) == 0
    (line,) = (tmp_path / "out.jsonl").read_text().splitlines()
    found = json.loads(line)
    assert (found["scene"], found["row"], found["settings"], found["downscale"]) == ("tiny", "mine", settings, 2)
    assert set(found["views"]) == {view.name for view in nw.load_scene(folder / "tiny").test}
    mean = sum(view["psnr"] for view in found["views"].values()) / len(found["views"])
    assert found["psnr"] == pytest.approx(mean) and found["primitives"] <= 60 and found["flip"] > 0
    assert found["removed_last"] == 0 and found["config"] != config_name(preset("default"))
    assert len(list((tmp_path / "pictures").iterdir())) == len(found["views"])
    (model,) = (tmp_path / "models").glob("*/model.safetensors")
    assert found["megabytes"] == pytest.approx(model.stat().st_size / 1e6)
    trained = nw.load(model)
    assert trained.texture is not None and trained.texture.residual
    assert found["quarter_psnr"] == pytest.approx(quarter_psnr(trained, folder / "tiny"), abs=0.05)
    assert main(command) == 0
    assert "0 of 1 trainings to do" in capsys.readouterr().out
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 1
    with (tmp_path / "out.jsonl").open("a") as file:
        file.write('{"scene": "ti')  # killed
    assert main(command) == 0
    assert "out.jsonl: its last line was unfinished and is cut off\n0 of 1" in capsys.readouterr().out
    changed = [word.replace("1024", "2048") for word in command]
    expected = r"out\.jsonl: expected tiny mine 60 seed 0 with the settings of today, got others \(.*\): give another"
    with pytest.raises(ValueError, match=expected):
        main(changed)
    with pytest.raises(ValueError, match="--row: expected a name that no other row has, got no gamma"):
        main([word.replace("mine:", "no gamma:") for word in command])
    assert main(["table", str(tmp_path / "out.jsonl"), "--out", str(tmp_path / "table.md")]) == 0
    text = (tmp_path / "table.md").read_text()
    assert "| mine |" in text and "## tiny, photos reduced by 2, 60 primitives, 4 iterations" in text
    torch.set_num_threads(threads)


def quarter_psnr(model: nw.Model, folder: Path) -> float:
    """Of the test views at an eighth of the photos' size, from the model's file, whose numbers are halves."""
    figures = []
    for view in nw.load_scene(folder, downscale=8).test:
        out = model.render(view.camera)
        figures.append(psnr(to_uint8(out.image), view.image))
    return sum(figures) / len(figures)


def test_rows_that_differ_late_share_their_first_iterations() -> None:
    """Until K or the removal of floaters takes effect, 25,000 of 30,000 iterations; other rows train alone."""
    jobs = list(table_jobs("hits", ("fox", "car"), (0, 1), 30_000, 40))
    groups = group_jobs(jobs, ROWS)
    assert sorted(map(str, jobs)) == sorted(str(job) for group in groups for job in group.jobs)
    several = [group for group in groups if len(group.jobs) > 1]
    assert [[job.row for job in group.jobs] for group in several] == [["default", "K = 3", "K = 4"]] * 4
    assert {(group.jobs[0].scene, group.jobs[0].seed) for group in several} == {
        (scene, seed) for scene in ("fox", "car") for seed in (0, 1)
    }
    assert all(len({(job.scene, job.seed) for job in group.jobs}) == 1 for group in several)
    assert [group.iterations for group in several] == [24_999] * 4
    assert all(group.iterations == 0 for group in groups if len(group.jobs) == 1)
    peers = [TrainingJob("fox", "", GSPLAT, 40, 0, 100), TrainingJob("fox", "", "paper", 40, 0, 100)]
    assert group_jobs(peers, ROWS) == [JobGroup((job,), 0) for job in peers]


def test_rows_of_finishing_share_their_first_iterations() -> None:
    jobs = list(table_jobs("changes", ("fox",), (0,), 300, 40))
    shared = {tuple(job.row for job in g.jobs): g.iterations for g in group_jobs(jobs, ROWS) if g.iterations}
    finished = ("no footprints", "no SH smoothing", "no metering")
    assert shared == {("default", *finished, "floaters left"): 249}


def test_rows_without_texture_or_with_an_earlier_stop_share_their_own() -> None:
    job = TrainingJob("fox", "", "default", 40, 0, 300)
    few = {"none": {"max_hits": 0}, "none, left": {"max_hits": 0, "densify.floaters": False}, "one": {"max_hits": 1}}
    early = {"early": {"densify.stop": 20_000}, "early, left": {"densify.stop": 20_000, "densify.floaters": False}}
    rows = {name: Row(name, settings=settings) for name, settings in (few | early).items()}
    groups = group_jobs([dataclasses.replace(job, row=name) for name in rows], rows)
    assert [([job.row for job in group.jobs], group.iterations) for group in groups] == [
        (["none", "none, left"], 249),
        (["one"], 0),
        (["early", "early, left"], 199),
    ]
    four = Row("four", "paper", {"max_hits": 4})  # which takes effect from the start there
    rows = {"paper": ROWS["paper"], "four": four}
    jobs = [dataclasses.replace(job, row=row, iterations=100) for row in rows]
    assert group_jobs(jobs, rows) == [JobGroup((job,), 0) for job in jobs]


def test_a_training_from_a_shared_start_is_the_training(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit: its surfels, its texture and its figures."""
    monkeypatch.setitem(METRIC_FUNCTIONS, "lpips", lambda *_: None)  # it warns where its weights are not
    threads = torch.get_num_threads()
    out, models = tmp_path / "out.jsonl", tmp_path / "models"
    small = {"texture.levels": 4, "texture.table_size": 1024}
    differ: dict[str, dict[str, int]] = {"2 hits": {}, "3 hits": {"max_hits": 3}, "left": {"densify.floaters": False}}
    rows = {name: settings | small for name, settings in differ.items()}
    command = ["train", "--scenes", "tiny", "--seeds", "1", "--size", "60", "--iterations", "12", "--data", str(folder)]
    command += ["--out", str(out), "--models", str(models)]
    for name, settings in rows.items():
        command += ["--row", f"{name}:default:{json.dumps(settings)}"]
    assert main(command) == 0
    found = read_results([out])
    assert {job.row for job in found} == set(rows)
    textures = []
    for job, result in found.items():
        assert result["together"] == {"rows": [*rows], "iterations": 9}
        row = Row(job.row, settings=rows[job.row])
        alone = run_job(job, folder, row, models=tmp_path / "alone")
        assert alone["views"] == result["views"] and "together" not in alone
        one, other = (nw.load(path / file_name(job)) for path in (models, tmp_path / "alone"))
        assert one.meta == other.meta and one.options.max_hits == rows[job.row].get("max_hits", 2)
        assert one.texture is not None and other.texture is not None
        for part, same in zip((one.surfels, one.texture), (other.surfels, other.texture), strict=True):
            state = same.state_dict()
            assert all(torch.equal(tensor, state[name]) for name, tensor in part.state_dict().items())
        textures.append(one.texture.grid)
    assert not torch.equal(*textures[:2])
    torch.set_num_threads(threads)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_benchmark_takes_its_workers_along(folder: Path, tmp_path: Path, how: signal.Signals) -> None:
    command = [sys.executable, "-m", "benchmarks.quality", "train", "--row", "mine:default:{}", "--scenes", "tiny"]
    command += ["--seeds", "0,1", "--size", "60", "--iterations", "1000000", "--data", str(folder)]
    command += ["--out", str(tmp_path / "out.jsonl")]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"2 of 2 trainings to do\n"
        time.sleep(3)
        process.send_signal(how)  # to this process alone
        try:
            said = process.communicate(timeout=60)[1].decode()  # ends when the last that could write has
        finally:
            process.kill()
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert ("interrupted: the same command does what is missing" in said) == (how == signal.SIGINT)
    assert not (tmp_path / "out.jsonl").exists()


def test_only_some_rows_of_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps(result("no gamma", 0)) + "\n" + json.dumps(result("K = 3", 0)) + "\n")
    command = ["train", "--tables", "ablation,hits", "--scenes", "fox", "--seeds", "0", "--size", "40"]
    command += ["--iterations", "100", "--out", str(file), "--only"]
    assert main([*command, "no gamma,K = 3"]) == 0
    assert "0 of 2 trainings to do" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"--only: expected some of default, paper, .*, got K = 9"):
        main([*command, "no gamma,K = 9"])


def test_curves_have_means_and_spreads_by_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = []
    for row, size, seed, figure in (
        ("default", 5000, 0, 0.2),
        ("default", 5000, 1, 0.4),
        ("default", 1000, 0, 0.5),
        (GSPLAT, 5000, 0, 0.6),
        ("paper", 5000, 0, 0.1),
    ):
        job = TrainingJob("fox", "", row, size, seed, 30)
        lines.append(json.dumps(dataclasses.asdict(job) | {"flip": figure, "psnr": None}))
    # Neither counts: another variant, and photos of another size.
    for other in (
        TrainingJob("fox", "arc", "default", 5000, 0, 30),
        TrainingJob("fox", "", "default", 5000, 0, 30, downscale=2),
    ):
        lines.append(json.dumps(dataclasses.asdict(other) | {"flip": 9.0, "psnr": 1.0}))
    file = tmp_path / "results.jsonl"
    file.write_text("\n".join(lines))
    curves = curves_of(read_results([file]), "fox", "flip", 30)
    assert curves.keys() == {"default", GSPLAT}
    assert curves["default"] == [(1000, 0.5, 0.0), (5000, pytest.approx(0.3), pytest.approx(0.02**0.5))]
    assert curves[GSPLAT] == [(5000, 0.6, 0.0)]
    assert curves_of(read_results([file]), "fox", "psnr", 30) == {}
    pytest.importorskip("matplotlib", reason="draws the curves (extra `dev`)")
    picture = tmp_path / "curve.png"
    assert main(["curve", str(file), "--iterations", "30", "--out", str(picture)]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "default: 1,000 0.5000, 5,000 0.3000"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["curve", str(file), "--scene", "car", "--out", str(tmp_path / "no.png")]) == 2
    assert not (tmp_path / "no.png").exists()


OLDER = ("default of 705b43b", "floaters left")  # rows of the default as it was
A_MEAN = r"\d+\.\d\d ± \d\.\d\d, 0\.\d{4}, 0\.\d{4}"
A_DIFFERENCE = r"[+-]\d+\.\d\d ± \d\.\d\d, [+-]0\.\d{4} ± 0\.\d{4}, [+-]0\.\d{4} ± 0\.\d{4}"


def kept(name: str) -> dict[str, set[tuple[object, ...]]]:
    """Of which trainings a figure of a document is: (scene, variant, size, row), or (row, against) of a difference."""
    results = read_results([ROOT / "benchmarks" / "results" / f"{name}.jsonl"])
    found: dict[str, set[tuple[object, ...]]] = {}
    for row in summary(results):
        (figure, spread), (similarity, _), (error, _) = (row[metric] for metric in ("psnr", "ssim", "flip"))
        if spread is not None:
            text = f"{figure:.2f} ± {spread:.2f}, {similarity:.4f}, {error:.4f}"
            found.setdefault(text, set()).add((row["scene"], row["variant"], row["size"], row["row"]))
    for against in ("default", *OLDER):
        for row in (row for group in differences(results, against) for row in group["rows"]):
            if row["psnr"][1] is not None:
                each = [(row[metric], digits) for metric, digits in (("psnr", 2), ("ssim", 4), ("flip", 4))]
                text = ", ".join(f"{mean:+.{digits}f} ± {error:.{digits}f}" for (mean, error), digits in each)
                found.setdefault(text, set()).add((row["row"], against))
    return found


def page(name: str) -> str:
    """Text of a page, or of all pages of a folder."""
    path = ROOT / name
    return "".join(
        file.read_text(encoding="utf-8") for file in (sorted(path.glob("*.md")) if path.is_dir() else [path])
    )


def notes() -> str:
    return "benchmarks/notes" if (ROOT / "benchmarks" / "notes").is_dir() else "benchmarks/NOTES.md"


def tables_of(text: str) -> list[list[list[str]]]:
    """Cells of the lines of Markdown's tables, without the line below the header."""
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    return [
        [[cell.strip() for cell in line.split("|")[1:-1]] for line in t.splitlines() if "|---" not in line]
        for t in tables
    ]


def test_the_documents_figures_are_those_of_the_kept_trainings() -> None:
    """Means with their spreads, and differences with their errors; a document is not older than its results."""
    known = {
        figures
        for name in ("quality", "quality_tried", "quality_small", "quality_undone", "quality_demo")
        for figures in kept(name)
    }
    for name, least in (("README.md", 0), ("docs/quality.md", 40), (notes(), 50)):
        shown = re.findall(f"{A_MEAN}|{A_DIFFERENCE}", page(name))
        assert len(shown) >= least, f"{name}: the tables' figures are written otherwise"
        assert not (wrong := [figures for figures in shown if figures not in known]), f"{name}: {wrong}"


def test_each_scene_has_its_own_figures_beside_gsplat() -> None:
    figures, lines = kept("quality"), 0
    for header, *table in tables_of(page("README.md") + "\n" + page("docs/quality.md")):
        for cells in table:
            name = re.fullmatch(rf"({'|'.join(SCENES)}), ([\d,]+)( \*)?", cells[0])
            if name and header[1].endswith("PSNR [dB]"):
                scene, size = name[1], int(name[2].replace(",", ""))
                assert [cell.split(": ")[-1] for cell in header[1:]] == ["PSNR [dB]", "SSIM", "FLIP", "MB"] * 2
                for rows, three in (((DEFAULT.name, *OLDER[: bool(name[3])]), cells[1:4]), ((GSPLAT,), cells[5:8])):
                    jobs = {(scene, "", size, row) for row in rows}
                    assert jobs & figures[", ".join(three)], f"{cells[0]}: {rows[-1]} has not {three}"
                lines += 1
            elif preset := re.fullmatch(r"`--preset (\w+)`", cells[0]):
                for scene, cell in zip(SCENES, cells[1:], strict=False):
                    of = {job for text, jobs in figures.items() for job in jobs if text.startswith(f"{cell}, ")}
                    assert (scene, "", 40_000, preset[1]) in of, f"{scene}: {preset[1]} has not {cell}"
                lines += 1
    assert lines >= 9


def test_the_tables_of_quality_md_give_each_row_its_own_figures() -> None:
    figures, checked = kept("quality"), 0
    for header, *lines in tables_of(page("docs/quality.md")):
        left = any(cells[0] == "default but floaters left" for cells in lines)
        base = OLDER[left]
        names = {f"{OLDER[0]}, K = 2": OLDER[0], "default but floaters left": OLDER[1]}
        for cells in lines:
            row = names.get(cells[0], re.sub(r" \(.*", "", cells[0]) + (", floaters left" if left else ""))
            for column, cell in zip(header[1:], cells[1:], strict=True):
                if column in SCENES:
                    assert (column, "", 10_000, row) in figures[cell], f"{column}: {row} has not {cell}"
                elif re.fullmatch(A_DIFFERENCE, cell):
                    assert (row, base) in figures[cell], f"{row} less {base} is not {cell}"
                elif cells[0] in SCENES and re.fullmatch(A_MEAN, cell):
                    preset = "paper" if "preset paper" in column else "default"
                    assert (cells[0], "", 40_000, preset) in figures[cell], f"{cells[0]}: {preset} has not {cell}"
                else:
                    continue
                checked += 1
    assert checked >= 40
