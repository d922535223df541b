"""Settings of a small run, and what the command line leaves and says."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.cli import main as cli
from nexwarp.train.recipe import Config
from tests.trainer_support import OFTEN, TEXTURE

SMALL = Config(texture=TEXTURE, densify=OFTEN)
SHORT = ["--iterations", "20", "--max-surfels", "100", "--device", "cpu"]  # so short that only its end is saved
FLAGS = [*SHORT, "--checkpoint-every", "2"]
RESULTS = {"model.safetensors", "cameras.json", "metrics.json", "metrics.jsonl", "photos.csv", "renders"}
RUN_FILES = {"config.json", "checkpoint", *RESULTS}
RUN_FILES |= {"checkpoint.old"}  # where there was more than one


def read(run: Path, name: str) -> Any:
    return json.loads((run / name).read_text())


def picture(file: Path) -> torch.Tensor:
    with Image.open(file) as image:
        return torch.from_numpy(np.array(image))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], *words: str) -> None:
    """Fail unless the command exits with 2 and one line on stderr that holds all of `words`."""
    capsys.readouterr()
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("nexwarp: error: ") and err.count("\n") == 1 and err.endswith("\n"), err
    missing = [word for word in words if word not in err]
    assert not missing, f"{missing} not in {err!r}"
