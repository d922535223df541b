"""What the quality benchmark trains: scenes, ways of training, and the tables that are made of them."""

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from nexwarp.train.config import Config
from nexwarp.train.presets import DEMO_SETTINGS, preset
from nexwarp.train.settings import with_settings

SCENES = ("fox", "saharov", "kitchen25")
DEMO = "demo"  # the built-in scene, for who has no others
GSPLAT = "gsplat MCMC"


@dataclass(frozen=True)
class Row:
    """One way of training.

    Attributes:
        name: as the tables print it.
        preset: of nexwarp, or None for gsplat.
        settings: what differs from the preset.
    """

    name: str
    preset: str | None = "default"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        scene: folder below the data.
        variant: "" or one of `VARIANTS`.
        row: name of a `Row`.
        size: budget of primitives.
        seed: of all random choices.
        iterations: training steps.
        downscale: photos are reduced by this factor, for a machine without a GPU.
    """

    scene: str
    variant: str
    row: str
    size: int
    seed: int
    iterations: int
    downscale: int = 1


PAPER = Row("paper", "paper")
DEFAULT = Row("default")
PEER = Row(GSPLAT, None)
NO_TEXTURE = Row("no texture", settings={"max_hits": 0})  # K = 0
# The paper's ablation (its Sec. "Ablations").
REMOVALS = (
    NO_TEXTURE,
    Row("no gamma", settings={"rates.gammas": 0.0}),
    Row("no higher SH of surfels", settings={"sh_degree": 0, "texture.sh_degree": 3}),
    Row("no down-weighting", settings={"texture.down_weighting": False}),
)
HITS = (
    *(Row(f"K = {k}", settings={"max_hits": k}) for k in (1, 3, 4)),
    Row("K = 4 from the start", settings={"max_hits": 4, "more_hits_from": 0}),
)
# Each undoes one change of the default preset against the paper.
CHANGES = (
    Row("replacing texture", settings={"texture.residual": False}),
    Row("no footprints", settings={"footprints": False}),
    Row("no SH smoothing", settings={"smooth_sh": 0.0}),
    Row("no exposures", settings={"exposures": False}),
    Row("no metering", settings={"metering": False}),
    Row("no vignetting", settings={"vignetting": False}),
    Row("no border steps", settings={"border": 0.0}),
    Row("no depth loss", settings={"losses.depth": 0.0}),
    Row("black background", settings={"background": [0.0, 0.0, 0.0]}),
    Row("constant MLP rate", settings={"rates.mlp": [1e-3, 1e-3]}),
    Row("no filter of points", settings={"filter_points": False}),
    Row("random rotations", settings={"orient_points": False}),
    Row("clamped image", settings={"clamp_image": True}),
    Row("no pruning at the cap", settings={"densify.prune_at_cap": False}),
    Row("floaters left", settings={"densify.floaters": False}),
    Row("no depth jitter", settings={"depth_jitter": 0.0}),
    Row("paper's table", settings={"texture.table_size": 2**20}),
    Row("16 levels of 2 features", settings={"texture.levels": 16, "texture.features": 2}),
    Row("paper's resolutions", settings={"texture.min_resolution": 16.0, "texture.max_resolution": 256.0}),
)
# `nexwarp train demo`, and the paper with a run as short: with its rates, but without what the paper has not.
_SHORT = {name: value for name, value in DEMO_SETTINGS.items() if name not in ("iterations", "max_surfels")}
_AS_PAPER = {"depth_jitter": 0.0, "coarse": 0.0, "rates.mlp": (DEMO_SETTINGS["rates.mlp"][0],) * 2}
DEMOS = (Row("demo", settings=_SHORT), Row("demo of the paper", "paper", _SHORT | _AS_PAPER))
ROWS = {row.name: row for row in (DEFAULT, PAPER, PEER, *REMOVALS, *HITS, *CHANGES, *DEMOS)}
TABLES = ("peers", "curve", "paper", "ablation", "hits", "changes", "arc", "frames", "demo")
CURVE = (5_000, 10_000, 20_000, 40_000, 100_000)


def jobs_of(table: str, scenes: Iterable[str], seeds: Iterable[int], iterations: int, size: int) -> Iterator[Job]:
    """Yield the trainings that a table is made of."""
    seeds = tuple(seeds)

    def each(rows: Iterable[Row], sizes: Iterable[int], variants: Iterable[str] = ("",), of: Iterable[str] = ()):
        for scene in of or scenes:
            for count in sizes:
                for variant in variants:
                    for row in rows:
                        for seed in seeds:
                            yield Job(scene, variant, row.name, count, seed, iterations)

    if table == "peers":
        yield from each((DEFAULT, PEER), (size, size // 4))
    elif table == "curve":
        yield from each((DEFAULT, PEER), CURVE, of=("fox",))
    elif table == "paper":
        yield from each((DEFAULT, PAPER), (size,))
    elif table == "ablation":
        yield from each((DEFAULT, *REMOVALS), (size,))
    elif table == "hits":
        yield from each((DEFAULT, NO_TEXTURE, *HITS), (size,))
    elif table == "changes":
        yield from each((DEFAULT, *CHANGES), (size,))
    elif table == "arc":
        yield from each((DEFAULT, PAPER), (size,), ("arc",), of=("fox",))
    elif table == "frames":
        yield from each((DEFAULT,), (size,), ("", "x100", "moved"), of=("fox",))
    elif table == "demo":
        iterations = DEMO_SETTINGS["iterations"]
        yield from each(DEMOS, (DEMO_SETTINGS["max_surfels"],), ("arc",), of=(DEMO,))
    else:
        raise ValueError(f"--tables: expected some of {', '.join(TABLES)}, got {table}")


def config_of(job: Job, row: Row) -> Config:
    """Return the settings of a training of nexwarp."""
    config = with_settings(preset(row.preset), row.settings)
    return dataclasses.replace(config, max_surfels=job.size, seed=job.seed, iterations=job.iterations)


def together(jobs: Iterable[Job], rows: Mapping[str, Row]) -> list[tuple[list[Job], int]]:
    """Trainings that begin as one, because what differs does not count at first; and for how many iterations.

    That is K, where it is 2 or more, whether floaters are removed, and what only a finished model has. Those that begin
    alone come alone, with 0. All are in the order of their first.
    """
    groups: dict[Any, tuple[list[Job], int]] = {}
    for job in jobs:
        key, alike = (job, ""), 0
        if rows[job.row].preset is not None:
            config = config_of(job, rows[job.row])
            looked = config.scaled(config.densify.stop)  # for floaters, from there on
            alike = min(config.settled - 1, looked - 1, job.iterations)
            if alike > 0:
                densify = dataclasses.replace(config.densify, floaters=False)
                finished = {"metering": False, "footprints": False, "smooth_sh": 0.0}
                begun = dataclasses.replace(config, max_hits=min(config.max_hits, 2), densify=densify, **finished)
                key = (dataclasses.replace(job, row=""), json.dumps(begun.as_dict()))
        groups.setdefault(key, ([], alike))[0].append(job)
    return [(found, alike if len(found) > 1 else 0) for found, alike in groups.values()]
