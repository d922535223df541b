"""Limits of a rendering, checked before anything is allocated: int32 indices and the memory that there is."""

import torch

from nexwarp.errors import OutOfMemoryError
from nexwarp.kernels.tiles import LARGEST_INT
from nexwarp.machine import available_memory

GIB = 2**30
# Fewer bytes are not compared with the free memory: asking for it takes up to a millisecond.
SMALLEST_CHECKED = GIB


def check_image(
    width: int, height: int, max_hits: int, real: torch.dtype, device: torch.device, *, texture: tuple[int, torch.dtype]
) -> None:
    """Raise an error unless an image can be rendered: its pixels and hits are counted in int32, and it takes memory.

    The memory compared is what a rendering holds at once, without its lists of surfels: a lower bound. `texture` has
    the number of values that the texture keeps for each hit, 0 without a texture, and their dtype.
    """
    image, advice = f"{width}x{height}", "render the image in parts (Camera.crop)"
    padded = -(-width // 16) * 16 * -(-height // 16) * 16
    if padded > LARGEST_INT:
        raise ValueError(
            f"camera: expected an image of at most {LARGEST_INT:,} pixels, in tiles of 16x16, got {image}; {advice}"
        )
    hits, (values, dtype) = width * height * max_hits, texture
    # The byte offset of one row of a texture's values is an int32; rows are padded by at most 128 bytes.
    most = (LARGEST_INT - 128) // dtype.itemsize if values else LARGEST_INT
    if hits > most:
        raise ValueError(
            f"max_hits: expected at most {most:,} hits, pixels times max_hits, got {image} times {max_hits}; {advice}"
        )
    # plain, base, alpha and directions; weights and depths; positions, colours and the texture's values. Two int32.
    size = real.itemsize
    needed = width * height * (10 * size + 4) + hits * (2 * size + 4)
    needed += hits * (6 * size + values * dtype.itemsize) if values else 0
    check_memory(needed, device, f"an image of {image} pixels with K = {max_hits}")


def check_memory(needed: int, device: torch.device, task: str) -> None:
    """Raise OutOfMemoryError if a GPU cannot hold `needed` bytes at all, or a computer not now.

    The allocator of a GPU refuses what is not free; a computer's grants more than there is.
    """
    if needed < SMALLEST_CHECKED:
        return
    if device.type == "cpu":
        free, place = available_memory(), "are free"
    else:
        free, place = torch.cuda.get_device_properties(device).total_memory, "are on the GPU"
    if needed > free:
        raise OutOfMemoryError.of(task, f"at least {needed / GIB:.1f} GiB, of which {free / GIB:.1f} GiB {place}")
