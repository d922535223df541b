import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.cameras.paths import focus, look_at, up_direction
from nexwarp.cli import main as cli
from nexwarp.data.ply import read_vertices
from nexwarp.model.buffers import load_buffers
from nexwarp.model.edit import EDIT_FILE
from nexwarp.run.edit import crop_command, measured
from nexwarp.run.folder import keep_camera_path, open_model
from tests.cli.support import picture, read, refused, snapshot
from tests.scenes import rigid
from tests.tolerances import assert_close

MOVES = (["--level"], ["--scale-between", "0", "0", "0", "0", "-2", "0", "7"], ["--origin", "-1", "2e0", "-.5"])


def edit(run: Path, *arguments: str) -> None:
    assert cli.main(["edit", str(run), *arguments]) == 0


def centres(run):
    vertices = read_vertices(run / "export" / "surfels.ply")
    return np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(float)


def test_a_levelled_and_scaled_run_looks_the_same_from_the_moved_cameras(finished):
    assert cli.main(["render", str(finished), "--set", "test", "--device", "cpu"]) == 0
    names = sorted(read(finished, "cameras.json")["test"])
    before = [picture(finished / "renders" / "test" / name) for name in names]
    for move in MOVES:
        edit(finished, *move)
    opened = open_model(finished)
    assert opened.frame.scale == 3.5
    moved = [opened.frame.camera(camera) for camera in opened.cameras["test"].values()]
    assert np.allclose(up_direction(moved), [0, 1, 0], atol=0.02)
    keep_camera_path(finished, [opened.cameras["test"][name] for name in names], frame=opened.frame)
    path = finished / "camera_path_1.json"
    assert cli.main(["render", str(finished), "--path", str(path), "--buffers", "--device", "cpu"]) == 0
    for number, (name, image) in enumerate(zip(names, before, strict=True)):
        file = finished / "renders" / "path_camera_path_1" / f"{number:04d}.png"
        assert (picture(file).int() - image.int()).abs().max() <= 1
        moved_camera = opened.frame.camera(opened.cameras["test"][name])
        shown = load_buffers(file.with_suffix(".exr")).camera
        assert_close(shown.viewmat, moved_camera.viewmat, kind="value", name="camera")


def test_the_ground_of_a_tilted_scene_becomes_y_0(tmp_path):
    turn = rigid((0.3, 0.8, -0.4, 0.2), (1, 2, 3))
    floor = torch.cat([4 * torch.rand(300, 2) - 2, torch.zeros(300, 1)], 1)
    things = torch.cat([torch.rand(80, 2), 0.2 + torch.rand(80, 1)], 1)
    below = torch.cat([torch.rand(10, 2), -2 * torch.ones(10, 1)], 1)
    means = torch.cat([floor, things, below]).double() @ turn[:3, :3].T + turn[:3, 3]
    quats = torch.tensor([[0.3, 0.8, -0.4, 0.2]]).expand(390, 4)
    scales = torch.cat([torch.full((380, 2), 0.1), torch.full((10, 2), 3.0)])
    ones = torch.ones(390)
    shape = means.float(), quats, scales, 0.9 * ones, torch.ones(390, 2)
    surfels = nw.Surfels.from_activated(*shape, torch.zeros(390, 1, 3))
    nw.Model(surfels, None).save(tmp_path)
    K, up = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), torch.tensor([0.0, 0, 1]).double()
    cameras = {}
    for number in range(8):
        angle = number * math.pi / 4
        place = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.5]).double()
        viewmat = look_at(place, torch.zeros(3).double(), up) @ torch.linalg.inv(turn)
        cameras[f"{number}.png"] = nw.Camera(viewmat.float(), K, 40, 30)
    save_cameras(tmp_path / CAMERAS_FILE, {"train": cameras, "test": {}})
    edit(tmp_path, "--level")
    levelled = open_model(tmp_path).frame.points(means.numpy())
    assert np.allclose(levelled[:300, 1], 0, atol=1e-3) and np.allclose(levelled[380:, 1], -2, atol=1e-3)
    edit(tmp_path, "--level")
    assert np.allclose(open_model(tmp_path).frame.points(means.numpy()), levelled, atol=1e-3), "once is enough"


def test_the_viewer_s_command_crops_by_the_sphere_it_shows(finished, capsys):
    for move in MOVES:
        edit(finished, *move)
    opened = open_model(finished)
    means = opened.trained.surfels.means.detach().double().numpy()
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.4))
    program, *arguments = shlex.split(crop_command(opened, centre, radius))
    assert program == "nexwarp" and cli.main(arguments) == 0
    assert open_model(finished).kept.mean() == pytest.approx(0.4, abs=0.03)


def test_measured_points_are_those_of_exports_and_their_command_scales(finished):
    edit(finished, "--origin", "1", "-2", "3e-5")
    opened = open_model(finished)
    points = opened.trained.surfels.means.detach().double().numpy()[[0, 1]]
    before = math.dist(*opened.frame.points(points))
    (one,) = measured(opened, points[:1], 2.5)
    *places, distance, command = measured(opened, points, 2.5)
    assert cli.main(["export", str(finished)]) == 0
    for place, exported in zip(places, centres(finished)[:2], strict=True):
        np.testing.assert_allclose([float(x) for x in place.strip("`").split()], exported, rtol=1e-5, atol=1e-5)
    assert one == places[0] and distance == f"**{before:.4g} units**"
    program, *arguments = shlex.split(command.strip("`"))
    assert program == "nexwarp" and cli.main(arguments) == 0
    *_, distance, _ = measured(open_model(finished), points, 2.5)
    assert distance == "**2.5 units**"


def test_the_list_says_where_the_subject_is(trained, capsys):
    edit(trained)
    surfels, subject = capsys.readouterr().out.splitlines()
    cameras = [*open_model(trained).cameras["train"].values()]
    expected = focus(cameras)
    numbers = [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", subject)]
    away = np.median([(camera.position - expected).norm().item() for camera in cameras])
    assert np.allclose(numbers, [*expected.tolist(), away], rtol=1e-3, atol=1e-3) and "surfels" in surfels


def test_exports_are_in_the_new_coordinates_and_hold_what_is_left(finished):
    assert cli.main(["export", str(finished)]) == 0
    before = centres(finished)
    edit(finished, "--scale", "2")
    edit(finished, "--origin", "1", "0", "0")
    edit(finished, "--crop", "box", "-2", "-50", "-50", "0.5", "50", "50")
    assert cli.main(["export", str(finished)]) == 0
    new = 2 * before - [1, 0, 0]
    left = (new[:, 0] >= -2) & (new[:, 0] <= 0.5)
    assert 0 < left.sum() < len(new) and np.allclose(centres(finished), new[left], atol=1e-5)
    assert len(nw.load(finished).surfels) == len(new), "the model's file and nexwarp.load have all surfels"
    for kind in ("compact", "cameras"):
        assert cli.main(["export", str(finished), "--format", kind]) == 0
    assert len(nw.load(finished / "export" / "compact.safetensors").surfels) == left.sum()
    first = read(finished / "export", "camera_path.json")["camera_path"][0]["camera_to_world"]
    places = [2 * camera.position - torch.tensor([1.0, 0, 0]) for group in open_model(finished).cameras.values()
              for camera in group.values()]  # fmt: skip
    assert any(np.allclose(place, first[3:12:4], atol=1e-4) for place in places)


def test_undo_gives_the_same_bits_and_evaluation_never_sees_edits(finished, capsys):
    assert cli.main(["export", str(finished)]) == 0
    model, exported = (finished / "model.safetensors").read_bytes(), snapshot(finished / "export")
    for arguments in (["--crop", "sphere", "0", "0", "0", "1.5"], *MOVES):
        edit(finished, *arguments)
    assert cli.main(["eval", str(finished), "--device", "cpu"]) == 0
    metrics = read(finished, "metrics.json")
    capsys.readouterr()
    edit(finished)
    out = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("the cameras look at")]
    assert [line[:8] for line in out[:4]] == ["1. crop ", "2. level", "3. scale", "4. origi"] and len(out) == 5
    assert cli.main(["info", str(finished)]) == 0
    assert "crop sphere 0 0 0 1.5" in capsys.readouterr().out
    for _ in range(4):
        edit(finished, "--undo")
    assert not (finished / EDIT_FILE).exists() and (finished / "model.safetensors").read_bytes() == model
    assert cli.main(["export", str(finished)]) == 0
    assert snapshot(finished / "export") == exported and cli.main(["eval", str(finished), "--device", "cpu"]) == 0
    assert read(finished, "metrics.json") == metrics
    refused(capsys, ["edit", str(finished), "--undo"], "--undo", "found none")


def test_floaters_are_counted_and_belong_to_one_model(finished, capsys, monkeypatch):
    monkeypatch.setattr("nexwarp.run.edit.find_floaters", lambda model, *_: torch.arange(len(model.surfels)) < 3)
    count = len(nw.load(finished).surfels)
    edit(finished, "--crop", "sphere", "0", "0", "0", "1.5")
    left = len(open_model(finished).model.surfels)
    edit(finished, "--remove-floaters", "--device", "cpu")
    assert f"3 of {left:,} surfels are floaters" in capsys.readouterr().out and left < count
    assert len(open_model(finished).model.surfels) == left - 3
    monkeypatch.setattr("nexwarp.run.edit.find_floaters", lambda model, *_: torch.zeros(len(model.surfels)) > 0)
    before = snapshot(finished)
    edit(finished, "--remove-floaters", "--device", "cpu")
    assert snapshot(finished) == before, "none found"
    model = nw.load(finished)
    with torch.no_grad():
        model.surfels.means.add_(1)
    model.save(finished)
    refused(capsys, ["export", str(finished)], EDIT_FILE, "has changed since remove 3 floaters", "--undo")
    refused(capsys, ["edit", str(finished), "--undo", "--level"], "one operation")
    edit(finished, "--undo")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--crop"], ["--crop", "box or sphere"]),
        (["--crop", "ring", "1"], ["--crop", "ring"]),
        (["--crop", "box", "0", "0", "0", "1", "1"], ["box: expected 6 numbers, got 5"]),
        (["--crop", "box", "0", "0", "0", "1", "1", "x"], ["--crop", "'x'"]),
        (["--crop", "box", "0", "0", "0", "1", "-1", "1"], ["lowest and a highest corner"]),
        (["--crop", "sphere", "0", "0", "0", "0"], ["sphere: expected at least"]),
        (["--crop", "sphere", "99", "0", "0", "1e-3"], ["leaves none of"]),
        (["--scale", "0"], ["--scale", "expected at least"]),
        (["--scale", "nan"], ["--scale", "nan"]),
        (["--scale-between", "1", "1", "1", "1", "1", "1", "2"], ["--scale-between", "inf"]),
        (["--origin", "inf", "0", "0"], ["--origin", "inf"]),
        (["--level", "--scale", "2"], ["--level, --scale", "one operation"]),
    ],
)
def test_bad_edits_change_nothing(arguments, words, finished, capsys):
    edit(finished, "--scale", "2")
    before = snapshot(finished)
    refused(capsys, ["edit", str(finished), *arguments], *words)
    assert snapshot(finished) == before


def test_damaged_edits_are_named_by_every_command(finished, capsys):
    (finished / EDIT_FILE).write_text(json.dumps({"format_version": 1, "edits": [{"name": "paint", "numbers": []}]}))
    for command in (["edit"], ["render"], ["export"], ["info"], ["edit", "--undo"]):
        refused(capsys, [command[0], str(finished), *command[1:]], EDIT_FILE, "paint")


def test_baked_exports_move_too(finished, monkeypatch):
    pytest.importorskip("trimesh")
    monkeypatch.setattr("nexwarp.export.fit.FEWEST_STEPS", 2)
    monkeypatch.setattr("nexwarp.export.glb.CUTOFF", 0.05)  # surfels of a short training are faint
    command, file = ["export", str(finished), "--format", "glb", "--device", "cpu"], finished / "export" / "scene.glb"
    assert cli.main(command) == 0
    before = nw.load_baked(file)
    for move in MOVES:
        edit(finished, *move)
    assert cli.main(command) == 0
    after, opened = nw.load_baked(file), open_model(finished)
    expected = opened.frame.points(before.shape.means.numpy())
    assert np.allclose(after.shape.means.numpy(), expected, atol=1e-4)
    assert_close(after.shape.scales, 3.5 * before.shape.scales, kind="gradient", name="half sides")
    camera = next(iter(opened.cameras["test"].values()))
    image = after.render(opened.frame.camera(camera))
    assert_close(image, before.render(camera), kind="gradient", name="image", allow_flips=0.005)
    edit(finished, "--crop", "box", *map(str, np.quantile(expected, (0.1, 0.9), axis=0).ravel()))
    assert cli.main(command) == 0
    assert 0 < len(nw.load_baked(file).shape.means) < len(expected)
