"""Files of newer versions: unknown keys and tensors are passed over, an unknown format version is one clear line.

And files with too many entries, which are refused before each entry is looked at.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.data.scene import SceneSource
from nexwarp.errors import CheckpointError
from nexwarp.io.json_files import write_json
from nexwarp.model.model_file import save_model
from nexwarp.run.folder import RunRecord, create_run, read_metrics, read_run
from nexwarp.train import initial
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.recipe import TextureConfig
from tests.data.inputs.support import edit
from tests.model.test_bounds import tiny_camera, tiny_model
from tests.model_file_support import refused, rewrite
from tests.narrowing import neural
from tests.scenes import make_camera, random_scene
from tests.tolerances import assert_equal
from tests.trainer_support import assert_same_state, small, trained

ANYTHING = {"new": [1, {"a": None}], "x": "text", "": 0}
WRONG_VERSIONS = (True, False, 1.0, "1", 0, -1, None, [1], 1.5)


def test_a_model_with_unknown_keys_and_tensors_loads_the_same(tmp_path: Path) -> None:
    model = tiny_model()
    expected = nw.load(save_model(tmp_path / "old", model))
    file = save_model(tmp_path / "new", model)

    def extend(tensors: dict[str, torch.Tensor], meta: dict[str, Any]) -> None:
        meta["brightness"] = ANYTHING
        meta["texture"]["activation"] = "sine"
        for name in ("surfels.roughness", "exposures.curve", "texture.mlp.6.weight", "texture.bias", "lights"):
            tensors[name] = torch.full((2, 3), torch.nan, dtype=torch.float64)
        tensors["labels"] = torch.zeros(5, dtype=torch.int64)

    rewrite(file, extend)
    loaded = nw.load(file)
    assert_equal(loaded.state_dict(), expected.state_dict())
    assert loaded.options == expected.options and loaded.meta["brightness"] == ANYTHING
    with torch.no_grad():
        assert torch.equal(loaded.render(tiny_camera()).image, expected.render(tiny_camera()).image)


def test_a_run_with_unknown_keys_reads_the_same(tmp_path: Path) -> None:
    create_run(tmp_path, RunRecord(SceneSource("demo", downscale=2), nw.Config(seed=3)))
    record = read_run(tmp_path)

    def extend(data: Any) -> None:
        for part in (data, data["scene"], data["config"], *(data["config"][x] for x in ("losses", "texture"))):
            part |= ANYTHING

    edit(tmp_path, extend, "config.json")
    assert read_run(tmp_path) == record and record.config.seed == 3 and record.source.downscale == 2
    write_json(tmp_path / "metrics.json", {"psnr": 20.0, **ANYTHING})
    assert read_metrics(tmp_path)["psnr"] == 20.0


def test_cameras_with_unknown_keys_load_the_same(tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    save_cameras(file, {"train": {"a": make_camera(random_scene(2))}, "test": {}})

    def extend(data: Any) -> None:
        data["train"]["a"] |= ANYTHING
        data |= ANYTHING

    before = load_cameras(file)
    edit(tmp_path, extend, "cameras.json")
    after = load_cameras(file)
    assert after.keys() == before.keys() and torch.equal(after["train"]["a"].viewmat, before["train"]["a"].viewmat)


def test_a_checkpoint_with_unknown_keys_and_tensors_restores_the_same(tmp_path: Path, tiny_scene: nw.Scene) -> None:
    config = small(iterations=4)
    done = trained(tiny_scene, config)
    tensors, state = done.snapshot()
    for name in ("surfels.roughness", "texture.bias", "adam.surfels.means.memory", "adam.lights.exp_avg", "lights"):
        tensors[name] = torch.zeros(2, 3, dtype=torch.float32)
    tensors["labels"] = torch.zeros(5, dtype=torch.int64)
    state |= ANYTHING | {"config": state["config"] | ANYTHING}
    save_checkpoint(tmp_path, tensors, state)
    resumed = nw.Trainer(tiny_scene, config, "cpu")
    resumed.restore(tmp_path)
    assert_same_state(resumed, done)


def test_a_checkpoint_of_a_version_that_derived_another_table_is_resumed(
    tmp_path: Path, tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small(iterations=4, texture=TextureConfig(levels=4, width=16))
    with monkeypatch.context() as other:
        other.setattr(initial, "_table_size", lambda *_: 2**9)
        done = trained(tiny_scene, config)
        halfway = nw.Trainer(tiny_scene, config, "cpu")
        halfway.run(until=2)
        halfway.save(tmp_path)
    resumed = nw.Trainer(tiny_scene, config, "cpu")
    assert resumed.texture.state_dict()["grid"].shape[1] == 2**12
    resumed.restore(tmp_path)
    resumed.run()
    assert_same_state(resumed, done)
    texture = nw.NeuralTexture(**neural(resumed.texture).config | {"table_size": 2**12})
    own = nw.Trainer(tiny_scene, config, "cpu", texture=texture)  # which is trained in place
    with pytest.raises(CheckpointError, match="it does not fit"):
        own.restore(tmp_path)
    assert own.texture is texture


def write_version(kind: str, folder: Path, version: object) -> tuple[Path, Callable[[], object]]:
    """Write a file with a format version; return it, and what reads it."""
    data = {"format_version": version}
    if kind == "model":
        file = save_model(folder, nw.Model(tiny_model().surfels, None))
        rewrite(file, lambda _, meta: meta.update(data))
        return file, lambda: nw.load(file)
    if kind == "config":
        create_run(folder, RunRecord(SceneSource("demo"), nw.Config()))
        edit(folder, lambda old: old.update(data), "config.json")
        return folder / "config.json", lambda: read_run(folder)
    if kind == "checkpoint":
        folder.mkdir()
        save_checkpoint(folder, {"x": torch.zeros(1)}, {})
        edit(folder / "checkpoint", lambda old: old.update(data), "state.json")
        return folder / "checkpoint", lambda: load_checkpoint(folder)
    file = folder / f"{kind}.json"
    write_json(file, {"train": {}, "test": {}, **data})
    return file, lambda: load_cameras(file) if kind == "cameras" else read_metrics(folder)


@pytest.mark.parametrize("kind", ["model", "config", "metrics", "cameras", "checkpoint"])
def test_only_known_versions_are_read(tmp_path: Path, kind: str) -> None:
    known = "1 to 3" if kind == "model" else "1"
    for number, version in enumerate(WRONG_VERSIONS):
        file, read = write_version(kind, tmp_path / str(number), version)
        refused(ValueError, read, names=file, match=f"expected format version {known}, got {version!r}")
    newest = int(known[-1]) + 1
    file, read = write_version(kind, tmp_path / "newer", newest)
    message = f"got {newest}; a newer nexwarp wrote the file, update nexwarp to read it"
    refused(ValueError, read, names=file, match=f"expected format version {known}, {message}")


# Files with too many entries


def test_too_many_entries_are_refused_at_once(tmp_path: Path) -> None:
    pose = torch.eye(4).int().tolist()
    frames = ",".join([json.dumps({"file_path": "images/1.png", "transform_matrix": pose})] * 150_000)
    scene = tmp_path / "transforms.json"
    scene.write_text(f'{{"camera_angle_x": 0.7, "w": 8, "h": 6, "frames": [{frames}]}}')
    model = save_model(tmp_path, tiny_model())
    entries = {f"x{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(100_000)}
    header = json.dumps({"__metadata__": {"nexwarp": "{}"}, **entries}).encode()
    model.write_bytes(len(header).to_bytes(8, "little") + header)
    for file, read, match in (
        (scene, lambda: nw.load_scene(tmp_path), "expected at most 500,000 lists and objects, got 900,"),
        (model, lambda: nw.load(model), "expected a safetensors header of at most 1,048,576 bytes"),
    ):
        begun = time.process_time()
        refused(ValueError, read, names=file, match=match)
        assert time.process_time() - begun < 2.0
