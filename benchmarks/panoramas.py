"""Crops of panoramas against pinhole views: PSNR by the order of blending and the panorama's width.

Usage: `python -m benchmarks.panoramas RUN [--widths 4096 8192] [--device cuda]`. The pinholes are the run's test views,
straight and turned, with pixels as large as the panorama's. Where the run's scene is there, both orders are compared
with its test photos, too. On a GPU, the time of a frame in each order follows.
"""

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import fmean, median

import torch

import nexwarp as nw
from nexwarp.errors import NexwarpError
from nexwarp.ops.tiles import Order
from nexwarp.run.folder import read_run
from nexwarp.run.metrics import psnr

TURNS = ((0.0, 0.0), (0.35, 0.1))  # yaw and pitch, radians
ORDERS: tuple[Order, ...] = ("depth", "distance")
MARGIN = 3  # pixels around a window, for the interpolation


def turned(viewmat: torch.Tensor, yaw: float, pitch: float) -> torch.Tensor:
    """A viewmat after the camera was turned about its own centre."""
    c, s, d, e = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    around = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    up = torch.tensor([[1, 0, 0], [0, d, e], [0, -e, d]], dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = up @ around
    return (motion @ viewmat.double().cpu()).to(viewmat)


def crop(camera: nw.Camera, turn: tuple[float, float], width: int) -> nw.Camera:
    """The camera, turned by a yaw and a pitch, with pixels as large as those of a panorama of `width` pixels."""
    factor = width / (2 * math.pi) / camera.focal
    K = camera.K.clone()
    K[:2] *= factor
    size = round(camera.width * factor), round(camera.height * factor)
    return nw.Camera(turned(camera.viewmat, *turn), K, *size, camera.near)


def sampled(model: nw.Model, viewmat: torch.Tensor, camera: nw.Camera, width: int) -> torch.Tensor:
    """Look up a pinhole's pixels in a panorama at the mean exposure, by bicubic interpolation.

    Only the window of the panorama that the pinhole sees is rendered; it must not cross the panorama's border.

    Args:
        model: the model, on the CPU or a GPU.
        viewmat: (4, 4) of the panorama, at the pinhole's place.
        camera: the pinhole.
        width: pixels of the whole panorama.

    Returns:
        (H, W, 3) image, not clamped.
    """
    turn = (camera.viewmat[:3, :3].double() @ viewmat[:3, :3].double().T).cpu()
    rays = nw.RayCamera.pinhole(camera).rays.double().cpu() @ turn
    x, y = places(rays, width)
    left, top = int(x.min()) - MARGIN, int(y.min()) - MARGIN
    right, bottom = int(x.max()) + MARGIN + 1, int(y.max()) + MARGIN + 1
    longitude = ((torch.arange(left, right).double() + 0.5) / width - 0.5) * 2 * math.pi
    latitude = ((torch.arange(top, bottom).double() + 0.5) / (width // 2) - 0.5) * math.pi
    latitude, longitude = torch.meshgrid(latitude, longitude, indexing="ij")
    across = latitude.cos()
    window = torch.stack([longitude.sin() * across, latitude.sin(), longitude.cos() * across], -1).to(viewmat)
    image = model.render(nw.RayCamera(viewmat, window, camera.near, width / (2 * math.pi)), exposure="mean").image
    height, columns = image.shape[:2]
    at = torch.stack([(x - left) / columns, (y - top) / height], -1) * 2 - 1
    layers = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(layers, at.to(image)[None], mode="bicubic", align_corners=False)
    return found[0].permute(1, 2, 0)


def places(rays: torch.Tensor, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel coordinates x and y (H, W) of rays (H, W, 3) in an equirectangular panorama's frame."""
    units = torch.nn.functional.normalize(rays, dim=-1)
    x = (torch.atan2(units[..., 0], units[..., 2]) / (2 * math.pi) + 0.5) * width
    return x, (torch.asin(units[..., 1].clamp(-1, 1)) / math.pi + 0.5) * (width // 2)


def told(values: list[float]) -> str:
    """Lowest, mean and highest of some values."""
    return f"{min(values):.2f}, {fmean(values):.2f}, {max(values):.2f}"


def frame_ms(render: Callable[[], object], repeats: int = 60) -> float:
    """Median time of a rendering on a GPU, ms."""
    times = []
    for index in range(repeats + 5):
        torch.cuda.synchronize()
        start = time.perf_counter()
        render()
        torch.cuda.synchronize()
        times += [1000 * (time.perf_counter() - start)] if index >= 5 else []
    return median(times)


@torch.no_grad()
def main(argv: list[str] | None = None) -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--widths", type=int, nargs="+", default=[4096, 8192])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args(argv)
    model = nw.load(options.run).to(options.device)
    cameras = list(nw.load_cameras(options.run)["test"].values())
    for width in options.widths:
        found: dict[Order, list[float]] = {order: [] for order in ORDERS}
        for given in cameras:
            for turn in TURNS:
                camera = crop(given, turn, width).to(options.device)
                image = sampled(model, given.viewmat.to(options.device), camera, width)
                for order, values in found.items():
                    values.append(psnr(image, model.render(camera, order=order, exposure="mean").image))
        print(f"{width} pixels:", "; ".join(f"by {order} {told(values)} dB" for order, values in found.items()))
    try:
        test = read_run(options.run)[0].load().test
    except (NexwarpError, OSError) as error:
        print(f"photos: {error}")
    else:
        for order in ORDERS:
            values = [psnr(model.render(v.camera, order=order).image.cpu(), v.image / 255) for v in test]
            print(f"photos by {order}: {told(values)} dB")
    if model.device.type == "cuda":
        for order in ORDERS * 2:
            frame = partial(model.render, cameras[0], order=order)
            print(f"frame by {order}: {frame_ms(frame):.3f} ms")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
