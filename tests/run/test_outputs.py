import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.camera import resized
from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.cameras.nerfstudio import load_camera_path, save_camera_path
from nexwarp.cameras.paths import ellipse, interpolate
from nexwarp.cli import main as cli
from nexwarp.data.scene import SceneSource
from nexwarp.io.pictures import to_uint8
from nexwarp.model.buffers import load_buffers
from nexwarp.model.model_file import save_model
from nexwarp.run.folder import RunRecord, create_run
from tests.cameras.test_paths import ring, row
from tests.cli.support import picture, refused
from tests.data.inputs import room
from tests.scenes import make_surfels, make_texture, random_scene

TRAIN, TEST = ["b.png", "c.jpg", "d.png", "e.png"], ["a.png", "sub/f.png"]
OPTIONS = nw.RenderOptions(background=(0.1, 0.2, 0.3))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of random surfels about the point that the cameras look at."""
    run = tmp_path_factory.mktemp("outputs") / "run"
    torch.manual_seed(0)
    scene = random_scene(40)
    scene["means"] = scene["means"] - scene["means"].mean(0) + torch.tensor([1.0, -2.0, 0.3])
    create_run(run, RunRecord(SceneSource(str(run.parent / "scene"), "images_2"), nw.Config()))
    save_model(run, nw.Model(make_surfels(scene), make_texture(), options=OPTIONS))
    cameras = [each.to(torch.float32) for each in ring(6)]
    sets = {"train": dict(zip(TRAIN, cameras[1:5], strict=True)), "test": dict(zip(TEST, cameras[::5], strict=True))}
    save_cameras(run / "cameras.json", sets)
    return run


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def command(*arguments: object) -> int:
    words = [str(argument) for argument in arguments]
    return cli.main([*words, "--device", "cpu"] if words[0] == "render" else words)


def files(folder: Path) -> set[str]:
    return {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}


def rendered(run: Path, camera: nw.Camera) -> torch.Tensor:
    model = nw.load(run)
    with torch.no_grad():
        return to_uint8(model.render(camera).image)


@pytest.mark.parametrize(("views", "names"), [("test", TEST), ("train", TRAIN), ("all", TRAIN + TEST)])
def test_still_views(run: Path, views: str, names: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command("render", run, "--set", views) == 0
    group = {name: "train" if name in TRAIN else "test" for name in names}
    assert files(run / "renders") == {f"{group[n]}/{n.rsplit('.')[0]}.png" for n in names}
    assert f"{len(names)} pictures in {run / 'renders'}" in capsys.readouterr().out
    camera = load_cameras(run / "cameras.json")[group[names[-1]]][names[-1]]
    mine = picture(run / "renders" / group[names[-1]] / f"{names[-1].rsplit('.')[0]}.png")
    assert mine.equal(rendered(run, camera)) and mine.float().std() > 5


def test_sizes(run: Path) -> None:
    camera = load_cameras(run / "cameras.json")["test"]["a.png"]
    for flags, size in ((["--size", "80x20"], (80, 20)), (["--scale", "1.5"], (96, 72)), (["--scale", "0.01"], (1, 1))):
        assert command("render", run, "--set", "test", *flags) == 0
        assert picture(run / "renders" / "test" / "a.png").equal(rendered(run, resized(camera, *size)))


def test_info_tells_the_range_of_exposures(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = load_cameras(run / "cameras.json")
    model = nw.load(run)
    log_gains = torch.tensor([[0.3, 0.0, -0.2], [0.1, 0.2, 0.1], [-0.4, -0.2, 0.1], [0.0, 0.0, 0.0]])
    model.exposures = nw.Exposures.of(log_gains, list(cameras["train"].values()))
    save_model(run, model)
    assert command("info", run) == 0
    assert "0.67 to 1.35 times the photos' mean" in capsys.readouterr().out


def test_paths_are_those_of_the_runs_cameras(run: Path) -> None:
    sets = load_cameras(run / "cameras.json")
    train = list(sets["train"].values())
    by_name = [(sets["train"] | sets["test"])[name] for name in sorted(TRAIN + TEST)]
    for name, path in (("ellipse", ellipse(train, 4)), ("interpolate", interpolate(by_name, 4))):
        assert command("render", run, "--path", name, "--frames", "4") == 0
        folder = run / "renders" / name
        assert files(folder) == {f"{i:04d}.png" for i in range(4)}
        for i in (0, 3):
            assert picture(folder / f"{i:04d}.png").equal(rendered(run, path[i]))
    assert not (run / "renders" / "test").exists() and command("render", run, "--path", "ellipse", "--frames", "2") == 0
    assert files(run / "renders" / "ellipse") == {"0000.png", "0001.png"}, "no frames of the longer one"


def test_the_path_suits_the_capture_and_is_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    around = {str(i): each.to(torch.float32) for i, each in enumerate(ring(24))}
    ahead = {str(i): each.to(torch.float32) for i, each in enumerate(row())}
    for name, views, words in (("ellipse", around, "surround"), ("interpolate", ahead, "do not surround")):
        save_cameras(run / "cameras.json", {"train": views, "test": {}})
        assert command("render", run, "--frames", "2") == 0
        assert f"--path {name}, as the cameras {words} what they look at\n" in capsys.readouterr().out
        assert files(run / "renders" / name) == {"0000.png", "0001.png"}
    assert command("render", run, "--frames", "2", "--path", "ellipse") == 0
    assert "as the cameras" not in capsys.readouterr().out


def test_a_path_from_a_file(run: Path, tmp_path: Path) -> None:
    """nerfstudio's, with its size."""
    path = [resized(each, 40, 30) for each in interpolate(ring(3), 2)]
    save_camera_path(tmp_path / "flight.json", path, fps=5)
    assert command("render", run, "--path", tmp_path / "flight.json") == 0
    folder = run / "renders" / "path_flight"
    assert files(folder) == {"0000.png", "0001.png"}
    near = load_cameras(run / "cameras.json")["train"]["b.png"].near
    second = load_camera_path(tmp_path / "flight.json", near).cameras[1]
    assert picture(folder / "0001.png").equal(rendered(run, second))


def test_video(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    av = pytest.importorskip("av", reason="videos need PyAV (extra `video`)")
    video = tmp_path / "new" / "out.mp4"
    assert command("render", run, "--video", video, "--frames", "6", "--fps", "12", "--scale", "2") == 0
    assert f"0.50 s of video in {video}" in capsys.readouterr().out
    assert [f.name for f in video.parent.iterdir()] == ["out.mp4"]
    assert files(run / "renders") == {f"interpolate/{i:04d}.png" for i in range(6)}
    with av.open(str(video)) as container:
        (stream,) = container.streams.video
        assert [(x.width, x.height) for x in container.decode(stream)] == [(128, 96)] * 6 and stream.average_rate == 12


def test_buffers_of_views_or_else_of_frames(run: Path) -> None:
    assert command("render", run, "--set", "test", "--buffers") == 0
    assert files(run / "renders") == {f"test/{n}.{s}" for n in ("a", "sub/f") for s in ("png", "exr")}
    buffers = load_buffers(run / "renders" / "test" / "sub" / "f.exr")
    assert buffers.background.tolist() == torch.tensor(OPTIONS.background).tolist()
    assert to_uint8(buffers.image).equal(picture(run / "renders" / "test" / "sub" / "f.png"))
    shutil.rmtree(run / "renders")
    assert command("render", run, "--path", "ellipse", "--frames", "2", "--buffers") == 0
    assert files(run / "renders") == {f"ellipse/000{i}.{s}" for i in range(2) for s in ("png", "exr")}
    shutil.rmtree(run / "renders")
    assert command("render", run, "--frames", "1", "--buffers") == 0
    exr = {name for name in files(run / "renders") if name.endswith(".exr")}
    assert exr == {"test/a.exr", "test/sub/f.exr"} and (run / "renders" / "interpolate" / "0000.png").is_file()


def test_export_splits_what_is_large_from_the_cameras_of_the_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def exported(*options: str) -> bytes:
        assert command("export", run, "--no-finetune", *options) == 0
        return (run / "export" / "splats.ply").read_bytes()

    whole = exported("--max-extent", "inf")
    assert len(exported("--max-extent", "0.5")) > len(whole)
    (run / "cameras.json").unlink()
    assert exported("--max-extent", "0.5") == whole, "a training that was broken off leaves none"
    capsys.readouterr()
    assert command("export", run, "--max-extent", "0") == 2
    assert capsys.readouterr().err == "nexwarp: error: --max-extent: expected more than 0, got 0\n"


@pytest.mark.filterwarnings("default:.*the scene cannot be read")
def test_export_cameras(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("export", run, "--format", "cameras") == 0
    assert "are those of the photos as they were trained on" in " ".join(capsys.readouterr().out.split())
    assert files(run / "export") == {"transforms.json", "camera_path.json"}
    before = {name: c for group in load_cameras(run / "cameras.json").values() for name, c in group.items()}
    path = load_camera_path(run / "export" / "camera_path.json").cameras
    assert all(along.K.equal(before[name].K) for name, along in zip(sorted(before), path, strict=True))
    data = json.loads((run / "export" / "transforms.json").read_text())
    assert data["train_filenames"] == [f"images_2/{n}" for n in TRAIN]
    assert data["test_filenames"] == [f"images_2/{n}" for n in TEST]


@pytest.mark.parametrize(
    ("camera", "model"),
    [
        (f"PINHOLE {room.LENS}", "PINHOLE"),
        (f"OPENCV {room.LENS} -0.1 0.02 0.001 0.002", "OPENCV"),
        (f"SIMPLE_RADIAL_FISHEYE {room.WIDTH} {room.HEIGHT} 40 31 24.5 0.02", "OPENCV_FISHEYE"),
        (f"DIVISION {room.LENS} -0.1", None),
    ],
)
def test_exported_cameras_are_those_of_the_photos_files(tmp_path: Path, camera: str, model: str | None) -> None:
    """Trained on reduced, undistorted photos: the export read as a scene is the scene, in its full size."""
    folder = tmp_path / "scene"
    room.write_colmap(folder, room.write_photos(folder / "images"), camera)
    source, run = SceneSource(str(folder), downscale=2), tmp_path / "run"
    create_run(run, RunRecord(source, nw.Config()))
    save_cameras(run / "cameras.json", source.load().cameras)
    assert command("export", run, "--format", "cameras", "--out", folder) == 0
    data = json.loads((folder / "transforms.json").read_text())
    assert data["camera_model"] == (model or "PINHOLE")
    if model is None:
        frames = data["frames"]
        assert all(f["file_path"].startswith("undistorted/") and f["w"] < room.WIDTH for f in frames)
        return
    original = nw.load_scene(folder, format="colmap")
    read = nw.load_scene(folder, format="nerfstudio")
    assert [view.name for view in read.test] == [view.name for view in original.test]
    for one, other in zip(read.train, original.train, strict=True):
        torch.testing.assert_close(one.camera.viewmat, other.camera.viewmat, rtol=0, atol=1e-6)
        assert one.camera.K.allclose(other.camera.K) and one.image.equal(other.image)


@pytest.fixture
def refuses(run: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Expect one line and exit code 2, and nothing new in the run's folder nor beside it."""

    def check(arguments: list[object], *words: str) -> None:
        before = files(run.parent)
        refused(capsys, [str(word) for word in (arguments[0], run, *arguments[1:])], *words)
        assert files(run.parent) == before

    return check


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--path", "elipse"], ["--path: expected ellipse, interpolate or a file ending in .json", "'elipse'"]),
        (["--set", "val"], ["--set: expected test, train or all, got 'val'"]),
        (["--path", "ellipse", "--frames", "0"], ["--frames: expected at least 1", "got 0"]),
        (["--frames", "-1"], ["--frames: expected at least 0, got -1"]),
        (["--set", "test", "--frames", "5"], ["--frames: expected together with --path or --video"]),
        (["--fps", "30"], ["--fps: expected together with --video"]),
        (["--video", "a.mp4", "--fps", "0"], ["--fps: expected more than 0 and at most 1000 frames a second"]),
        (["--video", "a.mp4", "--fps", "nan"], ["--fps: expected more than 0"]),
        (["--video", "a.avi"], ["--video: a.avi: expected a video ending in .mp4, .mov, .mkv, .webm, got .avi"]),
        (["--size", "100"], ["--size: expected WIDTHxHEIGHT of 1 to 16384 pixels each, got '100'"]),
        (["--scale", "0"], ["--scale: expected a number above 0, got 0"]),
        (["--scale", "1000"], ["--scale: expected at most 16384 pixels a side, got 64000x48000"]),
        (["--order", "near"], ["--order: expected depth or distance, got 'near'"]),
        (["--exposure", "auto"], ["--exposure: expected photos or mean, got 'auto'"]),
        (["--scale", "2", "--size", "9x9"], ["--size, --scale: expected at most one"]),
        (["--camera", "cube"], ["--camera: expected pinhole, panorama, fisheye, got"]),
        (["--fov", "0", "--camera", "fisheye"], ["--fov: expected 1 to 360"]),
        (["--fov", "90"], ["--fov: expected together with --camera fisheye"]),
        (["--buffers", "--camera", "panorama"], ["--buffers: expected together with --camera pinhole"]),
    ],
)
def test_bad_render_options(refuses: Callable[..., None], flags: list[str], words: list[str]) -> None:
    refuses(["render", *flags], *words)


def test_bad_path_files_and_cameras_that_no_path_suits(refuses: Callable[..., None], run: Path) -> None:
    path = run.parent / "flight.json"
    path.write_text("{")
    refuses(["render", "--path", path], str(path), "expected JSON")
    save_camera_path(path, ring(2))
    refuses(["render", "--path", path, "--frames", "3"], "--frames: expected no value with", "got 3")
    alone = "expected at least two distinct ones"
    camera = ring(1)[0].to(torch.float32)
    save_cameras(run / "cameras.json", {"train": {"0": camera}, "test": {"1": camera}})
    refuses(["render"], f"--path interpolate: cameras: {alone}", "--frames 0 renders the still views alone")


def test_bad_exports(refuses: Callable[..., None], run: Path, tmp_path: Path) -> None:
    known = "ply, mesh, compact, cameras, web, glb, usd, spz, gltf-splats"
    refuses(["export", "--format", "obj"], f"--format: expected one of {known}, got 'obj'")
    (run / "cameras.json").write_text("{}")
    refuses(["export", "--format", "cameras"], "cameras.json: expected at least one camera, found none")
    refuses(["render", "--set", "test"], "cameras.json: expected test views to render, found none")
    (run / "cameras.json").unlink()
    refuses(["export", "--format", "cameras"], "cameras.json: expected at least one camera, found none")
    (run / "model.safetensors").unlink()
    refuses(["export"], "model.safetensors")
    (run / "config.json").unlink()
    refuses(["export"], "expected a run folder or a model, found no config.json")
