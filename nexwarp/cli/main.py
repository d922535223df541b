"""Command line: `nexwarp train`, `eval`, `render`, `edit`, `export`, `view`, `info`, `process`, `sfm`."""

import io
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr
from difflib import get_close_matches
from typing import Any, NoReturn

import tyro
from rich.console import Console

from nexwarp.cli import __version__, display
from nexwarp.cli.commands import Edit, Eval, Export, Info, Process, Render, ViewCommand
from nexwarp.cli.signals import stopped_by_signals
from nexwarp.cli.train import Train
from nexwarp.errors import NexwarpError, RankError
from nexwarp.io.files import printable
from nexwarp.machine import needed_memory
from nexwarp.train.ranks.ranks import end_process, launch, may_speak

PROGRAM = ("-m", "nexwarp")  # what the ranks of a training run
CLOSED_PIPE = 128 + 13  # SIGPIPE, which other systems do not have
COMMANDS: dict[str, Callable[..., Callable[[Console], None]]] = {
    "train": Train,
    "eval": Eval,
    "render": Render,
    "edit": Edit,
    "export": Export,
    "view": ViewCommand,
    "info": Info,
    "process": Process,
    "sfm": Process,
}


class OutputConsole(Console):
    """The console of all output: names from photos and files cannot control the terminal, nor look like other text.

    It takes brackets as they are, since paths may have them, and breaks no line of text, which may be a path or a
    command to copy. It raises BrokenPipeError when nobody reads its output any more; rich's own exits with 1.
    """

    def __init__(self) -> None:
        super().__init__(markup=False, highlight=False)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print text with what does not print escaped, or a table."""
        text = all(isinstance(x, str) for x in objects)
        super().print(*(printable(x) if isinstance(x, str) else x for x in objects), soft_wrap=text, **options)

    def on_broken_pipe(self) -> NoReturn:
        """Raise the error that is being handled."""
        raise BrokenPipeError


def _parse(arguments: list[str]) -> Callable[[Console], None]:
    """Return the command of the arguments; invalid ones print one line on stderr and exit with 2."""
    message = io.StringIO()
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        close = get_close_matches(arguments[0], COMMANDS, n=1, cutoff=0.5)
        meant = f"; perhaps you meant nexwarp {close[0]}" if close else ""
        _complain(f"error: no command {arguments[0]!r:.60}, expected one of {', '.join(COMMANDS)}{meant}")
        raise SystemExit(2)
    try:
        with redirect_stderr(message):
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                prog="nexwarp",
                description="Nexels: neurally textured surfels. Each command has its own --help. "
                "--debug shows the full traceback of an error, --version the version.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code:
            help_of = f"nexwarp {arguments[0]}" if arguments and arguments[0] in COMMANDS else "nexwarp"
            _complain(f"error: {_unboxed(message.getvalue(), help_of)}; see {help_of} --help")
        raise


def _unboxed(text: str, command: str) -> str:
    """Reduce an error message of tyro, a box of several paragraphs, on a command to one sentence."""
    lines = [line.strip("│╭╮╰╯|+ ") for line in text.splitlines()]
    # The first line is the title. Terminals without box characters get lines of "-".
    parts = [part for part in re.split(r"\n[─-]*\n", "\n".join(["", *lines[1:]])) if part]
    fault = " ".join(parts[0].split()).removesuffix(".").replace(" or misplaced", "")
    fault = fault.replace(f" (applied to {command}) ", ", ").removesuffix(f" (applied to {command})")
    value = re.fullmatch(
        r"Error parsing (\S+): (?:no type matching \S*(INT|FLOAT)\b|invalid literal for (int)|"
        r"could not convert string to (float)).*?'(.*)'.*",
        fault,
    )
    if value is not None:
        option, *kinds, text = value.groups()
        kind = "an integer" if "int" in [(k or "").lower() for k in kinds] else "a number"
        return f"{option}: expected {kind}, got {text!r}"
    meant = next((part for part in parts if part.startswith("Perhaps you meant:")), None)
    if meant is None:
        return fault
    option = meant.split("\n")[1]
    owners = re.findall(r"^in (nexwarp \w+) --help$", meant, re.M)
    return f"{fault}; perhaps you meant {option if command in owners or not owners else f'{owners[0]} {option}'}"


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code.

    0: success. 2: invalid input, a full disk or a diverged training. 3: an internal error, a fault of the GPU, or of
    ranks. 128 plus the signal's number: ended by Ctrl-C (130), SIGTERM (143) or SIGHUP (129), or because nobody reads
    its output any more (141, as of SIGPIPE). Every failure but the last prints one line on stderr.
    """
    import warp as wp

    # Hide Warp's warnings, which users cannot act on.
    wp.config.log_level = wp.LOG_ERROR
    _open_streams()
    words = sys.argv[1:] if arguments is None else arguments
    try:
        with stopped_by_signals():
            return _run([word for word in words if word != "--debug"], debug="--debug" in words)
    except BrokenPipeError:
        return CLOSED_PIPE
    finally:
        try:
            sys.stdout.flush()
        except OSError:
            # Otherwise Python would try to write the rest when it ends, and report that it cannot.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_streams() -> None:
    """Let what this process was started without, stdin, stdout or stderr, lead nowhere, instead of into a file."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+"))


def _run(words: list[str], *, debug: bool) -> int:
    """Run a command and return its exit code; BrokenPipeError if nobody reads its output any more."""
    command: Callable[[Console], None] | None = None
    try:
        if words == ["--version"]:
            print(f"nexwarp {__version__}", flush=True)
            return 0
        command = _parse(words)
        if isinstance(command, Train):
            command.given = frozenset(
                word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")
            )
        if isinstance(command, Train) and (count := command.starts()):
            with stopped_by_signals(deferred=True) as stop:
                return launch(count, [*PROGRAM, *words, *(["--debug"] if debug else [])], stop)
        console = OutputConsole()
        with display.plain_warnings(console):
            command(console)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except KeyboardInterrupt as stop:
        number = getattr(stop, "number", signal.SIGINT)
        hint = "; continue with --resume" if isinstance(command, Train) else ""
        _complain(f"{'interrupted' if number == signal.SIGINT else 'terminated'}{hint}", stop)
        return end_process(128 + number)
    except Exception as error:
        return end_process(_tell(error, command, debug))
    return 0


def _tell(error: Exception, command: Callable[[Console], None] | None, debug: bool) -> int:
    """Print one line about an error; return the exit code."""
    hint = "; --resume continues from the last checkpoint" if isinstance(command, Train) else ""
    text, code = f"error: {error}", 2
    if (needed := needed_memory(error)) is not None and not isinstance(error, NexwarpError):
        text = f"error: out of memory: needed {needed}; try a smaller image size"
    elif isinstance(error, RankError):
        code = 3
    elif isinstance(error, RuntimeError) and (fault := re.match(r"(Warp )?CUDA error\b[^\n]*", str(error))):
        text, code = f"error: the GPU failed ({fault[0]}){hint}", 3
    elif not isinstance(error, (NexwarpError, ValueError, OSError)):
        hint = "" if debug else "; --debug shows the traceback"
        text, code = f"internal error: {type(error).__name__}: {error}{hint}", 3
    _complain(text, error, debug=debug)
    return code


def _complain(text: str, error: BaseException | None = None, *, debug: bool = False) -> None:
    """Print one line on stderr, below the traceback with `debug`; of several ranks, one does."""
    if not may_speak(error):
        return
    if debug and error is not None:
        for line in "".join(traceback.format_exception(error)).splitlines():
            print(printable(line), file=sys.stderr)
    line = printable(" ".join(f"nexwarp: {text}".split()))
    Console(stderr=True, soft_wrap=True, highlight=False).print(line, markup=False)


if __name__ == "__main__":
    sys.exit(main())
