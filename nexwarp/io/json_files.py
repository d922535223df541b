"""JSON that others wrote: bounded in size and depth before it is parsed, and nothing but an error of one line."""

import json
import re
from pathlib import Path
from typing import Any, TypeAlias, Union

from nexwarp.io.files import one_line, write_atomically

# What reading a damaged file of ours may raise.
READ_ERRORS = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)

Json: TypeAlias = Union[bool, int, float, str, list["Json"], dict[str, "Json"], None]  # noqa: UP007  # recursive


def write_json(path: Path, data: object) -> None:
    """Write indented JSON atomically."""
    write_atomically(path, (json.dumps(data, indent=2) + "\n").encode())


MAX_BYTES = 32 * 2**20  # some 30,000 cameras; parsed it takes at most twenty times as much
MAX_DEPTH = 64

# The closing quote is optional, so that a text without one is looked at once, not from each of its quotes.
TOKENS = re.compile(rb'"(?:[^"\\]+|\\.)*"?|[\[\]{}]', re.DOTALL)


def read_json(path: Path, *, max_bytes: int = MAX_BYTES, finite: bool = False) -> Any:
    """Parse a JSON file; arguments and errors as of `parse_json`, with the file's name.

    Raises:
        FileNotFoundError: no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, expected JSON")
    size = path.stat().st_size
    if size > max_bytes:
        raise ValueError(f"{path}: expected at most {max_bytes:,} bytes of JSON, got {size:,}")
    return parse_json(str(path), path.read_bytes(), max_bytes=max_bytes, finite=finite)


def parse_json(where: str, content: bytes, *, max_bytes: int = MAX_BYTES, finite: bool = False) -> Any:
    """Parse JSON in UTF-8.

    Args:
        where: what the content is, for messages.
        content: bytes.
        max_bytes: refuse more than so many.
        finite: refuse NaN and Infinity, which are no JSON, but which Python writes.

    Raises:
        ValueError: too long, nested deeper than 64, or no JSON.
    """
    if len(content) > max_bytes:
        raise ValueError(f"{where}: expected at most {max_bytes:,} bytes of JSON, got {len(content):,}")
    depth = 0
    for token in TOKENS.finditer(content):
        first = content[token.start()]
        depth += (first in b"[{") - (first in b"]}")
        if depth > MAX_DEPTH:
            raise ValueError(f"{where}: expected JSON of at most {MAX_DEPTH} levels, got one nested too deeply")
    try:
        return json.loads(content.decode("utf-8"), parse_constant=_refuse if finite else None)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: expected JSON, could not parse it: {one_line(error)}") from None


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")
