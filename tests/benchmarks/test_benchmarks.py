"""The benchmarks measure what they say: timer, scenes, commands, gsplat, the README's picture."""

import json
import time
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from benchmarks import __main__ as command
from benchmarks import bench_peers
from benchmarks.gpu_time import busy
from benchmarks.picture import GAP, draw_row
from benchmarks.scenes import SurfelScene, cloud, geometry
from benchmarks.timing import Measurement, Repeats, measure
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
