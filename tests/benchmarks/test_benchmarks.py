"""The benchmarks measure what they say: the timer, the scenes, the command line, the torch comparison."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import nexwarp as nw
from benchmarks import __main__ as command
from benchmarks import bench_cpu, bench_frame, bench_kernels, bench_peers, bench_sizes
from benchmarks.gpu_time import busy
from benchmarks.scenes import SurfelScene, cloud, fox, garden, geometry, outputs, random_like, texture, workload
from benchmarks.suite import Options, table
from benchmarks.timing import Measurement, figure, measure, ratio
from nexwarp import Camera, NeuralTexture, Surfels, ops
from nexwarp.cameras.cameras_file import save_cameras
from nexwarp.model import model as model_module
from nexwarp.model.detail_limits import NEVER
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from nexwarp.ops import Pinhole
from tests.tolerances import assert_close

CPU = torch.device("cpu")


def small_scene() -> SurfelScene:
    return cloud(300, 43, 30)


def test_timer_finds_the_median_of_a_known_sleep() -> None:
    calls: list[None] = []

    def nap() -> None:
        calls.append(None)
        time.sleep(0.2 if len(calls) == 1 else 0.02)

    m = measure("nap", nap, CPU, warmup=1, least=5, most=5, sizes={"surfels": 1})
    assert len(calls) == 6 and m.repeats == 5
    assert 20 <= m.median < 60  # the slow first call is warm-up; a shared machine may oversleep
    assert m.p10 <= m.median <= m.p90
    assert m.unit == "ms" and m.device == "cpu" and m.device_name and m.commit and m.date


def test_timer_stops_in_time() -> None:
    assert measure("nap", lambda: time.sleep(0.03), CPU, warmup=0, least=2, seconds=0.0).repeats == 2


def test_ratio_divides_medians() -> None:
    a, b = figure("a", [1.0, 2.0, 3.0], CPU), figure("b", 4.0, CPU)
    assert ratio("a over b", a, b).median == pytest.approx(0.5)
    assert ratio("a over b", a, b).unit == "x"


def test_table_compares_gpu_and_cpu() -> None:
    results = [
        Measurement(name="walk", scene="cloud", device=device, median=median, p10=1.0, p90=1.0)
        for device, median in (("cuda", 2.0), ("cpu", 50.0))
    ]
    assert "times as fast" in table(results)
    assert table(results).splitlines()[-1].split() == ["walk", "cloud", "50", "2", "25"]
    assert "times as fast" not in table(results[:1])


def points_file(folder: Path) -> None:
    """A garden_points.npz of few points."""
    import numpy as np

    generator = np.random.default_rng(0)
    K = np.array([[480.0, 0, 324], [0, 480, 210], [0, 0, 1]], dtype=np.float32)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3.0
    np.savez(
        folder / "garden_points.npz",
        means3d=generator.normal(size=(50, 3)).astype(np.float32),
        colors=generator.integers(0, 256, (50, 3), dtype=np.uint8),
        viewmats=viewmat[None],
        Ks=K[None],
    )


def test_scenes_are_seeded(tmp_path: Path) -> None:
    points_file(tmp_path)
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


def test_scenes_are_seen() -> None:
    g = geometry(small_scene())
    assert g.hits().alpha.mean() > 0.5


def test_command_writes_well_formed_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    assert command.main(["--quick", "--device", "cpu", "--only", "collect", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    names = [line["name"] for line in lines]
    assert names == [
        "collect, forward",
        "collect, backward",
        "collection stage, forward",
        "collection stage, forward + backward",
    ]
    for line in lines:
        assert line.keys() == Measurement.__dataclass_fields__.keys()
        assert line["device"] == "cpu" and line["unit"] == "ms" and line["device_name"]
        assert 0 < line["p10"] <= line["median"] <= line["p90"]
        assert line["sizes"].items() >= {"surfels": 500, "width": 64, "height": 48}.items()
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)


OPTIONS = RenderOptions(max_hits=1, background=(0.0, 1.0, 0.0), sh_degree=2, clamp_texture=True)


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """What `nexwarp train` leaves behind, as far as the benchmarks need it."""
    folder = tmp_path / "run"
    folder.mkdir()
    scene = small_scene()
    field = NeuralTexture(levels=4, table_size=2**8, width=16)
    Model(scene.surfels, field, options=OPTIONS).save(folder)
    cameras = {str(i): camera for i, camera in enumerate(scene.cameras)}
    save_cameras(folder / "cameras.json", {"train": cameras, "test": {}})
    return folder


def test_trained_scene_is_that_of_the_run(run_folder: Path) -> None:
    scene, made = fox(run_folder), small_scene()
    assert torch.equal(scene.surfels.means, made.surfels.means)
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(scene.cameras, made.cameras, strict=True))
    assert texture(scene) is scene.model.texture and texture(scene).config["table_size"] == 2**8
    assert scene.model.options == OPTIONS
    assert "fox" in scene.name and "300 at 43x30" in scene.name


def test_trained_scene_takes_part_only_when_it_is_named(run_folder: Path) -> None:
    without, with_model = (workload(Options(CPU, quick=True, model=model)) for model in (None, run_folder))
    assert [scene.name for scene in with_model[:-1]] == [scene.name for scene in without]
    assert "fox" in with_model[-1].name and not any("fox" in scene.name for scene in without)


def test_frames_of_the_trained_scene_are_timed_with_its_options(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, seen = fox(run_folder), []
    render = nw.render

    def note(surfels: Surfels, texture: NeuralTexture, camera: Camera, *options: Any, **others: Any) -> Any:
        seen.append((texture, options[:5], others["detail_limits"]))
        return render(surfels, texture, camera, *options, **others)

    monkeypatch.setattr(model_module, "render", note)
    bench_frame.frame(scene, Options(CPU, quick=True))
    # The first rendering measures the detail limits, which this model lacks.
    (_, _, first), *frames = seen
    assert first is None and len(frames) > 2
    expected = (OPTIONS.max_hits, OPTIONS.background, OPTIONS.sh_degree, OPTIONS.low_pass, OPTIONS.clamp_texture)
    assert all(options == expected for _, options, _ in frames)
    assert all(field is scene.model.texture and limits is not None for field, _, limits in frames)


def test_frames_of_an_untrained_scene_have_what_a_finished_model_has() -> None:
    model = bench_frame.finished(small_scene())
    assert model.texture is not None and model.detail_limits is not None and model.exposures is not None
    assert (model.detail_limits.nearest < NEVER).any() and (model.detail_limits.farthest < NEVER).any()
    again = bench_frame.finished(replace(small_scene(), model=model))
    assert again.texture is model.texture and again.detail_limits is model.detail_limits


def test_command_names_the_trained_scene_or_says_that_it_is_absent(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ["--quick", "--device", "cpu", "--only", "tiles"]
    assert command.main(quick) == 0
    assert "the trained fox was left out" in capsys.readouterr().out
    assert command.main([*quick, "--model", str(run_folder)]) == 0
    shown = capsys.readouterr().out
    assert "left out" not in shown and "fox, trained, 300 at 43x30" in shown
    with pytest.raises(SystemExit):
        command.main([*quick, "--model", str(run_folder.parent)])
    assert "model.safetensors" in capsys.readouterr().err


def test_command_refuses_unknown_stages(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["--only", "colect"])
    assert "colect" in capsys.readouterr().err


def test_a_failing_stage_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(options: Options) -> list[Measurement]:
        raise RuntimeError("broken")

    monkeypatch.setitem(command.STAGES, "tiles", fail)
    out = tmp_path / "figures.json"
    assert command.main(["--quick", "--device", "cpu", "--only", "tiles,project", "--out", str(out)]) == 1
    assert "project, forward" in out.read_text()


@pytest.mark.parametrize("max_hits", [0, 2, 4])
def test_torch_comparison_agrees_with_the_kernels(max_hits: int) -> None:
    g = geometry(small_scene())
    with torch.no_grad():
        projection = g.project()
    records = projection.records.requires_grad_()
    tiles = g.tiles(projection)
    actual = outputs(ops.collect(projection, tiles, g.pinhole, max_hits=max_hits))
    expected = bench_cpu.torch_collect(records, tiles, g.pinhole, max_hits)
    for name, a, e in zip(("plain", "depths", "weights", "alpha"), actual, expected, strict=True):
        assert_close(a, e, kind="value", name=name)
    signals = random_like(actual)
    gradients = [torch.autograd.grad(found, records, signals)[0] for found in (actual, expected)]
    assert_close(*gradients, kind="gradient", name="records")


def test_peer_gets_the_same_scene() -> None:
    """gsplat is called with its own names and shapes; a stand-in records them, since gsplat needs CUDA."""
    seen = {}

    class Peer:
        @staticmethod
        def rasterization_2dgs(means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane):
            seen.update({k: tuple(v.shape) for k, v in locals().items() if isinstance(v, torch.Tensor)})
            assert (width, height) == (43, 30) and near_plane > 0
            return means.sum().expand(1, height, width, 3), opacities.sum().expand(1, height, width, 1), None

    g = geometry(small_scene())
    assert isinstance(g.pinhole, Pinhole)
    call = bench_peers.gsplat_call(g, Peer)
    assert len(call.forward()) == 2
    assert seen == {
        "means": (300, 3),
        "quats": (300, 4),
        "scales": (300, 3),
        "opacities": (300,),
        "colors": (1, 300, 3),
        "viewmats": (1, 4, 4),
        "Ks": (1, 3, 3),
    }
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
    starts = tiles.tile_offsets[(y // tiles.tile_size) * tiles.columns + x // tiles.tile_size]
    assert walked == pytest.approx((hits.stops - starts).double().mean().item())
    assert 0 < walked < listed


# Cost against size


def test_sizes_cover_what_they_should() -> None:
    sweep = bench_sizes.CUDA
    ends = {axis: [getattr(p, axis) for p in sweep.along(axis)] for axis in ("surfels", "megapixels", "hits")}
    assert (ends["surfels"][0], ends["surfels"][-1]) == (10_000, 4_000_000)
    assert (ends["megapixels"][0], ends["megapixels"][-1]) == (0.25, 8.0)
    assert (ends["hits"][0], ends["hits"][-1]) == (0, 8)
    for axis in ends:
        points = sweep.along(axis)
        assert sweep.base in points
        assert all((bench_sizes.share(axis, a, b) or 1) <= 2.5 for a, b in pairwise(points)), axis


def test_sizes_mark_a_cliff_and_nothing_else() -> None:
    before = figure("frame", 10.0, CPU, peak_mib=100.0)
    fair, steep = (figure("frame", t, CPU, peak_mib=200.0) for t in (20.0, 30.0))
    assert bench_sizes.growth(before, fair, 2.0) == "time x2.00, memory x2.00 for x2.00"
    assert bench_sizes.growth(before, steep, 2.0) == "time x3.00 CLIFF, memory x2.00 for x2.00"
    assert "memory x2.00 CLIFF" in bench_sizes.growth(before, fair, 1.5)
    assert "CLIFF" not in bench_sizes.growth(before, steep, None), "a texture is more than its share of K = 0"


def sizes(monkeypatch: pytest.MonkeyPatch, cost: Callable[[SimpleNamespace, int], float]) -> list[Measurement]:
    """Run the CUDA sweeps over made-up costs in ms."""

    def at_size(scene: SimpleNamespace, hits: int, *_: object) -> list[Measurement]:
        return [figure(name, cost(scene, hits), CPU, **scene.facts) for name in ("frame", "frame + backward")]

    monkeypatch.setattr(bench_sizes, "CPU", bench_sizes.CUDA)
    monkeypatch.setattr(bench_sizes, "at_size", at_size)

    def scene_at(point: bench_sizes.Point, *_: object) -> SimpleNamespace:
        return SimpleNamespace(point=point, facts={"scene": str(point), "sizes": {"surfels": point.surfels}})

    monkeypatch.setattr(bench_sizes, "scene_at", scene_at)
    return bench_sizes.run(Options(CPU))


def test_sizes_count_cliffs_and_leave_out_what_takes_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    *rows, cliffs = sizes(monkeypatch, lambda scene, hits: scene.point.surfels / 1000)  # 4M: 4 s, over the limit
    assert cliffs.median == 0 and not any(bench_sizes.CLIFF in m.note for m in rows)
    by_surfels = [m for m in rows if m.name == "frame + backward, by surfels"]
    assert by_surfels[-1].sizes["surfels"] == 2_000_000
    assert "left out, too slow: surfels 4,000,000" in by_surfels[-1].note

    *rows, cliffs = sizes(monkeypatch, lambda scene, hits: 1.0 if scene.point.megapixels < 4.0 else 100.0)
    marked = [m for m in rows if bench_sizes.CLIFF in m.note]
    assert cliffs.median == len(marked) == 2 and all("megapixels=4.0" in m.scene for m in marked)


def test_sizes_leave_out_what_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def cost(scene: SimpleNamespace, hits: int) -> float:
        if scene.point.surfels > 1_000_000:
            raise torch.OutOfMemoryError("full")
        return 1.0

    rows = [m for m in sizes(monkeypatch, cost) if m.name == "frame + backward, by surfels"]
    assert rows[-1].sizes["surfels"] == 1_000_000
    assert "left out, out of memory: surfels 2,000,000, 4,000,000" in rows[-1].note


def test_sizes_measure_a_scene_that_is_seen() -> None:
    rows = bench_sizes.run(Options(CPU, quick=True))
    assert {m.name.rpartition(" by ")[2] for m in rows[:-1]} == {"surfels", "megapixels", "hits"}
    assert {m.sizes["max_hits"] for m in rows[:-1]} == {0, 2}
    empty = replace(small_scene(), cameras=(away(small_scene().camera),))
    with pytest.raises(RuntimeError, match="finite picture"):
        bench_sizes.at_size(empty, 0, bench_sizes.QUICK, Options(CPU, quick=True))


def away(camera: Camera) -> Camera:
    """The same camera, far outside and looking away."""
    viewmat = camera.viewmat.clone()
    viewmat[2, 3] = -1000.0
    return Camera(viewmat, camera.K, camera.width, camera.height)


def test_kernels_of_a_call_are_summed_by_short_names(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = ("collect_kernel__locals__collect_0a1b2c3d_cuda_kernel_forward", "collect_kernel__locals__collect")
    sums = "void at::native::reduce_kernel<512, 1, at::native::ReduceOp<float> >(at::native::ReduceOp<float>)"
    found = {hashed[0]: 2.0, sums: 1.0, sums.replace("<512", "<256"): 0.5, "rare_kernel(int)": 0.001}
    monkeypatch.setattr(bench_kernels, "gpu_time", lambda call, repeats: (3.501, found))
    scene = cloud(10, 8, 8)
    rows = [*bench_kernels.kernels("frame", lambda: None, scene, Options(CPU))]
    told = {row.name: (row.median, row.note) for row in rows[1:]}
    assert rows[0].median == 3.501 and told == {
        f"frame: {hashed[1]}": (2.0, "57.1 % of the call"),
        "frame: reduce_kernel<ReduceOp": (1.5, "42.8 % of the call"),
    }
