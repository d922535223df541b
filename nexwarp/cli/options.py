"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import tyro

from nexwarp.errors import SettingError
from nexwarp.kernels.types import MAX_HITS


def option(metavar: str, default: str | None = None) -> object:
    """Return tyro's settings of an option: its metavar in --help, and its default if the field's default is None."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


Run_ = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
Flag_ = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Device_ = Annotated[str | None, option("{cuda,cpu}", "cuda if there is one")]
Preset_ = Annotated[str, option("NAME")]
Port_ = Annotated[int, option("PORT")]
Host_ = Annotated[str, option("ADDRESS")]


def check_max_hits(max_hits: int | None) -> None:
    """Raise SettingError unless --max-hits is in range."""
    if max_hits is not None and not 0 <= max_hits <= MAX_HITS:
        raise SettingError(f"--max-hits: expected 0 to {MAX_HITS}, got {max_hits}")
