"""The benchmarks measure what they say: the timer, the scenes, the command line, the torch comparison."""

import json
import time
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as command
from benchmarks import bench_cpu, bench_peers
from benchmarks.scenes import Scene, cloud, garden, geometry, outputs, random_like
from benchmarks.suite import Options, table
from benchmarks.timing import Measurement, figure, measure, ratio
from nexwarp import ops
from nexwarp.ops import Pinhole
from tests.tolerances import assert_close

CPU = torch.device("cpu")


def small_scene() -> Scene:
    return cloud(300, 43, 30)


def test_timer_finds_the_median_of_a_known_sleep() -> None:
    calls = []

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
    facts = {"name": "walk", "scene": "cloud", "p10": 1.0, "p90": 1.0}
    results = [Measurement(device=d, median=m, **facts) for d, m in (("cuda", 2.0), ("cpu", 50.0))]
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
    rasterize, leaves = bench_peers.gsplat_call(g, Peer)
    assert len(rasterize()) == 2
    assert seen == {
        "means": (300, 3),
        "quats": (300, 4),
        "scales": (300, 3),
        "opacities": (300,),
        "colors": (300, 3),
        "viewmats": (1, 4, 4),
        "Ks": (1, 3, 3),
    }
    assert all(x.is_leaf and x.requires_grad for x in leaves)
