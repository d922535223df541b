"""Files of depth maps: PNG, OpenEXR, NPY and COLMAP's, and which photo each belongs to."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import torch

from nexwarp.data.capture import Photo, find_named, listed
from nexwarp.data.images import read_grey
from nexwarp.io.files import one_line
from nexwarp.io.pictures import load_exr_channel

DEPTHS = "depths"
SUFFIXES = (".png", ".exr", ".npy")
STEREO = Path("stereo", "depth_maps")  # of COLMAP, beside the photos that it has undistorted
STEREO_SUFFIXES = (".geometric.bin", ".photometric.bin")  # the better one first
MILLIMETRES = 1000.0
HEADER_BYTES = 64  # at most, of COLMAP's maps
MOST_NAMED = 8
LARGEST = torch.finfo(torch.float16).max  # 65,504


def with_depths(path: Path, photos: list[Photo]) -> list[Photo]:
    """Return the photos of a scene in `path` with their depth maps: those of depths/, else those that COLMAP made.

    Where transforms.json names depth maps, the photos keep these. Warns of files in depths/ that fit no photo;
    FileNotFoundError where none does.
    """
    folder, stereo = path / DEPTHS, path / STEREO
    if any(photo.depth for photo in photos) or not (folder.is_dir() or stereo.is_dir()):
        return photos
    if not folder.is_dir():
        return [dataclasses.replace(x, depth=find_named(stereo, x.name, STEREO_SUFFIXES)) for x in photos]
    photos = [dataclasses.replace(x, depth=find_named(folder, x.name, SUFFIXES, SUFFIXES)) for x in photos]
    used = {photo.depth for photo in photos}
    files = [file for file in folder.rglob("*") if file.suffix in SUFFIXES]
    unused = sorted(str(file.relative_to(folder)) for file in files if file not in used)
    if len(unused) == len(files):
        raise FileNotFoundError(f"{folder}: none is named after a photo, expected {Path(photos[0].name).stem}.png, say")
    if unused:
        names = one_line(listed(unused, MOST_NAMED), 400)
        warnings.warn(f"{folder}: {len(unused)} of {len(files)} depth maps fit no photo: {names}", stacklevel=2)
    return photos


def read_depth(path: Path) -> torch.Tensor:
    """Read a depth map (H, W) float16; what is not above 0, or above 65,504, is unknown and becomes 0.

    A PNG file has 8 or 16 bits a pixel in millimetres, which become metres. Numbers of others stay as they are.
    ValueError: a file that is damaged, of another kind or of more than one channel, has NaN, or no depth.
    """
    try:
        if path.suffix.lower() == ".png":
            values = read_grey(path) / MILLIMETRES
        elif path.suffix.lower() == ".exr":
            values = load_exr_channel(path)
        else:
            values = _read_npy(path) if path.suffix.lower() == ".npy" else _read_colmap(path)
    except (OSError, EOFError) as error:
        raise ValueError(f"{path}: expected a whole depth map, but it cannot be read ({one_line(error)})") from None
    if np.isnan(values).any():
        raise ValueError(f"{path}: expected depths, and 0 where they are unknown, got NaN")
    known = (values > 0) & (values <= LARGEST)
    depths = torch.from_numpy(np.where(known, values, 0).astype(np.float16))
    if not depths.any():
        raise ValueError(f"{path}: expected depths above 0, up to {LARGEST:,.0f}, got none")
    return depths


def _read_npy(path: Path) -> np.ndarray:
    try:
        values = np.load(path, mmap_mode="r")  # which checks the size that the header announces
    except Exception as error:  # numpy parses headers as Python, with its errors
        raise ValueError(f"{path}: expected an array of numbers, could not read it: {one_line(error)}") from None
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise ValueError(f"{path}: expected an array of numbers, got {getattr(values, 'dtype', 'several')}")
    sizes = [size for size in values.shape if size != 1]
    if len(sizes) != 2 or not values.size:
        raise ValueError(f"{path}: expected shape (H, W), got {values.shape}")
    return np.asarray(values, np.float32).reshape(sizes)


def _read_colmap(path: Path) -> np.ndarray:
    """Read a map of COLMAP's patch-match stereo: "WIDTH&HEIGHT&1&", and rows of float32."""
    with path.open("rb") as file:
        *sizes, _ = [*file.read(HEADER_BYTES).split(b"&", 3), b""]
    try:
        width, height, channels = (int(size) for size in sizes[:3])
    except ValueError:
        raise ValueError(f"{path}: expected a depth map: .png, .exr, .npy or COLMAP's") from None
    start = sum(len(size) + 1 for size in sizes[:3])
    if channels != 1 or min(width, height) < 1 or path.stat().st_size != start + 4 * width * height:
        raise ValueError(f"{path}: expected 1 channel of {width}x{height} float32, got {path.stat().st_size} bytes")
    return np.fromfile(path, "<f4", offset=start).reshape(height, width)
