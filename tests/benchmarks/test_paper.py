"""The comparison with the paper: its figures are the publication's, and one command makes the table."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.paper import (
    BUDGETS,
    DIGITS,
    GROUPS,
    NO_LPIPS,
    PUBLISHED,
    SCENES,
    main,
    mean,
    published,
    table,
)
from benchmarks.quality.jobs import TrainingJob
from benchmarks.timing import ROOT
from tests.scene_writers import write_demo

TEX = ROOT.parent / "shared" / "paper.tex"
NAMES = {40_000: "Nexels (40K)", 100_000: "Nexels (100K)", 400_000: "Nexels (400K)", 1_000_000: "Nexels (1M)"}


def tex_table(label: str) -> str:
    """The publication's table of a label, up to it."""
    if not TEX.is_file():
        pytest.skip(f"the publication is not here: {TEX}")
    before = TEX.read_text(encoding="utf-8").split(f"\\label{{{label}}}")[0]
    return before[before.rindex(r"\begin{table*}") :]


def tex_rows(label: str, name: str) -> list[list[str]]:
    """The figures of the rows of that name, "-" where there is none, without memory and numbers of primitives."""
    rows = [row.strip().splitlines()[-1].split("&") for row in tex_table(label).split(r"\\")]
    plain = [[re.sub(r"\\textbf\{(.*)\}", r"\1", cell.strip()) for cell in row] for row in rows]
    return [[cell for cell in row[1:] if cell[-1:] not in "BM"] for row in plain if row[0] == name]


@pytest.mark.parametrize("size", BUDGETS)
def test_the_figures_are_the_publications(size: int) -> None:
    assert tex_rows("tab:ours_detailed", NAMES[size]) == [PUBLISHED[metric, size].split() for metric in DIGITS]
    short = [re.sub("[aeiouy]", "", scene)[:3].capitalize() for scene in SCENES]  # as its caption says
    assert re.findall(r"\\textsc\{(\w+)\}", tex_table("tab:ours_detailed")) == short


@pytest.mark.parametrize("size", BUDGETS)
def test_their_means_are_the_publications(size: int) -> None:
    (row,) = tex_rows("tab:table_all", NAMES[size])
    means = dict(zip((GROUPS[0], GROUPS[1], GROUPS[3]), (row[:3], row[3:6], row[6:9]), strict=True))
    if size == 400_000:
        means[GROUPS[2]] = tex_rows("tab:high_results", "Ours")[0][3:6]
    for group, words in means.items():
        figures = mean([published(scene, size) for scene, (of, *_) in SCENES.items() if of == group])
        for (metric, digits), word in zip(DIGITS.items(), words, strict=True):
            expected = None if word == "-" else pytest.approx(float(word), abs=10**-digits)
            assert figures[metric] == expected, (group, metric)


def test_rows_say_the_size_of_photos_and_groups_have_means() -> None:
    ours = {"psnr": 22.5, "ssim": 0.8, "lpips": 0.2}
    scenes = ("kitchen", "treehill", "train", "truck", "table")
    jobs = {(scene, 400_000): TrainingJob(scene, "", "paper", 400_000, 0, 30_000) for scene in scenes}
    results: dict[TrainingJob, dict[str, Any]] = {
        jobs["treehill", 400_000]: ours | {"pixels": "634x416"},
        jobs["train", 400_000]: ours | {"pixels": "980x545", "lpips": None},
        jobs["truck", 400_000]: ours,
        jobs["table", 400_000]: ours | {"pixels": "1500x1000"},
    }
    lines = table(jobs, results).splitlines()[2:]
    cells = [[cell.strip() for cell in line.split("|")[4:7]] for line in lines]
    assert cells == [
        ["- / - / -", "- / - / -", "not run; the paper's 1558x1039"],
        ["22.50 / 0.800 / 0.200", "-0.49 / +0.176 / -0.086", "634x416; the paper's 1267x832"],
        ["22.50 / 0.800 / -", "+1.00 / -0.002 / -", "980x545"],
        ["22.50 / 0.800 / 0.200", "-3.11 / -0.080 / +0.088", "size not recorded; the paper's 979x546"],
        ["22.50 / 0.800 / 0.200", "-5.48 / -0.106 / +0.054", "1500x1000; the paper's size is not published"],
        ["22.50 / 0.800 / -", "-1.05 / -0.041 / -", ""],
    ]
    assert lines[-1].startswith("| mean of Tanks & Temples | 400,000 | 23.55")


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
    assert (NO_LPIPS in first) == (result["lpips"] is None)
    assert main(command) == 0 and out.read_text() == line + "\n"
    again = capsys.readouterr().out
    assert "0 of 1 trainings to do" in again and row in again
