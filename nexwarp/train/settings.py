"""Settings by name: as a person types them, and as a run's config.json holds them."""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any, get_type_hints

from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json
from nexwarp.train.recipe import DEFAULT, PRESETS, Config, typed

PARTS = [field.name for field in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(DEFAULT, field.name))]
Stored = Mapping[str, Any]  # settings, as `Config.as_dict` of any version returns them
# What runs did before a setting existed, where the default does something else.
BEFORE: dict[str, object] = {"skybox": 0, "teachers": 0, "densify.relocate": 0.0}
# Settings that no version has any more, and the value with which they did nothing.
REMOVED: dict[str, object] = {"blur_poses": 1, "coarse": 0.0, "low_pass": False, "losses.distortion": 0.0}


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
        changes.setdefault(part, {})[key] = typed(name, value, hints[key])
    whole = changes.pop("", {})
    for part, values in changes.items():
        try:
            whole[part] = dataclasses.replace(getattr(config, part), **values)
        except ValueError as error:  # which names the setting without the part
            raise ValueError(f"{part}.{error}") from None
    return dataclasses.replace(config, **whole)  # type: ignore[arg-type]  # typed has checked them


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


def config_from_dict(data: Stored) -> Config:
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


def refuse_removed(data: Stored) -> None:
    """Raise ValueError where settings, as an older version wrote them, ask for something that was removed since."""
    stored = _flat(data)
    for name, neutral in REMOVED.items():
        if stored.get(name, neutral) != neutral:
            raise ValueError(f"{name}: {stored[name]} was removed; versions up to 0.2 have it")


def _flat(data: Stored) -> dict[str, object]:
    """Return the settings of `Config.as_dict`, or of another version, by name."""
    flat: dict[str, object] = {}
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
