import dataclasses
import json
from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data import Scene
from nexwarp.export.splats import save_surfels_ply
from nexwarp.io.ply import write_elements
from nexwarp.model.surfels import PARAMETERS
from tests.cli.support import refused
from tests.reference.collect import rotations
from tests.scenes import make_surfels, random_scene
from tests.tolerances import assert_close
from tests.trainer_support import small, trained


def write_gaussians(path: Path, quats: torch.Tensor, log_scales: torch.Tensor, **changes: torch.Tensor | None) -> None:
    """A file as of 3DGS, with SH of degree 1."""
    count = len(quats)
    columns = {name: torch.arange(count) + 10.0 * i for i, name in enumerate(["x", "y", "z", "opacity"])}
    columns |= {f"f_dc_{i}": torch.full((count,), float(i)) for i in range(3)}
    columns |= {f"f_rest_{i}": torch.full((count,), float(i)) for i in range(9)}
    columns |= {f"scale_{i}": column for i, column in enumerate(log_scales.unbind(1))}
    columns |= {f"rot_{i}": column for i, column in enumerate(quats.unbind(1))}
    kept = {name: x.float().numpy() for name, x in (columns | changes).items() if x is not None}
    write_elements(path, {"vertex": kept})


def test_an_export_comes_back_bit_for_bit(tmp_path: Path) -> None:
    surfels = make_surfels(random_scene(20))
    save_surfels_ply(tmp_path / "surfels.ply", surfels)
    again = nw.Surfels.load(tmp_path / "surfels.ply")
    assert all(torch.equal(getattr(again, name), getattr(surfels, name)) for name in PARAMETERS)


def test_gaussians_lie_along_their_two_largest_axes(tmp_path: Path) -> None:
    """Without its smallest axis, each has the covariance of its surfel; colours are channel by channel."""
    quats, log_scales = torch.randn(12, 4), torch.randn(12, 3)
    write_gaussians(tmp_path / "splats.ply", quats, log_scales)
    surfels = nw.Surfels.load(tmp_path / "splats.ply")
    squares = (2 * log_scales.double()).exp()
    squares[torch.arange(12), log_scales.argmin(1)] = 0
    axes = rotations(quats.double())
    expected = axes @ torch.diag_embed(squares) @ axes.mT
    plane = rotations(surfels.raw_quats.detach().double())[..., :2]
    found = plane @ torch.diag_embed(surfels.scales.detach().double().square()) @ plane.mT
    assert_close(found.float(), expected.float(), kind="value", name="surfels")
    assert torch.equal(surfels.logit_opacities, torch.arange(12) + 30.0)
    assert surfels.shN[3].tolist() == [[0, 3, 6], [1, 4, 7], [2, 5, 8]] and bool((surfels.gammas < 1.01).all())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"opacity": None}, "found no property opacity"),
        ({"rot_2": None}, "3DGS"),
        ({"f_rest_8": None}, "3DGS"),
        ({"x": torch.full((5,), float("nan"))}, r"surfels\.means: expected"),
        ({f"rot_{i}": torch.zeros(5) for i in range(4)}, r"surfels\.raw_quats: expected a length"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, changes: dict[str, torch.Tensor | None], message: str) -> None:
    write_gaussians(tmp_path / "bad.ply", torch.randn(5, 4), torch.randn(5, 3), **changes)
    with pytest.raises(ValueError, match=rf"bad\.ply: expected surfels, or Gaussians of 3DGS.*{message}|{message}"):
        nw.Surfels.load(tmp_path / "bad.ply")


def test_a_training_starts_from_what_is_given(tiny_scene: Scene) -> None:
    config = small()
    first = trained(tiny_scene, config).finish()
    assert isinstance(first.texture, nw.NeuralTexture)
    from_model = nw.Trainer(tiny_scene, config, "cpu", init=first)
    assert all(torch.equal(getattr(from_model.surfels, name), getattr(first.surfels, name)) for name in PARAMETERS)
    assert isinstance(from_model.texture, nw.NeuralTexture)
    assert torch.equal(from_model.texture.grid, first.texture.grid) and from_model.texture is not first.texture
    plainer = nw.Trainer(tiny_scene, dataclasses.replace(config, sh_degree=1), "cpu", init=first)
    points, depths = torch.rand(9, 3), torch.rand(9)
    assert torch.equal(plainer.surfels.sh, first.surfels.sh[:, :4])
    with torch.no_grad():
        degree_1, degree_3 = (texture(points, depths, 9.0) for texture in (plainer.texture, first.texture))
    assert_close(degree_1, degree_3[:, :4], kind="value", name="texture of degree 1")
    from_surfels = nw.Trainer(tiny_scene, dataclasses.replace(config, sh_degree=1), "cpu", surfels=first.surfels)
    assert torch.equal(from_surfels.surfels.sh, first.surfels.sh[:, :4])
    back = nw.Trainer(tiny_scene, config, "cpu", surfels=from_surfels.surfels).surfels
    assert torch.equal(back.sh[:, :4], first.surfels.sh[:, :4]) and not back.sh[:, 4:].any()
    assert isinstance(from_surfels.texture, nw.NeuralTexture)
    assert not torch.equal(from_surfels.texture.grid, first.texture.grid)
    other = nw.Model(first.surfels, None, meta={"scene_scale": 2 * tiny_scene.scale})
    for start, message in (
        ({"init": first, "surfels": first.surfels}, "init: expected None with surfels"),
        ({"init": other}, "init: expected a model of .*, whose scale is"),
        ({"surfels": make_surfels(random_scene(121))}, "surfels: expected 1 to max_surfels, 120, got 121"),
        ({"init": 3}, r"init: expected a nexwarp\.Model or None, got int"),
        ({"begin": 3}, "begin: expected no argument of this name"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            nw.train(tiny_scene, config, device="cpu", **start)


def test_the_command_starts_from_a_file_or_a_run(tiny_folder: Path, tmp_path: Path, capsys) -> None:
    """What it started from stands in config.json; a resumed run needs the surfels' file no more."""
    flags = ["--device", "cpu", "--iterations", "4", "--max-surfels", "60", "--set", "texture.table_size=256"]
    runs = [tmp_path / name for name in "abc"]
    write_gaussians(tmp_path / "splats.ply", torch.randn(70, 4), torch.zeros(70, 3))
    train = ["train", str(tiny_folder), *flags]
    many = ["--init", str(tmp_path / "splats.ply")]
    refused(capsys, [*train, "--run", str(runs[0]), *many], "--init: surfels: expected 1 to max_surfels, 60, got 70")
    assert cli.main([*train, "--run", str(runs[0])]) == 0
    save_surfels_ply(tmp_path / "surfels.ply", nw.load(runs[0]).surfels)
    for run, init in ((runs[1], tmp_path / "surfels.ply"), (runs[2], runs[0])):
        assert cli.main([*train, "--run", str(run), "--init", str(init)]) == 0
        assert json.loads((run / "config.json").read_text())["init"] == str(init)
    (tmp_path / "surfels.ply").unlink()
    assert cli.main([*train, "--run", str(runs[1]), "--resume"]) == 0
    assert len(nw.load(runs[1]).surfels) == len(nw.load(runs[0]).surfels)
