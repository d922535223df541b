"""Our figures beside the paper's, scene by scene, as one Markdown table.

    python -m benchmarks.paper --data DIR --out paper.jsonl
    python -m benchmarks.paper --data DIR --out paper.jsonl --sizes 40000,400000 --preset default --raw

Each folder of DIR that has the name of one of the paper's scenes is trained with the budgets of which the paper has
figures. A training that the results file holds is read from there, so the command can be stopped and repeated. Photos
are read from the folder that the paper used, `images_2` or `images_4` of the data sets, or from `images` where that
is missing. Where they are of another size than the paper's, the last column says so.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

import torch

from benchmarks.quality.documents import MISSING, caption
from benchmarks.quality.jobs import DEFAULT, ITERATIONS, PAPER, RAW, Row, TrainingJob
from benchmarks.quality.results import Results, markdown, read_results
from benchmarks.quality.run import Places, missing_jobs, run_jobs
from nexwarp.errors import SettingError
from nexwarp.run.evaluate import check_metrics

INDOOR, OUTDOOR, TANKS, CUSTOM = GROUPS = ("Mip-NeRF 360 indoor", "Mip-NeRF 360 outdoor", "Tanks & Temples", "custom")
SCENES = {  # group, folder and size of the paper's photos; treehill's is inferred from photos of half the size
    "bonsai": (INDOOR, "images_2", "1559x1039"),
    "counter": (INDOOR, "images_2", "1558x1038"),
    "kitchen": (INDOOR, "images_2", "1558x1039"),
    "room": (INDOOR, "images_2", "1557x1038"),
    "bicycle": (OUTDOOR, "images_4", "1237x822"),
    "flowers": (OUTDOOR, "images_4", "1256x828"),
    "garden": (OUTDOOR, "images_4", "1297x840"),
    "stump": (OUTDOOR, "images_4", "1245x825"),
    "treehill": (OUTDOOR, "images_4", "1267x832"),
    "train": (TANKS, "images", "980x545"),
    "truck": (TANKS, "images", "979x546"),
    "graffiti": (CUSTOM, "images_4", "size is not published"),
    "grocery": (CUSTOM, "images_4", "size is not published"),
    "table": (CUSTOM, "images_1", "size is not published"),
    "tripod": (CUSTOM, "images_4", "size is not published"),
}
BUDGETS = (40_000, 100_000, 400_000, 1_000_000)
# The paper's \label{tab:ours_detailed}, by metric and budget, in the order of SCENES.
PUBLISHED = {
    ("psnr", 40_000): "29.98 27.61 29.62 30.32 23.44 19.79 25.59 25.11 22.33 - - 25.38 27.16 27.95 25.50",
    ("psnr", 100_000): "30.81 28.13 30.32 30.51 24.05 20.38 26.23 25.88 22.53 - - 25.50 27.51 27.73 25.74",
    ("psnr", 400_000): "31.92 28.95 31.22 31.66 24.72 21.19 26.96 26.56 22.99 21.50 25.61 25.98 28.07 27.98 26.12",
    ("psnr", 1_000_000): "32.47 29.26 31.59 31.97 25.04 21.48 27.36 27.01 22.97 - - - - - -",
    ("ssim", 40_000): "0.913 0.880 0.901 0.903 0.657 0.492 0.793 0.691 0.600 - - 0.767 0.857 0.905 0.815",
    ("ssim", 100_000): "0.923 0.892 0.910 0.899 0.690 0.530 0.817 0.728 0.607 - - 0.776 0.864 0.904 0.831",
    ("ssim", 400_000): "0.935 0.905 0.921 0.922 0.730 0.577 0.842 0.764 0.624 0.802 0.880 0.789 0.878 0.906 0.829",
    ("ssim", 1_000_000): "0.942 0.911 0.927 0.925 0.749 0.595 0.855 0.781 0.629 - - - - - -",
    ("lpips", 40_000): "0.199 0.205 0.146 0.210 0.288 0.364 0.164 0.282 0.309 - - 0.302 0.248 0.151 0.261",
    ("lpips", 100_000): "0.188 0.192 0.136 0.215 0.261 0.334 0.145 0.249 0.302 - - 0.318 0.234 0.146 0.251",
    ("lpips", 400_000): "0.170 0.176 0.123 0.186 0.227 0.298 0.124 0.216 0.286 0.197 0.112 0.274 0.222 0.146 0.245",
    ("lpips", 1_000_000): "0.161 0.167 0.114 0.179 0.208 0.281 0.110 0.197 0.277 - - - - - -",
}
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
NO_LPIPS = (
    "LPIPS: - is a training without its weights. `python -m benchmarks.lpips_weights`, then train to another --out."
)
# The finest level of the hash grid is the paper's of all scenes but Mip-NeRF 360's (docs/paper.md).
FINE = Row("paper with 1024 cells", "paper", {"texture.max_resolution": 1024.0})
ROWS = {row.name: row for row in (PAPER, FINE, DEFAULT, RAW)}

Figures = Mapping[str, float | None]  # by the names of DIGITS
Jobs = Mapping[tuple[str, int], TrainingJob]  # by scene and budget


def published(scene: str, size: int) -> Figures:
    """Return the paper's figures; None where it has none."""
    column = list(SCENES).index(scene)
    words = {name: PUBLISHED[name, size].split()[column] if size in BUDGETS else "-" for name in DIGITS}
    return {name: None if word == "-" else float(word) for name, word in words.items()}


def mean(members: Sequence[Figures]) -> Figures:
    """Return the means over scenes; None where one has none."""
    known = {metric: [x for member in members if (x := member[metric]) is not None] for metric in DIGITS}
    return {metric: fmean(values) if len(values) == len(members) else None for metric, values in known.items()}


def wanted_jobs(options: argparse.Namespace) -> Jobs:
    """Return the trainings of the scenes that are there; SystemExit where there is none."""
    scenes = [scene for scene in SCENES if (options.data / scene).is_dir()]
    if not scenes:
        expected = f"a folder named {', '.join(SCENES)}" if options.data.is_dir() else "a folder of scenes"
        raise SystemExit(f"--data: expected {expected}, found none at {options.data}")
    jobs = {}
    for scene in scenes:
        group, images, _ = SCENES[scene]
        paper = PAPER if group in (INDOOR, OUTDOOR) else FINE
        row = paper if options.preset == "paper" else RAW if options.raw else DEFAULT
        images = images if (options.data / scene / images).is_dir() else "images"
        for size in options.sizes or (size for size in BUDGETS if published(scene, size)["psnr"] is not None):
            jobs[scene, size] = TrainingJob(scene, "", row.name, size, options.seed, options.iterations, 1, images)
    return jobs


def table(jobs: Jobs, results: Results) -> str:
    """Return Markdown: a line for each scene and budget, and the means of the groups that are complete."""
    lines, figures = [], {}
    for (scene, size), job in jobs.items():
        paper, ours = figures[scene, size] = published(scene, size), results.get(job, dict.fromkeys(DIGITS))
        photos, expected = ours.get("pixels", "size not recorded" if job in results else MISSING), SCENES[scene][-1]
        photos += "" if photos == expected else f"; the paper's {expected}"
        lines.append(_line(scene, size, paper, ours, photos))
    for group in GROUPS:
        scenes = [scene for scene, (of, *_) in SCENES.items() if of == group]
        for size in dict.fromkeys(size for _, size in jobs):
            if all((scene, size) in figures for scene in scenes):
                theirs, own = (mean([figures[scene, size][side] for scene in scenes]) for side in (0, 1))
                lines.append(_line(f"mean of {group}", size, theirs, own, ""))
    header = ["scene", "surfels", "the paper's PSNR [dB] / SSIM / LPIPS", "ours", "ours less the paper's", "photos"]
    return markdown(header, lines)


def _line(name: str, size: int, paper: Figures, ours: Figures, photos: str) -> list[str]:
    pairs = {metric: (ours[metric], paper[metric]) for metric in DIGITS}
    less = {metric: None if a is None or b is None else a - b for metric, (a, b) in pairs.items()}
    return [name, f"{size:,}", _text(paper), _text(ours), _text(less, "+"), photos]


def _text(figures: Figures, sign: str = "") -> str:
    return " / ".join("-" if (x := figures[m]) is None else f"{x:{sign}.{digits}f}" for m, digits in DIGITS.items())


def integers(text: str) -> list[int]:
    """Parse integers between commas."""
    return [int(word) for word in text.split(",")]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of the scenes' folders")
    add("--out", type=Path, default=Path("paper.jsonl"), help="results file (default: %(default)s)")
    add("--sizes", type=integers, help="budgets of surfels (default: those of which the paper has figures)")
    add("--preset", default="paper", choices=("paper", "default"), help="default: %(default)s")
    add("--raw", action="store_true", help="exposures=false, as it is in the paper's preset")
    add("--seed", type=int, default=0, help="default: %(default)s")
    add("--iterations", type=int, default=ITERATIONS, help="default: %(default)s")
    add("--jobs", type=int, default=1, help="trainings at once (default: %(default)s)")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    options = make_parser().parse_args(arguments)
    jobs = wanted_jobs(options)
    missing = missing_jobs([*jobs.values()], options.out)
    if missing:
        try:
            check_metrics(["lpips"], torch.device("cpu"))
        except SettingError as error:
            print(str(error).removeprefix("--metrics: "), file=sys.stderr, flush=True)
    failed = run_jobs(missing, ROWS, Places(options.data), options.out, options.jobs)
    results = read_results([options.out]) if options.out.exists() else {}
    shown = [results[job] for job in jobs.values() if job in results]
    rows = ", ".join(sorted({job.row for job in jobs.values()}))
    print(f"\n{table(jobs, results)}\n")
    print(f"Ours: {rows}; seed {options.seed}, {options.iterations:,} iterations. {caption(shown, 'benchmarks.paper')}")
    if any(result["lpips"] is None for result in shown):
        print(NO_LPIPS)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
