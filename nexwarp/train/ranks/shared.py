"""One copy of a scene in the memory of a machine, for all ranks of a training that run there.

Any rank may be the next to need any photo. So the first rank of each machine decodes the photos, into memory that the
others map: each photo is decoded once and held once on a machine, however many GPUs it has.
"""

import dataclasses
import mmap
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data.scene import Scene
from nexwarp.data.views import View
from nexwarp.train.ranks.ranks import Ranks

ALIGNMENT = 64  # bytes
TOKEN_BYTES = 16  # at the beginning of the memory: they tell it from a file of another process
PHOTO = ("image", "mask", "alpha", "points")
CLOUD = ("points", "colors", "track_lengths", "reprojection_errors")

Described = dict[str, Any]  # JSON


def shared_scene(load: Callable[[], Scene], ranks: Ranks) -> Scene:
    """Return a scene that one rank of each machine loads, and the others map; collective.

    Where the system does not allow it, each rank loads the scene for itself. The tensors are not to be changed: the
    other ranks would see what the first one of a machine writes.

    Args:
        load: loads the scene, the same on all ranks.
        ranks: all ranks.
    """
    if ranks.size == 1:
        return load()
    scene, told, file = None, None, None
    if ranks.local_rank == 0:
        scene = load()
        # A rank that is alone on its machine shares nothing, but takes part in what all do.
        reserved = _reserved(scene) if ranks.local_size > 1 else None
        if reserved is not None:
            file, content = reserved
            scene, told = _moved(scene, file, content)
    given = ranks.gather(told)[ranks.rank - ranks.local_rank]
    if scene is None and isinstance(given, dict):
        scene = _mapped(given)
    ranks.barrier()
    if file is not None:
        os.close(file)  # its mappings stay
    return load() if scene is None else scene


class _Memory:
    """Tensors in a mapped file."""

    def __init__(self, content: mmap.mmap) -> None:
        self.content, self.end = content, ALIGNMENT

    def put(self, tensor: torch.Tensor | None) -> Described | None:
        """Copy a tensor behind the last one; return its description."""
        if tensor is None:
            return None
        told = {"dtype": str(tensor.dtype).removeprefix("torch."), "shape": list(tensor.shape), "start": self.end}
        self.end += _aligned(tensor.nbytes)
        self.get(told).copy_(tensor)
        return told

    def get(self, told: Described) -> torch.Tensor:
        """Return the tensor of a description; it shares the memory."""
        dtype, shape = getattr(torch, told["dtype"]), told["shape"]
        if not prod(shape):
            return torch.empty(shape, dtype=dtype)
        found = torch.frombuffer(self.content, dtype=dtype, count=prod(shape), offset=told["start"])
        return found.view(shape)

    def get_all(self, told: Mapping[str, Described | None]) -> dict[str, torch.Tensor | None]:
        return {name: None if each is None else self.get(each) for name, each in told.items()}


def _reserved(scene: Scene) -> tuple[int, mmap.mmap] | None:
    """Return a file in memory for a scene, and its mapping; None where the system has or gives none."""
    size = ALIGNMENT + sum(_aligned(tensor.nbytes) for tensor in _tensors(scene))
    if not hasattr(os, "memfd_create"):
        return None
    try:
        file = os.memfd_create("nexwarp-scene")
    except OSError:
        return None
    try:
        os.ftruncate(file, size)
        return file, mmap.mmap(file, size)
    except OSError:
        os.close(file)
        return None


def _moved(scene: Scene, file: int, content: mmap.mmap) -> tuple[Scene, Described]:
    """Move a scene to a memory file; return it, and what other processes need to map it.

    Photos move one by one, in the scene's own lists, so that no more than one is there twice.
    """
    content[:TOKEN_BYTES] = token = secrets.token_bytes(TOKEN_BYTES)
    memory = _Memory(content)
    told: Described = {"file": f"/proc/{os.getpid()}/fd/{file}", "token": token.hex(), "train": [], "test": []}
    for group, views in (("train", scene.train), ("test", scene.test)):
        for index, view in enumerate(views):
            told[group].append(_described(view, memory))
            views[index] = _view(told[group][index], memory)
    told["cloud"] = {name: memory.put(getattr(scene, name)) for name in CLOUD}
    told["rest"] = [scene.scale, str(scene.path), scene.background, scene.random_background]
    cloud: dict[str, Any] = memory.get_all(told["cloud"])
    return dataclasses.replace(scene, **cloud), told


def _mapped(told: Described) -> Scene | None:
    """Return the scene that another process has moved; None if its memory cannot be had."""
    try:
        with open(told["file"], "rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    except (OSError, ValueError):
        return None
    if content[:TOKEN_BYTES] != bytes.fromhex(told["token"]):
        return None
    memory = _Memory(content)
    train, test = ([_view(each, memory) for each in told[group]] for group in ("train", "test"))
    scale, path, background, random = told["rest"]
    color = None if background is None else tuple(background)
    cloud: dict[str, Any] = memory.get_all(told["cloud"])
    return Scene(train, test, **cloud, scale=scale, path=Path(path), background=color, random_background=random)


def _described(view: View, memory: _Memory) -> Described:
    camera = view.camera
    return {
        "name": view.name,
        "size": [camera.width, camera.height, camera.near],
        "pose": [memory.put(camera.viewmat), memory.put(camera.K)],
        "photo": {name: memory.put(getattr(view, name)) for name in PHOTO},
    }


def _view(told: Described, memory: _Memory) -> View:
    viewmat, K = (memory.get(each) for each in told["pose"])
    photo: dict[str, Any] = memory.get_all(told["photo"])
    return View(camera=Camera(viewmat, K, *told["size"]), name=told["name"], **photo)


def _tensors(scene: Scene) -> Iterator[torch.Tensor]:
    for view in (*scene.train, *scene.test):
        yield from (view.camera.viewmat, view.camera.K)
        yield from (x for x in (view.image, view.mask, view.alpha, view.points) if x is not None)
    yield from (getattr(scene, name) for name in CLOUD)


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT
