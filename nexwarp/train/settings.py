"""Settings by name: as a person types them, and as a run's config.json holds them."""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json
from nexwarp.train.recipe import DEFAULT, PRESETS, Config

LARGEST_NUMBER = 2**53  # all integers up to there are floats too
PARTS = [field.name for field in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(DEFAULT, field.name))]
# What runs did before a setting existed, where the default does something else.
BEFORE: dict[str, object] = {"skybox": 0, "teachers": 0, "densify.relocate": 0.0}
# Settings that no version has any more, and the value with which they did nothing.
REMOVED: dict[str, object] = {"blur_poses": 1, "coarse": 0.0, "low_pass": False, "losses.distortion": 0.0}
KINDS: dict[object, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "text",
    type(None): "null",
}


def setting_names() -> list[str]:
    """Return the names of all settings; a dot leads into a part, as in "texture.residual"."""
    return list(_flat(DEFAULT.as_dict()))


def setting(config: Config, name: str) -> object:
    """Return the value of a setting; ValueError when there is none of that name."""
    _check_name(name)
    part, _, key = name.rpartition(".")
    return getattr(getattr(config, part) if part else config, key)


def with_settings(config: Config, settings: Mapping[str, object]) -> Config:
    """Return a config with some settings replaced, by name; lists stand for tuples.

    Raises:
        ValueError: there is no setting of that name, or its value is of another type or out of range.
    """
    changes: dict[str, dict[str, object]] = {}
    for name, value in settings.items():
        _check_name(name)
        part, _, key = name.rpartition(".")
        hints = get_type_hints(type(getattr(config, part) if part else config))
        changes.setdefault(part, {})[key] = _typed(name, value, hints[key])
    whole = changes.pop("", {})
    for part, values in changes.items():
        try:
            whole[part] = dataclasses.replace(getattr(config, part), **values)
        except ValueError as error:  # which names the setting without the part
            raise ValueError(f"{part}.{error}") from None
    return dataclasses.replace(config, **whole)  # type: ignore[arg-type]  # _typed has checked them


def parse_settings(texts: Iterable[str]) -> dict[str, Json]:
    """Read settings as a person types them, KEY=VALUE each; VALUE is JSON, or else stands for itself as a string.

    Raises:
        ValueError: no KEY=VALUE, or a KEY twice; names and types are checked in `with_settings`.
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


def config_from_dict(data: Mapping[str, Any]) -> Config:
    """Rebuild a config from `Config.as_dict`; ValueError names a value of another type or out of range.

    Settings that an older version did not write are those of the preset that the run started from, but for those of
    `BEFORE`. Those that this version does not know are passed over; see `refuse_removed`.
    """
    try:
        stored = _flat(data)
        if "densify" in data:  # the record of a run has it, a few settings do not
            stored = BEFORE | stored
        known = {name: stored[name] for name in setting_names() if name in stored}
        return with_settings(PRESETS.get(data.get("preset", ""), DEFAULT), known)
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"config: expected the settings of a nexwarp run ({error})") from None


def refuse_removed(data: Mapping[str, Any]) -> None:
    """Raise ValueError where settings, as an older version wrote them, ask for something that was removed since."""
    stored = _flat(data)
    for name, neutral in REMOVED.items():
        if stored.get(name, neutral) != neutral:
            raise ValueError(f"{name}: {stored[name]} was removed; versions up to 0.2 have it")


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of `Config.as_dict`, or of another version, by name."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        if name in PARTS:
            flat |= {f"{name}.{key}": x for key, x in value.items()}
        else:
            flat[name] = value
    return flat


def _check_name(name: str) -> None:
    if name in REMOVED:
        raise ValueError(f"{name}: expected a setting, got one that was removed; versions up to 0.2 have it")
    known = setting_names()
    if name not in known:
        close = get_close_matches(name, known, n=4, cutoff=0.5) or known[:4]
        raise ValueError(f"{one_line(name, 60)}: expected a setting, such as {', '.join(close)}")


def _typed(name: str, value: object, annotation: object) -> object:
    """Return a value as its annotation has it: int where float is meant and list for tuple will do."""
    options = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER
    for option in options:
        if get_origin(option) is tuple:
            kinds = get_args(option)
            if isinstance(value, (list, tuple)) and len(value) == len(kinds):
                return tuple(_typed(name, x, kind) for x, kind in zip(value, kinds, strict=True))
        elif option in (int, float):
            if number and (option is float or isinstance(value, int)):
                return option(value)
        elif type(value) is option:
            return value
    expected = " or ".join(KINDS.get(x, f"a list of {len(get_args(x))} numbers") for x in options)
    raise ValueError(f"{name}: expected {expected}, got {json.dumps(value, default=repr)[:60]}")
