"""The user's cache folder, which holds the demo scene and undistorted photos."""

import hashlib
import os
import tempfile
import threading
import warnings
from pathlib import Path

import numpy as np
import torch

VERSION = b"1"  # of cached photos; raise it when the same photo and lens give other pixels


def cache_folder() -> Path:
    """The cache folder: $NEXWARP_CACHE, else $XDG_CACHE_HOME/nexwarp, else ~/.cache/nexwarp."""
    cache = os.environ.get("NEXWARP_CACHE")
    return Path(cache) if cache else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nexwarp"


class PhotoCache:
    """Undistorted photos as PNG files, named by a digest of all inputs of the undistortion.

    If the folder cannot be written to, a warning is issued once and the photos are undistorted at each load.
    """

    def __init__(self, folder: Path) -> None:
        """Use a folder, which is created when the first photo is saved."""
        self.folder = folder
        self._lock = threading.Lock()
        self._writable = True

    @staticmethod
    def key(*parts: bytes) -> str:
        """Hexadecimal digest of byte strings and their lengths."""
        digest = hashlib.blake2b(VERSION, digest_size=20)
        for part in parts:
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        return digest.hexdigest()

    def load(self, key: str, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor | None] | None:
        """Load a photo (H, W, 3 or 4) uint8 and its mask, (H, W) bool or None; None if it is missing or damaged."""
        file, mask_file = self._files(key)
        photo = _read(file)
        if photo is None or photo.shape[:2] != (height, width) or photo.ndim != 3:
            return None
        if not mask_file.is_file():
            return torch.from_numpy(photo), None
        mask = _read(mask_file)
        if mask is None or mask.shape != (height, width):
            return None
        return torch.from_numpy(photo), torch.from_numpy(mask > 0)

    def save(self, key: str, photo: torch.Tensor, mask: torch.Tensor | None) -> None:
        """Save a photo and its mask; the mask first, so that no photo exists without its mask."""
        if not self._writable:
            return
        file, mask_file = self._files(key)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            if mask is not None:
                _write(mask_file, (mask.numpy() * np.uint8(255)))
            _write(file, photo.numpy())
        except OSError as error:
            with self._lock:
                first, self._writable = self._writable, False
            if first:
                warnings.warn(
                    f"{self.folder}: undistorted photos cannot be kept here ({error.strerror or error}); "
                    "each load will undistort them anew",
                    stacklevel=2,
                )

    def _files(self, key: str) -> tuple[Path, Path]:
        folder = self.folder / key[:2]
        return folder / f"{key}.png", folder / f"{key}-mask.png"


def _read(file: Path) -> np.ndarray | None:
    from PIL import Image

    try:
        with Image.open(file, formats=["PNG"]) as image:
            return np.array(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def _write(file: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".png")
    try:
        with os.fdopen(handle, "wb") as stream:
            Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
        os.replace(temporary, file)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
