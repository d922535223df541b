"""Names of all files that nexwarp writes to a run folder: one list for their writers and for `--overwrite`."""

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from nexwarp.cameras.cameras_file import CAMERAS_FILE
from nexwarp.cameras.paths import PATHS
from nexwarp.io.files import is_abandoned, is_temporary, remove_empty
from nexwarp.io.json_files import READ_ERRORS, read_json
from nexwarp.model.model_file import MODEL_FILE
from nexwarp.train.checkpoint import CHECKPOINT_FILES, CHECKPOINTS
from nexwarp.train.recipe import MOST_TEACHERS

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.json"
LOG_FILE = "metrics.jsonl"
DIVERGED_FILE = "diverged.json"
LOCK_FILE = "run.lock"
WANDB_FILE = "wandb.json"  # the id of the run at Weights & Biases
CAMERA_PATH = "camera_path_{}.json"
ROOT_FILES = (CONFIG_FILE, MODEL_FILE, CAMERAS_FILE, METRICS_FILE, LOG_FILE, DIVERGED_FILE, LOCK_FILE, WANDB_FILE)

TEACHERS_FOLDER = "teachers"
TENSORBOARD_FOLDER = "tensorboard"
EVENTS = "events.out.tfevents."  # the beginning of the names that TensorBoard gives its files
EXPORT_FOLDER = "export"
# The files of each --format of `nexwarp export`.
EXPORTS = {
    "ply": ("surfels.ply", "splats.ply"),
    "mesh": ("mesh.ply",),
    "compact": ("compact.safetensors",),
    "cameras": ("transforms.json", "camera_path.json"),
    "web": ("scene.html",),
    "glb": ("scene.glb",),
    "spz": ("splats.spz",),
}

RENDERS_FOLDER = "renders"
TRAIN = "train"
TEST = "test"
COMPARE = "compare"
FILE_PATH = "path_{}"  # folder of the frames of a path from a file
PROJECTIONS = ("panorama", "fisheye", "orthographic")  # folders of the pictures of other cameras than pinholes

FOLDERS = (*CHECKPOINTS, TENSORBOARD_FOLDER, EXPORT_FOLDER, TEACHERS_FOLDER, RENDERS_FOLDER)
PATTERN = re.compile(
    "|".join(
        [
            *map(re.escape, ROOT_FILES),
            re.escape(CAMERA_PATH).replace(r"\{\}", r"[1-9]\d*"),
            *(re.escape(f"{EXPORT_FOLDER}/{name}") for names in EXPORTS.values() for name in names),
            rf"{RENDERS_FOLDER}/(?:(?:{'|'.join(PROJECTIONS)})/)?"
            rf"(?:{'|'.join(PATHS)}|{FILE_PATH.format('[^/]+')})/\d{{4,}}\.(?:png|exr)",
        ]
    )
)


def picture_name(view: str) -> str:
    """Return the file name of a view's rendering; a photo in a subfolder gives a name with the subfolder."""
    return f"{Path(view).with_suffix('')}.png"


def teacher_folder(run: Path, number: int) -> Path:
    """Return the folder of a teacher that a run trains for itself, a run too; teachers are counted from 1."""
    return run / TEACHERS_FOLDER / str(number)


def teacher_folders(run: Path) -> list[Path]:
    """Return the existing folders of a run's own teachers; its config tells how many it has."""
    try:
        count = int(read_json(run / CONFIG_FILE)["own_teachers"]["count"])
    except (*READ_ERRORS, KeyError, TypeError):  # it has none, or the config is damaged
        return []
    folders = [teacher_folder(run, number) for number in range(1, min(count, MOST_TEACHERS) + 1)]
    return [folder for folder in folders if folder.is_dir() and not (folder.is_symlink() or folder.parent.is_symlink())]


def list_files(run: Path) -> tuple[list[str], list[str]]:
    """Return the files below a run folder that have names of ours, and what else there is; links are not followed.

    Names are relative to the folder. A foreign folder counts as one entry, with a slash at its end.
    """
    own: list[str] = []
    foreign: list[str] = []
    teachers = teacher_folders(run)
    for folder in teachers:
        prefix = f"{folder.relative_to(run).as_posix()}/"
        for names, below in zip((own, foreign), list_files(folder), strict=True):
            names += [prefix + name for name in below]
    views = _view_pictures(run)
    for name, entry in _entries(run):
        if not entry.is_dir(follow_symlinks=False):
            (own if _is_ours(name, views) else foreign).append(name)
        elif not _may_hold_ours(name) and run / name not in teachers:
            foreign.append(f"{name}/")
    return own, foreign


def delete_files(run: Path, keep: Iterable[str] = ()) -> list[str]:
    """Delete the files of a run but those to keep, and the folders that this leaves empty; return what is not ours."""
    own, foreign = list_files(run)
    # The files of a run folder itself go last: until then they tell which pictures are ours.
    runs = [run, *teacher_folders(run)]
    own.sort(key=lambda name: (run / name).parent in runs)
    folders = {each / name for each in runs for name in FOLDERS}
    for name in own:
        if name not in keep:
            (run / name).unlink()
            folders |= {run / parent for parent in Path(name).parents[:-1]}
    remove_empty(sorted(folders, reverse=True))
    return foreign


def remove_leftovers(run: Path) -> None:
    """Remove the incomplete files that killed processes left; the caller holds the lock of the run folder.

    Nobody else writes the files that need the lock. Pictures, exports and camera paths need none: a temporary file of
    these stays while its process may be at work.
    """
    folders = {folder for folder in run.iterdir() if _is_aside(folder.name)}
    for name in list_files(run)[0]:
        path = Path(name)
        in_checkpoint = len(path.parts) > 1 and _is_aside(path.parts[0])
        if in_checkpoint or (is_temporary(path.name) and (_needs_lock(name) or is_abandoned(run / name))):
            (run / name).unlink(missing_ok=True)
            folders |= {run / parent for parent in path.parents[:-1]}
    remove_empty(sorted(folders, reverse=True))


def _entries(folder: Path, prefix: str = "") -> Iterator[tuple[str, os.DirEntry[str]]]:
    """Yield the entries of a folder and of those subfolders that may hold files of ours, with their names."""
    with os.scandir(folder) as scan:
        entries = sorted(scan, key=lambda entry: entry.name)
    for entry in entries:
        name = prefix + entry.name
        yield name, entry
        if entry.is_dir(follow_symlinks=False) and _may_hold_ours(name):
            yield from _entries(Path(entry.path), f"{name}/")


def _is_aside(folder: str) -> bool:
    """Whether a folder is a checkpoint that is being written."""
    return folder.startswith(".checkpoint.") and is_temporary(folder)


def _may_hold_ours(folder: str) -> bool:
    top, _, rest = folder.partition("/")
    return top == RENDERS_FOLDER or (not rest and (top in FOLDERS or _is_aside(top)))


def _is_ours(name: str, views: set[str]) -> bool:
    folder, _, base = name.rpartition("/")
    if folder in CHECKPOINTS or _is_aside(folder):
        return base in CHECKPOINT_FILES or is_temporary(base)
    if folder == TENSORBOARD_FOLDER:
        return base.startswith(EVENTS)
    return name in views or is_temporary(base) or PATTERN.fullmatch(name) is not None


def _needs_lock(name: str) -> bool:
    """Whether a temporary file is one of a file that only the holder of the lock writes."""
    folder, _, base = name.rpartition("/")
    return folder in CHECKPOINTS or (not folder and base.startswith(tuple(f".{Path(f).stem}." for f in ROOT_FILES)))


def _view_pictures(run: Path) -> set[str]:
    """Return the names that renderings of the run's views have, as far as the run tells its views."""
    views: set[str] = set()
    for file, keys in ((CAMERAS_FILE, (TRAIN, TEST)), (METRICS_FILE, ("views", ""))):
        try:
            content = read_json(run / file)
            views |= {str(name) for key in keys for name in content.get(key, ())}
        except READ_ERRORS:  # there is none yet, or it is damaged
            continue
    pictures = [Path(picture_name(view)) for view in views if Path(view).name]
    groups = (TRAIN, TEST, COMPARE, *(f"{kind}/{group}" for kind in PROJECTIONS for group in (TRAIN, TEST)))
    return {
        f"{RENDERS_FOLDER}/{group}/{picture.with_suffix(suffix).as_posix()}"
        for group in groups
        for picture in pictures
        for suffix in (".png", ".exr")
    }
