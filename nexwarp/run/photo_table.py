"""photos.csv of a run: how well the model renders each photo, and how sharp the photo is."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from nexwarp.data import View
from nexwarp.data.sfm.frames import photo_luma, reduced_luma, sharpness
from nexwarp.errors import FormatError
from nexwarp.io.files import one_line, write_atomically
from nexwarp.machine import in_threads
from nexwarp.run.evaluate import Values

COLUMNS = ["photo", "split", "psnr", "sharpness"]
MOST_CHARACTERS = 2**23  # of a table; 30,000 photos have about 1.5 million


def save_photo_table(file: Path, sets: Mapping[str, Sequence[View]], judged: Mapping[str, Values]) -> None:
    """Write a line for each view of each set: name, set, PSNR in dB, and `frames.sharpness`; the lowest PSNR first.

    StorageError: the file cannot be written.
    """
    import kornia.filters  # noqa: F401  # before threads import it at once

    photos = [(view, split) for split, views in sets.items() for view in views]
    sharp = in_threads(lambda photo: sharpness(reduced_luma(photo_luma(photo[0].image))), photos)
    rows = [
        (view.name, split, cast(float, judged[view.name]["psnr"]), value)
        for (view, split), value in zip(photos, sharp, strict=True)
    ]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for name, split, psnr, value in sorted(rows, key=lambda row: row[2]):
        table.writerow((name, split, f"{psnr:.3f}", f"{value:.4g}"))
    write_atomically(file, text.getvalue().encode())


def load_photo_table(file: Path) -> dict[str, tuple[float, float]]:
    """Read PSNR in dB and sharpness by "set/name", the lowest PSNR first; nothing where there is no file.

    FormatError: the file is damaged.
    """
    if not file.is_file():
        return {}
    try:
        with file.open(newline="", encoding="utf-8") as opened:
            text = opened.read(MOST_CHARACTERS + 1)
        if len(text) > MOST_CHARACTERS:
            raise ValueError(f"expected at most {MOST_CHARACTERS:,} characters")
        lines = csv.reader(io.StringIO(text), strict=True)
        if (header := next(lines, [])) != COLUMNS:
            raise ValueError(f"expected the columns {', '.join(COLUMNS)}, got {', '.join(header)!r:.60}")
        table = {f"{split}/{name}": (float(psnr), float(sharp)) for name, split, psnr, sharp in lines}
        if any(math.isnan(value) for values in table.values() for value in values):
            raise ValueError("expected numbers, got nan")
    except (OSError, ValueError, csv.Error) as error:
        raise FormatError(f"{file}: expected the photos of a run ({one_line(error)})") from None
    return dict(sorted(table.items(), key=lambda row: row[1][0]))
