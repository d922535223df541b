"""Comparisons of scenes, and edits of their files."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.scene_writers import write_nerfstudio

SIZE = {"width": 96, "height": 72, "views": 10, "points": 300}


def assert_same_cameras(one, other, photos: bool = True) -> None:
    assert len(one.train) == len(other.train) and len(one.test) == len(other.test)
    for a, b in zip([*one.train, *one.test], [*other.train, *other.test], strict=True):
        assert Path(a.name).name == Path(b.name).name
        torch.testing.assert_close(a.camera.viewmat, b.camera.viewmat, rtol=0, atol=1e-6)
        torch.testing.assert_close(a.camera.K, b.camera.K, rtol=1e-6, atol=0)
        assert (a.camera.width, a.camera.height) == (b.camera.width, b.camera.height)
        assert a.camera.near == pytest.approx(b.camera.near, rel=1e-6) and (not photos or torch.equal(a.image, b.image))
    assert one.scale == pytest.approx(other.scale, rel=1e-6)


def edit(path: Path, change, name: str = "transforms.json") -> Path:
    data = json.loads((path / name).read_text())
    change(data)
    (path / name).write_text(json.dumps(data))
    return path


def write_mask(file: Path, mask: np.ndarray, mode: str = "L") -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).convert(mode).save(file)


MASK = np.random.default_rng(3).random((36, 48)) < 0.7


def spoilt(change):
    """Maker of a nerfstudio scene with a changed transforms.json."""
    return lambda demo, path: edit(write_nerfstudio(demo, path), change)


def frame(**keys):
    return spoilt(lambda data: data["frames"][3].update(keys))


def file(name: str, content: bytes, **keys):
    """Maker of a scene with a file of some bytes, and a frame that may name it."""

    def make(demo, path):
        edit(write_nerfstudio(demo, path), lambda data: data["frames"][3].update(keys))
        (path / name).write_bytes(content)
        return path

    return make
