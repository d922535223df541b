"""Nothing of a model is lost on the way through a file or a state dict; what is missing is named."""

import dataclasses
import re
from pathlib import Path

import pytest
import safetensors.torch
import torch

import nexwarp as nw
from nexwarp.errors import FormatError
from nexwarp.io.json_files import Json
from tests.model.test_model import cameras_of, full_model
from tests.narrowing import present
from tests.render_support import assert_same

# None of them the default.
OPTIONS = nw.RenderOptions(1, (0.3, 0.2, 0.1), 2, True, "mean", False, "distance")
META: dict[str, Json] = {
    "near": 0.02,
    "scene_scale": 3.0,
    "preset": "paper",
    "iteration": 11,
    "smooth_sh": 0.5,
    "mine": {"a": [1, None]},
}
PARTS = ("surfels", "texture", "exposures", "detail_limits")


def model_with_everything() -> nw.Model:
    model = full_model()
    return nw.Model(model.surfels, model.texture, model.exposures, model.detail_limits, OPTIONS, META)


def without(state: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name: x for name, x in state.items() if not name.startswith(prefix)}


def test_no_option_of_these_tests_is_the_default():
    assert all(getattr(OPTIONS, f.name) != f.default for f in dataclasses.fields(nw.RenderOptions))


def test_everything_comes_back_from_a_file(tmp_path):
    model, camera = model_with_everything(), cameras_of()[0]
    loaded = nw.load(model.save(tmp_path / "a.safetensors"))
    again = nw.load(loaded.save(tmp_path / "b.safetensors"))
    for each in (loaded, again):
        assert each.options == OPTIONS and META.items() <= each.meta.items()
        assert present(each.texture).config == present(model.texture).config
        assert each.state_dict().keys() == model.state_dict().keys()
    with torch.no_grad():
        present(model.texture).load_state_dict(present(loaded.texture).state_dict())  # rounded to half precision
    for name, x in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], x), name
    assert_same(loaded.render(camera), model.render(camera))
    everything = loaded.render(camera, exposure="photos", detail_limits=True)
    assert_same(everything, model.render(camera, exposure="photos", detail_limits=True))
    for part in ("exposures", "detail_limits"):  # each of them is seen in the picture
        setattr(again, part, None)
        assert not torch.equal(again.render(camera, exposure="photos", detail_limits=True).image, everything.image), (
            part
        )


def test_tensors_come_back_from_a_state_dict_and_options_stay(tmp_path):
    """A state dict holds the tensors alone, as any module's does."""
    model, other, camera = model_with_everything(), model_with_everything(), cameras_of()[0]
    torch.save(model.state_dict(), tmp_path / "state.pt")
    with torch.no_grad():
        for x in other.state_dict().values():
            x.mul_(0.9)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    assert {name.partition(".")[0] for name in state} == set(PARTS)
    assert not any(torch.equal(other.state_dict()[name], x) for name, x in state.items() if bool(x.any()))
    other.load_state_dict(state)
    assert other.options == OPTIONS and other.meta == META
    assert_same(other.render(camera), model.render(camera))
    one, two = (each.render(camera, exposure="photos", detail_limits=True) for each in (other, model))
    assert_same(one, two)


@pytest.mark.parametrize("part", PARTS)
def test_a_state_dict_without_a_part_is_refused_by_name(part):
    model = model_with_everything()
    state = dict(model.state_dict())
    with pytest.raises(RuntimeError, match=rf'Missing key\(s\) in state_dict: "{part}\.'):
        model.load_state_dict(without(state, f"{part}."))
    if part != "surfels":
        setattr(model, part, None)
        with pytest.raises(RuntimeError, match=rf'Unexpected key\(s\) in state_dict: "{part}\.'):
            model.load_state_dict(state)


def test_surfels_alone_are_no_model(tmp_path):
    model = model_with_everything()
    alone = model.surfels.state_dict()
    for state in (alone, {f"surfels.{name}": x for name, x in alone.items()}):
        with pytest.raises(RuntimeError) as caught:
            model.load_state_dict(state)
        assert all(f'"{name}"' in str(caught.value) for name in model.state_dict() if name not in state)
    with pytest.raises(TypeError, match=r"^surfels: expected a nexwarp\.Surfels, got dict$"):
        nw.Model(dict(alone), None)  # type: ignore[arg-type]
    file = tmp_path / "surfels.safetensors"
    safetensors.torch.save_file(dict(alone), file)
    with pytest.raises(
        FormatError, match=rf"^{re.escape(str(file))}: expected a nexwarp model, but the file has no nexw"
    ):
        nw.load(file)


def test_a_model_s_state_is_not_that_of_surfels():
    """An earlier version took the surfels from it and left out what else there was."""
    state = model_with_everything().state_dict()
    own = {name.removeprefix("surfels."): x for name, x in state.items()}
    for given in (state, own):
        with pytest.raises(
            ValueError, match=r"^raw: expected the keys \['log_scales', .* got \[.*'exposures\.falloff'"
        ):
            nw.Surfels(dict(given))


@pytest.mark.parametrize("name", ["exposures.mean", "exposures.lengths", "texture.grid", "surfels.means"])
def test_a_file_without_a_tensor_is_refused_by_name(tmp_path, name):
    file = Path(model_with_everything().save(tmp_path / "a.safetensors"))
    with safetensors.safe_open(file, "pt") as opened:
        tensors = {key: opened.get_tensor(key) for key in opened.keys() if key != name}
        metadata = opened.metadata()
    safetensors.torch.save_file(tensors, file, metadata)
    with pytest.raises(FormatError, match=rf"^{re.escape(str(file))}: .*{name.partition('.')[2]}"):
        nw.load(file)
