"""The documents' tables of today's default: results of one commit, gaps marked, figures of their own trainings."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.quality.__main__ import main
from benchmarks.quality.documents import MISSING, blocks, figures
from benchmarks.quality.equal_seconds import BEST
from benchmarks.quality.jobs import TrainingJob, config_of
from benchmarks.quality.published import fill, of_one_default
from benchmarks.quality.results import Results, read_results
from benchmarks.quality.rows import GSPLAT, ROWS
from benchmarks.quality.run import config_name, sources_digest
from benchmarks.timing import ROOT

EXPOSED = "gsplat MCMC, exposures"
PAGES = ("docs/quality.md", "README.md")
# Commits whose kept results have the settings and the arithmetic of today's default.
SAME = {"55fc7bc", "0e1a112", "92d09bb", "e4bdad5", "aade3ba", "7c85264", "cf10875", "a05fb25"}
OLDER = False  # True while the tables are of a default with other settings than today's
KEPT = ("quality", "quality_checks", "quality_peers", "quality_default")


def line(scene: str, row: str, size: int, psnr: float, seed: int = 0, **changes: object) -> dict[str, Any]:
    job = TrainingJob(scene, "", row, size, seed, 30_000)
    preset = ROWS[row].preset
    trained = None if preset is None else config_of(job, ROWS[row])
    config: dict[str, object] = {} if trained is None else {"config": config_name(trained)}
    if trained is not None and trained.teachers:
        config["teachers"] = {"count": 2, "max_surfels": max(size, 40_000)}
    figures: dict[str, object] = {"psnr": psnr, "ssim": 0.9, "flip": 0.1, "lpips": None, "megabytes": 2.0}
    facts: dict[str, object] = {"commit": "abc", "date": "2026-11-25", "device": "H200", "seconds": 5.0, "settings": {}}
    compact = {"psnr": psnr - 0.5, "ssim": 0.8, "flip": 0.2, "megabytes": 1.0}
    return dataclasses.asdict(job) | figures | facts | config | {"compact": compact} | changes


def read(lines: list[dict[str, Any]], path: Path) -> Results:
    path.write_text("".join(json.dumps(each) + "\n" for each in lines))
    return read_results([path])


def rows_of(table: str) -> dict[str, list[str]]:
    cells = [[cell.strip() for cell in text.split("|")[1:-1]] for text in table.splitlines() if text.startswith("|")]
    return {row[0]: row[1:] for row in cells}


def test_the_best_gsplat_row_of_each_scene_is_the_peer(tmp_path: Path) -> None:
    lines = [
        line("fox", "default", 40_000, 32.5),
        line("fox", "default", 40_000, 32.3, seed=1, ssim=0.92),
        line("fox", GSPLAT, 40_000, 31.5, commit="older"),
        line("fox", EXPOSED, 40_000, 32.0, flip=0.12, commit="newer"),
        line("saharov", "default", 40_000, 22.0),
        line("saharov", GSPLAT, 40_000, 20.0, commit="oldest"),
    ]
    tables = blocks(of_one_default([read(lines, tmp_path / "x.jsonl")]))
    rows = rows_of(tables["peers-40000"])
    assert rows["scene"][1:3] == ["gsplat MCMC as in its example", "and background, exposures"]
    two = "32.50 and 32.30, 0.9100, 0.1000"
    assert rows["fox"] == [two, "31.50, 0.9000, 0.1000", "32.00, 0.9000, 0.1200", "+0.40 dB, +0.0100, -0.0200"]
    peer = ["20.00, 0.9000, 0.1000", MISSING, "+2.00 dB, +0.0000, +0.0000"]
    assert rows["saharov"] == ["22.00, 0.9000, 0.1000", *peer]
    assert rows["train"] == [MISSING] * 4
    assert (
        "nexwarp H200, 2026-11-25, abc, seeds 0, 1; gsplat H200, 2026-11-25, newer, older and oldest, seed 0"
        in tables["peers-40000"]
    )
    assert "Not run with 40,000: gsplat MCMC, background;" in tables["peers-40000"]
    readme = rows_of(tables["readme"])
    assert readme["fox"] == ["32.40", "0.9100", "0.1000", "2.0", "32.00", "0.9000", "0.1200", "2.0"]
    assert readme["kitchen25"] == [MISSING, "", "", ""] * 2
    assert "scene: fox +0.40 dB, saharov +2.00 dB." in tables["short"]


def test_three_seeds_are_a_mean_and_a_range() -> None:
    cell = [{"psnr": psnr, "ssim": 0.9, "flip": 0.1} for psnr in (32.0, 32.5, 32.1)]
    assert figures(cell) == "32.20 (32.00 to 32.50, 3 seeds), 0.9000, 0.1000"
    assert figures(cell[:2]) == "32.00 and 32.50, 0.9000, 0.1000"


def test_more_surfels_and_equal_megabytes(tmp_path: Path) -> None:
    sizes = {5_000: 30.0, 10_000: 30.5, 40_000: 30.2, 100_000: 31.0}
    lines = [line("fox", "default", size, psnr) for size, psnr in sizes.items()]
    lines += [line("fox", "5 MB", 37_000, 31.0), line("fox", EXPOSED, 68_400, 30.75)]
    lines += [line("train", "5 MB", 37_000, 21.0), line("train", EXPOSED, 68_400, 21.25)]
    tables = blocks(of_one_default([read(lines, tmp_path / "x.jsonl")]))
    row = rows_of(tables["sizes"])["fox"]
    assert row[2] == MISSING and row[-1] == "0.30 dB", "a size that was not run is passed over"
    assert rows_of(tables["sizes"])["train"][-1] == MISSING
    rows = rows_of(tables["megabytes"])
    peer = "30.25, 0.8000, 0.2000 (exposures, 68,400)"
    assert rows["fox"][:3] == ["30.50, 0.8000, 0.2000", peer, "+0.25 dB, +0.0000, +0.0000"]
    assert rows["fox"][4] == peer, "the smaller file is the better one of at most 10 MB, too"
    assert rows["mean"] == ["", "", MISSING] * 2, "two scenes are no mean of four"
    lines += [line(scene, "5 MB", 37_000, 21.0) for scene in ("saharov", "kitchen25")]
    lines += [line(scene, EXPOSED, 68_400, 21.0) for scene in ("saharov", "kitchen25")]
    rows = rows_of(blocks(of_one_default([read(lines, tmp_path / "y.jsonl")]))["megabytes"])
    assert rows["mean"] == ["", "", "+0.00 dB, +0.0000, +0.0000", "", "", MISSING]


def test_gsplat_with_our_seconds_stands_beside_us(tmp_path: Path) -> None:
    today = line("fox", "default", 40_000, 32.5, seconds=94.2)
    lines = [line("fox", "default", 40_000, 31.0, 1, config="other"), today, line("saharov", "default", 40_000, 22.0)]
    lines += [line("fox", BEST["fox"], 40_000, 30.0 + n / 1000, iterations=n, seconds=n / 150) for n in (1000, 3000)]
    lines += [line("fox", BEST["fox"], 40_000, 32.0, iterations=14_500, seconds=93.7)]
    table = blocks({}, read(lines, tmp_path / "x.jsonl"))["seconds"]
    own, peer = "32.50, 0.9000, 0.1000", "32.00, 0.9000, 0.1000 (skybox, 14,500)"
    assert rows_of(table)["fox"] == ["H200", "94 s", own, "94 s", peer, "+0.50 dB, +0.0000, +0.0000"]
    assert rows_of(table)["saharov"] == rows_of(blocks({})["seconds"])["fox"] == [MISSING] * 6
    assert table.endswith("*Measured by* `python -m benchmarks.quality.equal_seconds`: 2026-11-25; abc.")
    lines += [line("fox", BEST["fox"], 40_000, 33.0, device="H100"), line("fox", GSPLAT, 40_000, 31.0)]
    alone = read(lines, tmp_path / "y.jsonl")
    assert blocks({}, alone)["seconds"] == table, "neither another GPU nor another row is compared with"
    whole = read([*lines, line("fox", BEST["fox"], 40_000, 32.25, seconds=94.0)], tmp_path / "z.jsonl")
    assert "32.25, 0.9000, 0.1000 (skybox, 30,000)" in rows_of(blocks({}, whole)["seconds"])["fox"]
    short = read(lines[:5], tmp_path / "short.jsonl")
    assert rows_of(blocks({}, short)["seconds"])["fox"] == [MISSING] * 6, "the two short ones are no comparison"


def test_results_of_two_defaults_are_not_mixed(tmp_path: Path) -> None:
    lines = [line("fox", "default", 40_000, 32.0), line("saharov", "default", 40_000, 22.0, commit="def")]
    results = read([*lines, line("fox", "paper", 40_000, 31.0, commit="ghi")], tmp_path / "x.jsonl")
    with pytest.raises(ValueError, match="--commit: expected one of abc, def: the default's results are not of one"):
        of_one_default([results])
    with pytest.raises(ValueError, match="--commit: expected one of abc, def, got jkl"):
        of_one_default([results], "jkl")
    assert {(job.scene, job.row) for job in of_one_default([results], "abc")} == {("fox", "default"), ("fox", "paper")}
    assert len(of_one_default([results], "abc", ["def"])) == 3
    newer, older = ({job: x | {"commit": name} for job, x in results.items()} for name in ("abc", "old"))
    for files in ((newer, older), (older, newer)):
        assert {x["commit"] for job, x in of_one_default(files, "abc").items() if job.row == "default"} == {"abc"}
    with pytest.raises(ValueError, match=r"fox default 40000 seed 0 \(abc\): expected the settings of today, got"):
        of_one_default([read([line("fox", "default", 40_000, 32.0, config="other")], tmp_path / "y.jsonl")])
    assert len(of_one_default([read_results([tmp_path / "y.jsonl"])], older=True)) == 1
    for teachers in (None, {"count": 2}):  # teachers of an older default were missing, or as large as the student
        other = line("saharov", "default", 20_000, 22.0, teachers=teachers)
        with pytest.raises(ValueError, match=r"saharov default 20000 seed 0 \(abc\): expected the settings of today"):
            of_one_default([read([other], tmp_path / "t.jsonl")])
    mixed = [line("fox", "default", 40_000, 32.0, seed, config=config) for seed, config in enumerate(("one", "other"))]
    with pytest.raises(ValueError, match=r"seed 1 .*: expected the settings of other trainings of the row, got"):
        of_one_default([read(mixed, tmp_path / "m.jsonl")], older=True)
    short = [
        line("fox", "default", 40_000, 32.0, iterations=1000),
        line("fox", "default", 40_000, 3.0, variant="inner"),
    ]
    assert not of_one_default([read(short, tmp_path / "z.jsonl")])


def test_a_digest_of_the_sources_names_them_where_git_cannot(tmp_path: Path) -> None:
    package = tmp_path / "one" / "package"
    package.mkdir(parents=True)
    (package / "a.py").write_text("x = 1\n")
    (package / "notes.txt").write_text("x")
    before = sources_digest(package)
    (package / "notes.txt").write_text("y")
    assert sources_digest(package.rename(tmp_path / "package")) == before and len(before) == 12
    (tmp_path / "package" / "a.py").write_text("x = 2\n")
    assert sources_digest(tmp_path / "package") != before


def test_pages_are_filled_in_their_blocks_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read([line("fox", "default", 40_000, 32.0)], tmp_path / "x.jsonl")
    page = tmp_path / "page.md"
    page.write_text("# A\n\n<!-- results: sizes -->\nold\n<!-- end of results -->\n\nkept \\1\n")
    command = ["publish", str(tmp_path / "x.jsonl"), "--page", str(page), "--show", "short"]
    assert main(command) == main(command) == 0
    text = page.read_text()
    assert text.startswith("# A\n\n<!-- results: sizes -->\n| scene |") and text.endswith("-->\n\nkept \\1\n")
    assert "old" not in text and "32.00, 0.9000, 0.1000" in text
    shown = capsys.readouterr().out
    assert "sizes 23" in shown and "* 40,000 primitives" in shown
    with pytest.raises(ValueError, match="results: expected blocks named a, got b"):
        fill("<!-- results: b -->\n<!-- end of results -->", {"a": ""})
    with pytest.raises(ValueError, match="expected a page with a line <!-- results: NAME -->"):
        fill("text", {"a": ""})


def test_the_pages_hold_the_tables_of_the_kept_results() -> None:
    files = [ROOT / "benchmarks" / "results" / f"{name}.jsonl" for name in KEPT]
    kept = [read_results([file]) for file in files]
    commit, *same = {x["commit"] for x in kept[-1].values() if ROWS[x["row"]].preset == "default"}
    assert {commit, *same} <= SAME
    alone = read_results([ROOT / "benchmarks" / "results" / "quality_alone.jsonl"])
    tables = blocks(of_one_default(kept, commit, same, OLDER), alone)
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        assert ("of an older default" in " ".join(text.split())) == OLDER, f"{page}: say whose tables these are"
        assert fill(text, tables) == text, f"{page}: fill it by benchmarks.quality publish"
