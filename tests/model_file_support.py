"""Models to write, and what a damaged file must be answered with."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from safetensors import safe_open

from nexwarp.io.json_files import Json
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions
from tests.scenes import make_surfels, make_texture, random_scene

META: dict[str, Json] = {"near": 0.01, "scene_scale": 1.25, "preset": "default", "iteration": 1200}
OPTIONS = RenderOptions(background=(0.1, 0.2, 0.3), clamp_texture=True)


def make_model(count: int = 24) -> Model:
    return Model(make_surfels(random_scene(count)), make_texture(), options=OPTIONS, meta=META)


def rewrite(file: Path, change: Callable[[dict[str, torch.Tensor], dict[str, Any]], object]) -> None:
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
