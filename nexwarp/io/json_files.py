"""JSON files: written atomically; read with bounds on size and depth, and with errors of one line."""

import codecs
import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, Union

import numpy as np

from nexwarp.errors import FormatError
from nexwarp.io.files import one_line, write_atomically

# Exceptions that the use of a damaged file's content can raise.
READ_ERRORS = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)

Json: TypeAlias = Union[bool, int, float, str, list["Json"], dict[str, "Json"], None]  # noqa: UP007  # recursive
JsonObject: TypeAlias = dict[str, Json]

MAX_BYTES = 32 * 2**20  # enough for about 30,000 cameras; the parsed values take at most twenty times as much memory
MAX_DEPTH = 64
MAX_CONTAINERS = 500_000  # lists and objects; a camera has up to ten

# The closing quote is optional: an unterminated string is scanned once, not again from each quote inside it.
STRINGS = re.compile(rb'"(?:[^"\\]+|\\.)*"?', re.DOTALL)
STEPS = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")  # change of depth at a bracket, as int8
OTHERS = bytes(set(range(256)) - set(b"[{]}"))


def write_json(path: Path, data: object) -> None:
    """Write indented JSON atomically; ValueError for NaN and infinity, which JSON does not have."""
    write_atomically(path, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


def finite(value: Json) -> Json:
    """Return a value with null for NaN and infinity, which JSON does not have, such as the PSNR of equal pictures."""
    if isinstance(value, dict):
        return {name: finite(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(path: Path, *, finite: bool = False) -> Any:
    """Parse a JSON file in UTF-8 of at most `MAX_BYTES`; `finite` refuses NaN and Infinity, which JSON does not have.

    FileNotFoundError: no such file. ValueError: as of `parse_json`; the message names the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, expected JSON")
    with path.open("rb") as file:
        return parse_json(str(path), file.read(MAX_BYTES + 1), finite=finite)


def parse_json(where: str, content: bytes, *, finite: bool = False) -> Any:
    """Parse JSON in UTF-8; the caller has to check the type of what it uses. `where` names the content in messages.

    ValueError: the content is too long, has more than 500,000 lists and objects, is nested deeper than 64 levels, or is
    not JSON.
    """
    if len(content) > MAX_BYTES:
        raise ValueError(f"{where}: expected at most {MAX_BYTES:,} bytes of JSON, got more")
    content = content.removeprefix(codecs.BOM_UTF8)
    steps = np.frombuffer(STRINGS.sub(b"", content).translate(STEPS, OTHERS), np.int8)
    # Each list or object takes about a microsecond and several hundred bytes, whatever it is used for.
    if len(steps) > 2 * MAX_CONTAINERS:
        raise ValueError(f"{where}: expected at most {MAX_CONTAINERS:,} lists and objects, got {len(steps) // 2:,}")
    if steps.cumsum(dtype=np.int32).max(initial=0) > MAX_DEPTH:
        raise ValueError(f"{where}: expected JSON of at most {MAX_DEPTH} levels, got one nested too deeply")
    try:
        return json.loads(content.decode("utf-8"), parse_constant=_refuse if finite else None)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: expected JSON, could not parse it: {one_line(error)}") from None


def read_object(path: Path, *, finite: bool = False) -> JsonObject:
    """Parse a JSON file as `read_json` does; FormatError if it holds no object."""
    data: Json = read_json(path, finite=finite)
    if not isinstance(data, dict):
        raise FormatError(f"{path}: expected a JSON object, got {type(data).__name__}")
    return data


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")
