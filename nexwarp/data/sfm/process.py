"""From a video or a folder of photos to a scene. The work is done by a process of its own (`work`).

An abort in the libraries that decode and reconstruct ends that process alone; this one shows the progress, and puts
the finished scene in its place. What the two send each other through pipes is pickled.
"""

import errno
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from signal import Signals
from subprocess import PIPE

from nexwarp.data.sfm.frames import FEWEST, take_frames
from nexwarp.data.sfm.photos import SECOND, list_photos
from nexwarp.data.sfm.report import PYCOLMAP, Observer, SfmOptions, SfmReport
from nexwarp.errors import OutOfMemoryError, SceneError, StorageError, require
from nexwarp.io.files import made_folders, one_line
from nexwarp.io.json_files import Json, write_json
from nexwarp.io.video import check_av
from nexwarp.machine import needed_memory

REPORT_FILE = "sfm.json"
FRAMES = 120  # parts of a video, of which each gives a photo
MAX_STEM = 40  # characters of the scene's name in that of the folder to work in

CHILD = (sys.executable, "-c", "from nexwarp.data.sfm.process import work; work()")
FULL = re.compile(r"No space left|disk is full|File too large|File size limit|disk I/O error", re.I)
REASON = re.compile(f"Check failed|what\\(\\):|{FULL.pattern}", re.I)
FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
KILLED = 9  # SIGKILL, also of the system when memory runs out
PROBE = 2**20  # bytes that are written after a failure of pycolmap, to see whether the disk is full


@dataclass(frozen=True)
class Order:
    """What the other process is to do."""

    source: Path  # the video, or the folder of the photos
    photos: list[str]  # names of the photos; none for a video
    skipped: dict[str, str]  # name -> reason, of those in formats that cannot be read
    folder: Path  # to work in; the scene is made in its subfolder scene/
    frames: int  # number of parts of a video
    options: SfmOptions
    identity: dict[str, Json]  # of the source


def process(
    source: str | os.PathLike[str],
    scene: str | os.PathLike[str],
    frames: int = FRAMES,
    options: SfmOptions | None = None,
    *,
    observe: Observer = lambda stage, done, total: None,
) -> SfmReport:
    """Estimate the cameras and points of a video or of photos, and write a COLMAP scene for `load_scene`.

    The scene holds images/ (undistorted, with the given names), sparse/0 (PINHOLE cameras) and sfm.json (the report
    and the options). It is made in a folder beside `scene`, and renamed at the end. A failure or interruption leaves
    nothing, and so does the end of this process.

    Args:
        source: a video file, or a folder of photos, searched with its subfolders; hidden files are ignored.
        scene: folder to write; must be empty or absent.
        frames: number of parts of a video that give a photo each.
        options: settings; None is the defaults.
        observe: called repeatedly with the stage's name, the number of finished items and their total.

    Raises:
        OSError: no such `source`; `scene` exists; the disk is full.
        ValueError: an option out of range, photos or a video that cannot be used, or no model was found; then the
            message gives advice.
        MemoryError: a photo needs more memory than there is.
    """
    source, scene, options = Path(source), Path(scene), options or SfmOptions()
    options.check()
    video = source.is_file()
    names, skipped = ([], {}) if video else list_photos(source)
    if options.strict and (name := next((name for name in skipped if skipped[name] != SECOND), None)):
        raise SceneError(f"{source / name}: {skipped[name]}")
    if video:
        require(frames >= FEWEST, f"--frames: expected at least {FEWEST}, got {frames}")
        check_av(source)
    _check_target(source, scene)
    with _folder_beside(scene) as folder:
        order = Order(source.absolute(), names, skipped, folder, frames, options, source_identity(source))
        report = _in_child(order, scene, observe)
        _publish(folder / "scene", scene)
    return report


def source_identity(source: Path) -> dict[str, Json]:
    """Return name, size and time of a video, or of all photos of a folder, by which a scene tells its source."""
    photos = [source / name for name in list_photos(source)[0]] if source.is_dir() else []
    states = [file.stat() for file in photos or [source]]
    size, modified = sum(state.st_size for state in states), max(state.st_mtime for state in states)
    count: dict[str, Json] = {"photos": len(photos)} if photos else {}
    return {"name": source.absolute().name, **count, "bytes": size, "modified": modified}


# The process that works


def _in_child(order: Order, scene: Path, observe: Observer) -> SfmReport:
    """Let a process of its own do the work; return its report, or raise its error."""
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    # A session of its own: Ctrl-C in a terminal reaches this process alone, which then ends the other one.
    with (
        tempfile.TemporaryFile() as words,
        subprocess.Popen(CHILD, stdin=PIPE, stdout=PIPE, stderr=words, env=variables, start_new_session=True) as child,
    ):
        assert child.stdin is not None and child.stdout is not None
        answer: object = None
        try:
            with suppress(BrokenPipeError):
                pickle.dump(order, child.stdin)
                child.stdin.flush()
            try:
                while not isinstance(answer, (SfmReport, Exception)):
                    answer = pickle.load(child.stdout)
                    if isinstance(answer, tuple):
                        observe(*answer)
            except EOFError:  # it has ended without an answer
                pass
            except pickle.UnpicklingError:  # it was killed while it wrote, or wrote something else
                child.kill()
        except BaseException:
            child.kill()
            raise
        finally:
            child.wait()  # a `with` block waits a quarter of a second only after Ctrl-C
        words.seek(0)
        text = words.read().decode(errors="replace")
    if isinstance(answer, SfmReport):
        return answer
    error = answer if isinstance(answer, Exception) else None
    if error is None:
        error = SceneError(_end_of(order.source, child.returncode, text))
    number = error.errno if isinstance(error, OSError) else None
    if PYCOLMAP in str(error):  # it seldom tells why
        number = errno.ENOSPC if FULL.search(str(error)) else _write_fault(order.folder)
    if number in FULL_ERRORS:
        raise StorageError.at(scene, OSError(number, os.strerror(number)))
    raise error


def _write_fault(folder: Path) -> int | None:
    """Return the number of the error of writing a file of 1 MiB; None if that works."""
    try:
        (folder / "probe").write_bytes(bytes(PROBE))
    except OSError as error:
        return error.errno
    return None


def _end_of(source: Path, code: int, words: str) -> str:
    """Describe the end of a process that gave no answer, by its exit code and what it wrote to stderr."""
    lines = [line for line in words.splitlines() if line.strip()]
    reason = next((line for line in lines if REASON.search(line)), lines[-1] if lines else "no reason given")
    end = f"signal {Signals(-code).name}" if code < 0 else f"exit code {code}"
    hint = "; it may have had too little memory" if code == -KILLED else ""
    return f"{source}: {PYCOLMAP}: its process ended with {end} ({one_line(reason)}){hint}"


def work() -> None:
    """Do what stdin orders, once."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    order: Order = pickle.load(sys.stdin.buffer)
    watch = threading.Thread(target=_end_with_parent, args=(order.folder,), daemon=True)
    watch.start()

    def answer(content: object) -> None:
        try:
            pickle.dump(content, answers)
            answers.flush()
        except BrokenPipeError:  # the other process has ended: this one would end, too, before all is deleted
            watch.join()

    try:
        answer(_make(order, lambda *progress: answer(progress)))
    except Exception as error:
        if needed_memory(error) is not None:
            answer(OutOfMemoryError(str(error) or type(error).__name__))
        elif isinstance(error, RuntimeError):  # pycolmap's
            answer(ValueError(f"{order.source}: {PYCOLMAP}: {one_line(error)}"))
        elif isinstance(error, (ValueError, OSError)):
            answer(error)
        else:
            answer(RuntimeError(f"{type(error).__name__}: {error}"))
    os._exit(0)


def _end_with_parent(folder: Path) -> None:
    """Wait for the end of stdin, which is that of the other process; then delete the folder and end."""
    sys.stdin.buffer.read()
    for _ in range(3):  # other threads may still write
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _make(order: Order, observe: Observer) -> SfmReport:
    """Make folder/scene of the photos, or of frames of the video, and return the report."""
    from nexwarp.data.sfm.stages import Stages  # which imports pycolmap

    source, names, options, choice = order.source, order.photos, order.options, None
    if not order.photos:
        photos = order.folder / "frames"
        photos.mkdir()
        choice = take_frames(source, order.frames, photos, observe)
        source, names = photos, sorted(file.name for file in photos.iterdir())
        if options.matching == "auto":
            options = replace(options, matching="sequential")
    report = Stages(source, order.folder, options, observe).run(names)
    report = replace(report, frames=choice, skipped=order.skipped | report.skipped)
    extra = {"options": asdict(options), "folder" if order.photos else "video": order.identity}
    write_json(order.folder / "scene" / REPORT_FILE, asdict(report) | extra)
    return report


# The scene


def _check_target(source: Path, scene: Path) -> None:
    """Raise FileExistsError or ValueError if `scene` may not be written, before any work."""
    here, target = source.resolve(), scene.resolve()
    if here.is_relative_to(target) or target.is_relative_to(here):
        raise ValueError(f"{scene}: expected a scene folder apart from the photos in {source}")
    if scene.is_symlink() or (scene.exists() and not (scene.is_dir() and not any(scene.iterdir()))):
        raise FileExistsError(f"{scene}: expected a new folder, but it exists; delete it, or give another one")


@contextmanager
def _folder_beside(scene: Path) -> Iterator[Path]:
    """Yield a new folder beside `scene`; at the end it is deleted, and so are new folders above it that are empty."""
    parent = scene.absolute().parent
    with made_folders(parent):
        try:
            folder = Path(tempfile.mkdtemp(prefix=f".{scene.name[:MAX_STEM]}.", suffix=".making", dir=parent))
        except OSError as error:
            raise StorageError.at(scene, error) from error
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _publish(made: Path, scene: Path) -> None:
    """Rename `made` to `scene`; FileExistsError: there is a `scene` now, which stays as it is."""
    try:
        if os.name == "nt" and scene.exists():  # elsewhere an empty folder can be replaced
            scene.rmdir()
        made.rename(scene)
    except OSError as error:
        if not os.path.lexists(scene):
            raise StorageError.at(scene, error) from error
        raise FileExistsError(f"{scene}: appeared while the scene was made; not touching it") from None
