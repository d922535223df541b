"""Models, checkpoints and cameras on disk: what comes back is what went in, damage is one clear line."""

import json
import os
import pickle
import random
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from safetensors import safe_open

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras, save_cameras
from nexwarp.io.json_files import Json
from nexwarp.model.model import Model
from nexwarp.model.model_file import FORMAT_VERSION, LATER_OPTIONS, MODEL_FILE, save_model, write_atomically
from nexwarp.model.options import RenderOptions
from nexwarp.representation.detail_limits import NEVER, DetailLimits
from nexwarp.representation.exposures import Exposures
from nexwarp.train import checkpoint
from nexwarp.train.checkpoint import CHECKPOINTS, _read_checkpoint, has_checkpoint, load_checkpoint, save_checkpoint
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close

META: dict[str, Json] = {"near": 0.01, "scene_scale": 1.25, "preset": "default", "iteration": 1200}
OPTIONS = RenderOptions(background=(0.1, 0.2, 0.3), clamp_texture=True)


def make_model(count: int = 24) -> Model:
    return Model(make_surfels(random_scene(count)), make_texture(), options=OPTIONS, meta=META)


def rewrite(file: Path, change: Callable[[dict[str, torch.Tensor], dict[str, Any]], None]) -> None:
    """Let `change` alter tensors and metadata of a saved model."""
    with safe_open(file, "pt") as opened:
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}
        meta = json.loads(opened.metadata()["nexwarp"])
    change(tensors, meta)
    safetensors.torch.save_file(tensors, file, {"nexwarp": json.dumps(meta)})


def refused(error: type[Exception], call: Callable[..., Any], *args: Any, names: Path, match: str) -> None:
    """Fail unless `call` raises `error` with one line that begins with the path and contains `match`."""
    with pytest.raises(error) as caught:
        call(*args)
    message = str(caught.value)
    assert message.startswith(f"{names}: ") and "\n" not in message and match in message, message


class Bomb:
    """What a pickle must never get to do."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.marker,))


# Models


def test_loaded_model_renders_the_same_image(tmp_path):
    model = make_model()
    file = save_model(tmp_path, model)
    assert file == tmp_path / MODEL_FILE and os.listdir(tmp_path) == [MODEL_FILE]
    first, second = nw.load(tmp_path), nw.load(file)
    camera = make_camera(random_scene(24))
    with torch.no_grad():
        images = [m.render(camera).image for m in (model, first, second)]
    assert torch.equal(images[1], images[2])
    assert images[0].std() > 0.05
    assert_close(images[1], images[0], kind="value", name="image", precision=torch.float16)


def test_surfels_come_back_exactly_and_the_texture_in_half_precision(tmp_path):
    model = make_model()
    loaded = nw.load(save_model(tmp_path, model))
    for name, value in model.surfels.state_dict().items():
        assert torch.equal(loaded.surfels.state_dict()[name], value), name
    for name, value in model.texture.state_dict().items():
        now = loaded.texture.state_dict()[name]
        assert now.dtype == torch.float32
        assert torch.equal(now, value if name == "resolutions" else value.half().float()), name
    assert loaded.texture.config == model.texture.config


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
    assert nw.load(file).to(torch.float64).detail_limits.farthest.dtype == torch.float64
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
    expected = nw.render(
        loaded.surfels,
        loaded.texture,
        camera,
        background=OPTIONS.background,
        clamp_texture=True,
        exposures=loaded.exposures,
        detail_limits=DetailLimits(nearest, farthest) if stored else None,
    )
    assert torch.equal(loaded.render(camera).image, expected.image)
    assert (loaded.detail_limits is None) == (not stored)


def test_exposures_come_back_exactly(tmp_path):
    model = make_model()
    assert nw.load(save_model(tmp_path, model)).exposures is None
    model.exposures = Exposures(*torch.rand(4, 5, 3), torch.rand(3), torch.rand(2), torch.rand(3))
    loaded = nw.load(save_model(tmp_path, model))
    for name, value in model.exposures.tensors().items():
        assert torch.equal(loaded.exposures.tensors()[name], value), name
    assert loaded.to(torch.float64).exposures.lengths.dtype == torch.float64
    model.exposures.positions = torch.rand(4, 3)
    with pytest.raises(ValueError, match=r"expected the tensors of a nexwarp model \(positions: expected shape"):
        nw.load(save_model(tmp_path, model))


@pytest.mark.parametrize("largest", [0.0, -1.0, float("nan")])
def test_a_falloff_that_cannot_be_is_refused(tmp_path, largest):
    model = make_model()
    model.exposures = Exposures(*torch.rand(4, 5, 3), torch.rand(3), torch.rand(2))
    assert model.exposures.falloff.tolist() == [0.0, 0.0, 1.0]  # as in files from before there was one
    model.exposures.falloff = torch.tensor([0.1, 0.1, largest])
    with pytest.raises(ValueError, match=r"\(falloff: expected a largest squared tangent > 0, got "):
        nw.load(save_model(tmp_path, model))


def test_saving_what_was_loaded_changes_nothing(tmp_path):
    file = save_model(tmp_path, make_model())
    written = file.read_bytes()
    save_model(tmp_path, nw.load(tmp_path))
    again = file.read_bytes()
    assert safetensors.torch.load(again).keys() == safetensors.torch.load(written).keys()
    for name, tensor in safetensors.torch.load(written).items():
        assert torch.equal(safetensors.torch.load(again)[name], tensor), name


def test_meta_survives(tmp_path):
    loaded = nw.load(save_model(tmp_path, make_model()))
    assert {name: loaded.meta[name] for name in META} == META
    assert loaded.meta["format_version"] == FORMAT_VERSION and "COLMAP" in loaded.meta["frame"]
    assert loaded.options == OPTIONS


@pytest.mark.parametrize("changes", [{"exposure": "mean"}, {"detail_limits": False}, {"max_hits": 0, "low_pass": True}])
def test_options_survive(tmp_path: Path, changes: dict[str, Any]) -> None:
    model = Model(make_surfels(random_scene(3)), None, options=OPTIONS.changed(**changes), meta=META)
    loaded = nw.load(save_model(tmp_path, model))
    assert loaded.options == model.options
    assert not {field.name for field in fields(RenderOptions)} & loaded.meta.keys()


@pytest.mark.parametrize("count", [1, 700])
def test_file_is_as_large_as_accounted(tmp_path, count):
    """60 float32 a surfel, L T F half-precision features, a half-precision MLP (recipe.md 3.8), and a header."""
    scene = random_scene(count)
    texture = nw.NeuralTexture(levels=8, table_size=2**12, max_resolution=64.0)
    size = save_model(tmp_path, Model(make_surfels(scene), texture, options=OPTIONS, meta=META)).stat().st_size
    mlp = 2 * (16 * 64 + 64 * 64 + 64 * 48)
    accounted = 60 * 4 * count + 8 * 2**12 * 2 * 2 + mlp
    assert 0 < size - accounted < 4096


def test_missing_model(tmp_path):
    refused(FileNotFoundError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="expected a run folder")
    refused(FileNotFoundError, nw.load, tmp_path / "no", names=tmp_path / "no", match="expected a run folder")


@pytest.mark.parametrize("content", [b"", b"not a model at all", b"\xff" * 64, b"{}" * 100])
def test_file_of_another_kind(tmp_path, content):
    (tmp_path / MODEL_FILE).write_bytes(content)
    refused(ValueError, nw.load, tmp_path, names=tmp_path / MODEL_FILE, match="expected a safetensors file")


@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_truncated_model(tmp_path, share):
    file = save_model(tmp_path, make_model())
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    refused(ValueError, nw.load, file, names=file, match="expected a safetensors file")


def test_safetensors_of_another_program(tmp_path):
    file = tmp_path / MODEL_FILE
    safetensors.torch.save_file({"x": torch.zeros(3)}, file)
    refused(ValueError, nw.load, file, names=file, match="no nexwarp metadata")


@pytest.mark.parametrize("header", ["{", "[]", "3", '"text"'])
def test_damaged_metadata(tmp_path, header):
    file = tmp_path / MODEL_FILE
    safetensors.torch.save_file({"x": torch.zeros(3)}, file, {"nexwarp": header})
    refused(ValueError, nw.load, file, names=file, match="metadata")


@pytest.mark.parametrize("version", [0, FORMAT_VERSION + 1, "1", None])
def test_other_format_version(tmp_path, version):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda _, meta: meta.update(format_version=version))
    refused(ValueError, nw.load, file, names=file, match=f"expected format version {FORMAT_VERSION}, got {version}")


@pytest.mark.parametrize("name", ["surfels.means", "surfels.shN", "texture.grid", "texture.mlp.0.weight"])
def test_missing_tensor(tmp_path, name):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda tensors, _: tensors.pop(name))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])


@pytest.mark.parametrize("name", ["surfels.means", "surfels.raw_gammas", "texture.grid", "texture.mlp.2.weight"])
def test_tensors_that_do_not_fit(tmp_path, name):
    file = save_model(tmp_path, make_model())
    rewrite(file, lambda tensors, _: tensors.update({name: tensors[name][..., :1].contiguous()}))
    refused(ValueError, nw.load, file, names=file, match=name.split(".")[1])


@pytest.mark.parametrize("key", ["texture", "max_hits", "background", "sh_degree", "low_pass", "clamp_texture"])
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


# Atomic writing


def test_write_replaces_the_whole_file(tmp_path):
    file = tmp_path / "file"
    for content in (b"a long first content", b"short"):
        write_atomically(file, content)
        assert file.read_bytes() == content and os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("stage", ["write", "rename"])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, stage):
    file = tmp_path / "file"
    file.write_bytes(b"old")

    def full(path: Path, content: bytes) -> int:
        with open(path, "wb") as half:
            half.write(content[: len(content) // 2])
        raise OSError("no space left on device")

    def fail(*_: Any) -> None:
        raise OSError("cannot rename")

    if stage == "write":
        monkeypatch.setattr(Path, "write_bytes", full)
    else:
        monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match=r"no space|cannot rename"):
        write_atomically(file, b"new and longer")
    assert file.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]


# Checkpoints


def save_number(run: Path, number: int) -> None:
    save_checkpoint(run, {"x": torch.full((3,), float(number))}, {"iteration": number})


def saved_number(run: Path) -> int:
    tensors, state = load_checkpoint(run)
    assert tensors["x"].tolist() == [state["iteration"]] * 3
    return state["iteration"]


def kept(run: Path) -> list[int]:
    """Iterations of the checkpoints there are, the newest first; each is whole, and there is nothing else."""
    assert sorted(os.listdir(run)) == list(CHECKPOINTS[: len(os.listdir(run))])
    return [_read_checkpoint(run / name)[1]["iteration"] for name in CHECKPOINTS if (run / name).exists()]


def test_checkpoint_round_trip(tmp_path):
    tensors = {
        "float": torch.randn(5, 0, 3),
        "scalar": torch.tensor(7.0),
        "bytes": torch.get_rng_state(),
        "strided": torch.randn(4, 6).T,
    }
    state = {"iteration": 3, "order": [2, 0, 1], "python": [3, [1, 2], None], "seconds": 0.1}
    save_checkpoint(tmp_path, tensors, state)
    loaded, again = load_checkpoint(tmp_path)
    assert again == state and loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[name], tensors[name]) for name in tensors)
    save_number(tmp_path, 4)
    assert saved_number(tmp_path) == 4 and kept(tmp_path) == [4, 3]


def test_kill_between_the_renames_still_resumes(tmp_path):
    save_number(tmp_path, 1)
    (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.old")
    assert saved_number(tmp_path) == 1
    save_number(tmp_path, 2)
    assert saved_number(tmp_path) == 2 and kept(tmp_path) == [2, 1]


@pytest.mark.parametrize("after_kill", [False, True], ids=["checkpoint", "checkpoint.old"])
@pytest.mark.parametrize("stage", ["tensors", "state", "first rename", "second rename"])
def test_at_no_time_is_there_no_checkpoint(tmp_path, monkeypatch, stage, after_kill):
    """A save may die anywhere, also the one after a kill that left only checkpoint.old."""
    save_number(tmp_path, 1)
    if after_kill:
        (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.old")
    calls = []

    def fail(*_: Any) -> None:
        raise OSError("killed")

    def rename(path: Path, target: Path) -> Path:
        calls.append(path)
        if (stage == "first rename") == (len(calls) == 1):
            raise OSError("killed")
        os.rename(path, target)
        return target

    with monkeypatch.context() as patch:
        if stage == "tensors":
            patch.setattr(safetensors.torch, "save", fail)
        elif stage == "state":
            patch.setattr(checkpoint, "write_atomically", fail)
        else:
            patch.setattr(Path, "rename", rename)
        if (stage, after_kill) != ("second rename", True):  # there is only one rename then
            with pytest.raises(OSError, match="killed"):
                save_number(tmp_path, 2)
    assert saved_number(tmp_path) == 1
    save_number(tmp_path, 3)
    assert saved_number(tmp_path) == 3 and kept(tmp_path) == [3, 1]


SYSTEM_CALLS = (
    (Path, "write_bytes"),
    (os, "fsync"),
    (os, "replace"),
    (Path, "rename"),
    (Path, "mkdir"),
    (shutil, "rmtree"),
)


class Killed(BaseException):
    pass


def kill_at(patch: pytest.MonkeyPatch, moment: int) -> list[str]:
    """Die before the given call of the system, or half-way through it if it writes; returns the names of the calls."""
    calls: list[str] = []
    mine = threading.get_ident()  # other threads, with work for other tests, live on

    def dying(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != mine:
                return original(*args, **kwargs)
            calls.append(name)
            if len(calls) > moment:  # what is dead does nothing any more, not even clean up
                if len(calls) == moment + 1 and name == "write_bytes":
                    with open(args[0], "wb") as half:
                        half.write(args[1][: len(args[1]) // 2])
                raise Killed
            return original(*args, **kwargs)

        return call

    for owner, name in SYSTEM_CALLS:
        patch.setattr(owner, name, dying(name, getattr(owner, name)))
    unlink = Path.unlink

    def gone(*args: Any, **kwargs: Any) -> None:
        if len(calls) <= moment or threading.get_ident() != mine:
            unlink(*args, **kwargs)

    patch.setattr(Path, "unlink", gone)
    return calls


@pytest.mark.parametrize("before", [0, 1, 2, 3])
def test_a_kill_at_any_moment_of_a_save_loses_no_whole_checkpoint(tmp_path, before):
    """Whatever number of saves came before; and the next save, killed at any moment too, starts from what is left."""
    moment, calls = 0, []
    while moment <= len(calls):
        run = tmp_path / f"run{moment}"
        run.mkdir()
        for number in range(1, before + 1):
            save_number(run, number)
        for at in (moment, 3, 7, 11):  # killed again, and again
            with pytest.MonkeyPatch.context() as patch:
                done = kill_at(patch, at)
                with suppress(Killed):
                    save_number(run, before + 1)
            calls = done if at == moment else calls
            if before:
                assert saved_number(run) in (before, before + 1), (moment, at)
            else:
                assert not has_checkpoint(run) or saved_number(run) == 1
        save_number(run, before + 2)
        assert saved_number(run) == before + 2 and kept(run)[0] == before + 2
        moment += 1
    assert moment > 8


@pytest.mark.parametrize("name", ["tensors.safetensors", "state.json"])
def test_every_flipped_bit_and_every_length_is_found(tmp_path, name):
    """What is read is what was written, or the checkpoint before; never anything else."""
    save_number(tmp_path, 1)
    save_number(tmp_path, 2)
    file = tmp_path / "checkpoint" / name
    content = file.read_bytes()
    generator = random.Random(0)
    damaged = [content[:length] for length in range(len(content))]
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << generator.randrange(8)
        damaged.append(bytes(flipped))
    told: list[str] = []
    for bad in damaged:
        file.write_bytes(bad)
        told.clear()
        tensors, state = load_checkpoint(tmp_path, told.append)
        if told:
            assert state == {"iteration": 1} and tensors["x"].tolist() == [1.0] * 3
            assert told[0].startswith(f"{file.parent}: expected a whole checkpoint") and "\n" not in told[0]
        else:  # a flip in white space
            assert name == "state.json" and state == {"iteration": 2}, bad
    file.write_bytes(content + b"\0")
    assert load_checkpoint(tmp_path)[1] == {"iteration": 1}


def test_no_checkpoint(tmp_path):
    refused(FileNotFoundError, load_checkpoint, tmp_path, names=tmp_path, match="expected a checkpoint to resume from")


@pytest.mark.parametrize("name", ["tensors.safetensors", "state.json"])
@pytest.mark.parametrize("damage", ["missing", "truncated", "binary"])
def test_damaged_checkpoint(tmp_path, name, damage):
    save_number(tmp_path, 1)
    file = tmp_path / "checkpoint" / name
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:-3] if damage == "truncated" else b"\xff\xfe\x00" * 9)
    refused(ValueError, load_checkpoint, tmp_path, names=tmp_path / "checkpoint", match="expected a whole checkpoint")


# Cameras


def test_cameras_come_back_exactly(tmp_path):
    cameras = {
        "train": {f"{i}.png": make_camera(random_scene(2, off_centre=i == 1), near=0.1 * i) for i in range(3)},
        "test": {"folder/a b.jpg": make_camera(random_scene(2, seed=5))},
        "empty": {},
    }
    file = tmp_path / "cameras.json"
    save_cameras(file, cameras)
    loaded = load_cameras(file)
    assert {group: list(members) for group, members in loaded.items()} == {g: list(m) for g, m in cameras.items()}
    for group, members in cameras.items():
        for name, camera in members.items():
            now = loaded[group][name]
            assert torch.equal(now.viewmat, camera.viewmat) and torch.equal(now.K, camera.K)
            assert (now.width, now.height, now.near) == (camera.width, camera.height, camera.near)
            assert now.viewmat.dtype == torch.float32


ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
CAMERA = {"viewmat": ROWS, "K": [[9.0, 0.0, 4.0], [0.0, 9.0, 3.0], [0.0, 0.0, 1.0]], "width": 8, "height": 6}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[1, 2]",
        '{"train": [1]}',
        '{"train": {"a": 3}}',
        json.dumps({"train": {"a": CAMERA}}),  # no near
        json.dumps({"train": {"a": CAMERA | {"near": "x"}}}),
        json.dumps({"train": {"a": CAMERA | {"near": 0.1, "viewmat": ROWS[:3]}}}),
        json.dumps({"train": {"a": CAMERA | {"near": 0.1, "viewmat": "text"}}}),
        json.dumps({"train": {"a": CAMERA | {"near": 0.1, "K": ROWS}}}),
        json.dumps({"train": {"a": CAMERA | {"near": 0.1, "width": 0}}}),
        json.dumps({"train": {"a": CAMERA | {"near": 0.1, "viewmat": [[float("nan")] * 4] * 4}}}),
    ],
)
def test_malformed_cameras(tmp_path, content):
    file = tmp_path / "cameras.json"
    file.write_text(content)
    refused(ValueError, load_cameras, file, names=file, match="expected named cameras as JSON")


def test_missing_cameras(tmp_path):
    file = tmp_path / "cameras.json"
    refused(FileNotFoundError, load_cameras, file, names=file, match="expected the run's cameras")


def test_models_that_cannot_render_are_refused(tmp_path):
    from safetensors.torch import load_file, save_file

    texture = nw.NeuralTexture(levels=2, table_size=2**4, width=8)
    model = nw.Model(make_surfels(random_scene(3)), texture)
    for key, value in (
        ("max_hits", "two"),
        ("max_hits", 9),
        ("background", [0, 0]),
        ("low_pass", 1),
        ("sh_degree", None),
        ("near", "far"),
        ("smooth_sh", "smooth"),
        ("smooth_sh", -0.1),
        ("exposure", "bright"),
        ("detail_limits", "no"),
    ):
        rewrite(save_model(tmp_path, model), lambda _, meta, key=key, value=value: meta.update({key: value}))
        with pytest.raises(ValueError, match=key):
            nw.load(tmp_path)
    path = save_model(tmp_path, model)
    with safe_open(path, "pt") as file:
        header = file.metadata()
    tensors = load_file(path)
    tensors["surfels.means"][1, 2] = float("nan")
    save_file(tensors, path, header)
    with pytest.raises(ValueError, match=r"surfels.means: expected finite values, got nan at index \(1, 2\)"):
        nw.load(tmp_path)
