"""Run folders: the names of their files, creating, locking, checking, reading and opening them.

A run holds `config.json` (scene and settings), `model.safetensors`, `cameras.json`, `metrics.json`, `metrics.jsonl`,
perhaps `edit.json`, `renders/` and `checkpoint/`; docs/format.md describes the files.
"""

import dataclasses
import errno
import json
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from platform import node
from typing import Any

import numpy as np
import torch
from filelock import BaseFileLock, FileLock, Timeout

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.nerfstudio import save_camera_path
from nexwarp.cameras.paths import surrounding
from nexwarp.cameras.similarity import IDENTITY, Similarity
from nexwarp.data.scene import DEMO, SceneSource
from nexwarp.errors import FormatError, MissingError, RunError, SettingError, StorageError, check_version
from nexwarp.io.files import is_temporary, made_folders, one_line, remove_empty, sync, written_aside
from nexwarp.io.json_files import READ_ERRORS, Json, read_json, write_json
from nexwarp.model.edit import EDIT_FILE, Edit, frame_of, kept_surfels, read_edits, select
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE, SUFFIX, load
from nexwarp.train.checkpoint import CHECKPOINT_FILES, CHECKPOINTS
from nexwarp.train.recipe import MIN_SURFELS, MOST_TEACHERS, Config, config_from_dict
from nexwarp.train.stages import NO_TEACHERS, OwnTeachers

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.json"
LOG_FILE = "metrics.jsonl"
PHOTOS_FILE = "photos.csv"
DIVERGED_FILE = "diverged.json"  # of versions up to 0.2
LOCK_FILE = "run.lock"
WANDB_FILE = "wandb.json"  # of versions up to 0.2
CAMERA_PATH = "camera_path_{}.json"
RESULTS = (MODEL_FILE, CAMERAS_FILE, METRICS_FILE, PHOTOS_FILE, EDIT_FILE)
ROOT_FILES = (CONFIG_FILE, *RESULTS, LOG_FILE, DIVERGED_FILE, LOCK_FILE, WANDB_FILE)

TEACHERS_FOLDER = "teachers"
TENSORBOARD_FOLDER = "tensorboard"
EXPORT_FOLDER = "export"
ORIGIN_FILE = "origin.json"  # beside exports in the frame of a model whose origin is not the world's
# The files of each --format of `nexwarp export`.
EXPORTS = {
    "ply": ("surfels.ply", "splats.ply"),
    "mesh": ("mesh.ply",),
    "compact": ("compact.safetensors",),
    "cameras": ("transforms.json", "camera_path.json"),
    "web": ("scene.html",),
    "glb": ("scene.glb",),
    "usd": ("scene.usdz",),
    "spz": ("splats.spz",),
    "gltf-splats": ("splats.glb",),
}

RENDERS_FOLDER = "renders"
TRAIN = "train"
TEST = "test"
COMPARE = "compare"
FILE_PATH = "path_{}"  # folder of the frames of a path from a file

FOLDERS = (*CHECKPOINTS, TENSORBOARD_FOLDER, EXPORT_FOLDER, TEACHERS_FOLDER, RENDERS_FOLDER)
_ASIDE = r"\.checkpoint\.[^/]*\.tmp"  # a checkpoint that is being written


def _any(names: Iterable[str]) -> str:
    return f"(?:{'|'.join(map(re.escape, names))})"


# The files that nexwarp writes, for --overwrite: of a run, and of its teachers, which are runs too.
OURS = re.compile(
    rf"(?:{TEACHERS_FOLDER}/[1-{MOST_TEACHERS}]/)?(?:"
    + "|".join(
        [
            _any(ROOT_FILES),
            r"camera_path_[1-9]\d*\.json",
            rf"(?:{_any(CHECKPOINTS)}|{_ASIDE})/{_any(CHECKPOINT_FILES)}",
            rf"{TENSORBOARD_FOLDER}/events\.out\.tfevents\.[^/]*",
            rf"{EXPORT_FOLDER}/{_any([METRICS_FILE, ORIGIN_FILE, *chain(*EXPORTS.values())])}",
            rf"{RENDERS_FOLDER}/.*\.(?:png|exr)",
        ]
    )
    + ")"
)


RUN_VERSION = 1  # of config.json and metrics.json; a file without `format_version` has version 1
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
MAX_HOLDER = 300  # bytes of the record of a lock's holder that are read


@dataclass(frozen=True)
class RunRecord:
    """What a run's config.json holds: all that the training depends on."""

    source: SceneSource
    config: Config
    device: str = "cpu"  # type of the device on which the run began
    teachers: tuple[Path, ...] = ()  # folders or files of finished models that the run also learns from
    own: OwnTeachers = NO_TEACHERS  # teachers that the run trains first
    init: Path | None = None  # surfels, or a model, that the run starts from

    def as_dict(self) -> dict[str, Json]:
        """Return the entries of config.json; paths are absolute."""
        data: dict[str, Json] = {"scene": dataclasses.asdict(self.source.absolute()), "device": self.device}
        data["config"] = self.config.as_dict()
        options: dict[str, Json] = {
            "teachers": [str(path.resolve()) for path in self.teachers],
            "init": None if self.init is None else str(self.init.resolve()),
            "own_teachers": dataclasses.asdict(self.own) if self.own.count else None,
        }
        return data | {name: value for name, value in options.items() if value}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "RunRecord":
        """Read `as_dict`, of any version; one of `READ_ERRORS` says what is wrong with the entries."""
        check_version(data.get("format_version", 1), RUN_VERSION)
        source, init = SceneSource.from_dict(data["scene"]), data.get("init")
        if not isinstance(teachers := data.get("teachers", []), list):
            raise ValueError(f"teachers: expected a list of paths, got {teachers!r:.60}")
        config, own = config_from_dict(data["config"]), _own_teachers(data.get("own_teachers"))
        if own.count * own.iterations >= config.iterations:
            raise ValueError(f"own_teachers: expected fewer iterations than the run's {config.iterations}, got {own}")
        start = None if init is None else Path(init)
        return cls(source, config, str(data.get("device", "cpu")), tuple(map(Path, teachers)), own, start)


def _own_teachers(data: object) -> OwnTeachers:
    if data is None:
        return NO_TEACHERS
    values = data if isinstance(data, dict) else {}
    # Runs from before teachers had a budget of their own do not name one.
    own = OwnTeachers(values.get("count", 0), values.get("iterations", 0), values.get("max_surfels"))
    numbers = (own.count, own.iterations, MIN_SURFELS if own.max_surfels is None else own.max_surfels)
    least = (1, 1, MIN_SURFELS)
    if any(type(n) is not int or n < low for n, low in zip(numbers, least, strict=True)) or own.count > MOST_TEACHERS:
        expected = f"a count of 1 to {MOST_TEACHERS}, iterations, and max_surfels of at least {MIN_SURFELS}"
        raise ValueError(f"own_teachers: expected {expected}, got {data!r:.60}")
    return own


def read_run(run: Path) -> RunRecord:
    """Read a run's config; MissingError where there is none, FormatError where it is damaged."""
    path = run / CONFIG_FILE
    if not path.is_file():
        raise MissingError(f"{run}: expected a run folder, found no {CONFIG_FILE} there")
    try:
        return RunRecord.from_dict(read_json(path))
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the settings of a nexwarp run ({one_line(error)})") from None


def is_run(folder: Path) -> bool:
    """Whether a folder has the config of a run, which may be damaged."""
    return (folder / CONFIG_FILE).is_file()


def read_metrics(run: Path) -> dict[str, Json]:
    """Read a run's metrics; a run that has none yet gives an empty dict."""
    path = run / METRICS_FILE
    try:
        metrics = read_json(path) if path.is_file() else {}
        if not isinstance(metrics, dict):
            raise ValueError(f"expected an object, got {type(metrics).__name__}")
        check_version(metrics.get("format_version", 1), RUN_VERSION)
        for name in ("psnr", "ssim"):
            if metrics.get(name) is not None and not isinstance(metrics[name], (int, float)):
                raise ValueError(f"{name}: expected a number, got {metrics[name]!r}")
        return metrics
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the metrics of a nexwarp run ({one_line(error)})") from None


def prepare_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> bool:
    """Check that a run folder may be created, resumed or overwritten; return whether it holds a run to resume."""
    if resume and overwrite:
        raise SettingError("--resume, --overwrite: expected at most one of them, got both")
    if source.path != DEMO and Path(source.path).resolve().is_relative_to(run.resolve()):
        raise SettingError(f"--run: expected a folder that does not contain the scene, got {run}")
    owner = run.resolve().parent.parent
    if run.resolve().parent.name == TEACHERS_FOLDER and run.name.isdecimal() and is_run(owner):
        raise RunError(f"--run: expected a run of its own, got {run}, a teacher of {owner}")
    if resume and is_run(run):
        return True
    # A process that is killed before it has written the config leaves a lock and temporary files.
    empty = run.is_dir() and all(file.name == LOCK_FILE or is_temporary(file.name) for file in run.iterdir())
    if resume and not empty:
        raise MissingError(f"{run}: expected a run to resume, found no {CONFIG_FILE} there")
    if empty or not run.exists():
        return False
    if not overwrite:
        raise RunError(
            f"{run}: expected a new run folder, but it exists; give --resume or --overwrite, or another --run"
        )
    try:
        read_run(run)
    except (MissingError, FormatError) as error:
        raise RunError(
            f"{run}: expected a run folder to overwrite, and nothing was deleted; give another --run, or delete "
            f"the folder yourself ({error})"
        ) from None
    return False


@contextmanager
def claimed_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> Iterator[bool]:
    """Check a run folder as `prepare_run` does, and lock it for a training; yield whether there is a run to resume."""
    prepare_run(run, source, resume=resume, overwrite=overwrite)  # before a lock is written to a foreign folder
    with locked_run(run):
        yield prepare_run(run, source, resume=resume, overwrite=overwrite)  # another process may have changed it


@contextmanager
def locked_run(run: Path) -> Iterator[None]:
    """Hold the lock of a run folder during the block; RunError where another process or thread holds it.

    A missing folder is created, and removed if it is empty at the end. The lock's file, `run.lock`, tells the holder
    and is deleted at the end. A process that is killed leaves the file, but not the lock. Where the file system has no
    locks, a warning says so, and the block runs without.
    """
    lock = FileLock(run / LOCK_FILE, timeout=0, fallback_to_soft=False, on_acquired=_write_holder)
    with made_folders(run):
        _acquire(lock, run)
        try:
            yield
        finally:
            if lock.is_locked:  # a forked child does not hold it
                with suppress(OSError):  # Windows does not delete open files
                    (run / LOCK_FILE).unlink()
                lock.release()


def _acquire(lock: BaseFileLock, run: Path) -> None:
    path = run / LOCK_FILE
    try:
        lock.acquire()
    except Timeout:
        holder = one_line(path.read_bytes()[:MAX_HOLDER].decode(errors="replace")) or "another process"
        raise RunError(
            f"{run}: expected a run folder that no other process writes to, but {holder} does; "
            "wait until it ends, or give another run folder"
        ) from None
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise StorageError.at(path, error) from error
        path.unlink(missing_ok=True)
        text = f"its file system has no locks ({error.strerror}): do not start a second training in this folder"
        warnings.warn(f"{run}: {text}", stacklevel=2)


def _write_holder(file: int) -> None:
    """Write who holds a lock into its open file."""
    since = datetime.now().astimezone().isoformat(" ", "seconds")
    os.ftruncate(file, 0)
    os.write(file, f"process {os.getpid()} on {node()}, since {since},".encode())


def create_run(run: Path, record: RunRecord) -> list[str]:
    """Create a run folder that holds only its config; delete the files of an old run, and return the names of others.

    The new config is on the disk before anything is deleted, and replaces the old config last, when the disk has stored
    the deletions. An interruption at any point thus leaves a folder that is still a run.
    """
    with written_aside(run / CONFIG_FILE) as temporary:
        temporary.write_bytes((json.dumps(record.as_dict(), indent=2) + "\n").encode())
        sync(temporary)
        own, foreign = list_files(run)
        delete_files(run, [name for name in own if name not in (CONFIG_FILE, LOCK_FILE, temporary.name)])
        sync(run)
    return foreign


def update_run(run: Path, record: RunRecord) -> None:
    """Write what a resumed run changes into its config: places of scene and teachers, and the number of iterations."""
    before = read_json(run / CONFIG_FILE)
    changed = ["scene", "teachers"]
    if record.config.iterations != read_run(run).config.iterations:
        changed.append("config")
    after = before | {name: value for name, value in record.as_dict().items() if name in changed}
    if after != before:
        write_json(run / CONFIG_FILE, after)


def check_teachers_place(run: Path, count: int) -> None:
    """Raise RunError where something that is not the run's is where it would put its own teachers; change nothing."""
    folders = [teacher_folder(run, number) for number in range(1, count + 1)]
    for place in (*(folder.parent for folder in folders), *folders):
        if place.is_symlink() or place.is_file():
            raise RunError(
                f"{place}: expected a teacher's folder or nothing, got what nexwarp did not write; move it, or "
                "give another --run"
            )


def picture_name(view: str) -> str:
    """Return the file name of a view's rendering; a photo in a subfolder gives a name with the subfolder."""
    return f"{Path(view).with_suffix('')}.png"


def teacher_folder(run: Path, number: int) -> Path:
    """Return the folder of a teacher that a run trains for itself, a run too; teachers are counted from 1."""
    return run / TEACHERS_FOLDER / str(number)


def list_files(run: Path) -> tuple[list[str], list[str]]:
    """Return the files below a run folder that have names of ours, and the rest; folders of others end with a slash."""
    own: list[str] = []
    foreign: list[str] = []
    for place, folders, names in os.walk(run):
        inside = Path(place).relative_to(run)
        for name in list(folders):
            is_link = Path(place, name).is_symlink()
            may_hold_ours = inside.parts or name in FOLDERS or re.fullmatch(_ASIDE, name)
            if is_link or not may_hold_ours:
                foreign.append((inside / name).as_posix() + ("" if is_link else "/"))
                folders.remove(name)  # and is not walked through
        for name in names:
            file = (inside / name).as_posix()
            (own if is_temporary(name) or OURS.fullmatch(file) else foreign).append(file)
    return sorted(own), sorted(foreign)


def delete_files(run: Path, names: Iterable[str]) -> None:
    """Delete files of a run, and the folders that this leaves empty."""
    folders: set[Path] = set()
    for name in names:
        (run / name).unlink(missing_ok=True)
        folders |= {run / parent for parent in Path(name).parents[:-1]}
    remove_empty(sorted(folders, reverse=True))


def remove_leftovers(run: Path) -> None:
    """Remove the incomplete files that killed processes left; the caller holds the lock of the run folder."""
    leftovers = []
    for name in list_files(run)[0]:
        folder, _, base = name.rpartition("/")
        # Others are written without the lock: their processes may still be at work.
        locked = folder in CHECKPOINTS or (not folder and not base.startswith(".camera_path_"))
        if (is_temporary(base) and locked) or re.fullmatch(_ASIDE, folder):
            leftovers.append(name)
    delete_files(run, leftovers)
    remove_empty([folder for folder in run.iterdir() if re.fullmatch(_ASIDE, folder.name)])


def keep_camera_path(
    folder: Path,
    cameras: Sequence[Camera],
    opened: Path | None = None,
    origin: tuple[float, float, float] | None = None,
    frame: Similarity = IDENTITY,
) -> str:
    """Write cameras of a frame with `origin` into a folder; return the command that renders `opened` from there.

    The file has the coordinates of `frame`, an edited model's.
    """
    cameras = [frame.camera(dataclasses.replace(camera, origin=origin or camera.origin)) for camera in cameras]
    folder.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        path = folder / CAMERA_PATH.format(number)
        try:
            path.touch(exist_ok=False)  # another viewer may look for a name at the same time
        except FileExistsError:
            number += 1
            continue
        save_camera_path(path, cameras)
        return f"nexwarp render {opened or folder} --path {path}"


@dataclass(frozen=True)
class OpenedModel:
    """A run, or a model alone: its file, or a folder with `model.safetensors` and perhaps `cameras.json`."""

    path: Path  # as the user gave it
    folder: Path  # where results are written; never that of another model
    file: Path  # the model's; a run that has not finished has none yet
    source: SceneSource | None  # the run's scene
    config: Config | None  # the run's settings
    device: str = "cpu"  # type of the device on which the run began

    @property
    def title(self) -> str:
        """Name of the scene, or of the model's file or folder."""
        return self.folder.resolve().name if self.source is None else self.source.name

    @cached_property
    def trained(self) -> Model:
        """The model as it was trained, on the CPU."""
        return load(self.file)

    @cached_property
    def edits(self) -> list[Edit]:
        """The edits in effect, which `nexwarp edit` has written beside the model. FormatError: the file is damaged."""
        return read_edits(self.folder)

    @cached_property
    def kept(self) -> np.ndarray:
        """Which trained surfels (N,) bool the edits leave. RunError: the edits do not fit the model."""
        try:
            return kept_surfels(self.trained.surfels, self.edits)
        except ValueError as error:
            raise RunError(f"{self.folder / EDIT_FILE}: {error}") from None

    @cached_property
    def model(self) -> Model:
        """The part of the trained model that the edits leave, on the CPU, in the frame of the training."""
        return self.trained if self.kept.all() else select(self.trained, torch.from_numpy(self.kept))

    @property
    def frame(self) -> Similarity:
        """The motion from the frame of the training, which is that of `cameras`, to the edited coordinates."""
        return frame_of(self.edits)

    @cached_property
    def cameras(self) -> dict[str, dict[str, Camera]]:
        """Cameras by set and name; none without `cameras.json`, as of a model alone or an unfinished training."""
        file = self.folder / CAMERAS_FILE
        return load_cameras(file) if file.is_file() else {}

    @property
    def views(self) -> dict[str, Camera]:
        """The cameras of all sets by name."""
        return {name: camera for members in self.cameras.values() for name, camera in members.items()}

    @property
    def trained_cameras(self) -> list[Camera]:
        """The training cameras; RunError where there are none."""
        if not (cameras := self.cameras.get(TRAIN)):
            raise RunError(f"{self.folder / CAMERAS_FILE}: expected training cameras, found none")
        return [*cameras.values()]

    def path_cameras(self) -> dict[str, dict[str, Camera]]:
        """Return the cameras that a path is made of; without any, a ring around the surfels."""
        if self.views:
            return self.cameras
        ring = surrounding(self.model.surfels.means, near_depth(self.model))
        return {"train": {f"around_{index:02d}": camera for index, camera in enumerate(ring)}}


def near_depth(model: Model) -> float:
    """Return the near depth of a model's training cameras, world units; 0.01 if the model does not tell."""
    return near if isinstance(near := model.meta.get("near"), float) else 0.01


def open_model(path: Path) -> OpenedModel:
    """Open a run folder, a folder with a model, or a model's file; the model itself is read on first use."""
    folder = path
    file = path / MODEL_FILE
    if path.is_file() and path.suffix == SUFFIX:
        folder, file = (path.parent if path.name == MODEL_FILE else path.with_suffix("")), path
        if path.name != MODEL_FILE and (is_run(folder) or (folder / MODEL_FILE).is_file()):
            folder = path.with_name(f"{path.name}.results")  # another model's folder is left alone
    if is_run(folder) and file == folder / MODEL_FILE:
        record = read_run(folder)
        return OpenedModel(path, folder, file, record.source, record.config, record.device)
    if not file.is_file():
        raise MissingError(
            f"{path}: expected a run folder or a model, found no {CONFIG_FILE} and no {MODEL_FILE} there"
        )
    return OpenedModel(path, folder, file, None, None)
