"""The documents give the quality figures of the kept trainings."""

import re

from benchmarks.quality.jobs import SCENES
from benchmarks.quality.results import read_results
from benchmarks.quality.rows import DEFAULT, GSPLAT
from benchmarks.quality.tables import differences, summary
from benchmarks.timing import ROOT

OLDER_PAGE = "benchmarks/notes/older-defaults.md"
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
    for name, least in (("README.md", 0), ("docs/quality.md", 0), (notes(), 90)):
        shown = re.findall(f"{A_MEAN}|{A_DIFFERENCE}", page(name))
        assert len(shown) >= least, f"{name}: the tables' figures are written otherwise"
        assert not (wrong := [figures for figures in shown if figures not in known]), f"{name}: {wrong}"


def test_each_scene_has_its_own_figures_beside_gsplat() -> None:
    figures, lines = kept("quality"), 0
    for header, *table in tables_of(page("README.md") + "\n" + page(OLDER_PAGE)):
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


def test_the_tables_of_older_defaults_give_each_row_its_own_figures() -> None:
    figures, checked = kept("quality"), 0
    for header, *lines in tables_of(page(OLDER_PAGE)):
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


def test_fair_peers_have_the_figures_of_their_trainings() -> None:
    """Single trainings of gsplat beside the default: each cell is that of its scene and row."""
    shares = {"background and our exposures": "exposures", "and our initial points": "even start"}
    rows = {column: f"gsplat MCMC, {share}" for column, share in shares.items()}
    figures: dict[tuple[str, str], str] = {}
    checked = 0
    for job, result in read_results([ROOT / "benchmarks" / "results" / "quality_peers.jsonl"]).items():
        if job.size == 40_000:
            figures[job.scene, job.row] = f"{result['psnr']:.2f}, {result['ssim']:.4f}, {result['flip']:.4f}"
    for header, *lines in tables_of(page(OLDER_PAGE)):
        if "margin over the best gsplat" in header:
            for cells in lines:
                for column, cell in zip(header, cells, strict=True):
                    if column in rows and cell:
                        assert figures[cells[0], rows[column]] == cell, f"{cells[0]}: {column} has not {cell}"
                        checked += 1
    assert checked == len(figures)
