"""The quality benchmark's command line: `python -m benchmarks.quality --help`."""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path

from benchmarks import quality
from benchmarks.quality.curve import draw
from benchmarks.quality.documents import MISSING, blocks, fill
from benchmarks.quality.jobs import FOLDS, ITERATIONS, ROWS, SCENES, SIZE, TABLES, Row, TrainingJob
from benchmarks.quality.results import read_results
from benchmarks.quality.results import table as results_table
from benchmarks.quality.run import Places, missing_jobs, run_jobs
from benchmarks.timing import ROOT


def train(options: argparse.Namespace) -> int:
    """Run the trainings that the results file lacks."""
    rows = ROWS | own_rows(options.row or ())
    jobs = missing_jobs(wanted_jobs(options), options.out)
    places = Places(options.data, options.pictures, options.models, options.curve)
    failed = run_jobs(jobs, rows, places, options.out, options.jobs)
    return 1 if failed else 0


def own_rows(texts: Iterable[str]) -> dict[str, Row]:
    """Return the rows of `--row NAME:PRESET:SETTINGS`."""
    rows = {}
    for text in texts:
        name, base, settings = text.split(":", 2)
        rows[name] = Row(name, None if base == "gsplat" else base or "default", json.loads(settings or "{}"))
        if name in ROWS and rows[name] != ROWS[name]:
            raise ValueError(f"--row: expected a name that no other row has, got {name}")
    return rows


def wanted_jobs(options: argparse.Namespace) -> list[TrainingJob]:
    """Return the jobs that are asked for, each once; ValueError for an unknown table."""
    tables = options.tables.split(",") if options.tables else []
    if unknown := set(tables) - TABLES.keys():
        raise ValueError(f"--tables: expected some of {', '.join(TABLES)}, got {', '.join(unknown)}")
    wanted = [(row.name, size) for rows, sizes in (TABLES[name] for name in tables) for size in sizes for row in rows]
    wanted += [(text.split(":", 1)[0], options.size) for text in options.row or ()]
    jobs = [
        TrainingJob(scene, options.variant, row, size, int(seed), options.iterations, options.downscale)
        for scene in options.scenes.split(",")
        for row, size in wanted
        for seed in options.seeds.split(",")
    ]
    return [*dict.fromkeys(jobs)]


def table(options: argparse.Namespace) -> int:
    """Print means over seeds."""
    print(results_table(read_results(options.results)))
    return 0


def curves(options: argparse.Namespace) -> int:
    """Draw quality over seconds."""
    draw(read_results(options.results).values(), options.out)
    return 0


def publish(options: argparse.Namespace) -> int:
    """Fill the marked blocks of pages."""
    tables = blocks(read_results(options.results))
    for page in options.page:
        page.write_text(fill(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
    print("cells not run: " + ", ".join(f"{name} {text.count(MISSING)}" for name, text in tables.items()))
    return 0


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    description = (quality.__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality", description=description)
    commands = parser.add_subparsers(required=True)
    _add_train(commands.add_parser("train", help="do the trainings that are not there yet"))
    tables = commands.add_parser("table", help="print means over seeds as Markdown")
    tables.set_defaults(run=table)
    tables.add_argument("results", type=Path, nargs="+")
    pictures = commands.add_parser("curves", help="draw the quality over seconds of trainings with --curve")
    pictures.set_defaults(run=curves)
    pictures.add_argument("results", type=Path, nargs="+")
    pictures.add_argument("--out", type=Path, default=Path("curves.png"), help="default: %(default)s")
    pages = commands.add_parser("publish", help="fill the tables of the documents")
    pages.set_defaults(run=publish)
    pages.add_argument("results", type=Path, nargs="+")
    pages.add_argument("--page", type=Path, action="append", required=True, help="file to fill; several times")
    return parser


def _add_train(parser: argparse.ArgumentParser) -> None:
    """Add the options of `train`."""
    add = parser.add_argument
    parser.set_defaults(run=train)
    add("--tables", help=f"comma-separated: {', '.join(TABLES)}")
    add("--row", action="append", help="NAME:PRESET:JSON settings, to try something out; PRESET may be gsplat")
    add("--variant", default="", choices=("", *FOLDS), help="hold out validation views in place of the test views")
    add("--scenes", default=",".join(SCENES), help="default: %(default)s")
    add("--seeds", default="0,1", help="default: %(default)s")
    add("--size", type=int, default=SIZE, help="budget of primitives of --row (default: %(default)s)")
    add("--iterations", type=int, default=ITERATIONS, help="default: %(default)s")
    add("--downscale", type=int, default=1, help="reduce photos by (default: %(default)s)")
    add("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    add("--out", type=Path, default=Path("quality.jsonl"), help="default: %(default)s")
    add("--jobs", type=int, default=1, help="trainings at once (default: %(default)s)")
    add("--curve", action="store_true", help="also measure the quality at times of the training")
    add("--pictures", type=Path, help="folder for photo, rendering and error of each test view")
    add("--models", type=Path, help="folder to keep the models in")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    options = make_parser().parse_args(arguments)
    return options.run(options)


if __name__ == "__main__":
    sys.exit(main())
