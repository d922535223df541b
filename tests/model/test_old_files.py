"""Files of every past form of the formats: they load, render as they did, and serve every command.

`tests/data/inputs/old_files/README.md` says which version wrote each run, and how.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cli import main as cli
from nexwarp.run.folder import read_metrics, read_run
from tests.cli.support import refused
from tests.tolerances import assert_close

OLD = Path(__file__).parents[1] / "old_files"
SCENE = OLD / "scene"
RUNS = sorted(path.name for path in OLD.iterdir() if (path / "config.json").is_file())
# An hour's development version: its exposures lack what today's predict from.
UNREADABLE = {"0.1-d-9cd22ab": "exposures: expected coefficients, found none"}
# Only the version that wrote a checkpoint is promised to read it; these are refused.
NOT_RESUMED = {
    "0.1-a-ef9e8f4": "expected a whole checkpoint, but it cannot be read (expected format version 1, got None)",
    "0.1-b-097af4e": "expected a checkpoint of this run, but it does not fit (it has seen other training views",
    "0.1-c-6233b1b": "expected a whole checkpoint, but it cannot be read (expected format version 1, got None)",
    "0.1-d-9cd22ab": "expected a checkpoint of this run, but it does not fit (it has no 'rng.noise')",
    "0.1-e-cf5b37f": "expected a checkpoint of this run, but it does not fit (it has no 'rng.noise')",
}


# By default the commands are tried on the first run, one that is refused, and the last of each version.
OFTEN = (RUNS[0], *UNREADABLE, *RUNS[-2:])
EVERY_RUN = pytest.mark.parametrize(
    "run", [name if name in OFTEN else pytest.param(name, marks=pytest.mark.slow) for name in RUNS], indirect=True
)


@pytest.fixture(params=RUNS)
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of an old run."""
    return Path(shutil.copytree(OLD / request.param, tmp_path / request.param))


def rendered(run: Path) -> torch.Tensor:
    """Render the first test view."""
    camera = next(iter(load_cameras(run)["test"].values()))
    with torch.no_grad():
        return nw.load(run).render(camera).image


def test_there_are_runs_of_every_past_form() -> None:
    assert len(RUNS) == 8 and UNREADABLE.keys() | NOT_RESUMED.keys() <= set(RUNS)
    assert sum(file.stat().st_size for file in OLD.rglob("*") if file.is_file()) < 700_000


def test_old_models_render_the_picture_stored_with_them(run: Path) -> None:
    if run.name in UNREADABLE:
        with pytest.raises(ValueError, match=UNREADABLE[run.name]):
            nw.load(run)
        return
    expected = torch.from_numpy(np.load(run / "picture.npy"))
    assert expected.std() > 0.01
    assert_close(rendered(run), expected, kind="value", name=run.name)


@pytest.mark.filterwarnings("default:.*the scene cannot be read")
@EVERY_RUN
def test_old_runs_serve_every_command(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert read_run(run).config.max_surfels == 24
    before = read_metrics(run)
    assert before == json.loads((run / "metrics.json").read_text())
    assert cli.main(["export", str(run), "--format", "cameras"]) == 0
    others = [["info", str(run)], ["eval", str(run), "--scene", str(SCENE), "--device", "cpu"]]
    others += [["render", str(run), "--set", "test", "--device", "cpu"], ["export", str(run), "--no-finetune"]]
    for arguments in others:
        if run.name in UNREADABLE:
            refused(capsys, arguments, UNREADABLE[run.name])
        else:
            assert cli.main(arguments) == 0
    after = read_metrics(run)
    assert after["psnr"] == pytest.approx(before["psnr"], abs=0.01) and after["surfels"] == before["surfels"]


@EVERY_RUN
def test_old_runs_resume_or_are_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", str(SCENE), "--run", str(run), "--resume", "--device", "cpu"]
    if run.name in NOT_RESUMED:
        refused(capsys, arguments, NOT_RESUMED[run.name])
        return
    assert cli.main(arguments) == 0
    assert "resumed at iteration 5" in capsys.readouterr().out
    assert nw.load(run).meta["iteration"] == 6
    assert rendered(run).isfinite().all()
