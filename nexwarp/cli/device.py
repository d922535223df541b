"""Choice and set-up of the device that a command runs on."""

import ctypes
import sys

import torch

from nexwarp.errors import SettingError

# Parameters of glibc's mallopt.
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3


def pick_device(name: str | None) -> torch.device:
    """Return the device of this name; None selects CUDA if available, else the CPU. SettingError if there is none."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    if name not in ("cuda", "cpu"):
        raise SettingError(f"--device: expected cuda or cpu, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingError("--device: expected a CUDA device, but torch finds no CUDA device; use --device cpu")
    return torch.device("cuda", torch.cuda.current_device()) if name == "cuda" else torch.device("cpu")


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for reuse, for training on a CPU.

    Each step allocates the same blocks again. Getting them from the system anew, page by page, would take a tenth of
    the step's time. No effect with other C libraries.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for parameter, value in ((M_MMAP_THRESHOLD, 32 * 2**20), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 64 * 2**20)):
        mallopt(parameter, value)
