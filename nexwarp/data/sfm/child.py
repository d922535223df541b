"""The process that makes a scene: it reads an order on stdin, and writes progress and the report to stdout as JSON."""

import dataclasses
import json
import os
import shutil
import sys
import threading
from contextlib import suppress
from pathlib import Path

from nexwarp.data.sfm.frames import take_frames
from nexwarp.data.sfm.options import SfmOptions
from nexwarp.data.sfm.process import LOCK_FILE, REPORT_FILE, Order, file_facts
from nexwarp.data.sfm.stages import PYCOLMAP, Observer, Stages
from nexwarp.errors import NexwarpError
from nexwarp.io.files import one_line
from nexwarp.io.json_files import write_json
from nexwarp.machine import needed_memory


def main() -> None:
    """Do what stdin orders, once."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    order = Order(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_parent, args=(Path(order.folder),), daemon=True).start()

    def answer(content: dict[str, object]) -> None:
        print(json.dumps(content), file=answers, flush=True)

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
    if order.video is not None:
        photos = folder / "frames"
        photos.mkdir()
        choice = take_frames(source, order.frames, photos, observe)
        source, names = photos, sorted(file.name for file in photos.iterdir())
        if options.matching == "auto":
            options = dataclasses.replace(options, matching="sequential")
    report = dataclasses.replace(Stages(source, folder, options, observe).run(names), frames=choice)
    if choice is not None:  # it names those that were left out
        report = dataclasses.replace(report, blurred=[], repeated=[])
    scene = folder / "scene"
    content = dataclasses.asdict(report)
    files = {file.relative_to(scene).as_posix(): file_facts(file) for file in scene.rglob("*") if file.is_file()}
    extra = {"options": dataclasses.asdict(options), "video": order.video, "files": files}
    write_json(scene / REPORT_FILE, content | extra)
    return content
