"""The ways of training that the quality benchmark compares; the names are those in kept results."""

from dataclasses import dataclass, field
from typing import Any

from nexwarp.train.presets import DEMO_SETTINGS, preset
from nexwarp.train.settings import with_settings

GSPLAT = "gsplat MCMC"


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


PAPER = Row("paper", "paper")
DEFAULT = Row("default")
# gsplat as its examples have it, and with what our default has and they lack.
PEER = Row(GSPLAT, None)
_BACKGROUND = {"background": True}
_EXPOSED = _BACKGROUND | {"exposures": True}
PEERS = (
    PEER,
    Row("gsplat MCMC, background", None, _BACKGROUND),
    Row("gsplat MCMC, exposures", None, _EXPOSED),
    Row("gsplat MCMC, even start", None, _EXPOSED | {"even_start": True}),
    Row("gsplat MCMC, skybox", None, _EXPOSED | {"even_start": True, "skybox": preset("default").skybox}),
    Row("gsplat default", None, _BACKGROUND | {"strategy": "default"}),
    Row("gsplat 2DGS", None, _BACKGROUND | {"strategy": "default", "primitive": "2dgs"}),
)
# Compact files of 5 and 10 MB (10^6 bytes): 77 bytes a surfel and one a number of the grid; 73 bytes a Gaussian.
MEGABYTES = (
    (Row("5 MB", settings={"texture.table_size": 2**16}), 37_000),
    (Row("10 MB", settings={"texture.table_size": 2**17}), 74_900),
    *((row, size) for row in PEERS[2:5] for size in (68_400, 136_900)),
)
NO_TEXTURE = Row("no texture", settings={"max_hits": 0})  # K = 0
# The ablations of the paper.
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
    Row("no depth loss", settings={"losses.depth": 0.0}),
    Row("black background", settings={"background": [0.0, 0.0, 0.0]}),
    Row("no filter of points", settings={"filter_points": False}),
    Row("random rotations", settings={"orient_points": False}),
    Row("no skybox", settings={"skybox": 0}),
    Row("no pruning at the cap", settings={"densify.prune_at_cap": False}),
    Row("no depth jitter", settings={"depth_jitter": 0.0}),
    Row("paper's table", settings={"texture.table_size": 2**20}),
    Row("16 levels of 2 features", settings={"texture.levels": 16, "texture.features": 2}),
    Row("paper's resolutions", settings={"texture.min_resolution": 16.0, "texture.max_resolution": 256.0}),
)
# What may set the paper's preset apart from the publication on captures with few pixels.
SUSPECTS = (
    Row("paper, K = 0", "paper", {"max_hits": 0}),
    *(Row(f"paper, T = 2^{power}", "paper", {"texture.table_size": 2**power}) for power in (16, 18)),
    Row("paper, residual texture", "paper", {"texture.residual": True}),
)
# `nexwarp train demo`, and the paper's preset with a run as short: with the demo's rates, without our additions.
DEMO_CONFIG = with_settings(preset("default"), DEMO_SETTINGS)
_SHORT = {name: value for name, value in DEMO_SETTINGS.items() if name not in ("iterations", "max_surfels")}
_AS_PAPER = {"depth_jitter": 0.0, "rates.mlp": (DEMO_CONFIG.rates.mlp[0],) * 2}
DEMOS = (Row("demo", settings=_SHORT), Row("demo of the paper", "paper", _SHORT | _AS_PAPER))
ROWS = {
    row.name: row
    for row in (DEFAULT, PAPER, *PEERS, *REMOVALS, *HITS, *CHANGES, *SUSPECTS, *DEMOS, *(row for row, _ in MEGABYTES))
}
