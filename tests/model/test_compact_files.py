"""Compact model files: small, close to the model, and refused with one line where they are damaged."""

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
from nexwarp.model.model import Model
from nexwarp.model.model_file import (
    CODE,
    COMPACT_DTYPES,
    COMPACT_VERSION,
    MODEL_FILE,
    REACH,
    decode,
    encode,
    save_model,
)
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.run.evaluate import psnr
from tests.model_file_support import make_model, refused, rewrite
from tests.scenes import make_camera, random_scene


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


def test_a_compact_model_looks_the_same(tmp_path: Path) -> None:
    model = limited_model()
    loaded = nw.load(model.save(tmp_path / "compact.safetensors", compact=True))
    camera = make_camera(random_scene(24))
    with torch.no_grad():
        images = [to_uint8(m.render(camera).image) for m in (model, loaded)]
    assert images[0].float().std() > 10
    assert psnr(images[1], images[0]) > 50
    assert loaded.meta["format_version"] == COMPACT_VERSION
    assert (loaded.options, len(loaded.surfels)) == (model.options, 300)


def test_every_number_is_within_half_a_step(tmp_path: Path) -> None:
    before = full_tensors(limited_model(), tmp_path)
    coded = encode(before)
    after = decode(coded)
    assert after.keys() == before.keys()
    for name, values in before.items():
        error = (after[name] - values).abs()
        if name in ("footprints", "far_footprints"):  # bfloat16, towards 0
            assert bool((after[name] <= values).all()) and bool((error <= values / 128).all()), name
        elif name == "surfels.raw_quats":
            turned = torch.nn.functional.normalize(after[name]), torch.nn.functional.normalize(values)
            assert float((turned[0] - turned[1]).abs().max()) < 1 / 2**15
        elif name == "surfels.means":  # of the distance from the middle, never much less than the cloud's spread
            middle, spread, step = coded[name + CODE]
            reach = ((values - middle) ** 2 + spread**2).sqrt()
            assert bool((error <= 0.51 * step * reach + 1e-6).all())
        elif name in ("surfels.shN", "texture.grid"):  # of the square root
            scale = coded[name + CODE][0]
            scale = scale[:, None, None] if name == "texture.grid" else scale
            assert bool(((after[name].abs() / scale).sqrt() - (values.abs() / scale).sqrt()).abs().max() <= 0.51), name
        elif name in COMPACT_DTYPES:
            assert bool((error <= 0.51 * coded[name + CODE][1]).all()), name
        else:
            assert torch.equal(after[name], values), name


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_surfels(tmp_path: Path, count: int) -> None:
    model = make_model(2)
    model.surfels = nw.Surfels({name: x[:count] for name, x in model.surfels.state_dict().items()})
    loaded = nw.load(model.save(tmp_path, compact=True))
    assert len(loaded.surfels) == count
    assert bool(torch.isfinite(loaded.render(make_camera(random_scene(24))).image).all())


def test_extreme_values_harm_no_others(tmp_path: Path) -> None:
    """One far or transparent surfel leaves the coding of the others as fine as it was."""
    model = make_model(200)
    tensors = full_tensors(model, tmp_path)
    wild = {name: x.clone() for name, x in tensors.items()}
    wild["surfels.means"][0] = torch.tensor([1e6, -1e6, 1e6])
    wild["surfels.logit_opacities"][0] = -9000.0
    wild["surfels.log_scales"][0] = -9000.0
    after = decode(encode(wild))
    for name, most in (("surfels.means", 1e-3), ("surfels.logit_opacities", 1e-3), ("surfels.log_scales", 1e-3)):
        assert float((after[name][1:] - tensors[name][1:]).abs().max()) < most, name
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
        (put("surfels.sh0.code", torch.zeros(2, 1, 3, dtype=torch.float16)), "surfels.sh0.code"),
        (put("surfels.means", torch.zeros(24, 3)), "surfels.means: expected I16, got F32"),
        (put("surfels.means.code", torch.full((3, 3), 1e30)), "surfels.means"),
        (put("surfels.sh0.code", torch.full((2, 1, 3), float("nan"))), "surfels.sh0"),
        (put("surfels.raw_quats", torch.zeros(24, 4, dtype=torch.int16)), "surfels.raw_quats"),
        (lambda _, meta: meta.update(format_version=1), "surfels"),
        (lambda _, meta: meta.update(format_version=3), "version 1 to 2, got 3; a newer nexwarp"),
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


def test_export_writes_a_compact_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Path(__file__).parents[1] / "old_files" / "0.2.0-69de7c9"
    assert cli.main(["export", str(run), "--format", "compact", "--out", str(tmp_path)]) == 0
    file = tmp_path / "compact.safetensors"
    assert capsys.readouterr().out.split() == [str(file)]
    assert file.stat().st_size < (run / MODEL_FILE).stat().st_size  # of few surfels, so most of it is header
    assert len(nw.load(file).surfels) == len(nw.load(run).surfels)
