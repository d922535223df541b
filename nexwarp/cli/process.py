"""`nexwarp process`, and the scene of a video that is given to `nexwarp train`."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.options import Flag_, option
from nexwarp.data.sfm import SfmOptions, process
from nexwarp.data.sfm.photos import FILMS
from nexwarp.data.sfm.process import FRAMES, REPORT_FILE, video_identity
from nexwarp.errors import RunError
from nexwarp.io.json_files import READ_ERRORS, read_object


@dataclass
class Process:
    """Make a scene of a video or of photos: choose sharp frames, then estimate the cameras by structure from motion.

    Blurred and repeated frames of a video are left out; among photos, they are named. `process` and `sfm` are two names
    of one command.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO|PHOTOS")]
    """A video (extra `video`), or a folder of photos (JPEG, PNG, TIFF, BMP) with its subfolders."""
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Output folder: images/ (undistorted), sparse/0/ (a COLMAP model) and the report sfm.json."""
    frames: Annotated[int, option("N")] = FRAMES
    """Number of equal parts of a video, of which each gives its sharpest frame."""
    settings: tyro.conf.OmitArgPrefixes[SfmOptions] = dataclasses.field(default_factory=SfmOptions)
    overwrite: Flag_ = False
    """Replace images/, sparse/ and sfm.json of SCENE if nexwarp wrote all that is in them; other files stay."""

    def __call__(self, console: Console) -> None:
        """Make the scene."""
        make_scene(self, console)
        console.print(f"next: nexwarp train {self.scene}", soft_wrap=True, markup=False, highlight=False)


def make_scene(order: Process, console: Console) -> None:
    """Make a scene, and print the report."""
    with display.stages(console) as observe:
        report = process(
            order.source, order.scene, order.frames, order.settings, overwrite=order.overwrite, observe=observe
        )
    console.print(display.results_table(report.rows(), str(order.scene)))
    for line in report.lines():
        console.print(line, soft_wrap=True, markup=False, highlight=False)


def is_video(path: str) -> bool:
    """Whether a path is the file of a video, by its suffix."""
    return Path(path).suffix.lower() in FILMS and not Path(path).is_dir()


def scene_folder_of(video: Path) -> Path:
    """Return the folder of the scene that `nexwarp train` makes of a video."""
    return Path("scenes") / video.stem


def scene_of_video(video: Path, console: Console) -> None:
    """Make the scene of a video, unless that was done before; RunError if its folder holds something else."""
    if not video.is_file():
        raise FileNotFoundError(f"{video}: no such file, expected a video")
    scene = scene_folder_of(video)
    if (scene / REPORT_FILE).is_file():
        try:
            made_of = read_object(scene / REPORT_FILE).get("video")
        except READ_ERRORS:
            made_of = None
        if made_of == video_identity(video):
            console.print(f"{video}: the scene {scene} was made of it before", soft_wrap=True, highlight=False)
            return
    if scene.exists():
        raise RunError(
            f"{scene}: expected no folder of that name, or a scene made of {video}; "
            f"make a scene with nexwarp process {video} SCENE, and train that"
        )
    make_scene(Process(video, scene), console)
