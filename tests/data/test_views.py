from typing import Any

import numpy as np
import pytest
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.train import target as training_views

K = torch.tensor([[20.0, 0.0, 9.0], [0.0, 21.0, 6.0], [0.0, 0.0, 1.0]])


def make_views(count: int, width: int = 19, height: int = 13) -> list[View]:
    generator = torch.Generator().manual_seed(0)
    views = []
    for index in range(count):
        shape = (height, width)
        image = torch.randint(0, 256, (*shape, 3), generator=generator, dtype=torch.uint8)
        mask = torch.rand(shape, generator=generator) < 0.8
        alpha = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        plain = index % 3 == 0
        camera = Camera(torch.eye(4), K, width, height)
        views.append(View(camera, image, None if plain else mask, f"{index}", None if plain else alpha))
    return views


def test_photo_mask_and_alpha_are_those_of_the_view() -> None:
    views = make_views(3)
    mine = training_views.TrainingViews(views, torch.device("cpu"))
    for index, view in enumerate(views):
        camera, photo = mine.get(index)
        mask, alpha = mine.mask(index), mine.alpha(index)
        assert torch.equal(photo, view.image / 255.0) and torch.equal(camera.K, view.camera.K)
        if view.mask is None:
            assert mask is None and alpha is None
            continue
        assert mask is not None and alpha is not None and view.alpha is not None
        assert torch.equal(mask, view.mask) and torch.equal(alpha, view.alpha / 255.0)


@pytest.mark.cuda
def test_photos_on_the_host_are_the_photos(monkeypatch: Any):
    """Also while the GPU is busy, so that their copies wait."""
    monkeypatch.setattr(training_views, "PHOTO_SHARE", 0.0)
    views = make_views(12, width=640, height=480)
    mine = training_views.TrainingViews(views, torch.device("cuda"))
    assert all(not photo.is_cuda for photo in mine.photos)
    load = torch.rand(1024, 1024, device="cuda")
    seen = []
    for index in np.random.default_rng(0).integers(0, 12, 300).tolist():
        _, photo = mine.get(index)
        load = load @ load / load.norm()
        seen.append((index, (photo * 255.0).round().byte()))
    for index, photo in seen:
        assert torch.equal(photo.cpu(), views[index].image)
