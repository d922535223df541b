"""Options that several commands share."""

from pathlib import Path
from typing import Annotated, Any

import tyro

from nexwarp.errors import SettingError
from nexwarp.kernels.types import MAX_HITS
from nexwarp.train.config import Config
from nexwarp.train.settings import with_settings


def option(metavar: str, default: str | None = None) -> Any:
    """How --help shows an option's value, and its default where None stands for it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


Scene_ = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Run_ = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
Device_ = Annotated[str | None, option("{cuda,cpu}", "cuda where there is one, else cpu")]
Preset_ = Annotated[str, option("{default,paper}")]
Port_ = Annotated[int, option("PORT")]
Host_ = Annotated[str, option("ADDRESS")]


def with_flag_settings(config: Config, settings: dict[str, Any]) -> Config:
    """Return a config with what --set asks for; SettingError names --set."""
    try:
        return with_settings(config, settings)
    except ValueError as error:
        raise SettingError(f"--set: {error}") from None


def check_max_hits(max_hits: int | None) -> None:
    """Raise SettingError unless --max-hits is in range."""
    if max_hits is not None and not 0 <= max_hits <= MAX_HITS:
        raise SettingError(f"--max-hits: expected 0 to {MAX_HITS}, got {max_hits}")
