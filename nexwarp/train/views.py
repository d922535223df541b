"""The training photos, on the device of the training."""

import copy
import hashlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import torch

from nexwarp.cameras.camera import Camera
from nexwarp.data import View
from nexwarp.model.exposures import DECIMALS, Exposures
from nexwarp.model.poses import PoseCorrections
from nexwarp.train.exposure import ExposureCalibration

# Photos stay on the GPU when they take less than this share of its free memory.
PHOTO_SHARE = 0.25
AHEAD = 2  # photos to fetch meanwhile where they do not
VALUES_A_THREAD = 500_000


class TrainingViews:
    """Training views on the device they are used on; photos stay 8-bit.

    Where photos take a quarter of the GPU's free memory or more, they stay in host memory, and a thread copies the next
    ones to the GPU while a step runs, through pinned memory and on its own CUDA stream.
    """

    def __init__(
        self,
        views: list[View],
        device: torch.device,
        gains: torch.Tensor | None = None,
        lens: Exposures | None = None,
    ) -> None:
        """Move the views, whose photos have gains (V, 3) and a lens's falloff or else one exposure, to a device."""
        self.device = device
        self.gains = None if gains is None else gains.to(device)
        self.lens = None if lens is None else copy.deepcopy(lens).to(device)
        self.views = views
        self.cameras = [view.camera.to(device) for view in views]
        self.photos = [view.image for view in views]
        self.pool: ThreadPoolExecutor | None = None
        self.coming: dict[int, Future[tuple[torch.Tensor, torch.cuda.Event]]] = {}
        if device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(device)
            if sum(p.numel() for p in self.photos) < PHOTO_SHARE * free:
                self.photos = [p.to(device) for p in self.photos]
            else:
                self.pool = ThreadPoolExecutor(1, "photos")
                self.stream = torch.cuda.Stream(device)

    def __len__(self) -> int:
        return len(self.photos)

    def refined_cameras(self, poses: PoseCorrections | None) -> list[Camera]:
        """Return the cameras on the device, with the poses as they are corrected; None corrects none."""
        return self.cameras if poses is None else poses.cameras(self.cameras)

    def torch_threads(self, max_hits: int) -> int:
        """Return how many threads to give torch's own loops: on small images, to wake a second one takes longer."""
        all_threads, camera = torch.get_num_threads(), self.cameras[0]
        if self.device.type != "cpu":
            return all_threads
        return min(all_threads, 1 + 3 * camera.width * camera.height * max(max_hits, 1) // VALUES_A_THREAD)

    def fingerprint(self) -> str:
        """Return a digest of the views' names and cameras."""
        digest = hashlib.sha256()
        for view in self.views:
            camera = view.camera
            values = [*camera.viewmat.flatten().tolist(), *camera.K.flatten().tolist(), camera.width, camera.height]
            digest.update(f"{view.name} {values}\n".encode())
        return digest.hexdigest()

    def get(self, index: int, ahead: Sequence[int] = ()) -> tuple[Camera, torch.Tensor]:
        """Return camera and photo (H, W, 3) float in [0, 1] of a view; copy those of the next views, `ahead`."""
        photo = self._on_device(index)
        self._fetch(ahead[:AHEAD])
        return self.cameras[index], photo.float() / 255.0

    def exposure(self, index: int) -> torch.Tensor | None:
        """Return gains times falloff of a photo, (3,) or (H, W, 3); None where photos have one exposure."""
        if self.gains is None:
            return None
        falloff = None if self.lens is None else self.lens.falloff_of(self.cameras[index])
        return self.gains[index] if falloff is None else self.gains[index] * falloff

    def mask(self, index: int) -> torch.Tensor | None:
        """Return the mask (H, W) bool of a photo, or None."""
        mask = self.views[index].mask
        return None if mask is None else mask.to(self.device, non_blocking=True)

    def alpha(self, index: int) -> torch.Tensor | None:
        """Return alpha (H, W) float in [0, 1] of a photo; None if it is opaque."""
        alpha = self.views[index].alpha
        return None if alpha is None else alpha.to(self.device, non_blocking=True).float() / 255.0

    def _on_device(self, index: int) -> torch.Tensor:
        coming = self.coming.pop(index, None)
        if coming is None:
            return self.photos[index].to(self.device)
        photo, copied = coming.result()
        here = torch.cuda.current_stream(self.device)
        here.wait_event(copied)
        photo.record_stream(here)
        return photo

    def _fetch(self, ahead: Sequence[int]) -> None:
        if self.pool is None:
            return
        self.coming = {index: future for index, future in self.coming.items() if index in ahead}
        for index in ahead:
            if index not in self.coming:
                self.coming[index] = self.pool.submit(self._copy, index)

    def _copy(self, index: int) -> tuple[torch.Tensor, torch.cuda.Event]:
        pinned = self.photos[index].pin_memory()
        with torch.cuda.stream(self.stream):
            photo = pinned.to(self.device, non_blocking=True)
            copied = torch.cuda.Event()
            copied.record()
        return photo, copied


def with_cameras(views: Sequence[View], cameras: Sequence[Camera]) -> list[View]:
    """Return views with other cameras, which may be on any device."""
    return [replace(view, camera=camera.to("cpu")) for view, camera in zip(views, cameras, strict=True)]


def mean_color(views: list[View], calibration: ExposureCalibration | None = None) -> tuple[float, float, float]:
    """Mean sRGB colour in [0, 1] of all pixels of the photos, each divided by its exposure."""
    total, pixels = torch.zeros(3, dtype=torch.float64), 0
    for index, view in enumerate(views):
        light = None if calibration is None else calibration.exposures.falloff_of(view.camera)
        # Integers have the same sum whatever the number of threads; rounding hides the order of the others.
        sums = view.image.sum((0, 1), dtype=torch.int64) if light is None else (view.image / light.double()).sum((0, 1))
        total += sums if calibration is None else sums / calibration.gains[index].double()
        pixels += view.image.shape[0] * view.image.shape[1]
    mean = total / pixels / 255
    red, green, blue = (mean if calibration is None else mean.clamp(0, 1).round(decimals=DECIMALS)).tolist()
    return red, green, blue
