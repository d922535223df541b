"""Writer of PLY files, for points, surfels, Gaussians and meshes."""

import os
from collections.abc import Mapping

import numpy as np

from nexwarp.io.files import written_aside

TYPES = {"u1": "uchar", "i4": "int", "f4": "float", "f8": "double"}


def write_elements(
    path: str | os.PathLike[str], elements: Mapping[str, Mapping[str, np.ndarray]], comment: str = ""
) -> None:
    """Write a binary little-endian PLY file, atomically.

    Each element has columns by name: (N,), or (N, k) for a property that is a list of k values.
    """
    header = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    bodies = []
    for element, columns in elements.items():
        count = len(next(iter(columns.values())))
        header.append(f"element {element} {count}")
        fields: dict[str, np.ndarray] = {}
        for name, values in columns.items():
            is_list = values.ndim == 2
            header.append(f"property {'list uchar ' if is_list else ''}{TYPES[values.dtype.str[1:]]} {name}")
            if is_list:
                fields[f"length of {name}"] = np.full(count, values.shape[1], np.uint8)
            fields[name] = values
        rows = np.empty(count, [(name, x.dtype.newbyteorder("<"), x.shape[1:]) for name, x in fields.items()])
        for name, values in fields.items():
            rows[name] = values
        bodies.append(rows.tobytes())
    with written_aside(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.writelines(bodies)
