"""Settings by name, as a person types them."""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import get_args, get_origin, get_type_hints

from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json
from nexwarp.train.config import LARGEST_NUMBER, Config
from nexwarp.train.presets import REMOVED


def with_settings(config: Config, settings: Mapping[str, object]) -> Config:
    """Return a config with some settings replaced.

    Args:
        config: what to start from.
        settings: name -> value; a dot leads into a part, as in "texture.residual". Lists stand for tuples.

    Raises:
        ValueError: there is no setting of that name, or its value is of another type or out of range.
    """
    changes: dict[str, dict[str, object]] = {}
    for name, value in settings.items():
        part, key = _find_setting(config, name)
        hints = get_type_hints(type(getattr(config, part) if part else config))
        changes.setdefault(part, {})[key] = _typed(name, value, hints[key])
    whole = changes.pop("", {})
    for part, values in changes.items():
        try:
            whole[part] = dataclasses.replace(getattr(config, part), **values)
        except ValueError as error:  # which names the setting without the part
            raise ValueError(f"{part}.{error}") from None
    return dataclasses.replace(config, **whole)  # type: ignore[arg-type]  # _typed has checked them


def setting(config: Config, name: str) -> object:
    """Return the value of a setting, named as `with_settings` names it; ValueError when there is none."""
    part, key = _find_setting(config, name)
    return getattr(getattr(config, part) if part else config, key)


def parse_settings(texts: Iterable[str]) -> dict[str, Json]:
    """Read settings as a person types them.

    Args:
        texts: KEY=VALUE each; VALUE is JSON, or else stands for itself as a string.

    Returns:
        What `with_settings` takes; names and types are checked there.

    Raises:
        ValueError: no KEY=VALUE, or a KEY twice.
    """
    settings: dict[str, Json] = {}
    for text in texts:
        name, equals, value = (x.strip() for x in text.partition("="))
        if not (name and equals and value):
            raise ValueError(f"expected KEY=VALUE, got {text!r:.60}")
        if name in settings:
            raise ValueError(f"{one_line(name, 60)}: expected it once, got it twice")
        try:
            settings[name] = json.loads(value)
        except (ValueError, RecursionError):
            settings[name] = value
    return settings


def _find_setting(config: Config, name: str) -> tuple[str, str]:
    """Part, or "", and key of a setting."""
    part, _, key = name.rpartition(".")
    parts = {f.name for f in dataclasses.fields(config) if dataclasses.is_dataclass(getattr(config, f.name))}
    known = [f.name for f in dataclasses.fields(config) if f.name not in parts]
    known += [f"{p}.{f.name}" for p in sorted(parts) for f in dataclasses.fields(getattr(config, p))]
    if name in known:
        return part, key
    if name in REMOVED:
        raise ValueError(f"{name}: expected a setting, got one that was removed; versions up to 0.2 have it")
    close = get_close_matches(name, known, n=4, cutoff=0.5) or [n for n in known if n.startswith(f"{part or name}.")]
    # Not the first one of all, the preset, which has a flag of its own.
    raise ValueError(f"{one_line(name, 60)}: expected a setting, such as {', '.join(close or known[1:5])}")


def _typed(name: str, value: object, annotation: object) -> object:
    """Return a value as its annotation has it: int where float is meant and list for tuple will do."""
    options = [annotation] if annotation in (int, float, bool, str) else _alternatives(annotation)
    for option in options:
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER
        if option is float and number and isinstance(value, (int, float)):
            return float(value)
        if option is int and number and isinstance(value, int):
            return value
        if option in (bool, str, type(None)) and type(value) is option:
            return value
        if get_origin(option) is tuple and isinstance(value, (list, tuple)) and len(value) == len(get_args(option)):
            return tuple(_typed(name, x, kind) for x, kind in zip(value, get_args(option), strict=True))
    expected = " or ".join(_described(option) for option in options)
    raise ValueError(f"{name}: expected {expected}, got {json.dumps(value, default=repr)[:60]}")


def _alternatives(annotation: object) -> tuple[object, ...]:
    """Members of a union; anything else alone."""
    return (annotation,) if get_origin(annotation) is tuple else get_args(annotation)


def _described(kind: object) -> str:
    if get_origin(kind) is tuple:
        return f"a list of {len(get_args(kind))} numbers"
    names: dict[object, str] = {
        int: "an integer",
        float: "a number",
        bool: "true or false",
        str: "text",
        type(None): "null",
    }
    return names[kind]
