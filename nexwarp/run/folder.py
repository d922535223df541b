"""Run folders: creating, locking, checking and reading them.

A run holds `config.json` (scene and settings), `model.safetensors`, `cameras.json`, `metrics.json`, `metrics.jsonl`,
`renders/` and `checkpoint/`; `nexwarp.run.contents` has the names, and docs/format.md describes the files.
"""

import dataclasses
import errno
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from platform import node
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.nerfstudio import save_camera_path
from nexwarp.data.scene import DEMO, SceneSource
from nexwarp.errors import FormatError, MissingError, RunError, SettingError, StorageError, check_version
from nexwarp.io.files import is_temporary, make_folders, one_line, remove_empty, sync, written_aside
from nexwarp.io.json_files import READ_ERRORS, Json, parse_json, read_json, write_json
from nexwarp.run.contents import (
    CAMERA_PATH,
    CONFIG_FILE,
    LOCK_FILE,
    METRICS_FILE,
    TEACHERS_FOLDER,
    delete_files,
    teacher_folder,
    teacher_folders,
)
from nexwarp.train.recipe import MIN_SURFELS, MOST_TEACHERS, Config
from nexwarp.train.settings import config_from_dict
from nexwarp.train.stages import NO_TEACHERS, OwnTeachers

RUN_VERSION = 1  # of config.json and metrics.json; a file without `format_version` has version 1
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
MAX_HOLDER = 1000  # bytes of the record of a lock's holder that are read


@dataclass(frozen=True)
class RunRecord:
    """What a run's config.json holds: all that the training depends on.

    Attributes:
        source: the scene.
        config: the settings.
        device: type of the device on which the run began.
        launch: of several ranks, names their start; "" for one process.
        teachers: folders or files of finished models that the run also learns from.
        own: teachers that the run trains first.
    """

    source: SceneSource
    config: Config
    device: str = "cpu"
    launch: str = ""
    teachers: tuple[Path, ...] = ()
    own: OwnTeachers = NO_TEACHERS

    def as_dict(self) -> dict[str, Json]:
        """Return the entries of config.json; paths are absolute."""
        data: dict[str, Json] = {"scene": dataclasses.asdict(self.source.absolute()), "device": self.device}
        data["config"] = self.config.as_dict()
        if self.launch:
            data["launch"] = self.launch
        if self.teachers:
            data["teachers"] = [str(path.resolve()) for path in self.teachers]
        if self.own.count:
            data["own_teachers"] = dataclasses.asdict(self.own)
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "RunRecord":
        """Read `as_dict`, of any version; one of `READ_ERRORS` says what is wrong with the entries."""
        check_version(data.get("format_version", 1), RUN_VERSION)
        source = SceneSource.from_dict(data["scene"])
        teachers = data.get("teachers", [])
        if not isinstance(teachers, list) or not all(isinstance(path, str) for path in teachers):
            raise ValueError(f"teachers: expected a list of paths, got {teachers!r}")
        config, own = config_from_dict(data["config"]), _own_teachers(data.get("own_teachers"))
        if own.count * own.iterations >= config.iterations:
            raise ValueError(f"own_teachers: expected fewer iterations than the run's {config.iterations}, got {own}")
        places = tuple(map(Path, teachers))
        return cls(source, config, str(data.get("device", "cpu")), str(data.get("launch", "")), places, own)


def _own_teachers(data: object) -> OwnTeachers:
    if data is None:
        return NO_TEACHERS
    if not isinstance(data, dict):
        raise ValueError(f"own_teachers: expected an object, got {data!r:.60}")
    count, iterations = data.get("count"), data.get("iterations")
    surfels = data.get("max_surfels")  # None for runs from before teachers had a budget of their own
    if (
        type(count) is not int
        or type(iterations) is not int
        or type(surfels) not in (int, type(None))
        or not 0 <= count <= MOST_TEACHERS
        or iterations < min(count, 1)
        or (surfels is not None and surfels < MIN_SURFELS)
    ):
        expected = f"a count of 0 to {MOST_TEACHERS}, iterations, and max_surfels of at least {MIN_SURFELS}"
        raise ValueError(f"own_teachers: expected {expected}, got {data!r:.60}")
    return OwnTeachers(count, iterations, surfels)


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


def began(run: Path, launch: str) -> bool:
    """Whether a folder holds a run that the ranks of this launch have created."""
    try:
        return read_run(run).launch == launch
    except (FormatError, MissingError):
        return False


def read_metrics(run: Path) -> dict[str, Json]:
    """Read a run's metrics; a run that has none yet gives an empty dict."""
    path = run / METRICS_FILE
    try:
        metrics = read_json(path) if path.is_file() else {}
        if not isinstance(metrics, dict):
            raise ValueError(f"expected an object, got {type(metrics).__name__}")
        check_version(metrics.get("format_version", 1), RUN_VERSION)
        for name in ("psnr", "ssim"):
            if not isinstance(metrics.get(name, 0.0), (int, float)):
                raise ValueError(f"{name}: expected a number, got {metrics[name]!r}")
        return metrics
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the metrics of a nexwarp run ({one_line(error)})") from None


def prepare_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> bool:
    """Check that a run folder may be created, resumed or overwritten; change nothing.

    Return whether the folder holds a run to resume. False with `resume` too, if a process was killed before it wrote
    the run's config: the training then starts from the beginning.
    """
    if resume and overwrite:
        raise SettingError("--resume, --overwrite: expected at most one of them, got both")
    if source.path != DEMO and Path(source.path).resolve().is_relative_to(run.resolve()):
        raise SettingError(f"--run: expected a folder that does not contain the scene, got {run}")
    parent = run.resolve().parent.parent
    if run.resolve() in teacher_folders(parent):
        raise RunError(f"--run: expected a run of its own, got {run}, a teacher of {parent}")
    if resume and is_run(run):
        return True
    # A process that is killed before it has written the config leaves a lock and temporary files.
    empty = run.is_dir() and all(file.name == LOCK_FILE or is_temporary(file.name) for file in run.iterdir())
    if resume and not empty:
        raise MissingError(f"{run}: expected a run to resume, found no {CONFIG_FILE} there")
    if run.exists() and not empty and not overwrite:
        raise RunError(
            f"{run}: expected a new run folder, but it exists; give --resume or --overwrite, or another --run"
        )
    if run.exists() and not empty:
        _check_replaceable(run)
    return False


def _check_replaceable(run: Path) -> None:
    """Raise RunError unless a folder holds the config of a run."""
    try:
        read_run(run)
    except MissingError:
        raise RunError(
            f"{run}: expected a run folder to overwrite, but it holds no {CONFIG_FILE}; nothing was deleted"
        ) from None
    except FormatError as error:
        raise RunError(
            f"{run}: expected a run folder to overwrite, but its {CONFIG_FILE} is damaged or not of a run, and nothing "
            f"was deleted; give another --run, or delete the folder yourself ({error})"
        ) from None


@contextmanager
def claimed_run(
    run: Path, source: SceneSource, *, resume: bool, overwrite: bool, warn: Callable[[str], None] = lambda _: None
) -> Iterator[bool]:
    """Check a run folder as `prepare_run` does, and lock it for a training; yield whether there is a run to resume."""
    prepare_run(run, source, resume=resume, overwrite=overwrite)  # before a lock is written to a foreign folder
    with locked_run(run, warn):
        yield prepare_run(run, source, resume=resume, overwrite=overwrite)  # another process may have changed it


@contextmanager
def locked_run(run: Path, warn: Callable[[str], None] = lambda _: None) -> Iterator[None]:
    """Hold the lock of a run folder during the block; RunError where another process or thread holds it.

    A missing folder is created, and removed if it is empty at the end. The lock's file, `run.lock`, tells the holder
    and is deleted at the end. A process that is killed leaves the file, but not the lock. Where the file system has no
    locks, `warn` is told, and the block runs without.
    """
    lock = FileLock(run / LOCK_FILE, timeout=0, fallback_to_soft=False, on_acquired=_write_holder)
    try:
        created = make_folders(run)
    except OSError as error:
        raise StorageError.at(run, error) from error
    try:
        _acquire(lock, run, warn)
        try:
            yield
        finally:
            if lock.is_locked:  # a forked child does not hold it
                with suppress(OSError):  # Windows does not delete open files
                    (run / LOCK_FILE).unlink()
                lock.release()
    finally:
        remove_empty(created)


def _acquire(lock: BaseFileLock, run: Path, warn: Callable[[str], None]) -> None:
    path = run / LOCK_FILE
    try:
        lock.acquire()
    except Timeout:
        raise RunError(
            f"{run}: expected a run folder that no other process writes to, but {_holder(path)} does; "
            "wait until it ends, or give another run folder"
        ) from None
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise StorageError.at(path, error) from error
        path.unlink(missing_ok=True)
        warn(f"{run}: its file system has no locks ({error.strerror}): do not start a second training in this folder")


def _write_holder(file: int) -> None:
    """Write who holds a lock into its open file."""
    since = datetime.now().astimezone().isoformat(" ", "seconds")
    os.ftruncate(file, 0)
    os.write(file, (json.dumps({"process": os.getpid(), "host": node(), "since": since}) + "\n").encode())


def _holder(path: Path) -> str:
    """Describe the holder of a lock: its process, host and time."""
    try:
        with path.open("rb") as file:
            record = parse_json(str(path), file.read(MAX_HOLDER))
        return one_line(f"process {record['process']} on {record['host']}, since {record['since']},")
    except READ_ERRORS:  # the holder has not written it yet
        return "another process"


def create_run(run: Path, record: RunRecord) -> list[str]:
    """Create a run folder that holds only its config; delete the files of an old run, and return the names of others.

    The new config is on the disk before anything is deleted, and replaces the old config last, when the disk has stored
    the deletions. An interruption at any point thus leaves a folder that is still a run.
    """
    with written_aside(run / CONFIG_FILE) as temporary:
        temporary.write_bytes((json.dumps(record.as_dict(), indent=2) + "\n").encode())
        sync(temporary)
        foreign = delete_files(run, keep=(CONFIG_FILE, LOCK_FILE, temporary.name))
        sync(run)
    return foreign


def update_run(run: Path, record: RunRecord) -> None:
    """Write what a resumed run changes into its config: places of scene and teachers, and the number of iterations.

    The scene's place goes into the configs of the run's own teachers, too. Other entries stay.
    """
    teachers = {folder: read_run(folder) for folder in teacher_folders(run) if is_run(folder)}
    moved = {folder: dataclasses.replace(old, source=record.source) for folder, old in teachers.items()}
    for folder, new in {run: record, **moved}.items():
        before = read_json(folder / CONFIG_FILE)
        names = ["scene", "teachers"]
        if new.config.iterations != read_run(folder).config.iterations:
            names.append("config")
        after = before | {name: value for name, value in new.as_dict().items() if name in names}
        if after != before:
            write_json(folder / CONFIG_FILE, after)


def check_teachers_place(run: Path, count: int) -> None:
    """Raise RunError where something that is not the run's is where it would put its own teachers; change nothing."""
    own = teacher_folders(run)
    for place in (run / TEACHERS_FOLDER, *(teacher_folder(run, number) for number in range(1, count + 1))):
        taken = place.is_symlink() or (place.exists() and not place.is_dir())
        if count and (taken or (place.exists() and place.parent != run and place not in own)):
            raise RunError(
                f"{place}: expected a teacher's folder or nothing, got what nexwarp did not write; move it, or give "
                "another --run"
            )


def keep_camera_path(folder: Path, cameras: Sequence[Camera], opened: Path | None = None) -> str:
    """Write a camera path into a folder under the next free name; return the command that renders it.

    `opened` is the run or model that the command names; None is the folder.
    """
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
