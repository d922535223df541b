"""photos.csv of a run: how well the model renders each photo, and how sharp the photo is."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from nexwarp.data import View
from nexwarp.data.sfm.frames import photo_luma, reduced_luma, sharpness
from nexwarp.io.files import write_atomically
from nexwarp.run.evaluate import Values


def save_photo_table(file: Path, sets: Mapping[str, Sequence[View]], judged: Mapping[str, Values]) -> None:
    """Write a line for each view of each set: name, set, PSNR in dB, and `frames.sharpness`; the lowest PSNR first.

    StorageError: the file cannot be written.
    """
    rows = [
        (view.name, split, cast(float, judged[view.name]["psnr"]), sharpness(reduced_luma(photo_luma(view.image))))
        for split, views in sets.items()
        for view in views
    ]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("photo", "split", "psnr", "sharpness"))
    for name, split, psnr, sharp in sorted(rows, key=lambda row: row[2]):
        table.writerow((name, split, f"{psnr:.3f}", f"{sharp:.4g}"))
    write_atomically(file, text.getvalue().encode())
