"""From a video or a folder of photos to a scene: choice of frames, then structure from motion."""

import dataclasses
import os
import tempfile
from pathlib import Path
from typing import cast

import numpy as np

from nexwarp.data.images import read_image
from nexwarp.data.sfm.frames import (
    BLURRED,
    STILL,
    THUMBNAIL,
    FrameChoice,
    choose_frames,
    motion,
    reduced_luma,
    sharpness,
    write_frames,
)
from nexwarp.data.sfm.options import SfmOptions
from nexwarp.data.sfm.photos import list_photos
from nexwarp.data.sfm.pipeline import Observer, check_target, parents, reconstruct
from nexwarp.data.sfm.report import SfmReport
from nexwarp.io.json_files import Json

FRAMES = 120  # parts of a video, of which each gives a photo


@dataclasses.dataclass(frozen=True)
class ProcessReport:
    """What became of a video or of photos.

    Attributes:
        choice: the frames of a video; None for photos.
        blurred: names of photos that are much less sharp than the others; they are used all the same.
        repeated: names of photos that show nearly the same as the one before; they are used all the same.
        sfm: report of the reconstruction.
    """

    choice: FrameChoice | None
    blurred: list[str]
    repeated: list[str]
    sfm: SfmReport

    def rows(self) -> dict[str, str]:
        """The figures as rows of a table: name -> text."""
        return ({} if self.choice is None else self.choice.rows()) | self.sfm.rows()

    def lines(self) -> list[str]:
        """What is left out or suspicious, and advice, one line each."""
        lines = [f"blurred: {name}; kept" for name in self.blurred]
        lines += [f"repeats the photo before: {name}; kept" for name in self.repeated]
        return lines + self.sfm.lines()


def process(
    source: str | os.PathLike[str],
    scene: str | os.PathLike[str],
    frames: int = FRAMES,
    options: SfmOptions | None = None,
    *,
    overwrite: bool = False,
    observe: Observer = lambda stage, done, total: None,
) -> ProcessReport:
    """Make a scene of a video or a folder of photos.

    Of a video, `choose_frames` takes sharp frames that differ, which are then compared with their neighbours in time
    only, unless the options say otherwise. Photos are all used; blurred and repeated ones are named.

    Args:
        source: a video file, or a folder of photos as `reconstruct` takes it.
        scene: folder to write; must be empty or absent.
        frames: number of parts of a video that give a photo each.
        options: settings of the reconstruction; None is the defaults.
        overwrite: replace `scene` if nexwarp made it of photos or a video.
        observe: called repeatedly with the stage's name, the number of finished items and their total.

    Raises:
        ValueError, OSError: those of `choose_frames` and `reconstruct`; nothing is written then.
    """
    source, scene, options = Path(source), Path(scene), options or SfmOptions()
    options.check()
    if not source.is_file():
        names = list_photos(source)
        check_target(source, scene, overwrite)
        blurred, repeated = judge_photos(source, names, observe)
        notes: dict[str, Json] = {"blurred": list(blurred), "repeated": list(repeated)}
        report = reconstruct(source, scene, options, overwrite=overwrite, observe=observe, notes=notes)
        return ProcessReport(None, blurred, repeated, report)
    check_target(source, scene, overwrite)
    choice = choose_frames(source, frames, observe)
    if options.matching == "auto":
        options = dataclasses.replace(options, matching="sequential")
    with (
        parents(scene),
        tempfile.TemporaryDirectory(dir=scene.parent, prefix=f".{scene.name}-frames-") as folder,
    ):
        write_frames(source, choice, Path(folder), observe)
        notes = {"video": video_identity(source), "frames": cast(Json, dataclasses.asdict(choice))}
        report = reconstruct(folder, scene, options, overwrite=overwrite, observe=observe, notes=notes)
    return ProcessReport(choice, [], [], report)


def video_identity(path: Path) -> dict[str, Json]:
    """Return name, size and time of a video, by which a scene tells what it was made of."""
    status = path.stat()
    return {"name": path.name, "bytes": status.st_size, "modified": status.st_mtime}


def judge_photos(folder: Path, names: list[str], observe: Observer) -> tuple[list[str], list[str]]:
    """Return the names of photos that are blurred, and of those that repeat the photo before."""
    scores: list[float] = []
    repeated: list[str] = []
    before: np.ndarray | None = None
    for done, name in enumerate(names, start=1):
        luma = read_image(folder / name).float().mean(-1).byte().numpy()
        scores.append(sharpness(reduced_luma(luma)))
        small = reduced_luma(luma, THUMBNAIL)
        if before is not None and before.shape == small.shape and motion(small, before) < STILL:
            repeated.append(name)
        before = small
        observe("judging photos", done, len(names))
    limit = BLURRED * float(np.median(scores))
    return [name for name, score in zip(names, scores, strict=True) if score < limit], repeated
