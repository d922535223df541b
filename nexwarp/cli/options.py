"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import tyro

from nexwarp.errors import SettingError
from nexwarp.io.json_files import Json
from nexwarp.kernels.types import MAX_HITS
from nexwarp.train.recipe import Config
from nexwarp.train.settings import with_settings


def option(metavar: str, default: str | None = None) -> object:
    """Return tyro's settings of an option: its metavar in --help, and its default if the field's default is None."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


Scene_ = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Run_ = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
Device_ = Annotated[str | None, option("{cuda,cpu}", "cuda if available, else cpu")]
Preset_ = Annotated[str, option("{default,web,paper}")]
Port_ = Annotated[int, option("PORT")]
Host_ = Annotated[str, option("ADDRESS")]


def with_flag_settings(config: Config, settings: dict[str, Json]) -> Config:
    """Return a config with the settings of --set; a SettingError names --set."""
    try:
        return with_settings(config, settings)
    except ValueError as error:
        raise SettingError(f"--set: {error}") from None


def check_max_hits(max_hits: int | None) -> None:
    """Raise SettingError unless --max-hits is in range."""
    if max_hits is not None and not 0 <= max_hits <= MAX_HITS:
        raise SettingError(f"--max-hits: expected 0 to {MAX_HITS}, got {max_hits}")
