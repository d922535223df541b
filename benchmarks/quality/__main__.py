"""The quality benchmark's command line: `python -m benchmarks.quality --help`."""

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from benchmarks import quality
from benchmarks.quality.curve import curves_of, draw_curves
from benchmarks.quality.documents import MISSING, blocks
from benchmarks.quality.jobs import SCENES, TABLES, TrainingJob, config_of, table_jobs
from benchmarks.quality.published import fill, of_one_default
from benchmarks.quality.results import DIGITS, METRICS, Results, drop_unfinished, read_results
from benchmarks.quality.rows import DEFAULT, ROWS, Row
from benchmarks.quality.run import trained_with
from benchmarks.quality.scenes import VARIANTS
from benchmarks.quality.schedule import Schedule
from benchmarks.quality.tables import differences, markdown, summary
from benchmarks.timing import ROOT
from nexwarp.run.metrics import CONVENTION


def train(given: argparse.Namespace) -> int:
    """Run the trainings that the results file lacks."""
    rows = _rows(given.row or ())
    wanted = _wanted_jobs(given, rows)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    have: Results = {}
    if given.out.exists():
        if drop_unfinished(given.out):
            print(f"{given.out}: its last line was unfinished and is cut off")
        have = read_results([given.out])
    _check_settings(given.out, wanted, have, rows)
    jobs = [job for job in wanted if job not in have]
    print(f"{len(jobs)} of {len(wanted)} trainings to do", flush=True)
    return Schedule(rows, given.data, given.out, given.jobs, given.pictures, given.models).run(jobs)


def _rows(texts: Iterable[str]) -> dict[str, Row]:
    """Return all rows by name, with those of `--row NAME:PRESET:SETTINGS`."""
    rows = dict(ROWS)
    for text in texts:
        name, base, settings = text.split(":", 2)
        row = Row(name, None if base == "gsplat" else base or "default", json.loads(settings or "{}"))
        if rows.setdefault(name, row) != row:
            raise ValueError(f"--row: expected a name that no other row has, got {name}")
    return rows


def _row_names(text: str) -> list[str]:
    """Return the rows that a comma-separated list names; a name may have commas, too."""
    parts, found = text.split(","), list[str]()
    while parts:
        ends = [end for end in range(len(parts), 0, -1) if ",".join(parts[:end]) in ROWS]
        if not ends:
            raise ValueError(f"--only: expected some of {'; '.join(ROWS)}, got {parts[0]!r}")
        found.append(",".join(parts[: ends[0]]))
        del parts[: ends[0]]
    return found


def _wanted_jobs(given: argparse.Namespace, rows: Mapping[str, Row]) -> list[TrainingJob]:
    """Return the jobs that are asked for, each once."""
    wanted: dict[TrainingJob, None] = {}
    seeds = [int(x) for x in given.seeds.split(",")]
    scenes = given.scenes.split(",")
    only = _row_names(given.only) if given.only else [*ROWS]
    for table in filter(None, (given.tables or "").split(",")):
        for job in table_jobs(table, scenes, seeds, given.iterations, given.size):
            if job.row in only:
                job = dataclasses.replace(job, downscale=given.downscale, variant=job.variant or given.variant)
                wanted[job] = None
    for name in (text.split(":", 1)[0] for text in given.row or ()):
        for scene in scenes:
            for seed in seeds:
                job = TrainingJob(scene, given.variant, name, given.size, seed, given.iterations, given.downscale)
                wanted[job] = None
    return [*wanted]


def _check_settings(out: Path, wanted: Iterable[TrainingJob], have: Results, rows: Mapping[str, Row]) -> None:
    """Raise ValueError where a result of a wanted job was made with other settings than today's."""
    for job in wanted:
        before, row = have.get(job, {}), rows[job.row]
        if before.get("config") and row.preset is not None and not trained_with(before, config_of(job, row)):
            told = f"{job.scene} {job.row} {job.size} seed {job.seed} with the settings of today"
            raise ValueError(f"{out}: expected {told}, got others ({have[job]['commit']}): give another --out")


def table(given: argparse.Namespace) -> int:
    """Write Markdown, and JSON where that is asked for."""
    results = read_results(given.results)
    rows = {DEFAULT.name} | {job.row for job in results}
    if given.against not in rows:
        print(f"--against: expected one of {', '.join(sorted(rows))}, got {given.against}")
        return 2
    text = markdown(results, given.against)
    if given.json:
        tables = {"convention": CONVENTION, "rows": summary(results), "against": given.against}
        tables["differences"] = differences(results, given.against)
        given.json.write_text(json.dumps(tables, indent=1) + "\n")
    if given.out:
        given.out.write_text(text)
    else:
        print(text)
    return 0


def curve(given: argparse.Namespace) -> int:
    """Draw a metric over the number of primitives, and print the curves' points."""
    if given.commit is None:
        results = read_results(given.results)
    else:
        results = _of_one_default(given)
    curves = curves_of(results, given.scene, given.metric, given.iterations)
    if not curves:
        print(f"--scene: expected one with results of {given.iterations:,} iterations, got {given.scene}")
        return 2
    draw_curves(curves, given.scene, given.metric, given.out)
    for name, points in curves.items():
        print(f"{name}: " + ", ".join(f"{size:,} {mean:.{DIGITS[given.metric]}f}" for size, mean, _ in points))
    return 0


def publish(given: argparse.Namespace) -> int:
    """Fill the marked blocks of pages with the tables of one default."""
    results = _of_one_default(given)
    tables = blocks(results, read_results([given.alone]) if given.alone else None)
    filled = {page: fill(page.read_text(encoding="utf-8"), tables) for page in given.page or ()}
    for page, text in filled.items():
        page.write_text(text, encoding="utf-8")
    for name in given.show.split(",") if given.show else ():
        print(tables[name])
    missing = {name: text.count(MISSING) for name, text in tables.items()}
    print("cells not run: " + ", ".join(f"{name} {count}" for name, count in missing.items() if count))
    return 0


def _of_one_default(given: argparse.Namespace) -> Results:
    files = [read_results([file]) for file in given.results]
    return of_one_default(files, given.commit, given.same.split(",") if given.same else (), given.older)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    description = (quality.__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality", description=description)
    commands = parser.add_subparsers(required=True)
    _add_publish(commands.add_parser("publish", help="fill the tables of the documents with results of one default"))
    _add_train(commands.add_parser("train", help="do the trainings of some tables that are not there yet"))
    tables = commands.add_parser("table", help="make Markdown of results")
    tables.set_defaults(run=table)
    tables.add_argument("results", type=Path, nargs="+")
    tables.add_argument("--against", default=DEFAULT.name, help="row to compare with (default: %(default)s)")
    tables.add_argument("--out", type=Path, help="file to write; default: the screen")
    tables.add_argument("--json", type=Path, help="file to write the same to, as JSON")
    curves = commands.add_parser("curve", help="draw a metric over the number of primitives")
    curves.set_defaults(run=curve)
    curves.add_argument("results", type=Path, nargs="+")
    curves.add_argument("--scene", default="fox", help="default: %(default)s")
    curves.add_argument("--metric", default="flip", choices=METRICS, help="default: %(default)s")
    curves.add_argument("--iterations", type=int, default=30_000, help="default: %(default)s")
    _add_default(curves, "all of them")
    curves.add_argument("--out", type=Path, required=True, help="picture to write")
    return parser


def _add_publish(parser: argparse.ArgumentParser) -> None:
    """Add the options of `publish`."""
    add = parser.add_argument
    parser.set_defaults(run=publish)
    add("results", type=Path, nargs="+")
    _add_default(parser, "the only one in the results")
    add("--alone", type=Path, help="results of benchmarks.quality.equal_seconds, for its table")
    add("--page", type=Path, action="append", help="file with lines <!-- results: NAME --> to fill; several times")
    add("--show", help="comma-separated blocks to print: short, readme, peers-40000, peers-10000, sizes, train, ...")


def _add_default(parser: argparse.ArgumentParser, commit: str) -> None:
    """Add the options that name a default."""
    add = parser.add_argument
    add("--commit", help=f"of the default's trainings; default: {commit}")
    add("--same", help="comma-separated: further commits whose default computes the same")
    add("--older", action="store_true", help="the default had other settings then; the page has to say so")


def _add_train(parser: argparse.ArgumentParser) -> None:
    """Add the options of `train`."""
    add = parser.add_argument
    parser.set_defaults(run=train)
    add("--tables", help=f"comma-separated: {', '.join(TABLES)}; arc: a held-out arc of neighbouring views")
    add("--only", help="comma-separated rows of the tables; default: all of them")
    add("--row", action="append", help="NAME:PRESET:JSON settings, to try something out")
    add("--variant", default="", choices=("", *VARIANTS), help="of the scenes; inner, half, ...: validation views")
    add(
        "--scenes",
        default=",".join(SCENES),
        help="default: %(default)s; curve, arc and frames are of fox alone, demo of the built-in scene",
    )
    add("--seeds", default="0,1", help="default: %(default)s")
    add("--size", type=int, default=40_000, help="budget of primitives (default: %(default)s), but for the curve")
    add("--iterations", type=int, default=30_000, help="default: %(default)s")
    add("--downscale", type=int, default=1, help="reduce photos by (default: %(default)s)")
    add("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the scenes")
    add("--out", type=Path, default=Path("quality.jsonl"), help="default: %(default)s")
    add("--jobs", type=int, default=1, help="trainings at once (default: %(default)s)")
    add("--pictures", type=Path, help="folder for photo, rendering and error of each test view")
    add("--models", type=Path, help="folder to keep the models in")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    given = make_parser().parse_args(arguments)
    return given.run(given)


if __name__ == "__main__":
    sys.exit(main())
