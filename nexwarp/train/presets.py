"""The presets, and settings read back from a run's config.json."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from nexwarp.train.config import LARGEST_NUMBER, Config, LearningRates, TextureConfig
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.losses import LossWeights

# The demo is small enough for two CPU cores: a short run, so its steps are larger.
DEMO_SETTINGS: dict[str, object] = {
    "iterations": 1200,
    "max_surfels": 3000,
    "depth_jitter": 0.5,
    "texture.levels": 12,
    "texture.table_size": 2**15,
    "texture.features": 2,
    "texture.width": 32,
    "rates.means": (5e-4, 5e-6),
    "rates.quats": 5e-3,
    "rates.scales": 2.5e-2,
    "rates.opacities": 0.05,
    "rates.gammas": 5e-3,
    "rates.sh0": 1.25e-2,
    "rates.shN": 6e-4,
    "rates.grid": (2e-2, 2e-4),
    "rates.mlp": (3e-3, 3e-4),
}

PARTS = ("losses", "rates", "texture", "densify")

# Settings that no version has any more, and the value with which they did nothing.
REMOVED: dict[str, object] = {"blur_poses": 1, "coarse": 0.0, "low_pass": False, "losses.distortion": 0.0}

# What runs did before a setting existed, where the default does something else; "" has the settings without a part.
BEFORE: dict[str, dict[str, object]] = {"": {"skybox": 0, "teachers": 0}, "densify": {"relocate": 0.0}}


Part = TypeVar("Part", LossWeights, LearningRates, TextureConfig, DensifyConfig)


def _part(base: Part, data: Mapping[str, object], where: str) -> Part:
    """A part of the settings: those of `base`, changed by what `data` holds."""
    known = {field.name for field in dataclasses.fields(base)}
    data = {name: value for name, value in data.items() if name in known}
    return dataclasses.replace(base, **_checked(type(base), _tuples(data), where))


class KindError(ValueError):
    """A setting's value is not of its type."""


def _tuples(data: Mapping[str, object]) -> dict[str, object]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}


def _checked(cls: type, data: dict[str, object], where: str) -> dict[str, Any]:
    """Return settings whose values have their fields' types; numbers are finite."""
    types = get_type_hints(cls)
    for name, value in data.items():
        if name in types and not _fits(value, types[name]):
            kind = getattr(types[name], "__name__", types[name]) if not get_args(types[name]) else types[name]
            raise KindError(f"{where}: {name}: expected {kind}, got {value!r:.60}")
    return data


def _fits(value: object, kind: object) -> bool:
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(_fits, value, kinds))
    if get_args(kind):  # a union
        return any(_fits(value, one) for one in get_args(kind))
    if isinstance(value, bool) or kind not in (int, float):
        return isinstance(kind, type) and isinstance(value, kind)
    if not isinstance(value, int if kind is int else (int, float)):
        return False
    return abs(value) <= LARGEST_NUMBER


PRESETS: dict[str, Config] = {
    "default": Config(),
    # A texture that weak GPUs evaluate in real time: a third of the arithmetic.
    "web": Config(preset="web", texture=TextureConfig(width=32, hidden_layers=1, sh_degree=1)),
    "paper": Config(
        preset="paper",
        more_hits_from=0,
        background=(0.0, 0.0, 0.0),
        depth_jitter=0.0,
        footprints=False,
        smooth_sh=0.0,
        exposures=False,
        filter_points=False,
        orient_points=False,
        skybox=0,
        teachers=0,
        texture=TextureConfig(
            levels=16, table_size=2**20, features=2, min_resolution=16.0, max_resolution=256.0, residual=False
        ),
        losses=LossWeights(depth=0.0),
        densify=DensifyConfig(prune_at_cap=False, relocate=0.0),
    ),
}


def preset(name: str) -> Config:
    """Return a preset; ValueError lists the known ones."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(sorted(PRESETS))}, got {name!r}")
    return PRESETS[name]


def refuse_removed(data: Mapping[str, Any]) -> None:
    """Raise ValueError where settings, as an older version wrote them, ask for something that was removed since."""
    for name, neutral in REMOVED.items():
        part, _, key = name.rpartition(".")
        value = (data.get(part, {}) if part else data).get(key, neutral)
        if value != neutral:
            raise ValueError(f"{name}: {value} was removed; versions up to 0.2 have it")


def config_from_dict(data: Mapping[str, Any]) -> Config:
    """Rebuild a config from `Config.as_dict`; ValueError names a value of another type or out of range.

    Settings that an older version did not write are those of the preset that the run started from, but for those of
    `BEFORE`. Those that this version does not know are passed over; see `refuse_removed`.
    """
    try:
        preset = data.get("preset")
        base = PRESETS[preset] if isinstance(preset, str) and preset in PRESETS else Config()
        known = {field.name for field in dataclasses.fields(Config)}
        parts = {k: _part(getattr(base, k), {**BEFORE.get(k, {}), **v}, k) for k, v in data.items() if k in PARTS}
        written = BEFORE[""] if "densify" in parts else {}  # the record of a run has it, a few settings do not
        data = {**written, **{k: v for k, v in data.items() if k in known}, **parts}
        return dataclasses.replace(base, **_checked(Config, _tuples(data), "config"))
    except (TypeError, AttributeError, KindError) as error:
        raise ValueError(f"config: expected the settings of a nexwarp run ({error})") from None
