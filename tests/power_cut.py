"""A recorder of what is asked of a file system, and a model of what a power cut may leave of it.

The model promises what POSIX does, and no more. The content of a file is on the disk after `fsync` of the file, and a
folder's entries are after `fsync` of the folder. Until then, each change may be there or not: of a file's content, the
new or the old one, a part, or zeros; of a folder's entries, any, in any order, but that an entry's changes keep
theirs. A rename within a folder happens as a whole or not at all.
"""

from __future__ import annotations

import builtins
import io
import os
import random
import stat
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

ROOT = 0  # node of the folder that is recorded
CALLS = ("open", "mkdir", "rename", "replace", "unlink", "remove", "rmdir")


@dataclass(frozen=True)
class Data:
    """A file got this content."""

    node: int
    content: bytes


@dataclass(frozen=True)
class Entries:
    """A folder got or lost entries, in one step."""

    node: int
    changes: dict[str, int | None]


@dataclass(frozen=True)
class Synced:
    """A file's content or a folder's entries are on the disk."""

    node: int


@dataclass(frozen=True)
class Mark:
    """The program noted something."""

    label: tuple[str, int]


Operation = Data | Entries | Synced | Mark


@dataclass
class Tree:
    """Files and folders: contents and entries by node."""

    files: dict[int, bytes] = field(default_factory=dict)
    folders: dict[int, dict[str, int]] = field(default_factory=lambda: {ROOT: {}})

    def write(self, target: Path, node: int = ROOT) -> None:
        """Make a folder of what can be reached."""
        target.mkdir()
        for name, inner in self.folders[node].items():
            if inner in self.folders:
                self.write(target / name, inner)
            else:
                (target / name).write_bytes(self.files.get(inner, b""))


class Recorder:
    """Compares a folder with what it was before each call to the file system.

    `start` is what was there in the beginning, all of it on the disk; `operations` is what has happened since, in
    order; `folders` are the nodes that are folders.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.operations: list[Operation] = []
        self.folders: set[int] = set()
        self._nodes: dict[int, int] = {}  # by inode, which a later file may get anew
        self._count = ROOT
        self._thread = threading.get_ident()
        self._nodes[root.stat().st_ino] = ROOT
        self.start = self._last = self._scan()

    def mark(self, what: str, number: int) -> None:
        """Note something at this point of the record."""
        self.look()
        self.operations.append(Mark((what, number)))

    def look(self) -> None:
        """Record what has changed."""
        now, before = self._scan(), self._last
        for node, entries in now.folders.items():
            old = before.folders.get(node, {})
            changes = {name: entries.get(name) for name in old | entries if old.get(name) != entries.get(name)}
            if changes:
                self.operations.append(Entries(node, changes))
        for node, content in now.files.items():
            if content != before.files.get(node, b""):
                self.operations.append(Data(node, content))
        self._last = now

    def synced(self, number: int) -> None:
        """Record that a file or folder is synced."""
        self.look()
        node = self._nodes.get(os.fstat(number).st_ino)
        if node is not None:  # else it is not below the folder
            self.operations.append(Synced(node))

    def _scan(self) -> Tree:
        tree, seen = Tree(), {self.root.stat().st_ino}
        self._scan_folder(self.root, ROOT, tree, seen)
        self._nodes = {inode: node for inode, node in self._nodes.items() if inode in seen}
        self.folders |= tree.folders.keys()
        return tree

    def _scan_folder(self, folder: Path, node: int, tree: Tree, seen: set[int]) -> None:
        entries = tree.folders[node] = {}
        for name in sorted(os.listdir(folder)):
            status = (folder / name).stat()
            seen.add(status.st_ino)
            if status.st_ino not in self._nodes:
                self._count += 1
                self._nodes[status.st_ino] = self._count
            inner = entries[name] = self._nodes[status.st_ino]
            if stat.S_ISDIR(status.st_mode):
                self._scan_folder(folder / name, inner, tree, seen)
            else:
                with _open(folder / name, "rb") as file:
                    tree.files[inner] = file.read()

    def recorded(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that looks before each of its calls in this thread."""

        def call(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != self._thread:
                return original(*args, **kwargs)
            self.look()
            return original(*args, **kwargs)

        return call


_open = io.open


@contextmanager
def recorded(root: Path) -> Iterator[Recorder]:
    """Record what the block asks of the file system below a folder; syncing takes no time."""
    recorder = Recorder(root)
    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, recorder.recorded(getattr(os, name)))
        opening = recorder.recorded(_open)
        patch.setattr(builtins, "open", opening)
        patch.setattr(io, "open", opening)
        patch.setattr(os, "fsync", recorder.synced)
        yield recorder
    recorder.look()


def after_power_cut(recorder: Recorder, moment: int, chance: random.Random) -> Tree:
    """Return one of the trees that a power cut after so many operations may leave."""
    operations = recorder.operations[:moment]
    latest, loss = moment, 0.3
    if chance.random() < 0.5:  # a disk that writes in order: what is there is all that was done up to a point
        last_sync = max((i for i, operation in enumerate(operations) if isinstance(operation, Synced)), default=0)
        latest, loss = chance.randint(last_sync, moment), 0.0
    contents = defaultdict(lambda: [b""], {node: [content] for node, content in recorder.start.files.items()})
    folders = {node: dict(recorder.start.folders.get(node, {})) for node in recorder.folders}
    waiting: dict[int, list[tuple[int, Entries]]] = defaultdict(list)
    for index, operation in enumerate(operations):
        if isinstance(operation, Data) and index < latest:
            contents[operation.node].append(operation.content)
        elif isinstance(operation, Entries):
            waiting[operation.node].append((index, operation))
        elif isinstance(operation, Synced):
            contents[operation.node] = contents[operation.node][-1:]
            for _, change in waiting.pop(operation.node, []):
                _apply(folders[operation.node], change)
    for node, changes in waiting.items():
        lost: set[str] = set()
        for index, change in changes:
            if index >= latest or chance.random() < loss or lost & change.changes.keys():
                lost |= change.changes.keys()
            else:
                _apply(folders[node], change)
    return Tree({node: _surviving(versions, chance) for node, versions in contents.items()}, folders)


def _apply(entries: dict[str, int], change: Entries) -> None:
    for name, node in change.changes.items():
        if node is None:
            entries.pop(name, None)
        else:
            entries[name] = node


def _surviving(versions: list[bytes], chance: random.Random) -> bytes:
    """Return a content that a file may have, of which the first version alone is on the disk for certain."""
    i = chance.randrange(len(versions))
    if i == len(versions) - 1 or chance.random() < 0.3:
        return versions[i]
    old, new = versions[i], versions[i + 1]
    place = chance.randint(0, len(new))
    return chance.choice(
        [new[:place], bytes(len(new)), new[:place] + bytes(len(new) - place), new[:place] + old[place:]]
    )
