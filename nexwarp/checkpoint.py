"""Models and checkpoints on disk: safetensors and JSON only; every file is written aside, then renamed."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nexwarp.camera import Camera
from nexwarp.errors import CheckpointError, FormatError, MissingError
from nexwarp.exposures import Exposures
from nexwarp.files import one_line, sync, write_atomically
from nexwarp.json_files import parse_json, read_json
from nexwarp.kernels.types import MAX_HITS
from nexwarp.ops.checks import check_finite, check_range, check_tensors
from nexwarp.surfels import Surfels
from nexwarp.texture import LARGEST_RESOLUTION, NeuralTexture

FORMAT_VERSION = 1
CHECKPOINT_VERSION = 1
MODEL_FILE = "model.safetensors"
# Newest first. The last one is there only while others are renamed.
CHECKPOINTS = ("checkpoint", "checkpoint.old", "checkpoint.older")
FRAME = "COLMAP world, cameras x right, y down, z forward"
# What reading a damaged file of ours may raise.
READ_ERRORS = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)
DTYPES = ("F16", "F32")
LARGEST_COLOR, LARGEST_LENGTH = 1e6, 1e15
ROUNDING = 1 + 1e-6
FOOTPRINTS = ("footprints", "far_footprints")
RENDER_OPTIONS = ("max_hits", "background", "sh_degree", "low_pass", "clamp_texture")


@dataclass
class Model:
    """A trained scene.

    Attributes:
        surfels: the surfels, float32.
        texture: the neural texture, float32 (stored in half precision).
        meta: what rendering needs beside them: `max_hits`, `background`, `sh_degree`, `low_pass`, `clamp_texture`,
            `near`; and `format_version`, `frame`, `scene_scale`, `preset`, `iteration`, of a finished one `smooth_sh`.
    """

    surfels: Surfels
    texture: NeuralTexture
    meta: dict[str, Any]

    def to(self, device: torch.device | str) -> "Model":
        """Move surfels and texture to a device, in place."""
        self.surfels.to(device)
        self.texture.to(device)
        return self

    @property
    def render_options(self) -> dict[str, Any]:
        """Keyword arguments that the model was trained with, for `nexwarp.render`."""
        return {name: self.meta[name] for name in RENDER_OPTIONS}


def save_model(folder: str | os.PathLike[str], model: Model) -> Path:
    """Write `model.safetensors` into a folder: surfels in float32, grid and MLP in half precision."""
    from safetensors.torch import save

    tensors = {f"surfels.{name}": x for name, x in model.surfels.state_dict().items()}
    for name, x in model.texture.state_dict().items():
        tensors[f"texture.{name}"] = x if name == "resolutions" else x.half()
    for name in FOOTPRINTS:
        if (values := getattr(model.surfels, name)) is not None:
            tensors[name] = values
    if model.surfels.exposures is not None:
        tensors |= {f"exposures.{name}": x for name, x in model.surfels.exposures.tensors().items()}
    tensors = {name: x.detach().cpu().contiguous() for name, x in tensors.items()}
    meta = {**model.meta, "format_version": FORMAT_VERSION, "frame": FRAME, "texture": model.texture.config}
    path = Path(folder) / MODEL_FILE
    write_atomically(path, save(tensors, {"nexwarp": json.dumps(meta)}))
    return path


def load(path: str | os.PathLike[str]) -> Model:
    """Load a trained scene; needs neither the photos nor the training set.

    Args:
        path: a run folder or a `model.safetensors`.

    Raises:
        FileNotFoundError: nothing there.
        ValueError: not a nexwarp model, of another format version, damaged, or tensors that do not fit.
    """
    from safetensors import SafetensorError, safe_open

    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    if path.is_dir():
        path = path / MODEL_FILE
    if not path.is_file():
        raise MissingError(f"{path}: expected a run folder with a {MODEL_FILE}, or such a file")
    try:
        with safe_open(path, "pt") as file:
            header = (file.metadata() or {}).get("nexwarp")
            kinds = {name: (file.get_slice(name).get_dtype(), file.get_slice(name).get_shape()) for name in file.keys()}
            meta, texture = _check_header(path, header, kinds)
            tensors = {name: file.get_tensor(name) for name in kinds}
    except (SafetensorError, OSError) as error:
        raise FormatError(f"{path}: expected a safetensors file, but it cannot be read ({one_line(error)})") from None
    try:
        surfels = Surfels({name[8:]: x.float() for name, x in tensors.items() if name.startswith("surfels.")})
        for name in FOOTPRINTS:
            if name in tensors:
                check_tensors({name: (tensors[name], (len(surfels),))}, dtype=torch.float32)
                setattr(surfels, name, tensors[name])
        if exposures := {name[10:]: x.float() for name, x in tensors.items() if name.startswith("exposures.")}:
            surfels.exposures = Exposures(**exposures)
        for name, x in tensors.items():
            check_finite(name, x)
        field = NeuralTexture(**texture)
        field.load_state_dict({name[8:]: x.float() for name, x in tensors.items() if name.startswith("texture.")})
        check_range("texture.resolutions", float(field.resolutions.min()), 0.0)
        check_range("texture.resolutions", float(field.resolutions.max()), 0.0, LARGEST_RESOLUTION * ROUNDING)
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        raise _no_model(path, error) from None
    return Model(surfels, field, meta)


def _check_header(
    path: Path, header: str | None, kinds: Mapping[str, tuple[str, list[int]]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metadata and the texture's config, checked against dtypes and shapes before anything is allocated."""
    if header is None:
        raise FormatError(f"{path}: expected a nexwarp model, but the file has no nexwarp metadata")
    try:
        meta = parse_json(f"{path}: nexwarp metadata", header.encode("utf-8", "surrogatepass"))
    except ValueError:
        meta = None
    if not isinstance(meta, dict):
        raise FormatError(f"{path}: expected a JSON object as the nexwarp metadata, got {header[:40]!r}")
    if meta.get("format_version") != FORMAT_VERSION:
        raise FormatError(
            f"{path}: expected format version {FORMAT_VERSION}, got {one_line(meta.get('format_version'))}"
        )
    try:
        _check_options(meta)
        texture = meta.pop("texture")
        if not isinstance(texture, dict):
            raise ValueError(f"texture: expected the settings of a texture, got {texture!r:.60}")
        with torch.device("meta"):  # shapes without memory, whatever sizes the metadata names
            expected = {f"texture.{name}": list(x.shape) for name, x in NeuralTexture(**texture).state_dict().items()}
        for name, (dtype, shape) in kinds.items():
            if dtype not in DTYPES:
                raise ValueError(f"{name}: expected float16 or float32, got {dtype}")
            if name.startswith("texture.") and expected.get(name) != shape:
                raise ValueError(f"{name}: expected shape {expected.get(name)}, got {shape}")
        missing = sorted(expected.keys() - kinds.keys())
        if missing:
            raise ValueError(f"expected the tensor {missing[0]}, found none")
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _no_model(path, error) from None
    return meta, texture


def _no_model(path: Path, error: Exception) -> FormatError:
    return FormatError(f"{path}: the tensors do not make a model ({one_line(error)})")


def _check_options(meta: dict[str, Any]) -> None:
    """Raise ValueError unless the metadata holds what `nexwarp.render` takes."""
    missing = [name for name in RENDER_OPTIONS if name not in meta]
    if missing:
        raise ValueError(f"no {missing[0]} in the metadata")
    for name, high in (("max_hits", MAX_HITS), ("sh_degree", 3)):
        if type(meta[name]) is not int:
            raise ValueError(f"{name}: expected an int, got {meta[name]!r}")
        check_range(name, meta[name], 0, high)
    for name in ("low_pass", "clamp_texture"):
        if not isinstance(meta[name], bool):
            raise ValueError(f"{name}: expected true or false, got {meta[name]!r}")
    colour = meta["background"]
    if not (isinstance(colour, list) and len(colour) == 3 and all(type(x) in (int, float) for x in colour)):
        raise ValueError(f"background: expected three numbers, got {colour!r}")
    for x in colour:
        check_range("background", x, -LARGEST_COLOR, LARGEST_COLOR)
    for name in ("near", "scene_scale", "smooth_sh"):
        if name in meta:
            if type(meta[name]) not in (int, float):
                raise ValueError(f"{name}: expected a number, got {meta[name]!r:.60}")
            check_range(name, meta[name], 0.0, LARGEST_LENGTH)


def save_checkpoint(run: Path, tensors: Mapping[str, torch.Tensor], state: Mapping[str, Any]) -> None:
    """Write everything that shapes the future of a run into `run/checkpoint`, whole or not at all.

    The one before stays, as `run/checkpoint.old`. A kill or a power cut at any moment leaves at least one whole.

    Raises:
        OSError: it cannot be written; what was there is as it was.
    """
    from safetensors.torch import save

    newest, old, older = (run / name for name in CHECKPOINTS)
    aside = run / "checkpoint.tmp"
    shutil.rmtree(aside, ignore_errors=True)
    try:
        aside.mkdir()
        content = save({name: x.detach().cpu().contiguous() for name, x in tensors.items()})
        write_atomically(aside / "tensors.safetensors", content)
        record = {**state, "format_version": CHECKPOINT_VERSION, "tensors_sha256": hashlib.sha256(content).hexdigest()}
        write_atomically(aside / "state.json", json.dumps({**record, "sha256": _digest(record)}).encode())
        if newest.exists():  # else a kill came between the renames, and the others are all there is
            if old.exists():
                shutil.rmtree(older, ignore_errors=True)
                old.rename(older)
            newest.rename(old)
        aside.rename(newest)
        sync(run)
    except BaseException:  # whatever comes next may need the room
        shutil.rmtree(aside, ignore_errors=True)
        raise
    shutil.rmtree(older, ignore_errors=True)


def has_checkpoint(run: Path) -> bool:
    """Whether there is a checkpoint, whole or not."""
    return any((run / name).is_dir() for name in CHECKPOINTS)


def load_checkpoint(
    run: Path, warn: Callable[[str], None] = lambda _: None
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read the newest whole one of what `save_checkpoint` wrote, on the CPU.

    Args:
        run: run folder.
        warn: is told of a damaged one that is passed over.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: all there are are damaged, or of another version.
    """
    damaged: list[CheckpointError] = []
    for folder in (run / name for name in CHECKPOINTS):
        if not folder.is_dir():
            continue
        try:
            tensors, state = _read_checkpoint(folder)
        except CheckpointError as error:
            damaged.append(error)
            continue
        for error in damaged:
            warn(f"{error}; going back to the one before it, {folder.name}")
        return tensors, state
    if damaged:
        raise damaged[0]
    raise MissingError(f"{run}: expected a checkpoint to resume from, found none")


def _read_checkpoint(folder: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        record = read_json(folder / "state.json")
        version = record.get("format_version") if isinstance(record, dict) else None
        if version != CHECKPOINT_VERSION:
            raise ValueError(f"expected format version {CHECKPOINT_VERSION}, got {version}")
        if record.pop("sha256", None) != _digest(record):
            raise ValueError("state.json: its checksum does not agree")
        content = (folder / "tensors.safetensors").read_bytes()
        if hashlib.sha256(content).hexdigest() != record.pop("tensors_sha256"):
            raise ValueError("tensors.safetensors: its checksum does not agree")
        del record["format_version"]
        return load(content), record
    except (*READ_ERRORS, SafetensorError) as error:  # bad JSON and bad UTF-8 are ValueErrors
        raise CheckpointError(f"{folder}: expected a whole checkpoint, but it cannot be read ({error})") from None


def _digest(record: Mapping[str, Any]) -> str:
    """Checksum of what JSON makes of a record, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def save_cameras(path: Path, cameras: Mapping[str, Mapping[str, Camera]]) -> None:
    """Write named cameras by set ("train", "test") as JSON, so that a run renders without its photos."""
    data = {
        group: {
            name: {
                "viewmat": camera.viewmat.tolist(),
                "K": camera.K.tolist(),
                "width": camera.width,
                "height": camera.height,
                "near": camera.near,
            }
            for name, camera in members.items()
        }
        for group, members in cameras.items()
    }
    write_json(path, data)


def load_cameras(path: Path) -> dict[str, dict[str, Camera]]:
    """Read what `save_cameras` wrote, float32 on the CPU."""
    try:
        data = read_json(path)
        return {
            group: {
                name: Camera(torch.tensor(c["viewmat"]), torch.tensor(c["K"]), c["width"], c["height"], near=c["near"])
                for name, c in members.items()
            }
            for group, members in data.items()
        }
    except FileNotFoundError:
        raise MissingError(f"{path}: expected the run's cameras, found no such file") from None
    except (*READ_ERRORS, RuntimeError, OverflowError) as error:
        raise FormatError(f"{path}: expected named cameras as JSON ({one_line(error)})") from None


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically."""
    write_atomically(path, (json.dumps(data, indent=2) + "\n").encode())
