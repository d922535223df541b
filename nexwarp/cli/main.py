"""Command line: `nexwarp train`, `eval`, `render`, `export`, `view`, `info`, `sfm`, `warmup`."""

import io
import re
import signal
import sys
import traceback
from contextlib import redirect_stderr
from typing import Any

import tyro
from rich.console import Console

from nexwarp.cli.commands import Export, Info, Render, Sfm, Warmup
from nexwarp.cli.eval import Eval
from nexwarp.cli.signals import stopped_by_signals
from nexwarp.cli.train import Train
from nexwarp.cli.view import ViewCommand
from nexwarp.errors import NexwarpError
from nexwarp.train.health import needed_memory

COMMANDS: dict[str, Any] = {
    "train": Train,
    "eval": Eval,
    "render": Render,
    "export": Export,
    "view": ViewCommand,
    "info": Info,
    "sfm": Sfm,
    "warmup": Warmup,
}


def _parse(arguments: list[str]) -> Any:
    """The command that the arguments ask for; exits with 2 where they are none, after one line on stderr."""
    boxed = io.StringIO()
    try:
        with redirect_stderr(boxed):
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="nexwarp",
                description="Nexels: neurally-textured surfels. Each command has a --help of its own; with --debug, "
                "each shows the full trace of an error.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code:
            help_of = f"nexwarp {arguments[0]}" if arguments and arguments[0] in COMMANDS else "nexwarp"
            _complain(f"error: {_unboxed(boxed.getvalue())}; see {help_of} --help", None)
        raise


def _unboxed(text: str) -> str:
    """What tyro says in a box of several paragraphs, in one sentence."""
    lines = [line.strip("│╭╮╰╯|+ ") for line in text.splitlines()]
    # After the title; terminals without such characters get lines of "-".
    parts = [part for part in re.split(r"\n[─-]*\n", "\n".join(["", *lines[1:]])) if part]
    fault = " ".join(parts[0].split()).removesuffix(".")
    value = re.fullmatch(
        r"Error parsing (\S+): (?:no type matching \S*(INT|FLOAT)\b|invalid literal for (int)|"
        r"could not convert string to (float)).*?'(.*)'.*",
        fault,
    )
    if value is not None:
        option, *kinds, given = value.groups()
        kind = "an integer" if "int" in [(k or "").lower() for k in kinds] else "a number"
        return f"{option}: expected {kind}, got {given!r}"
    meant = next((part.split("\n")[1] for part in parts if part.startswith("Perhaps you meant:")), None)
    return fault if meant is None else f"{fault}; perhaps you meant {meant}"


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code.

    0: done. 2: bad input, a full disk, a training that diverged: one line on stderr. 3: an error of nexwarp itself,
    likewise. 128 and the signal's number: ended by Ctrl-C (130), SIGTERM (143) or SIGHUP (129).
    """
    import warp as wp

    # Warp's notes on a missing CUDA driver or on kernels it compiles are no news to a person at a terminal.
    wp.config.log_level = wp.LOG_ERROR
    given = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in given
    command = _parse([argument for argument in given if argument != "--debug"])
    console = Console()
    try:
        with stopped_by_signals():
            command(console)
    except KeyboardInterrupt as stop:
        number = getattr(stop, "number", signal.SIGINT)
        hint = "; continue with --resume" if isinstance(command, Train) else ""
        _complain(f"{'interrupted' if number == signal.SIGINT else 'terminated'}{hint}", None)
        return 128 + number
    except Exception as error:
        trace = error if debug else None
        if (needed := needed_memory(error)) is not None and not isinstance(error, NexwarpError):
            _complain(
                f"error: out of memory: it needed {needed}; ask for less at a time, such as a smaller size", trace
            )
            return 2
        if isinstance(error, (NexwarpError, ValueError, OSError)):
            _complain(f"error: {error}", trace)
            return 2
        hint = "" if debug else "; --debug shows where"
        _complain(f"internal error: {type(error).__name__}: {error}{hint}", trace)
        return 3
    return 0


def _complain(text: str, trace: Exception | None) -> None:
    """One line on stderr, and the trace of an error above it if there is one to show."""
    if trace is not None:
        traceback.print_exception(trace)
    line = " ".join(f"nexwarp: {text}".split())
    Console(stderr=True, soft_wrap=True, highlight=False).print(line, markup=False)


if __name__ == "__main__":
    sys.exit(main())
