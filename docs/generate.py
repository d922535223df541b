"""Write docs/options.md, docs/cli.md and docs/api.md, which are made from the code: `python docs/generate.py`.

What a person wrote above the made part of a page stays. Tests compare the pages with what this file makes.
"""

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import json
import os
import re
import textwrap
from pathlib import Path
from typing import Any
from unittest import mock

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.train.recipe import USER_SETTINGS, Config, preset, setting

DOCS = Path(__file__).parent

# The publication's symbol of a setting, and the section that gives its value (docs/paper.md has their titles);
# "code": only the authors' code gives it.
CODE = dict.fromkeys(("background", "seed"), ("", "code"))
SYMBOLS = {"iterations": ("", "4.3"), "max_surfels": ("P", "4.3"), "max_hits": ("K", "5"), **CODE}
SYMBOLS |= {"sh_degree": ("S = (d + 1)^2", "5"), "texture.table_size": ("T", "5")}


def written_above(page: str, made: str) -> str:
    """The text that a person wrote, above the part that is made."""
    return (DOCS / page).read_text(encoding="utf-8").partition(f"\n{made}")[0]


# docs/options.md


def field_docs(owner: type) -> dict[str, str]:
    """Docstrings of a dataclass's fields, on one line each."""
    docs = {}
    for line, following in itertools.pairwise(definition_of(owner).body):
        if isinstance(line, ast.AnnAssign) and isinstance(following, ast.Expr):
            assert isinstance(following.value, ast.Constant)
            docs[ast.unparse(line.target)] = " ".join(str(following.value.value).split())
    return docs


def definition_of(made: Any) -> Any:
    """The definition of a class or function as the code has it."""
    return ast.parse(textwrap.dedent(inspect.getsource(made))).body[0]


def cell(text: Any) -> str:
    return str(text).replace("|", "\\|")


def options_page() -> str:
    table = "| KEY | default | `paper` | what | symbol | section |\n|---|---|---|---|---|---|"
    page = [written_above("options.md", table), table]
    ours, paper = preset("default"), preset("paper")
    for name in USER_SETTINGS:
        part, _, key = name.rpartition(".")
        text = field_docs(type(getattr(Config(), part)) if part else Config)[key]
        default, theirs = (json.dumps(setting(config, name)) for config in (ours, paper))
        symbol, section = SYMBOLS.get(name, ("", ""))
        theirs = theirs if theirs == default else f"**{theirs}**"
        section = f"paper Sec. {section}" if section[:1].isdigit() else section
        page.append(f"| `{name}` | {default} | {theirs} | {cell(text)} | {symbol} | {section} |")
    return "\n".join(page) + "\n"


# docs/cli.md

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def help_text(*command: str, width: int = 100) -> str:
    out = io.StringIO()
    columns = mock.patch.dict(os.environ, COLUMNS=str(width))
    with columns, contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        cli.main([*command, "--help"])
    lines = [line.rstrip() for line in ANSI.sub("", out.getvalue()).splitlines()]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip()


def commands_page() -> str:
    page = [written_above("cli.md", "## nexwarp")]
    for command in ([], *([name] for name in cli.COMMANDS)):
        page += [f"## {' '.join(['nexwarp', *command])}", "", "```text", help_text(*command), "```", ""]
    return "\n".join(page)


# docs/api.md

# Titles, and the rooms of the package whose names stand below them.
ROOMS = {"Models and rendering": ("model", "ops", "kernels", "export"), "Cameras": ("cameras",)}
ROOMS |= {"Scenes": ("data", "io"), "Training": ("train", "run", "cli")}
SECTION = re.compile(r"(Args|Attributes|Buffers|Returns|Yields|Raises):")


def source_signature(made: Any, name: str) -> str:
    """The signature as the code has it, types included."""
    if isinstance(made, type) and dataclasses.is_dataclass(made):
        bases = [base for base in reversed(made.__mro__) if dataclasses.is_dataclass(base)]
        lines = [line for base in bases for line in definition_of(base).body if isinstance(line, ast.AnnAssign)]
        types = {ast.unparse(line.target): ast.unparse(line.annotation) for line in lines}
        fields = [f"{x.name}: {types[x.name]}{default_of(x)}" for x in dataclasses.fields(made) if x.init]
        return f"{name}({', '.join(fields)})"
    if isinstance(made, type) and "__init__" not in vars(made):
        return name
    node = definition_of(vars(made)["__init__"] if isinstance(made, type) else made)
    if node.args.args and node.args.args[0].arg in ("self", "cls"):
        node.args.args.pop(0)
    result = "" if node.returns is None or node.name == "__init__" else f" -> {ast.unparse(node.returns)}"
    return f"{name}({ast.unparse(node.args)}){result}"


def default_of(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return f" = {field.default!r}"
    return "" if field.default_factory is dataclasses.MISSING else " = ..."


def markdown_of(doc: str) -> str:
    """A docstring in Google's style as Markdown: its sections become lists."""
    page: list[str] = []
    section = ""
    for line in doc.splitlines():
        heading = SECTION.fullmatch(line)
        indent, text = len(line) - len(line.lstrip()), line.strip()
        if heading:
            section = heading[1]
            page += [f"*{section}*", ""]
        elif section and indent == 4:
            name, colon, rest = text.partition(": ")
            named = colon and re.fullmatch(r"[\w., *]+", name)
            page.append(f"- `{name}`: {rest}" if named else text if section in ("Returns", "Yields") else f"- {text}")
        elif section and indent > 4:
            page.append(f"  {text}")
        else:
            section = "" if text else section
            page.append(line)
    return "\n".join(page).strip()


def section_of(made: Any, name: str) -> list[str]:
    """The text of a public name, with the methods and properties of a class."""
    doc = markdown_of(inspect.getdoc(made) or "") + "\n"
    if inspect.ismodule(made):
        return [doc]
    texts = [f"```python\n{source_signature(made, f'nexwarp.{name}')}\n```\n", doc]
    for member, value in vars(made).items() if isinstance(made, type) else ():
        value = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
        doc = markdown_of(inspect.getdoc(value) or "")
        if member.startswith("_") or not doc:
            continue
        if inspect.isfunction(value):
            texts += [f"```python\n{source_signature(value, f'{name}.{member}')}\n```\n", f"{doc}\n"]
        elif isinstance(value, property | functools.cached_property):
            texts.append(f"`{name}.{member}`: {doc}\n")
    return texts


def api_page() -> str:
    table, texts = ["| name | what |", "|---|---|"], []
    for title, rooms in ROOMS.items():
        texts.append(f"## {title}\n")
        for name in sorted(nw.__all__, key=str.lower):
            made = getattr(nw, name)
            if (made.__name__ if inspect.ismodule(made) else made.__module__).split(".")[1] in rooms:
                doc = inspect.getdoc(made) or ""
                table.append(f"| [`{name}`](#{name.lower()}) | {cell(doc.splitlines()[0])} |")
                texts += [f"### {name}\n", *section_of(made, name)]
    assert len(table) - 2 == len(nw.__all__), "a public name of a room that no title has"
    return "\n".join([written_above("api.md", table[0]), *table, "", *texts]).rstrip() + "\n"


MADE = {"options.md": options_page, "cli.md": commands_page, "api.md": api_page}


if __name__ == "__main__":
    for name, page in MADE.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
