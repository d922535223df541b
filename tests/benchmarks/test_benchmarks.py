"""The benchmarks measure what they say: timer, command, gsplat."""

import json
import time
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as command
from benchmarks import bench_peers
from benchmarks.gpu_time import busy
from benchmarks.scenes import SurfelScene, cloud, geometry
from benchmarks.timing import Measurement, Repeats, measure
from nexwarp.ops import Pinhole

CPU = torch.device("cpu")


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


def test_the_command_writes_a_measurement_a_line(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    assert command.main(["--quick", "--device", "cpu", "--only", "collect", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(lines) == 4 and all(line.keys() == Measurement.__dataclass_fields__.keys() for line in lines)
    assert all(0 < line["p10"] <= line["median"] <= line["p90"] for line in lines)


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
