"""Views and points from tensors in memory, checked."""

import dataclasses
import warnings
from collections.abc import Sequence

import numpy as np
import torch

from nexwarp.cameras.camera import Array, Camera
from nexwarp.cameras.cameras_file import WORLD
from nexwarp.data.capture import LARGEST_COORDINATE, LOST_PIXELS, Cloud, far_origin, safe_name
from nexwarp.data.views import View
from nexwarp.errors import check_range, check_tensors, check_type, check_values


def split_views(
    images: Sequence[Array],
    cameras: Sequence[Camera],
    masks: Sequence[Array | None] | None,
    names: Sequence[str] | None,
    test_every: int,
) -> tuple[list[View], list[View]]:
    """Make the training and the test views of the arguments of `Scene.from_tensors`, sorted by name."""
    if isinstance(test_every, bool) or not isinstance(test_every, int):
        raise TypeError(f"test_every: expected an int, got {type(test_every).__name__}")
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every: expected 0, or at least 2, got {test_every}")
    for argument, values in (("images", images), ("cameras", cameras), ("masks", masks), ("names", names)):
        if values is not None and not (hasattr(values, "__len__") and hasattr(values, "__getitem__")):
            raise TypeError(f"{argument}: expected a sequence, got {type(values).__name__}")
    if not len(images):
        raise ValueError("images: expected at least one, got none")
    for argument, values in (("cameras", cameras), ("masks", masks), ("names", names)):
        if values is not None and len(values) != len(images):
            raise ValueError(f"{argument}: expected {len(images)}, one for each image, got {len(values)}")
    labels = _names(names, len(images))
    views = [
        _view(index, images[index], cameras[index], None if masks is None else masks[index], labels[index])
        for index in range(len(images))
    ]
    views.sort(key=lambda view: view.name)
    train = [view for index, view in enumerate(views) if not test_every or index % test_every]
    if not train:
        raise ValueError(f"test_every: expected 0 for {len(views)} image, which else is a test view, got {test_every}")
    return train, views[::test_every] if test_every else []


def make_cloud(points: Array, colors: Array | None) -> Cloud:
    """Make a point cloud of the arguments of `Scene.from_tensors`."""
    positions = _tensor("points", points)
    check_tensors({"points": (positions, ("P", 3))})
    check_range("points: number", len(positions), 1)
    check_values("points", positions, -LARGEST_COORDINATE, LARGEST_COORDINATE)
    if colors is None:
        raise ValueError(f"colors: expected one for each of {len(positions)} points, got None")
    values = as_bytes("colors", colors)
    if values.shape != positions.shape:
        raise ValueError(f"colors: expected shape {tuple(positions.shape)}, got {tuple(values.shape)}")
    return Cloud.of(positions.double().numpy(), values.numpy())


def near_origin(
    train: list[View], test: list[View], cloud: Cloud | None
) -> tuple[list[View], list[View], Cloud | None]:
    """Make cameras float32, and move them and the points to a frame near them where they are far from its origin."""
    cameras = [view.camera for view in (*train, *test)]
    frames = {camera.origin or WORLD for camera in cameras}
    if len(frames) > 1:
        raise ValueError(f"cameras: expected one origin, got {' and '.join(map(str, sorted(frames)[:2]))}")
    (frame,) = frames
    size = max(max(camera.width, camera.height) for camera in cameras)
    shift = far_origin([camera.viewmat.double().numpy() for camera in cameras], size, cloud)
    if shift.any() and any(camera.viewmat.dtype != torch.float64 for camera in cameras):
        warnings.warn(
            f"cameras: float32 rounds viewmats at {tuple(shift.tolist())} by more than {LOST_PIXELS} pixels; "
            "expected float64 there",
            stacklevel=3,
        )
    x, y, z = (shift + frame).tolist()

    def near(view: View) -> View:
        camera = dataclasses.replace(view.camera, origin=frame).moved((x, y, z))
        return dataclasses.replace(view, camera=camera.to(torch.float32))

    return [near(view) for view in train], [near(view) for view in test], cloud and cloud.moved(shift)


def _names(names: Sequence[str] | None, count: int) -> list[str]:
    if names is None:
        return [f"{index:0{len(str(count - 1))}d}" for index in range(count)]
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        if not isinstance(name, str):
            raise TypeError(f"names[{index}]: expected text, got {type(name).__name__}")
        label = safe_name(f"names[{index}]:", name, "images folder")  # renderings get files of these names
        if label in seen:
            raise ValueError(f"names[{index}]: expected a name of its own, got {label!r} as of names[{seen[label]}]")
        seen[label] = index
    return list(seen)


def _view(index: int, image: Array, camera: Camera, mask: Array | None, name: str) -> View:
    pixels = as_bytes(f"images[{index}]", image)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or not pixels.numel():
        raise ValueError(f"images[{index}]: expected shape (H, W, 3), got {tuple(pixels.shape)}")
    check_type(f"cameras[{index}]", camera, Camera)
    height, width = pixels.shape[:2]
    if (camera.width, camera.height) != (width, height):
        raise ValueError(
            f"cameras[{index}]: expected the size of images[{index}], {width}x{height}, "
            f"got {camera.width}x{camera.height}"
        )
    counts = None if mask is None else _mask(f"masks[{index}]", mask, (height, width))
    matrices = (camera.viewmat.detach().cpu(), camera.K.detach().cpu())
    return View(Camera(*matrices, width, height, camera.near, origin=camera.origin), pixels, counts, name)


def _mask(argument: str, mask: Array, shape: tuple[int, int]) -> torch.Tensor | None:
    """A mask (H, W) bool; None where all pixels count."""
    counts = _tensor(argument, mask)
    if counts.dtype != torch.bool:
        raise TypeError(f"{argument}: expected dtype torch.bool, True where the photo counts, got {counts.dtype}")
    if counts.shape != shape:
        raise ValueError(f"{argument}: expected shape {shape}, got {tuple(counts.shape)}")
    if not bool(counts.any()):
        raise ValueError(f"{argument}: expected pixels that count, got none")
    return None if bool(counts.all()) else counts


def as_bytes(argument: str, values: Array) -> torch.Tensor:
    """Colours in 8 bits: as they are, or rounded from floating values in [0, 1]."""
    tensor = _tensor(argument, values)
    if tensor.dtype == torch.uint8:
        return tensor
    if not tensor.is_floating_point():
        raise TypeError(f"{argument}: expected uint8, or floating values in [0, 1], got {tensor.dtype}")
    if tensor.numel() and not bool(((tensor >= 0) & (tensor <= 1)).all()):
        low, high = tensor.min().item(), tensor.max().item()
        raise ValueError(f"{argument}: expected values in [0, 1], got {low:g} to {high:g}")
    return (tensor * 255.0).round().to(torch.uint8)


def _tensor(argument: str, values: Array) -> torch.Tensor:
    """A contiguous copy on the CPU: what the caller does to its own later changes nothing."""
    if isinstance(values, torch.Tensor):
        return values.detach().to("cpu", copy=True).contiguous()
    if isinstance(values, np.ndarray):
        try:
            return torch.from_numpy(np.array(values, order="C"))
        except TypeError:
            raise TypeError(f"{argument}: expected numbers, got dtype {values.dtype}") from None
    raise TypeError(f"{argument}: expected a torch.Tensor or numpy.ndarray, got {type(values).__name__}")
