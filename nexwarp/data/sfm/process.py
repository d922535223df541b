"""From a video or a folder of photos to a scene. The work is done by a process of its own (`work`).

An abort in the libraries that decode and reconstruct ends that process alone; this one claims the scene's name, shows
the progress, and puts the finished scene in its place.
"""

import errno
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from signal import Signals
from subprocess import PIPE
from typing import Any
from zlib import crc32

from filelock import FileLock, Timeout

from nexwarp import errors
from nexwarp.data.sfm.frames import FrameChoice, check_frames, take_frames
from nexwarp.data.sfm.photos import SECOND, list_photos
from nexwarp.data.sfm.report import EstimatedCamera, Link, SfmOptions, SfmReport
from nexwarp.data.sfm.stages import PYCOLMAP, Observer, Stages
from nexwarp.errors import NexwarpError, SceneError, StorageError
from nexwarp.io.files import make_folders, one_line, remove_empty
from nexwarp.io.json_files import READ_ERRORS, Json, JsonObject, read_object, write_json
from nexwarp.machine import needed_memory

REPORT_FILE = "sfm.json"
PARTS = ("images", "sparse", REPORT_FILE)  # of a scene
FRAMES = 120  # parts of a video, of which each gives a photo
LOCK_FILE, REPLACED = "lock", "replaced"  # in the folder that claims a name
MAX_STEM = 40  # characters of the scene's name in that folder's name

CHILD = (sys.executable, "-c", "from nexwarp.data.sfm.process import work; work()")
LAST_LINES = 200  # of what a process writes to stderr, in which the reason of its end is searched
FULL = re.compile(r"No space left|disk is full|File too large|File size limit|disk I/O error", re.I)
REASON = re.compile(f"Check failed|what\\(\\):|{FULL.pattern}", re.I)
FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP)  # of a file system
KILLED = 9  # SIGKILL, also of the system when memory runs out
PROBE = 2**20  # bytes that are written after a failure of pycolmap, to see whether the disk is full
RAISED = ("SceneError", "FormatError", "SettingError", "OutOfMemoryError")


@dataclass(frozen=True)
class Order:
    """What the other process is to do."""

    source: str  # the video, or the folder of the photos
    photos: list[str]  # names of the photos; none for a video
    skipped: dict[str, str]  # name -> reason, of those in formats that cannot be read
    folder: str  # to work in; the scene is made in its subfolder scene/
    frames: int  # number of parts of a video
    options: JsonObject  # of `SfmOptions`
    identity: JsonObject  # of the source


def process(
    source: str | os.PathLike[str],
    scene: str | os.PathLike[str],
    frames: int = FRAMES,
    options: SfmOptions | None = None,
    *,
    overwrite: bool = False,
    observe: Observer = lambda stage, done, total: None,
) -> SfmReport:
    """Estimate the cameras and points of a video or of photos, and write a COLMAP scene for `load_scene`.

    Of a video, `take_frames` takes sharp frames that differ, which are then compared with their neighbours in time
    only, unless the options say otherwise. Of photos all that can be read are used, turned upright by EXIF; blurred and
    repeated ones are named.

    The scene holds images/ (undistorted, with the given names), sparse/0 (PINHOLE cameras) and sfm.json (the report,
    the options, and size and SHA-256 of each file). It is made in a folder beside `scene`, which no second call for the
    same scene gets, and renamed at the end. A failure or interruption leaves nothing, and so does the end of this
    process, but for a scene that was being replaced in that very moment: it stays in the folder beside.

    Args:
        source: a video file, or a folder of photos, searched with its subfolders; hidden files are ignored.
        scene: folder to write; must be empty or absent.
        frames: number of parts of a video that give a photo each.
        options: settings; None is the defaults.
        overwrite: replace images/, sparse/ and sfm.json of `scene` if nexwarp wrote all that is in them; other files of
            `scene` stay.
        observe: called repeatedly with the stage's name, the number of finished items and their total.

    Returns:
        The report.

    Raises:
        FileNotFoundError: no such `source`.
        FileExistsError: `scene` exists, may not be replaced, or is being made by another process.
        ValueError: an option out of range, fewer than 3 photos that can be read, a photo that cannot (`strict`), has a
            name that no scene can have, is a link out of the folder, or changed meanwhile, photos of one camera that
            differ in size,
            a video that is damaged or shows fewer than 3 sharp frames, or no model was found; then the message gives
            advice.
        StorageError: the disk is full.
        MemoryError: a photo needs more memory than there is.
    """
    source, options = Path(source), options or SfmOptions()
    scene = Path(scene).resolve() if Path(scene).is_symlink() else Path(scene)
    options.check()
    video = source.is_file()
    names, skipped = ([], {}) if video else list_photos(source)
    if options.strict and (name := next((name for name in skipped if skipped[name] != SECOND), None)):
        raise SceneError(f"{source / name}: {skipped[name]}")
    if video:
        check_frames(source, frames)
    _check_target(source, scene, overwrite)
    inputs = [source / name for name in names] or [source]
    before = {file: _identity(file) for file in inputs}
    with _claimed(scene) as folder:
        identity = source_identity(source)
        order = Order(str(source.absolute()), names, skipped, str(folder), frames, asdict(options), identity)
        try:
            report = _in_child(order, scene, observe)
        except Exception:
            _check_unchanged(before)
            raise
        _check_unchanged(before)
        _publish(folder / "scene", scene, folder / REPLACED if overwrite else None)
    return report


def source_identity(source: Path) -> dict[str, Json]:
    """Return name, size and time of a video, or of all photos of a folder, by which a scene tells its source."""
    photos = [source / name for name in list_photos(source)[0]] if source.is_dir() else []
    states = [file.stat() for file in photos or [source]]
    size, modified = sum(state.st_size for state in states), max(state.st_mtime for state in states)
    count: dict[str, Json] = {"photos": len(photos)} if photos else {}
    return {"name": source.absolute().name, **count, "bytes": size, "modified": modified}


def file_facts(file: Path) -> list[Json]:
    """Size and SHA-256 of a file, by which a later --overwrite knows it."""
    content = file.read_bytes()
    return [len(content), hashlib.sha256(content).hexdigest()]


# The source


def _identity(file: Path) -> tuple[int, ...] | None:
    """What changes when a file is changed or replaced; None if it is not there."""
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino


def _check_unchanged(before: dict[Path, tuple[int, ...] | None]) -> None:
    for file, identity in before.items():
        if _identity(file) != identity:
            raise SceneError(f"{file}: changed or vanished while the scene was made of it; nothing was written")


# The process that works


def _in_child(order: Order, scene: Path, observe: Observer) -> SfmReport:
    """Let a process of its own do the work; return its report, or raise its error."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    # A session of its own: Ctrl-C in a terminal reaches this process alone, which then ends the other one.
    with subprocess.Popen(
        CHILD, stdin=PIPE, stdout=PIPE, stderr=PIPE, env=environment, start_new_session=True
    ) as child:
        assert child.stdin is not None and child.stdout is not None and child.stderr is not None
        last: deque[bytes] = deque(maxlen=LAST_LINES)
        listener = threading.Thread(target=last.extend, args=(child.stderr,), daemon=True)
        listener.start()
        answer: Any = {}
        try:
            with suppress(BrokenPipeError):
                child.stdin.write(json.dumps(asdict(order)).encode() + b"\n")
                child.stdin.flush()
            for line in child.stdout:
                answer = json.loads(line)
                if "stage" in answer:
                    observe(*answer["stage"])
        except BaseException:
            child.kill()
            raise
        child.wait()
        listener.join()
    if "report" in answer:
        report = answer["report"]
        nested = {
            "cameras": [EstimatedCamera(**camera) for camera in report["cameras"]],
            "sizes": [tuple(size) for size in report["sizes"]],
            "separate": [Link(**link) for link in report["separate"]],
            "contradictions": [Link(**link) for link in report["contradictions"]],
            "frames": report["frames"] and FrameChoice(**report["frames"]),
        }
        return SfmReport(**(report | nested))
    if "error" in answer:
        kind, text, number = answer["error"], answer["text"], answer["number"]
    else:
        kind, number = "SceneError", None
        text = _end_of(order.source, child.returncode, b"".join(last).decode(errors="replace"))
    if PYCOLMAP in text:  # it seldom tells why
        number = errno.ENOSPC if FULL.search(text) else _write_fault(Path(order.folder))
    if number in FULL_ERRORS:
        raise StorageError.at(scene, OSError(number, os.strerror(number)))
    if number is not None:
        raise OSError(text)
    if kind in RAISED:
        raise getattr(errors, kind)(text)
    raise (ValueError if kind == "ValueError" else RuntimeError)(text)


def _write_fault(folder: Path) -> int | None:
    """Return the number of the error of writing a file of 1 MiB; None if that works."""
    try:
        (folder / "probe").write_bytes(bytes(PROBE))
    except OSError as error:
        return error.errno
    return None


def _end_of(source: str, code: int, words: str) -> str:
    """Describe the end of a process that gave no answer, by its exit code and what it wrote to stderr."""
    lines = [line for line in words.splitlines() if line.strip()]
    reason = next((line for line in lines if REASON.search(line)), lines[-1] if lines else "no reason given")
    end = f"signal {Signals(-code).name}" if code < 0 else f"exit code {code}"
    hint = "; it may have had too little memory" if code == -KILLED else ""
    return f"{source}: {PYCOLMAP}: its process ended with {end} ({one_line(reason)}){hint}"


def work() -> None:
    """Do what stdin orders, once."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    order = Order(**json.loads(sys.stdin.readline()))
    watch = threading.Thread(target=_end_with_parent, args=(Path(order.folder),), daemon=True)
    watch.start()

    def answer(content: dict[str, object]) -> None:
        try:
            print(json.dumps(content), file=answers, flush=True)
        except BrokenPipeError:  # the other process has ended: this one would end, too, before all is deleted
            watch.join()

    try:
        answer({"report": _make(order, lambda *progress: answer({"stage": progress}))})
    except Exception as error:
        kind, text = type(error).__name__, str(error)
        if needed_memory(error) is not None:
            kind = "OutOfMemoryError"
        elif isinstance(error, RuntimeError):  # pycolmap's
            kind, text = "ValueError", f"{order.source}: {PYCOLMAP}: {one_line(error)}"
        elif not isinstance(error, (ValueError, OSError)):
            text = f"{kind}: {text}"
        elif isinstance(error, ValueError) and not isinstance(error, NexwarpError):
            kind = "ValueError"
        number = error.errno if isinstance(error, OSError) else None
        answer({"error": kind, "text": text or kind, "number": number})
    os._exit(0)


def _end_with_parent(folder: Path) -> None:
    """Wait for the end of stdin, which is that of the other process; then delete the folder and end."""
    sys.stdin.read()
    for _ in range(3):  # other threads may still write
        shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        (folder.parent / LOCK_FILE).unlink()
        folder.parent.rmdir()
    os._exit(1)


def _make(order: Order, observe: Observer) -> dict[str, object]:
    """Make folder/scene of the photos, or of frames of the video, and return the report."""
    source, folder = Path(order.source), Path(order.folder)
    options = SfmOptions(**order.options)  # type: ignore[arg-type]  # checked before
    names, choice = order.photos, None
    if not order.photos:
        photos = folder / "frames"
        photos.mkdir()
        choice = take_frames(source, order.frames, photos, observe)
        source, names = photos, sorted(file.name for file in photos.iterdir())
        if options.matching == "auto":
            options = replace(options, matching="sequential")
    report = Stages(source, folder, options, observe).run(names)
    report = replace(report, frames=choice, skipped=order.skipped | report.skipped)
    if choice is not None:  # it names those that were left out
        report = replace(report, blurred=[], repeated=[])
    scene = folder / "scene"
    content = asdict(report)
    files = {file.relative_to(scene).as_posix(): file_facts(file) for file in scene.rglob("*") if file.is_file()}
    extra = {"options": asdict(options), "folder" if order.photos else "video": order.identity, "files": files}
    write_json(scene / REPORT_FILE, content | extra)
    return content


# The scene


def _check_target(source: Path, scene: Path, overwrite: bool) -> None:
    """Raise FileExistsError or ValueError if `scene` may not be written, before any work."""
    here, target = source.resolve(), scene.resolve()
    if here.is_relative_to(target) or target.is_relative_to(here):
        raise ValueError(f"{scene}: expected a scene folder apart from the photos in {source}")
    if not os.path.lexists(scene) or (scene.is_dir() and not any(scene.iterdir())):
        return
    if not overwrite:
        raise FileExistsError(f"{scene}: expected a new folder, but it exists; give --overwrite or another one")
    _check_ours(scene, scene)


def _check_ours(folder: Path, scene: Path) -> None:
    """Raise FileExistsError unless a folder has a scene's parts, and in them only files as nexwarp wrote them."""
    report = folder / REPORT_FILE
    if report.is_symlink() or not report.is_file():
        raise FileExistsError(
            f"{scene}: expected a scene of nexwarp to overwrite, but it holds no {REPORT_FILE}; not touching it"
        )
    try:
        listed = read_object(report).get("files")
    except READ_ERRORS:
        listed = None
    if not isinstance(listed, dict):
        raise FileExistsError(
            f"{scene}: expected a scene of nexwarp to overwrite, but its {REPORT_FILE} does not list the files; "
            "delete the scene yourself, or give another one"
        )
    for part in PARTS[:2]:
        for where, folders, files in os.walk(folder / part):
            for path in (Path(where), *(Path(where, name) for name in (*folders, *files))):
                name = path.relative_to(folder).as_posix()
                ours = path.is_dir() or (path.is_file() and listed.get(name) == file_facts(path))
                if path.is_symlink() or not ours:
                    raise FileExistsError(
                        f"{scene / name}: expected only files as nexwarp wrote them to overwrite, but this one is not; "
                        "move it away, or give another scene"
                    )


@contextmanager
def _claimed(scene: Path) -> Iterator[Path]:
    """Yield a new folder beside `scene`, while no other process can have one for the same scene."""
    claim = scene.absolute().with_name(f".{scene.name[:MAX_STEM]}-{crc32(os.fsencode(scene.name)):08x}.making")
    if claim.is_symlink() or (claim.exists() and not (claim / LOCK_FILE).is_file()):
        raise FileExistsError(f"{claim}: expected no such folder, where {scene} is to be made")
    lock = FileLock(claim / LOCK_FILE, timeout=0, fallback_to_soft=False)
    created: list[Path] = []
    try:
        created = make_folders(claim)
        lock.acquire()
    except Timeout:
        raise FileExistsError(f"{scene}: another process is making this scene; wait until it ends") from None
    except OSError as error:
        if claim not in created or error.errno not in WITHOUT_LOCKS:
            with suppress(OSError):
                (claim / LOCK_FILE).unlink()
            remove_empty(created)
            raise StorageError.at(scene, error) from error
    try:
        for left in claim.iterdir():  # by a process that was killed
            if left.is_dir() and (left / REPLACED).is_dir():
                raise FileExistsError(
                    f"{left / REPLACED}: holds {scene} as it was before a --overwrite that was killed; "
                    f"move its files back, or delete {claim}"
                )
            if left.is_dir():
                shutil.rmtree(left)
        yield Path(tempfile.mkdtemp(dir=claim))
    finally:
        for left in claim.iterdir():
            if left.is_dir() and not (left / REPLACED).is_dir():
                shutil.rmtree(left, ignore_errors=True)
        with suppress(OSError):
            (claim / LOCK_FILE).unlink()
        lock.release()
        remove_empty([claim, *created])


def _publish(made: Path, scene: Path, aside: Path | None) -> None:
    """Rename `made` to `scene`; with `aside`, replace its parts, which are moved there, checked, and deleted.

    FileExistsError: there is a `scene` now that may not be replaced; it stays as it is.
    """
    if aside is None or not scene.exists() or not any(scene.iterdir()):
        try:
            if os.name == "nt" and scene.exists():  # elsewhere an empty folder can be replaced
                scene.rmdir()
            made.rename(scene)
        except OSError as error:
            if not os.path.lexists(scene):
                raise StorageError.at(scene, error) from error
            raise FileExistsError(f"{scene}: appeared while the scene was made; not touching it") from None
        return
    aside.mkdir()
    moved: list[tuple[Path, Path]] = []  # from, to
    try:
        for part in PARTS:
            if os.path.lexists(scene / part):
                _move(scene / part, aside / part, moved)
        _check_ours(aside, scene)
        for part in PARTS:
            if os.path.lexists(scene / part):
                raise FileExistsError(f"{scene / part}: appeared while the scene was made; not touching it")
            _move(made / part, scene / part, moved)
    except BaseException:
        try:
            for origin, place in reversed(moved):
                place.rename(origin)
            aside.rmdir()
        except OSError as error:
            raise OSError(f"{scene}: cannot be put back ({error}); its files are in {aside}") from error
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _move(origin: Path, place: Path, moved: list[tuple[Path, Path]]) -> None:
    origin.rename(place)
    moved.append((origin, place))
