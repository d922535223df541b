"""The ways of training that the quality benchmark compares, and the trainings of each table."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nexwarp.data import Scene, load_scene
from nexwarp.data.scene import TEST_EVERY
from nexwarp.train.recipe import Config, preset, with_settings

SCENES = ("train", "fox", "saharov", "kitchen25")
SIZE, ITERATIONS = 40_000, 30_000  # of a training at full size
FOLDS = {"inner": 0} | {f"inner{first}": first for first in range(1, TEST_EVERY)}  # first held-out training view


@dataclass(frozen=True)
class Row:
    """One way of training, a row of the tables.

    Attributes:
        name: as the tables print it.
        preset: of nexwarp; None trains gsplat.
        settings: changes of the preset, by the names of `--set`; of gsplat those of `peer_gsplat.PeerSettings`.
    """

    name: str
    preset: str | None = "default"
    settings: dict[str, Any] = field(default_factory=dict)


DEFAULT, PAPER = Row("default"), Row("paper", "paper")
RAW = Row("raw", "default", {"exposures": False})  # as published tables are
# gsplat as its examples have it, and with what our default has and they lack.
_BACKGROUND = {"background": True}
_EXPOSED = _BACKGROUND | {"exposures": True}
RAW_PEER = Row("gsplat MCMC, raw", None, _BACKGROUND | {"even_start": True, "skybox": 100})
PEERS = (
    Row("gsplat MCMC", None),
    Row("gsplat MCMC, background", None, _BACKGROUND),
    RAW_PEER,
    Row("gsplat MCMC, exposures", None, _EXPOSED),
    Row("gsplat MCMC, even start", None, _EXPOSED | {"even_start": True}),
    Row("gsplat MCMC, skybox", None, _EXPOSED | {"even_start": True, "skybox": 100}),
    Row("gsplat default", None, _BACKGROUND | {"strategy": "default"}),
    Row("gsplat 2DGS", None, _BACKGROUND | {"strategy": "default", "primitive": "2dgs"}),
)
RAW_PEERS = tuple(row for row in PEERS if not row.settings.get("exposures"))
ROWS = {row.name: row for row in (DEFAULT, RAW, PAPER, *PEERS)}
TABLES: dict[str, tuple[tuple[Row, ...], tuple[int, ...]]] = {  # rows and budgets
    "peers": ((DEFAULT, *PEERS), (SIZE, SIZE // 4)),
    "raw": ((DEFAULT, RAW, *RAW_PEERS), (SIZE,)),
    "paper": ((PAPER,), (SIZE,)),
}


@dataclass(frozen=True)
class TrainingJob:
    """One training.

    Attributes:
        scene: folder below the data.
        variant: "" or one of `FOLDS`, whose validation views take the place of the test views.
        row: name of a `Row`.
        size: budget of primitives.
        seed: of all random choices.
        iterations: training steps.
        downscale: factor by which photos are reduced.
        images: folder of the photos, in the scene.
    """

    scene: str
    variant: str
    row: str
    size: int
    seed: int
    iterations: int
    downscale: int = 1
    images: str = "images"


def config_of(job: TrainingJob, row: Row) -> Config:
    """Return the settings of a training of nexwarp."""
    assert row.preset is not None
    config = with_settings(preset(row.preset), row.settings)
    return dataclasses.replace(config, max_surfels=job.size, seed=job.seed, iterations=job.iterations)


def scene_of(job: TrainingJob, data: Path) -> Scene:
    """Load the scene of a job from a folder of scenes."""
    scene = load_scene(data / job.scene, job.images, job.downscale)
    if not job.variant:
        return scene
    first = FOLDS[job.variant]
    train = [view for index, view in enumerate(scene.train) if index % TEST_EVERY != first]
    return dataclasses.replace(scene, train=train, test=scene.train[first::TEST_EVERY])
