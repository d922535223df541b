"""Model files: what comes back is what went in, damage is one clear line."""

import pickle
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from safetensors import safe_open

import nexwarp as nw
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.model_file import LATER_OPTIONS, MODEL_FILE, save_model
from nexwarp.model.options import RenderOptions
from nexwarp.model.render import draw
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from tests.model_file_support import META, OPTIONS, make_model, refused, rewrite
from tests.scenes import make_camera, make_surfels, random_scene


class Bomb:
    """What a pickle must never get to do."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.marker,))


@pytest.mark.parametrize("name", ["footprints", "far_footprints"])
def test_detail_limits_come_back_exactly(tmp_path: Path, name: str) -> None:
    """One may be there without the other, as in files from before there were two; the other then limits nothing."""
    model = make_model()
    assert nw.load(save_model(tmp_path, model)).detail_limits is None
    limits = DetailLimits(*torch.rand(2, len(model.surfels)))
    model.detail_limits = limits
    file = save_model(tmp_path, model)
    loaded = nw.load(file).detail_limits
    assert loaded is not None
    assert torch.equal(loaded.nearest, limits.nearest) and torch.equal(loaded.farthest, limits.farthest)
    double = nw.load(file).to(torch.float64).detail_limits
    assert double is not None and double.farthest.dtype == torch.float64
    other = "far_footprints" if name == "footprints" else "footprints"
    rewrite(file, lambda tensors, _: tensors.pop(other))
    alone = nw.load(file).detail_limits
    assert alone is not None
    if name == "footprints":
        assert torch.equal(alone.nearest, limits.nearest) and (alone.farthest == NEVER).all()
    else:
        assert (alone.nearest == 0).all() and torch.equal(alone.farthest, limits.farthest)
    rewrite(file, lambda tensors, _: tensors.update({name: torch.rand(len(model.surfels) + 1)}))
    with pytest.raises(ValueError, match=rf"expected the tensors of a nexwarp model \({name}: expected shape"):
        nw.load(file)


@pytest.mark.parametrize("stored", [(), ("footprints",), ("footprints", "far_footprints")])
def test_a_file_of_version_0_1_renders_as_before(tmp_path: Path, stored: tuple[str, ...]) -> None:
    """Its metadata has no `exposure` and `detail_limits`; it may hold the nearest limits alone, or none."""
    scene = random_scene(24)
    camera = make_camera(scene)
    model = make_model()
    limits = torch.full((24,), 3.5 / camera.focal), torch.full((24,), 3.0 / camera.focal)
    model.detail_limits = DetailLimits(*limits)
    model.exposures = Exposures.of(torch.tensor([[0.3, 0.0, -0.2]]), [camera], (-0.3, -0.2, 0.4))
    file = save_model(tmp_path, model)

    def age(tensors: dict[str, torch.Tensor], meta: dict[str, Any]) -> None:
        for key in LATER_OPTIONS:
            del meta[key]
        for name in {"footprints", "far_footprints"}.difference(stored):
            del tensors[name]

    rewrite(file, age)
    loaded = nw.load(file)
    assert loaded.options == OPTIONS and loaded.exposures is not None
    nearest = limits[0] if "footprints" in stored else torch.zeros(24)
    farthest = limits[1] if "far_footprints" in stored else torch.full((24,), NEVER)
    limits_read = DetailLimits(nearest, farthest) if stored else None
    drawn = (loaded.surfels, loaded.texture, camera, loaded.options)
    expected = draw(*drawn, exposures=loaded.exposures, limits=limits_read)
    assert torch.equal(loaded.render(camera).image, expected.image)
    assert (loaded.detail_limits is None) == (not stored)


def some_exposures(falloff: torch.Tensor | None = None) -> Exposures:
    """Random exposures of five photos."""
    log_gains, positions, directions, coefficients = torch.rand(4, 5, 3)
    buffers = {"log_gains": log_gains, "positions": positions, "directions": directions, "coefficients": coefficients}
    buffers |= {"mean": torch.rand(3), "lengths": torch.rand(2)} | ({} if falloff is None else {"falloff": falloff})
    return Exposures(buffers)


def test_exposures_come_back_exactly(tmp_path):
    model = make_model()
    assert nw.load(save_model(tmp_path, model)).exposures is None
    model.exposures = some_exposures(torch.rand(3))
    loaded = nw.load(save_model(tmp_path, model))
    assert loaded.exposures is not None
    for name, value in model.exposures.named_buffers():
        assert torch.equal(loaded.exposures.state_dict()[name], value), name
    double = loaded.to(torch.float64).exposures
    assert double is not None and double.lengths.dtype == torch.float64
    model.exposures.positions = torch.rand(4, 3)
    with pytest.raises(ValueError, match=r"expected the tensors of a nexwarp model \(positions: expected shape"):
        nw.load(save_model(tmp_path, model))


@pytest.mark.parametrize("changes", [{"exposure": "mean"}, {"detail_limits": False}, {"max_hits": 0}])
def test_options_survive(tmp_path: Path, changes: dict[str, Any]) -> None:
    model = Model(make_surfels(random_scene(3)), None, options=OPTIONS.changed(**changes), meta=META)
    loaded = nw.load(save_model(tmp_path, model))
    assert loaded.options == model.options
    assert not {field.name for field in fields(RenderOptions)} & loaded.meta.keys()


def test_missing_model(tmp_path):
    refused(FileNotFoundError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="or a run folder with")
    refused(FileNotFoundError, nw.load, tmp_path / "no", names=tmp_path / "no", match="or a run folder with")


def test_files_of_another_kind(tmp_path):
    file = save_model(tmp_path, make_model())
    whole = file.read_bytes()
    for content in (
        b"",
        b"not a model at all",
        b"\xff" * 64,
        b"{}" * 100,
        whole[:99],
        whole[: len(whole) // 2],
        whole[:-9],
    ):
        file.write_bytes(content)
        refused(ValueError, nw.load, tmp_path, names=file, match="expected a safetensors file")
    for header in (None, "{", "[]", "3", '"text"'):
        safetensors.torch.save_file({"x": torch.zeros(3)}, file, header and {"nexwarp": header})
        refused(ValueError, nw.load, file, names=file, match="metadata")


@pytest.mark.parametrize("name", ["surfels.means", "surfels.raw_gammas", "texture.grid", "texture.mlp.2.weight"])
def test_tensors_that_are_missing_or_do_not_fit(tmp_path, name):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda tensors, _: tensors.update({name: tensors[name][..., :1].contiguous()}))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])
    rewrite(file, lambda tensors, _: tensors.pop(name))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])


@pytest.mark.parametrize("key", ["texture", "max_hits", "background", "sh_degree", "clamp_texture"])
def test_missing_metadata(tmp_path, key):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda _, meta: meta.pop(key))
    refused(ValueError, nw.load, file, names=file, match=key)


def test_nothing_is_unpickled(tmp_path):
    marker = tmp_path / "exploded"
    content = pickle.dumps(Bomb(marker))
    (tmp_path / MODEL_FILE).write_bytes(content)
    refused(ValueError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="expected a safetensors file")
    torch.save({"x": Bomb(marker)}, tmp_path / MODEL_FILE)
    refused(ValueError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="expected a safetensors file")
    folder = tmp_path / "checkpoint"
    save_checkpoint(tmp_path, {"x": torch.zeros(1)}, {})
    (folder / "tensors.safetensors").write_bytes(content)
    refused(ValueError, load_checkpoint, tmp_path, names=folder, match="expected a whole checkpoint")
    assert not marker.exists()
    pickle.loads(content)  # the bomb does work
    assert marker.exists()


def update_meta(key: str, value: object) -> Callable[[dict[str, torch.Tensor], dict[str, Any]], None]:
    return lambda _, meta: meta.update({key: value})


def test_models_that_cannot_render_are_refused(tmp_path):
    from safetensors.torch import load_file, save_file

    texture = nw.NeuralTexture(levels=2, table_size=2**4, width=8)
    model = nw.Model(make_surfels(random_scene(3)), texture)
    for key, value in (
        ("max_hits", "two"),
        ("max_hits", 9),
        ("background", [0, 0]),
        ("low_pass", 1),
        ("low_pass", True),
        ("texture", {"parts": [{}]}),
        ("sh_degree", 7),
        ("sh_degree", None),
        ("near", "far"),
        ("smooth_sh", "smooth"),
        ("smooth_sh", -0.1),
        ("exposure", "bright"),
        ("detail_limits", "no"),
    ):
        rewrite(save_model(tmp_path, model), update_meta(key, value))
        with pytest.raises(ValueError, match=key):
            nw.load(tmp_path)
    path = save_model(tmp_path, model)
    with safe_open(path, "pt") as file:
        header = file.metadata()
    tensors = load_file(path)
    tensors["surfels.means"][1, 2] = float("nan")
    save_file(tensors, path, header)
    with pytest.raises(ValueError, match=r"means: expected values from -1e\+16 to 1e\+16, got nan at index \(1, 2\)"):
        nw.load(tmp_path)
