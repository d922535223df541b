"""The trainings that each table of the quality benchmark is made of, and which of them share their first iterations."""

import dataclasses
import json
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from benchmarks.quality.rows import (
    CHANGES,
    DEFAULT,
    DEMO_CONFIG,
    DEMOS,
    HITS,
    MEGABYTES,
    NO_TEXTURE,
    PAPER,
    PEER,
    PEERS,
    REMOVALS,
    SUSPECTS,
    Row,
)
from nexwarp.data.scene import TEST_EVERY
from nexwarp.train.config import Config
from nexwarp.train.presets import preset
from nexwarp.train.settings import with_settings
from nexwarp.train.stages import teacher_count

SCENES = ("train", "fox", "saharov", "kitchen25")
# Number of photos, to know without them whether a run has teachers.
PHOTOS = {"train": 301, "fox": 50, "saharov": 32, "kitchen25": 25}
ARC_VIEWS = 8  # held out by the variant "arc"
# Variants with the validation views of "inner" that train on every 2nd, 3rd or 5th of its training photos.
THINNED = {"half": 2, "third": 3, "fifth": 5}
DEMO = "demo"  # the built-in scene
TABLES = (
    "peers",
    "megabytes",
    "sizes",
    "curve",
    "paper",
    "ablation",
    "hits",
    "changes",
    "suspects",
    "arc",
    "frames",
    "demo",
)
SIZE, ITERATIONS = 40_000, 30_000  # of a training at full size
CURVE = (5_000, 10_000, 20_000, 40_000, 100_000)


@dataclass(frozen=True)
class TrainingJob:
    """One training.

    Attributes:
        scene: folder below the data, or `DEMO`.
        variant: "" or one of `benchmarks.quality.scenes.VARIANTS`.
        row: name of a `Row`.
        size: budget of primitives.
        seed: of all random choices.
        iterations: training steps.
        downscale: factor by which photos are reduced.
    """

    scene: str
    variant: str
    row: str
    size: int
    seed: int
    iterations: int
    downscale: int = 1


@dataclass(frozen=True)
class JobGroup:
    """Jobs whose first iterations are the same.

    Attributes:
        jobs: one job or more.
        iterations: how many iterations they share; 0 for a single job.
    """

    jobs: tuple[TrainingJob, ...]
    iterations: int


def table_jobs(
    table: str, scenes: Iterable[str], seeds: Iterable[int], iterations: int, size: int
) -> Iterator[TrainingJob]:
    """Yield the jobs of a table.

    Args:
        table: one of `TABLES`.
        scenes: names of scenes; `curve`, `arc` and `frames` are of fox alone, `demo` of the built-in scene.
        seeds: of each row.
        iterations: of each training; `demo` has its own.
        size: budget of primitives; `megabytes`, `sizes`, `curve` and `demo` have their own.

    Raises:
        ValueError: `table` is unknown.
    """
    rows: tuple[Row, ...] = ()
    sizes: tuple[int, ...] = (size,)
    variants: tuple[str, ...] = ("",)
    if table == "peers":
        rows, sizes = (DEFAULT, *PEERS), (size, size // 4)
    elif table == "sizes":
        rows, sizes = (DEFAULT,), CURVE
    elif table == "curve":
        rows, sizes, scenes = (DEFAULT, PEER), CURVE, ("fox",)
    elif table == "paper":
        rows = (DEFAULT, PAPER)
    elif table == "ablation":
        rows = (DEFAULT, *REMOVALS)
    elif table == "hits":
        rows = (DEFAULT, NO_TEXTURE, *HITS)
    elif table == "changes":
        rows = (DEFAULT, *CHANGES)
    elif table == "suspects":
        rows = (PAPER, *SUSPECTS)
    elif table == "arc":
        rows, variants, scenes = (DEFAULT, PAPER), ("arc",), ("fox",)
    elif table == "frames":
        rows, variants, scenes = (DEFAULT,), ("", "x100", "moved"), ("fox",)
    elif table == "demo":
        rows, variants, scenes = DEMOS, ("arc",), (DEMO,)
        sizes, iterations = (DEMO_CONFIG.max_surfels,), DEMO_CONFIG.iterations
    elif table != "megabytes":
        raise ValueError(f"--tables: expected some of {', '.join(TABLES)}, got {table}")
    seeds = tuple(seeds)
    sized = MEGABYTES if table == "megabytes" else [(row, count) for count in sizes for row in rows]
    for scene in scenes:
        for row, count in sized:
            for variant in variants:
                for seed in seeds:
                    yield TrainingJob(scene, variant, row.name, count, seed, iterations)


def config_of(job: TrainingJob, row: Row) -> Config:
    """Return the settings of a training of nexwarp; `row.preset` must not be None.

    The number of teachers is that of the scene; of a scene that is not one of `PHOTOS` the run decides.
    """
    assert row.preset is not None
    config = with_settings(preset(row.preset), row.settings)
    config = dataclasses.replace(config, max_surfels=job.size, seed=job.seed, iterations=job.iterations)
    photos = training_photos(job)
    return config if photos is None else dataclasses.replace(config, teachers=teacher_count(config, photos))


def training_photos(job: TrainingJob) -> int | None:
    """Return how many photos a training has; None where the scene is not one of `PHOTOS`."""
    if (photos := PHOTOS.get(job.scene)) is None:
        return None
    if job.variant == "arc":
        return photos - ARC_VIEWS
    train = photos - len(range(0, photos, TEST_EVERY))
    fold, every = ("inner", THINNED[job.variant]) if job.variant in THINNED else (job.variant, 1)
    if not fold.startswith("inner"):
        return train
    left = train - len(range(int(fold.removeprefix("inner") or 0), train, TEST_EVERY))
    return len(range(0, left, every))


def group_jobs(jobs: Iterable[TrainingJob], rows: Mapping[str, Row]) -> list[JobGroup]:
    """Group jobs that share their first iterations, in the order of each group's first job.

    They share them where their settings differ only in K (2 or more) or in how a model is finished. Other jobs come
    alone.

    Args:
        jobs: different ones.
        rows: rows by name.
    """
    groups: dict[Hashable, tuple[list[TrainingJob], int]] = {}
    for job in jobs:
        key, shared = _shared_start(job, rows[job.row])
        groups.setdefault(key, ([], shared))[0].append(job)
    return [JobGroup(tuple(found), shared if len(found) > 1 else 0) for found, shared in groups.values()]


def _shared_start(job: TrainingJob, row: Row) -> tuple[Hashable, int]:
    """Return a key that is equal for jobs with the same first iterations, and how many those are."""
    if row.preset is None:
        return job, 0
    config = config_of(job, row)
    shared = min(config.settled - 1, job.iterations)
    # Stages share no first iterations. Of an unknown scene a single photo is assumed, which leads to teachers soonest.
    if shared <= 0 or teacher_count(config, 1) > 0:
        return job, 0
    alike = dataclasses.replace(
        config,
        max_hits=min(config.max_hits, 2),
        footprints=False,
        smooth_sh=0.0,
    )
    return (dataclasses.replace(job, row=""), json.dumps(alike.as_dict())), shared
