"""The device that a command runs on."""

import ctypes
import sys

import torch

from nexwarp.errors import SettingError

# Of glibc's mallopt.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3


def pick_device(name: str | None) -> torch.device:
    """Return the device asked for, or CUDA where there is one, else the CPU."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    if name not in ("cuda", "cpu"):
        raise SettingError(f"--device: expected cuda or cpu, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingError("--device: cuda was asked for, but torch finds no CUDA device; use --device cpu")
    return torch.device("cuda", torch.cuda.current_device()) if name == "cuda" else torch.device("cpu")


def keep_freed_memory() -> None:
    """Let glibc keep what a CPU training frees: each step takes the same blocks again, page by page from the system.

    A tenth of a step's time. Does nothing where the C library is another one.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for parameter, value in ((M_MMAP_THRESHOLD, 32 * 2**20), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 64 * 2**20)):
        mallopt(parameter, value)
