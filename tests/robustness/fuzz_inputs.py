"""Damaged files: of binary ones the bytes and the numbers in them, of texts the words, of JSON the values."""

import json
import random
import struct
from typing import Any

Files = dict[str, bytes]

INTEGERS = (0, 1, 2, 3, 7, 255, 256, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**64 - 1)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e-30, 1e-8, 1e8, 1e30, 3.5e38, 1e300, float("inf"), -float("inf"),
          float("nan"))  # fmt: skip
WORDS = (b"", b"0", b"-1", b"nan", b"inf", b"-inf", b"1e999", b"1e308", b"99999999999999999999", b"4294967295", b"#",
         b"1e-320", b"\xff\xfe", b"\x00", b"../x", b"/etc/passwd", b"PINHOLE", b"x" * 300, b"0x10", b"1_0",
         b"9" * 5000)  # fmt: skip
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**40, 10**400, 0.5, -0.0, 1e-300, 1e300,
                           float("nan"), float("inf"), "", "x", "../x", "/etc/passwd", "a\0b", "\ud800", "y" * 300,
                           "./a/../b", "images", ".", "OPENCV", "EQUIRECTANGULAR", [], {}, [[]], [1, 2, 3], {"a": 1},
                           [[0.0] * 4] * 4, [[1e300] * 4] * 4, ["a"] * 16, [None] * 16, [10**400] * 16)  # fmt: skip
MAX_GROWTH = 200_000  # bytes


def damage(rng: random.Random, files: Files, fuzzed: tuple[str, ...]) -> Files:
    """Return the files with one of them, or two, damaged; `fuzzed` are the ends of names of those that may be."""
    files = dict(files)
    names = [name for name in sorted(files) if name.endswith(fuzzed)]
    for name in rng.sample(names, min(len(names), 1 + (rng.random() < 0.2))):
        data = files[name]
        if rng.random() < 0.02:
            del files[name]
            continue
        if name.endswith(".safetensors") and rng.random() < 0.8:
            data = _safetensors(rng, data)
        elif name.endswith(".json") and rng.random() < 0.8:
            data = _json(rng, data)
        elif _is_text(name, data) and rng.random() < 0.8:
            for _ in range(_few(rng)):
                data = _text(rng, data)
        else:
            for _ in range(_few(rng)):
                data = _binary(rng, data)
        files[name] = data
    return files


def _few(rng: random.Random) -> int:
    return rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3, 8))


def _is_text(name: str, data: bytes) -> bool:
    return name.endswith(".txt") or data.startswith((b"ply\nformat ascii", b"P3"))


def _binary(rng: random.Random, data: bytes) -> bytes:
    size = len(data)
    if not size:
        return rng.randbytes(rng.randrange(64))
    # Headers decide most, so half of the places lie in the first bytes.
    at = rng.randrange(min(size, 128)) if rng.random() < 0.5 else rng.randrange(size)
    kind = rng.randrange(9)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    if kind == 2:
        return data[:at] + rng.randbytes(rng.choice((1, 2, 4, 8, 100))) + data[at:]
    if kind == 3:
        return data[:at] + data[at + rng.choice((1, 2, 4, 8, 24, 64)) :]
    if kind == 4:
        start = rng.randrange(size)
        piece = data[start : start + rng.choice((4, 8, 24, 64, 500))]
        return data[:at] + piece + data[at + (len(piece) if rng.random() < 0.5 else 0) :]
    if kind == 5:
        value = struct.pack("<d" if rng.random() < 0.7 else rng.choice(("<f", ">d", ">f")), _narrow(rng.choice(FLOATS)))
        return data[:at] + value + data[at + len(value) :]
    if kind == 6 and size < MAX_GROWTH:
        return data + data * rng.choice((1, 2, 8))
    if kind == 7:
        return data[:at] + bytes(len(data) - at) if rng.random() < 0.5 else data[:at] + b"\xff" * (size - at)
    width = rng.choice((1, 2, 4, 8))
    value = (rng.choice(INTEGERS) + rng.choice((-1, 0, 0, 1))) % 2 ** (8 * width)
    return data[:at] + value.to_bytes(width, rng.choice(("little", "little", "big"))) + data[at + width :]


def _narrow(value: float) -> float:
    return value if abs(value) <= 3e38 else float("inf") if value == value else value


def _text(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    kind = rng.randrange(8)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, rng.choice(lines))
    elif kind == 2:
        lines.insert(at, rng.choice((b"", b"#", b" ", b"\t", b"\r", b"\x00")))
    elif kind == 3:
        return data[: rng.randrange(len(data) + 1)]
    elif kind == 4:
        lines[at] = lines[at] * rng.choice((2, 50)) if len(data) < MAX_GROWTH else b""
    else:
        words = lines[at].split(b" ")
        place = rng.randrange(len(words))
        if kind == 5:
            words[place : place + 1] = [words[place]] * rng.choice((0, 2, 3))
        else:
            words[place] = rng.choice(WORDS)
        lines[at] = b" ".join(words)
    return b"\n".join(lines)


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        found += _places(item, (*path, key))
    return found


def _replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = _replaced(copy[path[0]], path[1:], new)
    return copy


def _json(rng: random.Random, data: bytes) -> bytes:
    try:
        value = json.loads(data)
    except ValueError:
        return data
    for _ in range(_few(rng)):
        places = _places(value)
        # Keys near the top are as likely as the many numbers below them.
        depth = rng.choice(sorted({len(path) for path in places}))
        path = rng.choice([path for path in places if len(path) == depth])
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        kind = rng.randrange(6)
        if kind == 0 and path and isinstance(parent, dict):
            parent = dict(parent)
            del parent[path[-1]]
            value = _replaced(value, path[:-1], parent)
        elif kind == 1 and path and isinstance(parent, list):
            value = _replaced(value, path[:-1], parent[: path[-1]] + parent[path[-1] :] * 2)
        elif kind == 2 and path and isinstance(parent, dict):
            value = _replaced(value, path[:-1], {**parent, rng.choice(list(parent)): parent[path[-1]]})
        else:
            value = _replaced(value, path, rng.choice((*VALUES, *FLOATS, *INTEGERS)))
    text = json.dumps(value, ensure_ascii=rng.random() < 0.5).encode("utf-8", "surrogatepass")
    kind = rng.randrange(40)
    if kind == 0:
        place = text.find(b":") + 1
        deep = rng.choice((50, 100, 5000, 100_000))
        text = text[:place] + b"[" * deep + b"]" * deep * rng.randrange(2) + text[place:]
    elif kind == 1:
        text = text.replace(b"{", b"{" + text[1 : text.find(b":") + 1] + b"null,", 1)
    elif kind == 2:
        text = text[: rng.randrange(len(text) + 1)]
    elif kind == 3:
        text = text.replace(b'"', b'\\"' * 20_000, 1)
    return text


def _safetensors(rng: random.Random, data: bytes) -> bytes:
    """The header's JSON damaged, or that in its metadata; its length is mostly that of the new one."""
    (length,) = struct.unpack_from("<Q", data)
    header = data[8 : 8 + length]
    try:
        content = json.loads(header)
        if rng.random() < 0.5:
            return data[: 8 + length] + _values(rng, content, data[8 + length :])
        if rng.random() < 0.6:
            meta = content["__metadata__"]["nexwarp"].encode()
            content["__metadata__"]["nexwarp"] = _json(rng, meta).decode("utf-8", "replace")
            header = json.dumps(content).encode()
        else:
            header = _json(rng, header)
    except (KeyError, TypeError, ValueError, AttributeError):
        header = _binary(rng, header)
    body = data[8 + length :] if rng.random() < 0.9 else _binary(rng, data[8 + length :])
    length = len(header) if rng.random() < 0.95 else rng.choice(INTEGERS) % 2**64
    return struct.pack("<Q", length) + header + body


def _values(rng: random.Random, header: dict[str, Any], body: bytes) -> bytes:
    """The content of a safetensors file with numbers of some tensors replaced by extreme ones."""
    kinds = {"F16": ("<e", 65504.0), "F32": ("<f", 3e38), "F64": ("<d", 1e308)}
    for _ in range(_few(rng)):
        name = rng.choice(sorted(header.keys() - {"__metadata__"}))
        first, end = header[name]["data_offsets"]
        code, largest = kinds.get(header[name]["dtype"], ("<b", 127))
        size = struct.calcsize(code)
        if end - first < size:
            continue
        value: float = rng.choice((*FLOATS, 3e38, -3e38, 1e-44, largest, -largest))
        if code == "<b":
            value = rng.randrange(-128, 128)
        elif abs(value) > largest and value == value:
            value = float("inf") if value > 0 else -float("inf")
        count = (end - first) // size
        for place in range(count) if rng.random() < 0.1 else [rng.randrange(count)]:
            at = first + place * size
            body = body[:at] + struct.pack(code, value) + body[at + size :]
    return body
