"""The quality benchmark reads its results, and makes tables and curves of them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.quality.__main__ import main
from benchmarks.quality.curve import curves_of
from benchmarks.quality.jobs import TrainingJob
from benchmarks.quality.results import Results, drop_unfinished, read_results
from benchmarks.quality.rows import GSPLAT
from benchmarks.quality.tables import differences, markdown


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


def test_only_some_rows_of_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "results.jsonl"
    file.write_text(json.dumps(result("no gamma", 0)) + "\n" + json.dumps(result("K = 3", 0)) + "\n")
    command = ["train", "--tables", "ablation,hits", "--scenes", "fox", "--seeds", "0", "--size", "40"]
    command += ["--iterations", "100", "--out", str(file), "--only"]
    assert main([*command, "no gamma,K = 3"]) == 0
    assert "0 of 2 trainings to do" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"--only: expected some of default; paper; .*, got 'K = 9'"):
        main([*command, "no gamma,K = 9"])


def test_rows_whose_names_have_commas_can_be_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "results.jsonl"
    names = ("gsplat MCMC, skybox", "gsplat MCMC", "gsplat MCMC, even start")
    lines = [result(name, 0) | {"size": size} for name in names for size in (10, 40)]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    command = ["train", "--tables", "peers", "--scenes", "fox", "--seeds", "0", "--size", "40"]
    assert main([*command, "--iterations", "100", "--out", str(file), "--only", ",".join(names)]) == 0
    assert "0 of 6 trainings to do" in capsys.readouterr().out


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
