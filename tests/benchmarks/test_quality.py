"""The quality benchmark: its scenes, its rows and jobs, and its trainings from end to end."""

import dataclasses
import json
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from benchmarks.peer_gsplat import Gaussians, PeerSettings
from benchmarks.quality.__main__ import main
from benchmarks.quality.jobs import ARC_VIEWS, TABLES, THINNED, JobGroup, TrainingJob, group_jobs, table_jobs
from benchmarks.quality.results import read_results
from benchmarks.quality.rows import GSPLAT, MEGABYTES, PEERS, ROWS, Row
from benchmarks.quality.run import config_name, file_name, run_job
from benchmarks.quality.scenes import (
    VARIANTS,
    held_out_arc,
    inner_validation,
    moved,
    of_training_views,
    with_near,
)
from benchmarks.timing import ROOT
from nexwarp.data import Scene, View
from nexwarp.data.demo import write_demo
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import METRICS as METRIC_FUNCTIONS
from nexwarp.run.metrics import psnr
from nexwarp.train.config import Config, TextureConfig
from nexwarp.train.presets import preset
from nexwarp.train.settings import with_settings
from nexwarp.train.trainer import Trainer
from tests.narrowing import present
from tests.tolerances import assert_close


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes")
    write_demo(path / "tiny", width=48, height=36, views=12, points=200)
    return path


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return nw.load_scene(folder / "tiny")


def test_every_row_is_a_setting() -> None:
    for row in ROWS.values():
        if row.preset is not None:
            config = with_settings(preset(row.preset), row.settings)
            assert (config != preset(row.preset)) == bool(row.settings), row.name


@pytest.mark.parametrize("table", TABLES)
def test_tables_are_made_of_known_rows(table: str) -> None:
    jobs = list(table_jobs(table, ("fox", "saharov"), (0, 1), 100, 40))
    assert len(jobs) == len(set(jobs)) > 0
    assert all(job.row in ROWS and job.iterations == (1200 if table == "demo" else 100) for job in jobs)
    assert {job.seed for job in jobs} == {0, 1}
    assert all(job.variant in ("", *VARIANTS) for job in jobs)


def test_a_held_out_arc_is_of_neighbours(scene: Scene) -> None:
    names = sorted(view.name for view in (*scene.train, *scene.test))
    part = held_out_arc(scene)
    held = [view.name for view in part.test]
    start = names.index(held[0])
    assert held == names[start : start + ARC_VIEWS]
    assert sorted(view.name for view in part.train) == [name for name in names if name not in held]


def test_moved_scenes_look_the_same(scene: Scene) -> None:
    """Every point falls on the same pixel, its depth scaled."""
    other = moved(scene, factor=100.0, shift=(30.0, -20.0, 10.0))
    assert other.scale == pytest.approx(100 * scene.scale)
    for one, two in zip(scene.train, other.train, strict=True):
        pixels, depths = one.camera.project(scene.points.double().to(one.camera.K.dtype))
        again, scaled = two.camera.project(other.points)
        assert (pixels - again).abs().max() < 0.01
        assert_close(scaled / 100, depths, kind="gradient", name="depths")
        assert two.camera.near == pytest.approx(100 * one.camera.near)
        assert one.points is not None and two.points is not None
        seen, _ = two.camera.project(two.points)
        assert (seen - one.camera.project(one.points)[0]).abs().max() < 0.01


def test_a_training_is_done_once(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    settings = {"texture.levels": 4, "texture.table_size": 1024}
    command = ["train", "--row", f"mine:default:{json.dumps(settings)}", "--scenes", "tiny", "--seeds", "0"]
    command += ["--size", "60", "--iterations", "4", "--data", str(folder), "--out", str(tmp_path / "out.jsonl")]
    command += ["--pictures", str(tmp_path / "pictures"), "--models", str(tmp_path / "models"), "--downscale", "2"]
    assert main(command) == 0
    (line,) = (tmp_path / "out.jsonl").read_text().splitlines()
    found = json.loads(line)
    assert (found["scene"], found["row"], found["settings"], found["downscale"]) == ("tiny", "mine", settings, 2)
    assert set(found["views"]) == {view.name for view in nw.load_scene(folder / "tiny").test}
    mean = sum(view["psnr"] for view in found["views"].values()) / len(found["views"])
    assert found["psnr"] == pytest.approx(mean) and found["primitives"] <= 60 and found["flip"] > 0
    assert found["config"] != config_name(preset("default"))
    assert len(list((tmp_path / "pictures").iterdir())) == len(found["views"])
    (model,) = (tmp_path / "models").glob("*/model.safetensors")
    assert found["megabytes"] == pytest.approx(model.stat().st_size / 1e6)
    trained = nw.load(model)
    assert trained.texture is not None and trained.texture.residual
    assert found["quarter_psnr"] == pytest.approx(quarter_psnr(trained, folder / "tiny"), abs=0.05)
    assert main(command) == 0
    assert "0 of 1 trainings to do" in capsys.readouterr().out
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 1
    with (tmp_path / "out.jsonl").open("a") as file:
        file.write('{"scene": "ti')  # killed
    assert main(command) == 0
    assert "out.jsonl: its last line was unfinished and is cut off\n0 of 1" in capsys.readouterr().out
    changed = [word.replace("1024", "2048") for word in command]
    expected = r"out\.jsonl: expected tiny mine 60 seed 0 with the settings of today, got others \(.*\): give another"
    with pytest.raises(ValueError, match=expected):
        main(changed)
    with pytest.raises(ValueError, match="--row: expected a name that no other row has, got no gamma"):
        main([word.replace("mine:", "no gamma:") for word in command])
    assert main(["table", str(tmp_path / "out.jsonl"), "--out", str(tmp_path / "table.md")]) == 0
    text = (tmp_path / "table.md").read_text()
    assert "| mine |" in text and "## tiny, photos reduced by 2, 60 primitives, 4 iterations" in text
    torch.set_num_threads(threads)


def quarter_psnr(model: nw.Model, folder: Path) -> float:
    """Of the test views at an eighth of the photos' size, from the model's file, whose numbers are halves."""
    figures = []
    for view in nw.load_scene(folder, downscale=8).test:
        out = model.render(view.camera)
        figures.append(psnr(to_uint8(out.image), view.image))
    return sum(figures) / len(figures)


def test_rows_that_differ_late_share_their_first_iterations() -> None:
    """Until K takes effect, 25,000 of 30,000 iterations; other rows train alone."""
    jobs = list(table_jobs("hits", ("fox", "car"), (0, 1), 30_000, 40))
    groups = group_jobs(jobs, ROWS)
    assert sorted(map(str, jobs)) == sorted(str(job) for group in groups for job in group.jobs)
    several = [group for group in groups if len(group.jobs) > 1]
    assert [[job.row for job in group.jobs] for group in several] == [["default", "K = 3", "K = 4"]] * 4
    assert {(group.jobs[0].scene, group.jobs[0].seed) for group in several} == {
        (scene, seed) for scene in ("fox", "car") for seed in (0, 1)
    }
    assert all(len({(job.scene, job.seed) for job in group.jobs}) == 1 for group in several)
    assert [group.iterations for group in several] == [24_999] * 4
    assert all(group.iterations == 0 for group in groups if len(group.jobs) == 1)
    peers = [TrainingJob("fox", "", GSPLAT, 40, 0, 100), TrainingJob("fox", "", "paper", 40, 0, 100)]
    assert group_jobs(peers, ROWS) == [JobGroup((job,), 0) for job in peers]


def test_rows_of_finishing_share_their_first_iterations() -> None:
    jobs = list(table_jobs("changes", ("fox",), (0,), 300, 40))
    shared = {tuple(job.row for job in g.jobs): g.iterations for g in group_jobs(jobs, ROWS) if g.iterations}
    finished = ("no footprints", "no SH smoothing")
    assert shared == {("default", *finished): 249}


def test_rows_without_texture_share_their_own() -> None:
    job = TrainingJob("fox", "", "default", 40, 0, 300)
    few: dict[str, dict[str, float]] = {
        "none": {"max_hits": 0},
        "none, rough": {"max_hits": 0, "smooth_sh": 0.0},
        "one": {"max_hits": 1},
    }
    rows = {name: Row(name, settings=settings) for name, settings in few.items()}
    groups = group_jobs([dataclasses.replace(job, row=name) for name in rows], rows)
    assert [([job.row for job in group.jobs], group.iterations) for group in groups] == [
        (["none", "none, rough"], 249),
        (["one"], 0),
    ]
    four = Row("four", "paper", {"max_hits": 4})  # which takes effect from the start there
    rows = {"paper": ROWS["paper"], "four": four}
    jobs = [dataclasses.replace(job, row=row, iterations=100) for row in rows]
    assert group_jobs(jobs, rows) == [JobGroup((job,), 0) for job in jobs]


def test_a_training_from_a_shared_start_is_the_training(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit: its surfels, its texture and its figures."""
    monkeypatch.setitem(METRIC_FUNCTIONS, "lpips", lambda *_: None)  # it warns where its weights are not
    threads = torch.get_num_threads()
    out, models = tmp_path / "out.jsonl", tmp_path / "models"
    small = {"texture.levels": 4, "texture.table_size": 1024}
    differ: dict[str, dict[str, float]] = {"2 hits": {}, "3 hits": {"max_hits": 3}, "rough": {"smooth_sh": 0.0}}
    rows = {name: settings | small for name, settings in differ.items()}
    command = ["train", "--scenes", "tiny", "--seeds", "1", "--size", "60", "--iterations", "12", "--data", str(folder)]
    command += ["--out", str(out), "--models", str(models)]
    for name, settings in rows.items():
        command += ["--row", f"{name}:default:{json.dumps(settings)}"]
    assert main(command) == 0
    found = read_results([out])
    assert {job.row for job in found} == set(rows)
    textures = []
    for job, result in found.items():
        assert result["together"] == {"rows": [*rows], "iterations": 9}
        compact = result["compact"]
        assert compact["views"].keys() == result["views"].keys()
        assert statistics.fmean(compact["views"].values()) == pytest.approx(compact["psnr"])
        row = Row(job.row, settings=rows[job.row])
        alone = run_job(job, folder, row, models=tmp_path / "alone")
        assert alone["views"] == result["views"] and "together" not in alone
        one, other = (nw.load(path / file_name(job)) for path in (models, tmp_path / "alone"))
        assert one.meta == other.meta and one.options.max_hits == rows[job.row].get("max_hits", 2)
        assert one.texture is not None and other.texture is not None
        for part, same in zip((one.surfels, one.texture), (other.surfels, other.texture), strict=True):
            state = same.state_dict()
            assert all(torch.equal(tensor, state[name]) for name, tensor in part.state_dict().items())
        textures.append(one.texture.grid)
    assert not torch.equal(*textures[:2])
    torch.set_num_threads(threads)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_benchmark_takes_its_workers_along(folder: Path, tmp_path: Path, how: signal.Signals) -> None:
    command = [sys.executable, "-m", "benchmarks.quality", "train", "--row", "mine:default:{}", "--scenes", "tiny"]
    command += ["--seeds", "0,1", "--size", "60", "--iterations", "1000000", "--data", str(folder)]
    command += ["--out", str(tmp_path / "out.jsonl")]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"2 of 2 trainings to do\n"
        time.sleep(3)
        process.send_signal(how)  # to this process alone
        try:
            said = process.communicate(timeout=60)[1].decode()  # ends when the last that could write has
        finally:
            process.kill()
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert ("interrupted: the same command does what is missing" in said) == (how == signal.SIGINT)
    assert not (tmp_path / "out.jsonl").exists()


def test_near_planes_are_moved_alone(scene: Scene) -> None:
    other = with_near(scene, near=0.5)
    for one, two in zip((*scene.train, *scene.test), (*other.train, *other.test), strict=True):
        assert two.camera.near == 0.5 and torch.equal(one.camera.viewmat, two.camera.viewmat)
    assert torch.equal(scene.points, other.points)


def test_validation_views_are_training_views(scene: Scene) -> None:
    part = inner_validation(scene)
    names = [view.name for view in scene.train]
    assert [view.name for view in part.test] == names[::8]
    folds = [VARIANTS[name](scene) for name in ("inner", *(f"inner{first}" for first in range(1, 8)))]
    for fold in folds:
        assert sorted(view.name for view in (*fold.test, *fold.train)) == names
    assert sorted(view.name for fold in folds for view in fold.test) == names


def test_thinned_scenes_have_the_same_validation_views(scene: Scene) -> None:
    """They train on every k-th of the others, and start from what these show."""
    whole = inner_validation(scene)
    for name, every in THINNED.items():
        part = VARIANTS[name](scene)
        assert [view.name for view in part.test] == [view.name for view in whole.test]
        assert [view.name for view in part.train] == [view.name for view in whole.train][::every]
        shown = {tuple(point) for view in part.train for point in present(view.points).tolist()}
        assert {tuple(point) for point in part.points.tolist()} <= shown


def test_an_arc_starts_from_what_its_training_views_show(scene: Scene) -> None:
    """Points of held-out photos alone are dropped; the others' colours hold nothing of a held-out photo."""
    part = held_out_arc(scene)
    shown = {tuple(point) for view in part.train for point in present(view.points).tolist()}
    assert 0 < len(part.points) <= len(scene.points)
    assert {tuple(point) for point in part.points.tolist()} <= shown
    assert len(part.colors) == len(part.track_lengths) == len(part.reprojection_errors) == len(part.points)
    held_out = {view.name for view in part.test}

    def darkened(views: list[View]) -> list[View]:
        return [dataclasses.replace(v, image=v.image * 0) if v.name in held_out else v for v in views]

    dark = dataclasses.replace(
        scene, train=darkened(scene.train), test=darkened(scene.test), colors=torch.zeros_like(scene.colors)
    )
    assert torch.equal(held_out_arc(dark).colors, part.colors)
    here = {tuple(place): color for place, color in zip(scene.points.tolist(), scene.colors.tolist(), strict=True)}
    before = torch.tensor([here[tuple(place)] for place in part.points.tolist()])
    assert (part.colors.float() - before).abs().median() < 16
    without = dataclasses.replace(scene, train=[dataclasses.replace(view, points=None) for view in scene.train])
    assert of_training_views(without) is without


def test_files_of_a_budget_have_its_size(scene: Scene, tmp_path: Path) -> None:
    """Compact files of the table by megabytes: as many bytes as its primitives, its grid and its MLP take."""
    model = Trainer(scene, Config(max_surfels=100, texture=TextureConfig(table_size=2**12)), "cpu").finish()
    coded = 77 * len(model.surfels) + present(model.texture).grid.numel()
    known = model.save(tmp_path, compact=True).stat().st_size - coded
    for row, count in MEGABYTES:
        budget = {37_000: 5, 68_400: 5, 74_900: 10, 136_900: 10}[count] * 10**6
        if row.preset is None:
            size = 73 * count
        else:
            texture = with_settings(preset("default"), row.settings).texture
            size = 77 * count + texture.levels * texture.features * present(texture.table_size) + known
        assert 0.99 * budget < size <= budget, (row.name, size)


def test_settings_of_the_peers_are_checked() -> None:
    for row in PEERS:
        PeerSettings(**row.settings)
    with pytest.raises(ValueError, match="strategy: expected default for 2dgs, got mcmc"):
        PeerSettings(primitive="2dgs")
    with pytest.raises(ValueError, match="primitive: expected one of 3dgs, 2dgs, got '4dgs'"):
        PeerSettings(primitive="4dgs")
    with pytest.raises(ValueError, match="sh_degree: expected at least 0 and at most 4, got 5"):
        PeerSettings(sh_degree=5)


@pytest.mark.parametrize(("degree", "megabytes"), [(3, 9.44), (4, 13.76)])
def test_gaussians_count_their_sh(degree: int, megabytes: float) -> None:
    splats = {"means": torch.zeros(40_000, 3), "shN": torch.zeros(40_000, (degree + 1) ** 2 - 1, 3)}
    gaussians = Gaussians(torch.nn.ParameterDict(splats), torch.zeros(3), 1.0, "3dgs", torch.zeros(3))
    assert gaussians.sh_degree == degree and gaussians.megabytes == pytest.approx(megabytes)
