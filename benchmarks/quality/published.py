"""The documents' tables of one default: which results they may hold, and the blocks of a page that they fill."""

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from benchmarks.quality.equal_seconds import BEST, SHORT
from benchmarks.quality.jobs import ITERATIONS, SIZE, TrainingJob, config_of
from benchmarks.quality.results import Results
from benchmarks.quality.rows import DEFAULT, PEERS, ROWS
from benchmarks.quality.run import trained_with

BLOCK = re.compile(r"(<!-- results: ([\w-]+) -->\n)(.*?)(<!-- end of results -->)", re.DOTALL)
PEER_NAMES = tuple(row.name for row in PEERS)


def of_one_default(
    files: Iterable[Results], commit: str | None = None, same: Collection[str] = (), older: bool = False
) -> Results:
    """Return the results that may stand in one table: those of known rows at full size, our presets' from one commit.

    gsplat and the paper's preset, which change less than the default, may have been trained at other commits; the
    tables name them.

    Args:
        files: results of each file; of one job in several files, the later one counts.
        commit: of the default's trainings; None takes the only one that there is.
        same: further commits with the same arithmetic of the default.
        older: the default had other settings than today's, which the page has to say.

    Raises:
        ValueError: the default's results are of several commits and none is named, there is none of the named commit,
            or one was trained with other settings than today's (`older`: than another one of its row and size).
    """
    full = [(job, x) for file in files for job, x in file.items() if job.row in ROWS and _at_full_size(job)]
    own = [(job, x) for job, x in full if _is_default(job)]
    commits = sorted({x["commit"] for _, x in own})
    if commit is None and len(commits) > 1:
        raise ValueError(f"--commit: expected one of {', '.join(commits)}: the default's results are not of one commit")
    allowed = {*same, *(commits if commit is None else [commit])}
    chosen = {job: x for job, x in own if x["commit"] in allowed}
    if commit is not None and not any(x["commit"] == commit for x in chosen.values()):
        raise ValueError(f"--commit: expected one of {', '.join(commits) or 'none'}, got {commit}")
    digests: dict[tuple[str, int], str | None] = {}
    for job, result in chosen.items():
        digest = result.get("config")
        alike = digest == digests.setdefault((job.row, job.size), digest)
        if not (alike if older else trained_with(result, config_of(job, ROWS[job.row]))):
            told = f"{job.scene} {job.row} {job.size} seed {job.seed} ({result['commit']})"
            raise ValueError(
                f"{told}: expected the settings of {'other trainings of the row' if older else 'today'}, got others"
            )
    return chosen | {job: x for job, x in full if not _is_default(job)}


def _at_full_size(job: TrainingJob) -> bool:
    return job.downscale == 1 and job.iterations == ITERATIONS and job.variant in ("", "near")


def _is_default(job: TrainingJob) -> bool:
    return ROWS[job.row].preset == DEFAULT.preset


def fill(page: str, blocks: Mapping[str, str]) -> str:
    """Return a page with its marked blocks replaced.

    A block stands between the lines `<!-- results: NAME -->` and `<!-- end of results -->`.

    Raises:
        ValueError: the page has no block, or one that is unknown.
    """
    names = [found[2] for found in BLOCK.finditer(page)]
    if unknown := [name for name in names if name not in blocks]:
        raise ValueError(f"results: expected blocks named {', '.join(blocks)}, got {', '.join(unknown)}")
    if not names:
        raise ValueError("expected a page with a line <!-- results: NAME -->, got none")
    return BLOCK.sub(lambda found: f"{found[1]}{blocks[found[2]]}\n{found[4]}", page)


def seeds_of(
    results: Results, scene: str, row: str, size: int, variant: str = "", part: str | None = None
) -> list[Mapping[str, float]]:
    """Return the results of a cell, one for each seed, by seed.

    Args:
        results: by job.
        scene: of the cell.
        row: of the cell.
        size: budget of primitives.
        variant: of the scene.
        part: "compact" takes the figures of the compact file.
    """
    found = {
        job.seed: x
        for job, x in results.items()
        if (job.scene, job.row, job.size, job.variant) == (scene, row, size, variant) and (part is None or part in x)
    }
    return [found[seed] if part is None else found[seed][part] for seed in sorted(found)]


def best_peer(results: Results, scene: str, size: int) -> tuple[str, list[Mapping[str, float]]] | None:
    """Return the gsplat row with the best mean PSNR, and its cell as of `seeds_of`; None where there is none."""
    cells = [(name, seeds_of(results, scene, name, size)) for name in PEER_NAMES]
    return max((pair for pair in cells if pair[1]), key=lambda pair: mean(pair[1], "psnr"), default=None)


def best_peer_file(results: Results, scene: str, megabytes: float) -> tuple[str, list[Mapping[str, float]]] | None:
    """Return the gsplat row and size, and its cell, with the best mean PSNR of compact files of at most a size."""
    sizes = sorted({job.size for job in results if job.row in PEER_NAMES})
    named = [
        (f"{name}, {n:,}", seeds_of(results, scene, name, n, part="compact")) for name in PEER_NAMES for n in sizes
    ]
    small = (pair for pair in named if pair[1] and mean(pair[1], "megabytes") <= megabytes)
    return max(small, key=lambda pair: mean(pair[1], "psnr"), default=None)


def equal_seconds(alone: Results, scene: str) -> tuple[Mapping[str, Any], TrainingJob, Mapping[str, Any]] | None:
    """Return the default's result of `benchmarks.quality.equal_seconds`, then the job and result of gsplat beside it.

    gsplat's training is the longest one of the scene's row on the same kind of GPU, the two short ones left out. None
    where one of the two is missing, or the default had other settings than today's.

    Args:
        alone: results of trainings that were alone on their GPU.
        scene: of the two.
    """
    at_size = {job: x for job, x in alone.items() if (job.scene, job.size, job.variant) == (scene, SIZE, "")}
    own = [x for job, x in at_size.items() if job.row == DEFAULT.name and of_today(job, x)]
    long = [job for job in at_size if job.row == BEST[scene] and job.iterations not in SHORT]
    peers = [job for job in long if own and at_size[job]["device"] == own[-1]["device"]]
    if not peers:
        return None
    longest = max(peers, key=lambda job: job.iterations)
    return own[-1], longest, at_size[longest]


def of_today(job: TrainingJob, result: Mapping[str, Any]) -> bool:
    """Whether a result of a known row was trained with today's settings; of gsplat's rows each is."""
    row = ROWS.get(job.row)
    return row is not None and (row.preset is None or trained_with(result, config_of(job, row)))


def mean(found: Collection[Mapping[str, float]], metric: str) -> float:
    """Return the mean over seeds."""
    return sum(x[metric] for x in found) / len(found)
