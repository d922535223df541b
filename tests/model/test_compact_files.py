import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open

import nexwarp as nw
from examples import read_model
from nexwarp.cli import main as cli
from nexwarp.io.pictures import to_uint8
from nexwarp.model import compact
from nexwarp.model.compact import CODE, FREE, NOISE, REACH, STEPS, decode, encode
from nexwarp.model.model import Model
from nexwarp.model.model_file import COMPACT_VERSION, MODEL_FILE, save_model
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.run.evaluate import psnr
from tests.model_file_support import make_model, refused, rewrite
from tests.scenes import make_camera, make_surfels, random_scene


def limited_model(count: int = 300) -> Model:
    """A model with all parts that a compact file codes."""
    model = make_model(count)
    nearest = torch.logspace(-4, 2, count)
    nearest[::7] = NEVER
    model.detail_limits = DetailLimits(nearest, (nearest * 3).clamp(max=NEVER))
    return model


def full_tensors(model: Model, folder: Path) -> dict[str, torch.Tensor]:
    with safe_open(save_model(folder, model), "pt") as file:
        return {name: file.get_tensor(name).float() for name in file.keys()}


def coded_and_decoded(tensors: dict[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    coded = encode(tensors)
    return coded, decode(coded, {name: list(tensors[name].shape) for name in coded.keys() & set(compact.CODED)})


def test_a_compact_model_looks_the_same(tmp_path: Path) -> None:
    model = limited_model()
    # Of random surfels, the least change makes others the heaviest of a pixel.
    loaded = nw.load(model.save(tmp_path / "compact.safetensors", compact=1e-4))
    camera = make_camera(random_scene(24))
    with torch.no_grad():
        images = [to_uint8(m.render(camera).image) for m in (model, loaded)]
    assert images[0].float().std() > 10 and psnr(images[1], images[0]) > 50
    assert loaded.meta["format_version"] == COMPACT_VERSION
    assert (loaded.options, len(loaded.surfels)) == (model.options, 300)


def test_every_number_is_within_half_a_step(tmp_path: Path) -> None:
    before = full_tensors(limited_model(), tmp_path)
    coded, after = coded_and_decoded(before)
    assert after.keys() == before.keys()
    for name, values in before.items():
        error = (after[name] - values).abs()
        if name in ("footprints", "far_footprints"):  # bfloat16, towards 0
            assert bool((after[name] <= values).all()) and bool((error <= values / 128).all()), name
        elif name == "surfels.raw_quats":
            turned = torch.nn.functional.normalize(after[name]), torch.nn.functional.normalize(values)
            assert float((turned[0] - turned[1]).abs().max()) < NOISE * STEPS[name]
        elif name == "surfels.means":  # of the distance from the middle, never much less than the cloud's spread
            middle, spread, step = coded[name + CODE]
            reach = ((values - middle) ** 2 + spread**2).sqrt()
            assert bool((error <= 0.51 * step * reach + 1e-6).all())
        elif name == "texture.grid":  # without a sensitivity, a step in every direction
            assert bool((error <= 0.51 * coded[name + CODE][:, 1:].amax((1, 2))[:, None, None]).all())
        elif name in STEPS:
            assert bool((coded[name + CODE][1] <= NOISE * STEPS[name] + 1e-9).all()), name
            assert bool((error <= 0.51 * coded[name + CODE][1]).all()), name
        else:
            assert torch.equal(after[name], values), name


@pytest.mark.parametrize(("features", "residual"), [(1, True), (2, False), (4, True), (8, True)])
def test_the_grid_gets_the_noise_that_is_asked_for(features: int, residual: bool) -> None:
    """Colours of half weight change by the noise, whatever the features' scales and correlations are."""
    torch.manual_seed(0)
    texture = nw.NeuralTexture(levels=3, table_size=2**10, features=features, residual=residual)
    texture.resolutions.copy_(torch.tensor([4.0, 9.0, 20.0]))
    mixed = torch.randn(3, 2**10, features) @ torch.randn(features, features) + 2.0
    texture.grid.data = mixed * torch.tensor([0.1, 1.0, 3.0])[:, None, None]
    sensitivity = compact.texture_sensitivity(nw.Model(make_surfels(random_scene(60)), texture))
    points, directions = torch.rand(4000, 3) * 2 - 1, torch.nn.functional.normalize(torch.randn(4000, 3))

    def colors(grid: torch.Tensor) -> torch.Tensor:
        texture.grid.data = grid
        with torch.no_grad():
            return texture.evaluate(points[:, None], torch.full((4000, 1), 1e-9), directions, 1.0)

    grid, sizes = texture.grid.detach().clone(), []
    for noise in (1e-3, 8e-3):
        coded = encode({"texture.grid": grid}, sensitivity, noise)
        sizes.append(len(coded["texture.grid"]))
        changed = colors(decode(coded, {"texture.grid": list(grid.shape)})["texture.grid"])
        assert float((changed - colors(grid)).std()) == pytest.approx(noise * 2**0.5, rel=0.3)
    assert sizes[0] - sizes[1] == pytest.approx(grid.numel() * 3 / 8, rel=0.15)  # 3 bits a number for a factor of 8


def test_features_that_say_the_same_are_coded_once() -> None:
    torch.manual_seed(0)
    texture = nw.NeuralTexture(levels=1, table_size=2**12, features=4)
    sensitivity = compact.texture_sensitivity(nw.Model(make_surfels(random_scene(60)), texture))
    unlike = torch.randn(1, 2**12, 4)
    alike = unlike[..., :1].expand(-1, -1, 4)
    sizes = [len(encode({"texture.grid": grid}, sensitivity)["texture.grid"]) for grid in (alike, unlike)]
    assert sizes[0] < 0.4 * sizes[1]


def test_points_lie_on_the_surfels() -> None:
    surfels = make_surfels(random_scene(5))
    surfels.logit_opacities.data[2] = -9000.0
    ids, points = compact.surface_points(surfels, torch.Generator().manual_seed(0))
    offsets, normals = points - surfels.means.detach()[ids], surfels.normals.detach()[ids]
    assert float((offsets * normals).sum(1).abs().max()) < 1e-4
    for i, scales in enumerate(surfels.scales.detach()):
        assert bool((ids == i).any()) == (i != 2)
        if i != 2:
            assert float(offsets[ids == i].square().sum(1).mean()) == pytest.approx(float(scales @ scales), rel=0.1)


def test_numbers_that_are_alike_do_not_make_a_file_that_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream says by its length how much memory its numbers may take."""
    monkeypatch.setattr("nexwarp.model.compact.FREE", 100)
    zeros = {"texture.grid": torch.zeros(2, 2**16, 4)}
    coded, after = coded_and_decoded(zeros)
    assert len(coded["texture.grid"]) == pytest.approx(2**19 / compact.PER_BYTE, rel=0.1)
    assert torch.equal(after["texture.grid"], zeros["texture.grid"])
    with pytest.raises(ValueError, match=r"texture.grid: expected at most"):
        decode(coded, {"texture.grid": [2, 2**17, 4]})


def test_files_of_version_2_still_load(tmp_path: Path) -> None:
    run = Path(__file__).parents[1] / "old_files" / "0.2.0-69de7c9"
    full, coded = nw.load(run), nw.load(run / "compact.safetensors")
    assert coded.meta["format_version"] == 2
    expected = full.state_dict()
    for name, value in coded.state_dict().items():
        if name == "surfels.raw_quats":
            value, expected[name] = coded.surfels.quats.detach(), full.surfels.quats.detach()
        assert float((value - expected[name]).abs().max()) <= 0.01 * float(expected[name].abs().max()), name
    assert coded.options == full.options
    assert nw.load(coded.save(tmp_path, compact=True)).meta["format_version"] == COMPACT_VERSION


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_surfels(tmp_path: Path, count: int) -> None:
    model = make_model(2)
    model.surfels = nw.Surfels({name: x[:count] for name, x in model.surfels.state_dict().items()})
    loaded = nw.load(model.save(tmp_path, compact=True))
    assert len(loaded.surfels) == count
    assert bool(torch.isfinite(loaded.render(make_camera(random_scene(24))).image).all())


def test_extreme_values_harm_no_others(tmp_path: Path) -> None:
    """One far or transparent surfel leaves the coding of the others as fine as it was."""
    tensors = full_tensors(make_model(200), tmp_path)
    wild = {name: x.clone() for name, x in tensors.items()}
    wild["surfels.means"][0] = torch.tensor([1e6, -1e6, 1e6])
    wild["surfels.logit_opacities"][0] = -9000.0
    wild["surfels.log_scales"][0] = -9000.0
    after = coded_and_decoded(wild)[1]
    assert float((after["surfels.means"][1:] - tensors["surfels.means"][1:]).abs().max()) < 1e-3
    for name in ("surfels.logit_opacities", "surfels.log_scales"):
        assert float((after[name][1:] - tensors[name][1:]).abs().max()) < 0.51 * NOISE * STEPS[name], name
    assert float(after["surfels.means"][0].abs().min()) == pytest.approx(1e6, rel=1e-3)
    assert float(after["surfels.logit_opacities"][0]) < -REACH / 2


def drop(name: str) -> Callable[[dict[str, torch.Tensor], dict[str, Any]], object]:
    return lambda tensors, meta: tensors.pop(name)


def put(name: str, value: torch.Tensor) -> Callable[[dict[str, torch.Tensor], dict[str, Any]], object]:
    return lambda tensors, meta: tensors.update({name: value})


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (drop("surfels.means.code"), "surfels.means.code"),
        (drop("texture.grid"), "texture.grid"),
        (put("surfels.shN.code", torch.zeros(1, 2, 3)), "surfels.shN.code"),
        (put("surfels.means", torch.zeros(24, 3)), "surfels.means: expected U8, got F32"),
        (put("surfels.means", torch.zeros(240, dtype=torch.uint8)), "surfels.means: expected an xz stream"),
        (lambda tensors, _: tensors.update({"surfels.sh0": tensors["surfels.sh0"][:-8]}), "surfels.sh0: expected the"),
        (lambda _, meta: meta["shapes"].update({"surfels.sh0": [25, 1, 3]}), "surfels.sh0: expected the digits of 75"),
        (lambda _, meta: meta["shapes"].update({"surfels.sh0": [FREE, 300, 3]}), "surfels.sh0: expected at most"),
        (lambda _, meta: meta["shapes"].update({"surfels.sh0": [24, -1, 3]}), "expected the shape of surfels.sh0"),
        (lambda _, meta: meta["shapes"].pop("texture.grid"), "expected the shape of texture.grid, got None"),
        (put("surfels.sh0.code", torch.full((2, 1, 3), float("nan"))), "surfels.sh0"),
        (lambda _, meta: meta.update(format_version=2), ": expected I"),
        (lambda _, meta: meta.update(format_version=4), "version 1 to 3, got 4; a newer nexwarp"),
    ],
)
def test_damage_is_one_clear_line(tmp_path: Path, change: Callable[..., Any], match: str) -> None:
    file = make_model().save(tmp_path / "x.safetensors", compact=True)
    rewrite(file, change)
    refused(ValueError, nw.load, file, names=file, match=match)


def test_the_documented_reader_decodes_a_compact_file(tmp_path: Path) -> None:
    """The program of examples/, run on a compact file, gives the numbers that `nexwarp.load` gives."""
    file = limited_model().save(tmp_path / "x.safetensors", compact=True)
    tensors, meta = read_model.read(file)
    assert meta["format_version"] == COMPACT_VERSION
    loaded = nw.load(file)
    for name, value in loaded.surfels.state_dict().items():
        np.testing.assert_allclose(tensors[f"surfels.{name}"], value.numpy(), rtol=1e-6, atol=1e-9, err_msg=name)
    assert isinstance(loaded.texture, nw.NeuralTexture) and loaded.detail_limits is not None
    np.testing.assert_allclose(tensors["texture.grid"], loaded.texture.grid.detach().numpy(), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(tensors["footprints"], loaded.detail_limits.nearest.numpy())


def test_exports_of_worse_models_are_smaller(tmp_path: Path) -> None:
    """Noise that adds 0.03 dB to large errors would add more to small ones."""
    run = Path(shutil.copytree(Path(__file__).parents[1] / "old_files" / "0.2.0-69de7c9", tmp_path / "run"))

    def exported(metrics: str, *options: str) -> bytes:
        (run / "metrics.json").write_text(metrics)
        assert cli.main(["export", str(run), "--format", "compact", "--out", str(tmp_path), *options]) == 0
        return (tmp_path / "compact.safetensors").read_bytes()

    model = nw.load(run)
    usual = model.save(tmp_path / "usual.safetensors", compact=True).read_bytes()
    sizes = [len(exported(f'{{"psnr": {psnr}}}')) for psnr in (20, 30, 40)]
    assert sizes == sorted(sizes) and sizes[0] < sizes[2]
    assert exported('{"psnr": null}') == exported('{"psnr": 20}', "--noise", "0.002") == usual
    assert len(usual) < (run / MODEL_FILE).stat().st_size
    assert len(nw.load(tmp_path / "compact.safetensors").surfels) == len(model.surfels)
