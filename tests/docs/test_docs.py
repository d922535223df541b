"""The documents against the code: pages made from it are up to date, and every command and link is tried."""

import importlib.util
import json
import re
import shlex
import subprocess
import sys
import textwrap

import pytest

from docs.generate import DOCS, MADE, SYMBOLS, help_text
from nexwarp.cli import main as cli
from nexwarp.cli.train import Train
from nexwarp.train.recipe import PRESETS, USER_SETTINGS, preset, setting, setting_names, with_settings

ROOT = DOCS.parent


def test_the_help_of_train_fits_a_screen():
    lines = help_text("train", width=80).splitlines()
    assert sum(len(textwrap.wrap(line, 80) or [""]) for line in lines) <= 50


@pytest.mark.parametrize("name", MADE)
def test_pages_are_those_of_the_code(name):
    assert (DOCS / name).read_text(encoding="utf-8") == MADE[name](), "python docs/generate.py"


def test_settings_on_the_page_can_be_set():
    """They are few. What the tables print is what --set takes: each preset is the other with the page's values."""
    assert set(SYMBOLS) <= set(USER_SETTINGS) <= set(setting_names()) and len(USER_SETTINGS) <= 20
    ours, paper = PRESETS["default"], PRESETS["paper"]
    values = {name: json.loads(json.dumps(setting(paper, name))) for name in setting_names()}
    assert with_settings(ours, values) == paper


# docs/paper.md, the README, and commands on any page

PAGES = [*sorted(DOCS.glob("*.md")), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_can_be_typed(page, monkeypatch):
    """Every command is understood, and every setting of a training exists and takes its value."""
    understood = []
    for command in cli.COMMANDS.values():
        monkeypatch.setattr(command, "__call__", lambda self, console: understood.append(self))
    monkeypatch.setattr(Train, "starts", lambda self: 0)  # --gpus asks for more than a test machine has
    pattern = rf"\bnexwarp ((?:{'|'.join(cli.COMMANDS)})\b[^#;\n]*)"
    blocks = re.findall(r"^    .*$", page.read_text(encoding="utf-8"), re.M)  # indented
    for arguments in (shlex.split(command) for line in blocks for command in re.findall(pattern, line)):
        assert cli.main(arguments) == 0, arguments
        command = understood.pop()
        if isinstance(command, Train):
            assert command._config().preset == command.preset


def test_the_paper_page_lists_all_that_differs():
    listed = re.findall(r"^\| `([a-zA-Z_.]+)` \|", (DOCS / "paper.md").read_text(encoding="utf-8"), re.M)
    ours, paper = preset("default"), preset("paper")
    differ = {name for name in setting_names() if setting(ours, name) != setting(paper, name)} - {"preset"}
    assert set(listed) == differ and len(listed) == len(differ)


@pytest.mark.parametrize(("name", "most"), [("README.md", 600), ("CONTRIBUTING.md", 260)])
def test_the_first_pages_are_short(name, most):
    assert len((ROOT / name).read_text(encoding="utf-8").split()) <= most


def test_pages_are_in_the_site_s_navigation():
    """Each page of docs/ is there, and each is reached from the first page."""
    listed = set(re.findall(r"^ +- [^:]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    pages = {page.name for page in DOCS.glob("*.md")}
    assert pages <= listed
    first = (DOCS / "index.md").read_text(encoding="utf-8")
    assert pages - {"index.md"} <= set(re.findall(r"\]\(([a-z_]+\.md)", first))


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs the extra docs")
def test_the_site_builds(tmp_path):
    """All links and anchors between pages lead somewhere, and all names of the API are found."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "paper Eq. 6" in (tmp_path / "site" / "method" / "index.html").read_text(encoding="utf-8")
    assert not list((tmp_path / "site").rglob("*.py*"))


def test_links():
    for page in PAGES:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
