"""Choice and set-up of the device that a command runs on."""

import torch

from nexwarp.errors import SettingError


def pick_device(name: str | None) -> torch.device:
    """Return the device of this name; None selects CUDA if available, else the CPU. SettingError if there is none."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    if name not in ("cuda", "cpu"):
        raise SettingError(f"--device: expected cuda or cpu, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingError("--device: expected a CUDA device, but torch finds no CUDA device; use --device cpu")
    return torch.device("cuda", torch.cuda.current_device()) if name == "cuda" else torch.device("cpu")
