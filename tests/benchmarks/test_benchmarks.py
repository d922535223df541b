"""The benchmarks measure what they say: timer, scenes, commands, gsplat, the README's picture."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import nexwarp as nw
from benchmarks import __main__ as command
from benchmarks import before_after, bench_peers
from benchmarks.before_after import Values
from benchmarks.gpu_time import busy
from benchmarks.picture import GAP, draw_row
from benchmarks.scenes import SurfelScene, cloud, fox, garden, geometry, texture, workload
from benchmarks.suite import Options, table
from benchmarks.timing import ROOT, Measurement, Repeats, measure
from nexwarp.cameras.cameras_file import save_cameras
from nexwarp.io.pictures import CAPTION_HEIGHT, to_uint8
from nexwarp.ops import Pinhole
from tests.scenes import make_camera, make_surfels, make_texture, random_scene

CPU = torch.device("cpu")


QUICK = ["--quick", "--device", "cpu", "--only"]


def small_scene() -> SurfelScene:
    return cloud(300, 43, 30)


def test_timer_finds_the_median_of_a_known_sleep_in_turns() -> None:
    calls: list[str] = []

    def nap() -> None:
        calls.append("nap")
        time.sleep(0.2 if len(calls) == 1 else 0.02)

    runs = {"nap": nap, "none": lambda: calls.append("none")}
    m, none = measure(runs, CPU, repeats=Repeats(warmup=1, least=5, most=5), sizes={"surfels": 1})
    assert calls == ["nap", "none"] * 6 and m.repeats == none.repeats == 5 and none.median < 5
    assert 20 <= m.median < 60  # the slow first call is warm-up; a shared machine may oversleep
    assert m.p10 <= m.median <= m.p90
    assert m.unit == "ms" and m.device == "cpu" and m.device_name and m.commit and m.date


def test_table_compares_gpu_and_cpu() -> None:
    results = [
        Measurement(name="walk", scene="cloud", device=device, median=median, p10=1.0, p90=1.0)
        for device, median in (("cuda", 2.0), ("cpu", 50.0))
    ]
    assert "times as fast" in table(results)
    assert table(results).splitlines()[-1].split() == ["walk", "cloud", "50", "2", "25"]
    assert "times as fast" not in table(results[:1])


def test_scenes_are_seeded(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    K, viewmat = np.array([[480.0, 0, 324], [0, 480, 210], [0, 0, 1]], np.float32), np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3.0
    means = generator.normal(size=(50, 3)).astype(np.float32)
    colors = generator.integers(0, 256, (50, 3), dtype=np.uint8)
    np.savez(tmp_path / "garden_points.npz", means3d=means, colors=colors, viewmats=viewmat[None], Ks=K[None])
    made = []
    for seed in (1, 2):
        torch.manual_seed(seed)  # scenes must not depend on it
        made.append([small_scene(), garden(120, 64, 42, tmp_path), garden(120, 64, 42, tmp_path / "nowhere")])
    for first, second in zip(*made, strict=True):
        assert first.name == second.name
        for (name, a), b in zip(first.surfels.named_parameters(), second.surfels.parameters(), strict=True):
            assert torch.equal(a, b), f"{first.name}: {name}"
        for a, b in zip(first.cameras, second.cameras, strict=True):
            assert torch.equal(a.viewmat, b.viewmat) and torch.equal(a.K, b.K)
    real, absent = made[0][1:]
    assert len(real.surfels) == len(absent.surfels) == 120
    assert not real.note and "synthetic" in absent.note
    assert (absent.camera.width, absent.camera.height) == (64, 42)


def test_command_writes_well_formed_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    assert command.main([*QUICK, "collect", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    names = ["collect, forward", "collect, backward", *(f"collection stage, forward{x}" for x in ("", " + backward"))]
    assert [line["name"] for line in lines] == names
    for line in lines:
        assert line.keys() == Measurement.__dataclass_fields__.keys()
        assert line["device"] == "cpu" and line["unit"] == "ms" and line["device_name"]
        assert 0 < line["p10"] <= line["median"] <= line["p90"]
        assert line["sizes"].items() >= {"surfels": 500, "width": 64, "height": 48}.items()
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)


OPTIONS = nw.RenderOptions(max_hits=1, background=(0.0, 1.0, 0.0), sh_degree=2, clamp_texture=True)


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """What `nexwarp train` leaves behind, as far as the benchmarks need it."""
    scene, folder = small_scene(), tmp_path / "run"
    field = nw.NeuralTexture(levels=4, table_size=2**8, width=16)
    nw.Model(scene.surfels, field, options=OPTIONS).save(folder)
    cameras = {str(i): camera for i, camera in enumerate(scene.cameras)}
    save_cameras(folder / "cameras.json", {"train": cameras, "test": {}})
    return folder


def test_trained_scene_is_that_of_the_run_and_takes_part_when_it_is_named(run_folder: Path) -> None:
    scene, made = fox(run_folder), small_scene()
    assert torch.equal(scene.surfels.means, made.surfels.means)
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(scene.cameras, made.cameras, strict=True))
    assert texture(scene) is scene.model.texture and texture(scene).config["table_size"] == 2**8
    assert scene.model.options == OPTIONS
    assert "fox" in scene.name and "300 at 43x30" in scene.name
    without, with_model = (workload(Options(CPU, quick=True, model=model)) for model in (None, run_folder))
    assert [scene.name for scene in with_model[:-1]] == [scene.name for scene in without]
    assert "fox" in with_model[-1].name and not any("fox" in scene.name for scene in without)


def test_command_names_the_trained_scene_or_says_that_it_is_absent(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = [*QUICK, "tiles"]
    assert command.main(quick) == 0
    assert "the trained fox was left out" in capsys.readouterr().out
    assert command.main([*quick, "--model", str(run_folder)]) == 0
    shown = capsys.readouterr().out
    assert "left out" not in shown and "fox, trained, 300 at 43x30" in shown
    with pytest.raises(SystemExit):
        command.main([*quick, "--model", str(run_folder.parent)])
    assert "model.safetensors" in capsys.readouterr().err


def test_a_failing_stage_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(command.STAGES, "tiles", lambda _: 1 / 0)
    out = tmp_path / "figures.json"
    assert command.main([*QUICK, "tiles,project", "--out", str(out)]) == 1
    assert "project, forward" in out.read_text()


def test_peer_gets_the_same_scene() -> None:
    """gsplat is called with its own names and shapes; a stand-in records them, since gsplat needs CUDA."""
    seen = {}

    class Peer:
        @staticmethod
        def rasterization_2dgs(  # noqa: PLR0913  # as gsplat's
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane
        ):
            seen.update({k: tuple(v.shape) for k, v in locals().items() if isinstance(v, torch.Tensor)})
            assert (width, height) == (43, 30) and near_plane > 0
            return means.sum().expand(1, height, width, 3), opacities.sum().expand(1, height, width, 1), None

    g = geometry(small_scene())
    assert isinstance(g.pinhole, Pinhole)
    call = bench_peers.gsplat_call(g, Peer)
    assert len(call.forward()) == 2
    expected = {"means": (300, 3), "quats": (300, 4), "scales": (300, 3), "opacities": (300,), "colors": (1, 300, 3)}
    assert seen == {**expected, "viewmats": (1, 4, 4), "Ks": (1, 3, 3)}
    assert all(x.is_leaf and x.requires_grad for x in call.leaves)


def test_time_of_a_gpu_counts_kernels_side_by_side_once_and_gaps_never() -> None:
    assert busy([(5.0, 7.0), (0.0, 2.0), (1.0, 3.0), (5.5, 6.0)]) == 5.0
    assert busy([]) == 0.0


def test_entries_walked_by_our_side_end_at_each_pixel_s_last_hit() -> None:
    g = geometry(small_scene())
    projection = g.project()
    tiles = g.tiles(projection)
    hits = g.collect(projection, tiles)
    listed, walked = bench_peers.our_call(g).walked()
    assert listed == len(tiles.surfel_ids)
    y, x = torch.meshgrid(torch.arange(30), torch.arange(43), indexing="ij")
    starts = tiles.tile_offsets[(y // 16) * tiles.columns + x // 16]
    assert walked == pytest.approx((hits.stops - starts).double().mean().item())
    assert 0 < walked < listed


def test_checkouts_are_measured_in_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    turns: list[str] = []

    def measure(root: Path, options: list[str]) -> Values:
        assert options == ["--only", "frame", "--device", "cpu"]
        turns.append(root.name)
        return {("frame", "garden", "ms"): 10.0 * len(turns), ("new", "garden", "ms"): 1.0}

    for name in "ab":
        (tmp_path / name / "benchmarks").mkdir(parents=True)
    monkeypatch.setattr(before_after, "measure", measure)
    out = tmp_path / "report.json"
    command = [str(tmp_path / name) for name in "ab"]
    before_after.main([*command, "--only", "frame", "--device", "cpu", "--repeats", "2", "--out", str(out)])
    assert turns == ["a", "b"] * 2
    frame = json.loads(out.read_text())[0]
    assert (frame["before"], frame["after"]) == ([10.0, 30.0], [20.0, 40.0]) and frame["ratio"] == pytest.approx(1.5)


def test_a_checkout_measures_itself() -> None:
    values = before_after.measure(ROOT, [*QUICK, "tiles"])
    assert values["tiles", "cloud 500 at 64x48", "ms"] > 0


def test_columns_are_the_photo_and_what_its_camera_sees() -> None:
    scene = random_scene(8)
    camera, model = make_camera(scene).to(torch.float32), nw.Model(make_surfels(scene), make_texture())
    photo = torch.randint(0, 256, (camera.height, camera.width, 3), dtype=torch.uint8)
    row = draw_row(model, nw.View(camera, photo, None, "photo.png"))
    assert row.shape == (camera.height + CAPTION_HEIGHT, 4 * camera.width + 3 * GAP, 3)
    columns = [row[CAPTION_HEIGHT:, i * (camera.width + GAP) :][:, : camera.width] for i in range(4)]
    with torch.no_grad():
        rendering, plain = model.render(camera), model.render(camera, max_hits=0)
    assert columns[0].equal(photo)
    assert columns[1].equal(to_uint8(rendering.image)) and columns[2].equal(to_uint8(plain.image))
    empty, heaviest = (columns[3] == 255).all(-1), rendering.ids[..., 0]
    assert empty.equal(heaviest < 0) and 0.0 < empty.float().mean() < 1.0
    for surfel in heaviest.unique()[1:]:
        assert len(columns[3][heaviest == surfel].unique(dim=0)) == 1
