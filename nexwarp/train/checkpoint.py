"""Checkpoints on disk: safetensors and JSON; every file is written aside, then renamed."""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch

from nexwarp.errors import CheckpointError, MissingError, check_version
from nexwarp.io.files import check_tensors_header, is_temporary, sync, temporary_name, write_atomically
from nexwarp.io.json_files import READ_ERRORS, read_json

CHECKPOINT_VERSION = 1
CHECKPOINTS = ("checkpoint", "checkpoint.old")
TENSORS_FILE, STATE_FILE = CHECKPOINT_FILES = ("tensors.safetensors", "state.json")


class Snapshot(NamedTuple):
    """State of a training: tensors on the CPU by name, and the rest as JSON values."""

    tensors: dict[str, torch.Tensor]
    state: dict[str, Any]


def save_checkpoint(run: Path, tensors: Mapping[str, torch.Tensor], state: Mapping[str, object]) -> None:
    """Write everything that shapes the future of a run into `run/checkpoint`; OSError where it cannot be written.

    The one before becomes `run/checkpoint.old`. A kill or a power cut at any moment leaves at least one whole.
    """
    from safetensors.torch import save

    newest, old = (run / name for name in CHECKPOINTS)
    aside = temporary_name(newest)
    try:
        aside.mkdir()
        content = save({name: x.detach().cpu().contiguous() for name, x in tensors.items()})
        write_atomically(aside / TENSORS_FILE, content)
        record = {**state, "format_version": CHECKPOINT_VERSION, "tensors_sha256": hashlib.sha256(content).hexdigest()}
        write_atomically(aside / STATE_FILE, json.dumps({**record, "sha256": _digest(record)}).encode())
        if newest.exists():  # else a kill came between the renames, and the old one is all there is
            _make_way(old)
            newest.rename(old)
        aside.rename(newest)
        sync(run)
    except BaseException:  # whatever comes next may need the room
        _delete(aside)
        raise


def delete_checkpoints(run: Path) -> None:
    """Delete what `save_checkpoint` wrote."""
    for name in CHECKPOINTS:
        _delete(run / name)


def _delete(folder: Path) -> None:
    """Delete a checkpoint. Files in its folder that are not ours stay, and so does the folder then."""
    with suppress(OSError):
        for file in folder.iterdir():
            if file.name in CHECKPOINT_FILES or is_temporary(file.name):
                file.unlink()
        folder.rmdir()


def _make_way(folder: Path) -> None:
    """Delete a checkpoint; rename what is left of its folder."""
    _delete(folder)
    number = 1
    while folder.exists():
        kept = folder.with_name(f"{CHECKPOINTS[0]}.kept_{number}")
        if not kept.exists():
            folder.rename(kept)
        number += 1


def has_checkpoint(run: Path) -> bool:
    """Whether there is a checkpoint, whole or not."""
    return any((run / name / file).exists() for name in CHECKPOINTS for file in CHECKPOINT_FILES)


def load_checkpoint(run: Path, warn: Callable[[str], None] = lambda _: None) -> Snapshot:
    """Read the newest whole checkpoint of a run folder; `warn` is told of a damaged one that is passed over.

    MissingError where there is none, CheckpointError where all are damaged, or of another version.
    """
    damaged: list[CheckpointError] = []
    for folder in (run / name for name in CHECKPOINTS):
        if not any((folder / file).exists() for file in CHECKPOINT_FILES):
            continue
        try:
            snapshot = _read_checkpoint(folder)
        except CheckpointError as error:
            damaged.append(error)
            continue
        for fault in damaged:
            warn(f"{fault}; going back to the one before it, {folder.name}")
        return snapshot
    if damaged:
        raise damaged[0]
    raise MissingError(f"{run}: expected a checkpoint to resume from, found none")


def _read_checkpoint(folder: Path) -> Snapshot:
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        record = read_json(folder / STATE_FILE)
        check_version(record.get("format_version") if isinstance(record, dict) else None, CHECKPOINT_VERSION)
        if record.pop("sha256", None) != _digest(record):
            raise ValueError("state.json: its checksum does not agree")
        check_tensors_header(folder / TENSORS_FILE)
        content = (folder / TENSORS_FILE).read_bytes()
        if hashlib.sha256(content).hexdigest() != record.pop("tensors_sha256"):
            raise ValueError("tensors.safetensors: its checksum does not agree")
        del record["format_version"]
        return Snapshot(load(content), record)
    except (*READ_ERRORS, SafetensorError) as error:  # bad JSON and bad UTF-8 are ValueErrors
        raise CheckpointError(f"{folder}: expected a whole checkpoint, but it cannot be read ({error})") from None


def _digest(record: Mapping[str, object]) -> str:
    """Checksum of what JSON makes of a record, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
