"""Check that the photos of a scene fit into the host's memory, before any of them is decoded."""

from collections.abc import Sequence
from pathlib import Path

from nexwarp.machine import available_memory

GIB = 2**30
SHARE = 0.9  # largest share of the free memory for photos
MAX_DOWNSCALE = 64


def photos_bytes(sizes: Sequence[tuple[int, int]], downscale: int, channels: int) -> int:
    """Memory in bytes of photos of the given (width, height), reduced by `downscale`."""
    return sum((width // downscale) * (height // downscale) * channels for width, height in sizes)


def check_memory(path: Path, images: str, sizes: Sequence[tuple[int, int]], downscale: int, channels: int) -> int:
    """Return the memory in bytes that remains free after the photos are loaded.

    Args:
        path: folder of the scene, for the message.
        images: name of the photos' folder, for the message.
        sizes: width and height of every photo after undistortion, before the reduction.
        downscale: factor of the reduction.
        channels: bytes per pixel.

    Raises:
        ValueError: the photos do not fit; the message suggests a downscale or a folder of smaller images.
    """
    free = available_memory()
    limit = int(SHARE * free)
    need = photos_bytes(sizes, downscale, channels)
    if need <= limit:
        return free - need
    width, height = max(sizes)
    smallest = min(min(size) for size in sizes)
    factors = range(downscale + 1, min(MAX_DOWNSCALE, smallest) + 1)
    fits = [k for k in factors if photos_bytes(sizes, k, channels) <= limit]
    advice = "use fewer photos"
    if fits:
        advice = f"use downscale={fits[0]} ({photos_bytes(sizes, fits[0], channels) / GIB:.1f} GiB)"
        folders = sorted(f.name for f in path.glob("images_*") if f.is_dir() and f.name != images)
        advice += f" or a folder of smaller images ({', '.join(folders)})" if folders else ""
    raise ValueError(
        f"{path}: {len(sizes)} photos of up to {width}x{height} at downscale={downscale} need {need / GIB:.1f} GiB of "
        f"host memory, of which {free / GIB:.1f} GiB are free; {advice}"
    )
