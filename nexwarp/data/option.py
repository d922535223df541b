"""Options of commands: how fields of dataclasses stand in --help."""

from typing import Annotated

import tyro


def option(metavar: str | None, default: str | None = None, text: str | None = None) -> object:
    """Return tyro's settings of an option: its metavar, and what --help says of the default; "" says nothing.

    `text` is the help of options of one kind, which have no docstrings of their own.
    """
    hint = f"(default: {default})" if default else default
    return tyro.conf.arg(metavar=metavar, help=text, help_behavior_hint=hint)


Flag_ = Annotated[bool, option(None, "")]
