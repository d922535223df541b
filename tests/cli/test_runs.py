import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data import load_scene
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import CONVENTION, psnr
from nexwarp.run.folder import list_files, read_run
from nexwarp.run.photo_table import save_photo_table
from nexwarp.train.optimizer import set_rates
from nexwarp.train.recipe import config_from_dict
from nexwarp.train.trainer import Trainer
from tests.cli.support import FLAGS, RUN_FILES, SMALL, picture, read, refused, snapshot
from tests.data.test_scene import make_scene
from tests.scene_writers import write_blender, write_points

LINKS: dict[str, object] = {"follow_links": False, "skip_missing": False, "linear": None, "exclude": []}


def test_a_run_holds_what_it_should(trained, scene):
    assert {f.name for f in trained.iterdir()} == RUN_FILES
    assert {f.name for f in (trained / "checkpoint").iterdir()} == {"tensors.safetensors", "state.json"}
    config = read(trained, "config.json")
    given = {"path": str(scene.resolve()), "images": "images", "downscale": 1, "masks": "masks"}
    assert config["scene"] == given | LINKS | dict.fromkeys(("background", "points", "format"))
    assert config["device"] == "cpu" and config["config"]["preset"] == "default"
    settings = config_from_dict(config["config"])
    assert (settings.iterations, settings.max_surfels, settings.texture) == (20, 100, SMALL.texture)
    metrics = read(trained, "metrics.json")
    assert nw.load(trained).meta["iteration"] == 20 and len(nw.load(trained).surfels) == metrics["surfels"] <= 100
    assert list(metrics["views"]) == ["view_000.png", "view_008.png"] and metrics["convention"] == CONVENTION
    assert metrics["iterations"] == 20 and metrics["preset"] == "default" and metrics["device"] == "cpu"
    assert metrics["megabytes"] == (trained / "model.safetensors").stat().st_size / 1e6
    assert metrics["iterations_per_second"] == pytest.approx(20 / metrics["seconds"])
    for folder in ("test", "compare"):
        assert {f.name for f in (trained / "renders" / folder).iterdir()} == metrics["views"].keys()
    assert not [f.name for f in trained.rglob("*") if "tmp" in f.name or f.name.startswith(".")]


def test_memory_that_ends_while_finishing_costs_no_training(scene, tmp_path, monkeypatch, capsys):
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. And more")

    command = ["train", str(scene), "--run", str(tmp_path / "run"), *FLAGS]
    with monkeypatch.context() as patch:
        patch.setattr(nw.Trainer, "finish", full)
        assert cli.main(command) == 2
    told = "out of memory: needed 2.00 GiB; training is complete and saved: --resume finishes the run"
    assert capsys.readouterr().err == f"nexwarp: error: {told}\n" and cli.main([*command, "--resume"]) == 0
    assert "resumed at iteration 20" in capsys.readouterr().out and (tmp_path / "run" / "metrics.json").is_file()


def test_eval_reproduces_the_metrics(finished, capsys):
    before = read(finished, "metrics.json")
    renders = snapshot(finished / "renders")
    (finished / "metrics.json").unlink()
    shutil.rmtree(finished / "renders")
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 0
    assert read(finished, "metrics.json") == {key: before[key] for key in ("psnr", "ssim", "views", "convention")}
    assert snapshot(finished / "renders") == renders and f"{before['psnr']:.2f} dB" in capsys.readouterr().out


def test_the_table_of_photos_has_what_the_model_shows_of_each(trained, scene):
    """Its PSNR are those of renderings and of metrics.json; the lowest comes first."""
    with (trained / "photos.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    psnrs = [float(row["psnr"]) for row in rows]
    assert list(rows[0]) == ["photo", "split", "psnr", "sharpness"] and psnrs == sorted(psnrs)
    assert sorted(row["photo"] for row in rows) == sorted(file.name for file in (scene / "images").iterdir())
    tested = {name: figures["psnr"] for name, figures in read(trained, "metrics.json")["views"].items()}
    assert {row["photo"] for row in rows if row["split"] == "test"} == tested.keys()
    model, cameras = nw.load(trained), nw.load_cameras(trained / "cameras.json")
    for row, written in zip(rows, psnrs, strict=True):
        name = row["photo"]
        rendering = to_uint8(model.render_image(cameras[row["split"]][name]))
        assert written == pytest.approx(psnr(rendering, picture(scene / "images" / name)), abs=6e-4)
        assert written == pytest.approx(tested.get(name, written), abs=6e-4)


def test_a_blurred_photo_is_the_least_sharp_of_the_table(tmp_path):
    camera = nw.Camera(torch.eye(4), torch.tensor([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]]), 48, 36, 0.1)
    noise = torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(0))
    blurred = torch.from_numpy(gaussian_filter(noise.numpy(), (1.5, 1.5, 0)))
    views = {name: nw.View(camera, to_uint8(image), None, name) for name, image in (("a, b", noise), ("c", blurred))}
    save_photo_table(tmp_path / "photos.csv", {"train": [*views.values()]}, {name: {"psnr": 20.0} for name in views})
    with (tmp_path / "photos.csv").open(newline="") as file:
        sharpness = {row["photo"]: float(row["sharpness"]) for row in csv.DictReader(file)}
    assert sharpness["c"] < 0.5 * sharpness["a, b"]


def test_excluded_photos_stay_out_of_resume_and_eval(scene, tmp_path, capsys):
    run = tmp_path / "run"
    command = ["train", str(scene), "--run", str(run), *FLAGS]
    out = ["--exclude", "view_003.png", "view_00[78].png"]
    refused(capsys, [*command, "--exclude", "view_9*"], "exclude: no photo of", "is named 'view_9*', as view_000.png")
    assert cli.main([*command, *out]) == 0
    assert read(run, "config.json")["scene"]["exclude"] == out[1:]
    photos = {"view_003.png", "view_007.png", "view_008.png"}

    def left() -> set[str]:
        cameras = read(run, "cameras.json")
        return {*cameras["train"], *cameras["test"]}

    assert left() == {file.name for file in (scene / "images").iterdir()} - photos
    refused(capsys, [*command, "--resume", "--exclude", "view_003.png"], "--exclude: expected", "in the run to resume")
    before = left()
    for iterations, options in (("22", []), ("24", out)):
        assert cli.main([*command, "--resume", "--iterations", iterations, *options]) == 0 and left() == before
    assert cli.main(["eval", str(run), "--device", "cpu"]) == 0
    assert list(read(run, "metrics.json")["views"]) == ["view_000.png"]


def test_eval_finds_a_scene_that_moved(finished, scene, tmp_path, capsys):
    before = read(finished, "metrics.json")
    config = read(finished, "config.json")
    config["scene"]["path"] = str(tmp_path / "gone")
    (finished / "config.json").write_text(json.dumps(config))
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 2
    assert str(tmp_path / "gone") in capsys.readouterr().err and read(finished, "metrics.json") == before
    assert cli.main(["eval", str(finished), "--scene", str(scene), "--device", "cpu"]) == 0
    assert read(finished, "metrics.json") == before


def test_a_blender_scene_through_train_resume_and_eval(tmp_path, capsys):
    """Background, masks and points of the flags reach the run, and eval and --resume find them there again."""
    path = write_blender(make_scene(tmp_path / "colmap"), tmp_path / "blender")
    for file in path.rglob("*.png"):
        with Image.open(file) as photo:
            photo.putalpha(Image.linear_gradient("L").resize(photo.size))
            photo.save(file)
    points = write_points(tmp_path / "mine.ply", np.random.default_rng(0).uniform(-1, 1, (50, 3)), np.zeros((50, 3)))
    run = tmp_path / "run"
    flags = ["--run", str(run), "--device", "cpu", "--max-surfels", "32"]
    flags += ["--background", "0,0.5,1", "--masks", "alpha", "--points", str(points), "--iterations", "3"]
    assert cli.main(["train", str(path), *flags]) == 0
    assert "50 points" in capsys.readouterr().out
    config = read(run, "config.json")
    given = {"background": "0,0.5,1", "masks": "alpha", "points": str(points), "format": None}
    assert config["scene"] == {"path": str(path), "images": "images", "downscale": 1} | given | LINKS
    assert config["config"]["background"] == [0.0, 0.5, 1.0] and nw.load(run).options.background == (0.0, 0.5, 1.0)
    before = read(run, "metrics.json")["psnr"]
    assert cli.main(["eval", str(run), "--device", "cpu"]) == 0
    assert read(run, "metrics.json")["psnr"] == pytest.approx(before, abs=1e-6)
    assert cli.main(["train", str(path), "--run", str(run), "--device", "cpu", "--resume"]) == 0
    assert cli.main(["train", str(path), "--run", str(run), "--resume", "--background", "white"]) == 2
    assert "--background: expected 0,0.5,1 as in the run to resume, got white" in capsys.readouterr().err


def test_other_cameras_render_beside_the_photos(finished):
    """Panoramas have twice as many columns as rows, and go to a folder of their own, which --overwrite knows."""
    before = (finished / "renders" / "test" / "view_000.png").read_bytes()
    assert cli.main(["render", str(finished), "--camera", "panorama", "--set", "test", "--size", "32x16"]) == 0
    assert picture(finished / "renders" / "panorama" / "test" / "view_000.png").shape == (16, 32, 3)
    assert (finished / "renders" / "test" / "view_000.png").read_bytes() == before
    options = ["--path", "ellipse", "--frames", "2"]
    assert cli.main(["render", str(finished), *options, "--camera", "fisheye", "--scale", "0.5"]) == 0
    assert picture(finished / "renders" / "fisheye" / "ellipse" / "0001.png").shape == (18, 18, 3)
    assert list_files(finished)[1] == []


# A run that is continued beyond its end


@pytest.fixture(scope="module")
def extended(trained: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 20 iterations, continued to 30."""
    run = Path(shutil.copytree(trained, tmp_path_factory.mktemp("extended") / "run"))
    assert cli.main(["train", str(scene), "--run", str(run), "--device", "cpu", "--resume", "--iterations", "30"]) == 0
    return run


def test_a_finished_run_goes_on(extended: Path, scene: Path) -> None:
    assert read_run(extended).config.iterations == 30 and read(extended, "metrics.json")["iterations"] == 30
    logged = [json.loads(line)["iteration"] for line in (extended / "metrics.jsonl").read_text().splitlines()]
    assert logged == list(range(1, 31))
    # Finished once more, and as before, by another --resume.
    before = (extended / "model.safetensors").read_bytes()
    assert cli.main(["train", str(scene), "--run", str(extended), "--device", "cpu", "--resume"]) == 0
    assert (extended / "model.safetensors").read_bytes() == before


def test_it_is_said_and_an_interruption_changes_nothing(extended, trained, scene, tmp_path, capsys):
    """Interrupted before its first new checkpoint, an extended run is resumed without --iterations."""
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    command = ["train", str(scene), "--run", str(run), "--device", "cpu", "--resume"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        assert cli.main([*command, "--iterations", "30"]) == 130
    told = capsys.readouterr().out.replace("\n", " ")
    assert "extended from 20 to 30 iterations: from here on, learning rates" in told and cli.main(command) == 0
    assert "extended" not in capsys.readouterr().out
    assert (run / "model.safetensors").read_bytes() == (extended / "model.safetensors").read_bytes()


def test_its_schedules_are_those_of_the_longer_run(trained: Path, scene: Path) -> None:
    config = read_run(trained).config
    longer = type(config)(**{**vars(config), "iterations": 30})
    trainer = Trainer(load_scene(scene), longer, "cpu")
    with pytest.raises(ValueError, match="its settings are others"):
        trainer.restore(trained)
    trainer.restore(trained, extend=True)
    assert trainer.iteration == 20
    trainer.step()
    rates = [group["lr"] for group in trainer.optimizer.param_groups]
    set_rates(trainer.optimizer, 21, 30)
    assert rates == [group["lr"] for group in trainer.optimizer.param_groups]
    assert trainer.densifier.config == Trainer(load_scene(scene), longer, "cpu").densifier.config
