"""Whether a binary COLMAP model is complete.

pycolmap reads on past the end of a truncated file: counts become whatever memory holds, and it allocates for
them until memory is gone (minutes, for a cut-off points3D.bin). So the lengths in
the files are followed first.
"""

import struct
from pathlib import Path

MIN_CAMERA = 24 + 2 * 8  # id, model, width and height, and the two parameters of the simplest model


def check_binary_model(folder: Path) -> None:
    """Raise ValueError naming the file of the model in `folder` that ends before what its counts announce."""
    for name, end_of_record in (
        ("cameras.bin", lambda data, start: start + MIN_CAMERA),
        ("images.bin", _end_of_image),
        ("points3D.bin", _end_of_point),
        ("frames.bin", _end_of_frame),
    ):
        path = folder / name
        if path.is_file() and not _is_complete(path.read_bytes(), end_of_record):
            raise ValueError(f"{path}: truncated or damaged, expected more records than the file holds")


def _is_complete(data: bytes, end_of_record) -> bool:
    try:
        (count,) = struct.unpack_from("<Q", data)
        end = 8
        for _ in range(count):
            end = end_of_record(data, end)
            if end > len(data):
                return False
    except (struct.error, ValueError):  # a length or a name reaches past the end
        return False
    return True


def _end_of_image(data: bytes, start: int) -> int:
    """Id, pose (7 doubles), camera, name with a closing zero, and 24 bytes an observation."""
    name_end = data.index(b"\0", start + 64) + 1
    return name_end + 8 + 24 * struct.unpack_from("<Q", data, name_end)[0]


def _end_of_point(data: bytes, start: int) -> int:
    """Id, position, colour, error, and 8 bytes an observation."""
    return start + 51 + 8 * struct.unpack_from("<Q", data, start + 43)[0]


def _end_of_frame(data: bytes, start: int) -> int:
    """Id, rig, pose (7 doubles), and 16 bytes a sensor."""
    return start + 68 + 16 * struct.unpack_from("<I", data, start + 64)[0]
