"""Run folders: creating, checking and reading them.

A run holds `config.json` (scene and settings), `model.safetensors`, `cameras.json`, `metrics.json`, `metrics.jsonl`,
`renders/` and `checkpoint/`; `nexwarp.run.contents` has the names, and docs/format.md describes the files.
"""

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from nexwarp.data.scene import DEMO as DEMO
from nexwarp.data.scene import SceneSource as SceneSource
from nexwarp.errors import FormatError, MissingError, RunError, SettingError, StorageError, check_version
from nexwarp.io.files import is_temporary, one_line, sync, write_atomically, written_aside
from nexwarp.io.json_files import READ_ERRORS, Json, read_json, write_json
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
from nexwarp.run.lock import locked_run
from nexwarp.train.recipe import MIN_SURFELS, MOST_TEACHERS, Config
from nexwarp.train.settings import config_from_dict
from nexwarp.train.stages import NO_TEACHERS, OwnTeachers

RUN_VERSION = 1  # of config.json and metrics.json; a file without `format_version` has version 1


@contextmanager
def claimed_run(
    run: Path, source: SceneSource, *, resume: bool, overwrite: bool, warn: Callable[[str], None] = lambda _: None
) -> Iterator[bool]:
    """Check and lock a run folder for a training; yields what `prepare_run` returns, whose errors it raises.

    Args:
        run: run folder.
        source: the scene.
        resume: whether to resume the run.
        overwrite: whether to overwrite the run.
        warn: see `locked_run`.
    """
    prepare_run(run, source, resume=resume, overwrite=overwrite)  # before a lock is written to a foreign folder
    with locked_run(run, warn):
        yield prepare_run(run, source, resume=resume, overwrite=overwrite)  # another process may have changed it


def prepare_run(run: Path, source: SceneSource, *, resume: bool, overwrite: bool) -> bool:
    """Check that a run folder may be created, resumed or overwritten; change nothing.

    Returns:
        Whether the folder holds a run to resume. False with `resume` too, if a process was killed before it wrote the
        run's config: the training then starts from the beginning.

    Raises:
        ValueError: the folder exists and neither flag is given; both flags are given; the folder to overwrite is not a
            run, or its config is damaged; or the folder contains the scene.
        FileNotFoundError: the folder to resume is not a run.
    """
    if resume and overwrite:
        raise SettingError("--resume, --overwrite: expected at most one of them, got both")
    if source.path != DEMO and Path(source.path).resolve().is_relative_to(run.resolve()):
        raise SettingError(f"--run: expected a folder that does not contain the scene, got {run}")
    if run.resolve() in teacher_folders(run.resolve().parent.parent):
        raise RunError(f"--run: expected a run of its own, got {run}, a teacher of {run.resolve().parent.parent}")
    if resume and is_run(run):
        return True
    # A process that is killed before it has written the config leaves a lock and temporary files.
    empty = run.is_dir() and all(file.name == LOCK_FILE or is_temporary(file.name) for file in run.iterdir())
    if resume and not empty:
        raise MissingError(f"{run}: expected a run to resume, found no {CONFIG_FILE} there")
    if run.exists() and not empty and not resume:
        if not overwrite:
            raise RunError(
                f"{run}: expected a new run folder, but it exists; give --resume or --overwrite, or another --run"
            )
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


def create_run(
    run: Path,
    source: SceneSource,
    config: Config,
    device: str,
    launch: str = "",
    teachers: Sequence[Path] = (),
    own: OwnTeachers = NO_TEACHERS,
) -> list[str]:
    """Create a run folder that holds only its config; delete the files of an old run (see `prepare_run`).

    The new config is on the disk before anything is deleted, and replaces the old config last, when the disk has stored
    the deletions. An interruption at any point thus leaves a folder that is still a run.

    Args:
        run: run folder.
        source: the scene.
        config: settings.
        device: type of the device.
        launch: of several ranks, as `began` recognises it.
        teachers: folders or files of the models that it also learns from.
        own: teachers that it trains first.

    Returns:
        Names of the files and folders that nexwarp did not write; they stay.
    """
    places = _places(source, teachers)
    data = {"scene": places.pop("scene"), "device": device, "config": config.as_dict()}
    data |= ({"launch": launch} if launch else {}) | places
    if own.count:
        data["own_teachers"] = dataclasses.asdict(own)
    with written_aside(run / CONFIG_FILE) as temporary:
        temporary.write_bytes((json.dumps(data, indent=2) + "\n").encode())
        sync(temporary)
        foreign = delete_files(run, keep=(CONFIG_FILE, LOCK_FILE, temporary.name))
        sync(run)
    return foreign


def _places(source: SceneSource, teachers: Sequence[Path]) -> dict[str, Json]:
    """Return the entries of a run's config that hold paths, which are absolute there."""
    scene = dataclasses.asdict(source.absolute())
    return {"scene": scene} | ({"teachers": [str(path.resolve()) for path in teachers]} if teachers else {})


def record_places(run: Path, source: SceneSource, teachers: Sequence[Path] = ()) -> None:
    """Write where a run's scene and teachers lie into its config and those of its own teachers, if they have moved.

    Args:
        run: a run that goes on.
        source: its scene.
        teachers: folders or files of the models that it also learns from.
    """
    for folder, others in ((run, teachers), *((each, ()) for each in teacher_folders(run) if is_run(each))):
        data = read_run(folder)[2]
        if (now := data | _places(source, others)) != data:
            write_json(folder / CONFIG_FILE, now)


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


def rewrite_config(run: Path, config: Config) -> None:
    """Replace the settings in a run's config; the file's other entries stay."""
    write_json(run / CONFIG_FILE, {**read_run(run)[2], "config": config.as_dict()})


def began(run: Path, launch: str) -> bool:
    """Whether a folder holds a run that the ranks of this launch have created."""
    try:
        return read_run(run)[2].get("launch") == launch
    except (FormatError, MissingError):
        return False


def check_room(run: Path, size: int) -> None:
    """Raise StorageError unless the disk of a run folder has room.

    Args:
        run: run folder; it need not exist.
        size: bytes that the run's files need in all.
    """
    folder = next(f for f in (run, *run.absolute().parents) if f.is_dir())
    try:
        free = shutil.disk_usage(folder).free
    except OSError:  # the file system does not report its free space
        return
    if free < size:
        raise StorageError(
            f"{run}: expected about {size / 2**20:,.0f} MiB of free disk space for a model and its checkpoints, "
            f"got {free / 2**20:,.0f} MiB; free some, give another --run, or lower --max-surfels"
        )


def read_run(run: Path) -> tuple[SceneSource, Config, dict[str, Json]]:
    """Read a run's config.

    Returns:
        The scene's source, the settings, and all entries of the file.

    Raises:
        FileNotFoundError: the folder is not a run.
        ValueError: the config is damaged.
    """
    path = run / CONFIG_FILE
    if not path.is_file():
        raise MissingError(f"{run}: expected a run folder, found no {CONFIG_FILE} there")
    try:
        data = read_json(path)
        check_version(data.get("format_version", 1), RUN_VERSION)
        source = SceneSource.from_dict(data["scene"])
        teachers = data.get("teachers", [])
        if not isinstance(teachers, list) or not all(isinstance(path, str) for path in teachers):
            raise ValueError(f"teachers: expected a list of paths, got {teachers!r}")
        own, config = _own_teachers(data), config_from_dict(data["config"])
        if own.count * own.iterations >= config.iterations:
            raise ValueError(f"own_teachers: expected fewer iterations than the run's {config.iterations}, got {own}")
        return source, config, data
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the settings of a nexwarp run ({one_line(error)})") from None


def read_teachers(run: Path) -> tuple[Path, ...]:
    """Return the folders or files of the models that a run also learns from; errors are those of `read_run`."""
    paths = read_run(run)[2].get("teachers", [])
    assert isinstance(paths, list)
    return tuple(Path(str(path)) for path in paths)


def read_own_teachers(run: Path) -> OwnTeachers:
    """Return the teachers that a run trains first; errors are those of `read_run`."""
    return _own_teachers(read_run(run)[2])


def _own_teachers(data: Mapping[str, Json]) -> OwnTeachers:
    own = data.get("own_teachers", dataclasses.asdict(NO_TEACHERS))
    if not isinstance(own, dict):
        raise ValueError(f"own_teachers: expected an object, got {own!r:.60}")
    # Teachers of a run from before they had a budget of their own have the run's.
    count, iterations, surfels = own.get("count"), own.get("iterations"), own.get("max_surfels")
    if (
        type(count) is not int
        or type(iterations) is not int
        or not (surfels is None or type(surfels) is int)
        or not 0 <= count <= MOST_TEACHERS
        or iterations < min(count, 1)
        or (surfels is not None and surfels < MIN_SURFELS)
    ):
        expected = f"a count of 0 to {MOST_TEACHERS}, iterations, and max_surfels of at least {MIN_SURFELS}"
        raise ValueError(f"own_teachers: expected {expected}, got {own!r:.60}")
    return OwnTeachers(count, iterations, surfels)


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
            if not isinstance(metrics.get(name, 0.0), (int, float)):
                raise ValueError(f"{name}: expected a number, got {metrics[name]!r}")
        return metrics
    except READ_ERRORS as error:
        raise FormatError(f"{path}: expected the metrics of a nexwarp run ({one_line(error)})") from None


def keep_camera_path(folder: Path, content: bytes, opened: Path | None = None) -> str:
    """Write a camera path (JSON) into a folder under the next free name; return the command that renders it.

    Args:
        folder: run folder, or the folder of a model's results; created if it does not exist.
        content: the path.
        opened: the run or model that the command renders; None is `folder`.
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
        write_atomically(path, content)
        return f"nexwarp render {opened or folder} --path {path}"
