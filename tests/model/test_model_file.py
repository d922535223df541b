import pickle
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

import nexwarp as nw
from nexwarp.model.model_file import MODEL_FILE, save_model
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from tests.model_file_support import make_model, refused, rewrite


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


def test_missing_model(tmp_path):
    refused(FileNotFoundError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="or a run folder with")
    refused(FileNotFoundError, nw.load, tmp_path / "no", names=tmp_path / "no", match="or a run folder with")


def test_files_of_another_kind(tmp_path):
    file = save_model(tmp_path, make_model())
    whole = file.read_bytes()
    for content in (b"", b"no model", b"\xff" * 64, b"{}" * 100, whole[:99], whole[: len(whole) // 2], whole[:-9]):
        file.write_bytes(content)
        refused(ValueError, nw.load, tmp_path, names=file, match="expected a safetensors file")
    for metadata in (None, *({"nexwarp": header} for header in ("{", "[]", "3", '"text"'))):
        safetensors.torch.save_file({"x": torch.zeros(3)}, file, metadata)
        refused(ValueError, nw.load, file, names=file, match="metadata")


@pytest.mark.parametrize("name", ["surfels.means", "surfels.raw_gammas", "texture.grid", "texture.mlp.2.weight"])
def test_tensors_that_are_missing_or_do_not_fit(tmp_path, name):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda tensors, _: tensors.update({name: tensors[name][..., :1].contiguous()}))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])
    rewrite(file, lambda tensors, _: tensors.pop(name))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])


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


ABSENT = object()
BAD_METADATA = [
    *(("max_hits", value) for value in ("two", 9, ABSENT)),
    *(("background", value) for value in ([0, 0], ABSENT)),
    *(("low_pass", value) for value in (1, True)),
    *(("texture", value) for value in ({"parts": [{}]}, ABSENT)),
    *(("sh_degree", value) for value in (7, None, ABSENT)),
    *(("smooth_sh", value) for value in ("smooth", -0.1)),
    *(("near", "far"), ("exposure", "bright"), ("detail_limits", "no"), ("clamp_texture", ABSENT)),
]


@pytest.mark.parametrize(("key", "value"), BAD_METADATA)
def test_models_that_cannot_render_are_refused(tmp_path, key, value):
    file = save_model(tmp_path, make_model(3))
    rewrite(file, lambda _, meta: meta.pop(key) if value is ABSENT else meta.update({key: value}))
    refused(ValueError, nw.load, tmp_path, names=file, match=key)
