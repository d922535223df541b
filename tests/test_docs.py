"""The documents against the code: options.md and cli.md are made from it, format.md says what a run holds.

python -m tests.test_docs --write      # writes docs/options.md and docs/cli.md
"""

import ast
import contextlib
import dataclasses
import importlib.util
import inspect
import io
import itertools
import json
import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cli import main as cli
from nexwarp.cli.train import Train
from nexwarp.data import write_demo
from nexwarp.representation.detail_limits import DetailLimits
from nexwarp.representation.exposures import Exposures
from nexwarp.train.config import Config
from nexwarp.train.presets import DEMO_SETTINGS, PRESETS, preset
from nexwarp.train.settings import setting, with_settings

DOCS = Path(__file__).parents[1] / "docs"

# The publication's symbol of a setting, and the section that gives its value (docs/paper.md has their titles);
# "code": only the authors' code gives it.
SYMBOLS: dict[str, tuple[str, str]] = {
    "preset": ("", ""),
    "iterations": ("", "4.3"),
    "max_surfels": ("P", "4.3"),
    "max_hits": ("K", "5"),
    "more_hits_from": ("", ""),
    "sh_degree": ("S = (d + 1)^2", "5"),
    "sh_every": ("", "code"),
    "coarse": ("", ""),
    "background": ("", "code"),
    "footprints": ("", ""),
    "smooth_sh": ("", ""),
    "exposures": ("", ""),
    "metering": ("", ""),
    "vignetting": ("", ""),
    "mask_mode": ("", ""),
    "border": ("", ""),
    "border_every": ("", ""),
    "depth_jitter": ("", ""),
    "low_pass": ("", ""),
    "clamp_texture": ("", "code"),
    "clamp_image": ("", "code"),
    "filter_points": ("", ""),
    "orient_points": ("", ""),
    "seed": ("", "code"),
    "deterministic": ("", ""),
    "cuda_graphs": ("", ""),
    "losses.dssim": ("λ_D-SSIM", "4.3"),
    "losses.alpha": ("λ_alpha", "4.3"),
    "losses.alpha_hits": ("", ""),
    "losses.texture": ("λ_texture", "4.3"),
    "losses.opacity": ("λ_opacity", "4.3"),
    "losses.grid": ("λ_grid", "4.3"),
    "losses.empty": ("", ""),
    "losses.depth": ("", ""),
    "losses.border": ("", ""),
    "rates.means": ("", "code"),
    "rates.quats": ("", "code"),
    "rates.scales": ("", "code"),
    "rates.opacities": ("", "code"),
    "rates.gammas": ("", "code"),
    "rates.sh0": ("", "code"),
    "rates.shN": ("", "code"),
    "rates.grid": ("", "code"),
    "rates.mlp": ("", "code"),
    "texture.levels": ("L", "5"),
    "texture.table_size": ("T", "5"),
    "texture.features": ("F", "5"),
    "texture.min_resolution": ("s_0", "code"),
    "texture.max_resolution": ("s_(L-1)", "code"),
    "texture.width": ("", "5"),
    "texture.hidden_layers": ("", "5"),
    "texture.sh_degree": ("S = (d + 1)^2", "5"),
    "texture.residual": ("", ""),
    "texture.down_weighting": ("Δ", "4.1"),
    "densify.start": ("", "4.3"),
    "densify.stop": ("", "4.3"),
    "densify.every": ("", "4.3"),
    "densify.fraction": ("", "4.3"),
    "densify.prune_opacity": ("", "4.3"),
    "densify.prune_at_cap": ("", "code"),
    "densify.floaters": ("", ""),
}

INTRODUCTION = """\
# Settings

Options of each command, and all settings of a training ([below](#all-settings)). The page is made from the code by
`python -m tests.test_docs --write`; a test fails if the two disagree.

Every command has `--help` ([Commands](cli.md)). Bad input gives one line on stderr and exit code 2. Ctrl-C exits
with 130.
"""

SETTINGS = """\
## All settings

What a training depends on beside its scene: `nexwarp.Config`. `--preset` picks the values to start from, the
flags of `nexwarp train` change some, and `--set KEY=VALUE`, repeated, any:

    nexwarp train SCENE --preset paper --set texture.max_resolution=1024
    nexwarp train SCENE --set mask_mode=background --set losses.empty=0.2 --set 'rates.means=[1e-4, 1e-6]'

VALUE is JSON (`1024`, `true`, `null`, `[0.001, 0.00001]`) or a bare word. An unknown KEY and a value of another type or
out of range are refused before anything is written. The settings of a run are in its `config.json`. With `--resume`
they come from there, and options that are given must agree with them.

`demo` has settings of its own, for a short training on a CPU, with either preset: DEMO.

Symbol and section are the publication's; "code" means that only the authors' code has the setting. A setting without
either is not in the publication; `paper` turns it off, or it has no effect there. Values that differ are bold.
[Presets and paper](paper.md) says why they differ.
"""


# docs/options.md


def field_docs(owner: type) -> dict[str, str]:
    """Docstrings of a dataclass's fields, on one line each."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    assert isinstance(definition, ast.ClassDef)
    docs = {}
    for line, following in itertools.pairwise(definition.body):
        if isinstance(line, ast.AnnAssign) and isinstance(following, ast.Expr):
            assert isinstance(line.target, ast.Name) and isinstance(following.value, ast.Constant)
            docs[line.target.id] = " ".join(str(following.value.value).split())
    return docs


def options(command: Any) -> Iterator[tuple[str, str, str]]:
    """What a command takes: how it is written, its default, what it means."""
    docs, hints = field_docs(command), get_type_hints(command, include_extras=True)
    for f in dataclasses.fields(command):
        extras = getattr(hints[f.name], "__metadata__", ())
        parts = [p for p in (f.type, getattr(hints[f.name], "__origin__", None)) if dataclasses.is_dataclass(p)]
        if parts:
            assert isinstance(parts[0], type)
            yield from options(parts[0])
            continue
        (shown,) = [e for e in extras if hasattr(e, "metavar")] or [None]
        name = f"--{((shown and shown.name) or f.name).replace('_', '-')}"
        choices = getattr(hints[f.name], "__args__", ()) if shown is None else ()
        metavar = shown.metavar if shown else "{" + ",".join(choices) + "}" if choices else ""
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            yield metavar, "required", docs[f.name]
            continue
        hint = shown.help_behavior_hint if shown else None
        default = hint.removeprefix("(default: ").strip("()") if hint else "off" if f.default is False else f.default
        yield f"{name} {metavar}".strip(), str(default), docs[f.name]


def setting_names(config: Config) -> Iterator[tuple[str, str]]:
    """Names of all settings, and what they mean."""
    parts = []
    for name, text in field_docs(type(config)).items():
        if dataclasses.is_dataclass(getattr(config, name)):
            parts.append(name)
        else:
            yield name, text
    for part in parts:
        for name, text in field_docs(type(getattr(config, part))).items():
            yield f"{part}.{name}", text


def cell(text: Any) -> str:
    return str(text).replace("|", "\\|")


def options_page() -> str:
    """The text of docs/options.md."""
    page = [INTRODUCTION]
    for name, command in cli.COMMANDS.items():
        rows = list(options(command))
        needed = " ".join(option for option, default, _ in rows if default == "required")
        page.append(f"## nexwarp {name} {needed}".rstrip() + f"\n\n{inspect.getdoc(command)}\n")
        page.append("| option | default | what |\n|---|---|---|")
        page += [f"| `{cell(option)}` | {cell(default)} | {cell(text)} |" for option, default, text in rows]
        page.append("")
    demo = ", ".join(f"`{name}` {json.dumps(value)}" for name, value in DEMO_SETTINGS.items())
    page.append(SETTINGS.replace("DEMO", demo))
    page.append("| KEY | default | `paper` | what | symbol | section |\n|---|---|---|---|---|---|")
    ours, paper = preset("default"), preset("paper")
    for name, text in setting_names(ours):
        default, theirs = (json.dumps(setting(config, name)) for config in (ours, paper))
        symbol, section = SYMBOLS[name]
        theirs = theirs if theirs == default else f"**{theirs}**"
        section = f"paper Sec. {section}" if section[:1].isdigit() else section
        page.append(f"| `{name}` | {default} | {theirs} | {cell(text)} | {symbol} | {section} |")
    return "\n".join(page) + "\n"


# docs/cli.md

COMMANDS_PAGE = """\
# Commands

What `nexwarp COMMAND --help` prints. The page is made from the code by `python -m tests.test_docs --write`; a test
fails if the two disagree. [Settings](options.md) has the same options as tables, and the keys of `--set`.
"""
ANSI = re.compile(r"\x1b\[[0-9;]*m")


def help_text(*command: str) -> str:
    """What --help of a command prints, 100 columns wide."""
    out, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "100"
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            cli.main([*command, "--help"])
    finally:
        if columns is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns
    lines = [line.rstrip() for line in ANSI.sub("", out.getvalue()).splitlines()]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip()


def commands_page() -> str:
    """The text of docs/cli.md."""
    page = [COMMANDS_PAGE]
    for command in ([], *([name] for name in cli.COMMANDS)):
        page += [f"## {' '.join(['nexwarp', *command])}", "", "```text", help_text(*command), "```", ""]
    return "\n".join(page)


def test_the_commands_page_is_that_of_the_code():
    page = (DOCS / "cli.md").read_text(encoding="utf-8")
    assert page == commands_page(), "docs/cli.md is out of date: python -m tests.test_docs --write"


def test_the_options_page_is_that_of_the_code():
    page = (DOCS / "options.md").read_text(encoding="utf-8")
    assert page == options_page(), "docs/options.md is out of date: python -m tests.test_docs --write"


def test_every_setting_has_its_symbol():
    assert [name for name, _ in setting_names(Config())] == list(SYMBOLS)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_the_options_page_says_what_help_says(name, capsys, monkeypatch):
    """The same options, defaults and words, so that the page's own reading of the code is right."""
    monkeypatch.setenv("COLUMNS", "600")
    with pytest.raises(SystemExit):
        cli.main([name, "--help"])
    out = capsys.readouterr().out
    shown = " ".join(out.replace("│", " ").split())
    rows = list(options(cli.COMMANDS[name]))
    found = set(re.findall(r"^[ │]+(--[a-z][a-z-]*)", out, re.M))
    assert found == {option.split()[0] for option, _, _ in rows if option.startswith("--")}
    for option, default, text in rows:
        ending = {"required": " (required)", "off": " (default: False)", "repeatable": " (repeatable)"}
        assert f"{option} {text}{ending.get(default, f' (default: {default})')}" in shown, option
    assert "{None}" not in out


def test_settings_on_the_page_can_be_set():
    """What the tables print is what --set takes: each preset is the other one with the page's values."""
    ours, paper = PRESETS["default"], PRESETS["paper"]
    values = {name: json.loads(json.dumps(setting(paper, name))) for name in SYMBOLS}
    assert with_settings(ours, values) == paper


# docs/format.md


@pytest.fixture(scope="module")
def run(tmp_path_factory, one_torch_thread: None) -> Path:
    """A small run."""
    folder = tmp_path_factory.mktemp("docs")
    scene = write_demo(folder / "scene", width=48, height=36, views=10, points=200)
    changes = ("texture.levels=4", "texture.table_size=1024", "texture.width=16")
    flags = [x for change in changes for x in ("--set", change)]
    flags += ["--iterations", "5", "--max-surfels", "100", "--device", "cpu"]
    assert cli.main(["train", str(scene), "--run", str(folder / "run"), *flags]) == 0
    return folder / "run"


def section(title: str) -> str:
    """Text of docs/format.md below a heading, up to the next of its kind."""
    page = (DOCS / "format.md").read_text(encoding="utf-8")
    return page.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def named(text: str) -> list[str]:
    """First cells of a text's tables."""
    return re.findall(r"^\| `([^`]+)` \|", text, re.M)


def header(run: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    data = (run / "model.safetensors").read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    tensors = json.loads(data[8 : 8 + size])
    metadata = tensors.pop("__metadata__")
    assert set(metadata) == {"nexwarp"}
    return tensors, json.loads(metadata["nexwarp"])


def flat(data: dict[str, Any], *parts: str) -> set[str]:
    """Keys, those of the named parts with a dot."""
    inner = {f"{part}.{key}" for part in parts for key in data[part]}
    return {key for key in data if key not in parts} | inner


def test_files(run):
    listed = named((DOCS / "format.md").read_text(encoding="utf-8").split("\n## ", 1)[0])
    optional = {"tensorboard/", "camera_path_N.json", "export/", "diverged.json"}
    assert {f.name + "/" * f.is_dir() for f in run.iterdir()} == set(listed) - optional
    assert {f.name for f in (run / "checkpoint").iterdir()} == set(named(section("checkpoint/")))
    assert {f.name for f in (run / "renders").iterdir()} == {"test", "compare"}


def test_tensors(run):
    """Names, types and shapes of the table are those of the file."""
    tensors, meta = header(run)
    rows = re.findall(r"^\| `([a-z0-9A-Z_.]+)` \| (F\d\d) \| ([^|]+) \|", section("model.safetensors"), re.M)
    shape = meta["texture"]
    sizes = {"N": tensors["surfels.means"]["shape"][0], "C - 1": 15, "3": 3, "1": 1, "2": 2, "4": 4}
    sizes |= {
        "V": len(json.loads((run / "cameras.json").read_text())["train"]),
        "L": shape["levels"],
        "T": shape["table_size"],
        "F": shape["features"],
    }
    expected = {}
    for name, dtype, dimensions in rows:
        if ".I." in name:
            widths = [sizes["L"] * sizes["F"], *[shape["width"]] * shape["hidden_layers"], 48]
            for i, (inner, outer) in enumerate(itertools.pairwise(widths)):
                expected[name.replace("I", str(2 * i))] = (dtype, [outer, inner])
        else:
            expected[name] = (dtype, [sizes[d.strip()] for d in dimensions.split(",")])
    assert {name: (t["dtype"], t["shape"]) for name, t in tensors.items()} == expected


def test_metadata(run):
    _, meta = header(run)
    text = section("model.safetensors").split("a JSON object:", 1)[1]
    assert set(named(text)) == flat(meta, "texture")


def test_the_reader_draws_what_nexwarp_draws(run, tmp_path):
    """The document's program, executed: pixels of a test view, to rounding."""
    (program,) = re.findall(r"```python\n(.*?)```", section("model.safetensors"), re.S)
    reader: dict[str, Any] = {}
    exec(program, reader)
    cameras = json.loads((run / "cameras.json").read_text())["test"]
    name = next(iter(cameras))
    camera = load_cameras(run / "cameras.json")["test"][name]
    model = nw.load(run)
    texture = model.texture
    assert texture is not None
    others = list(load_cameras(run / "cameras.json")["train"].values())[:3]
    with torch.no_grad():  # more to be seen than after so few steps
        texture.grid.normal_(0, 2)
        model.surfels.log_scales.add_(0.7)
        model.surfels.raw_gammas.uniform_(-3, 1)
        model.surfels.logit_opacities.uniform_(-2, 5)
        model.surfels.shN.normal_(0, 0.2)
    count = len(model.surfels)
    model.detail_limits = DetailLimits(torch.rand(count) * 0.2, torch.rand(count) * 0.4)  # within, and beyond
    gains = torch.tensor([[0.2, 0.1, 0.0], [0.0, 0.3, 0.1], [0.1, 0.0, 0.4]])
    model.exposures = Exposures.of(gains, others, (-0.3, -0.4, 0.15))
    pixels = [(3, 5), (24, 18), (40, 30), (47, 0), (11, 27), (30, 9)]
    # As trained; with the texture in place of the plain colours; and with each option that a file may hold.
    for residual, changes in (
        (True, {}),
        (False, {}),
        (False, {"clamp_texture": True}),
        (True, {"max_hits": 1}),
        (True, {"max_hits": 0}),
        (True, {"exposure": "mean"}),
        (True, {"detail_limits": False}),
        (None, {}),  # without a texture
    ):
        if residual is None:
            model.texture = None
        else:
            texture.residual = texture.config["residual"] = residual
        model.options = nw.RenderOptions(background=(0.2, 0.5, 0.7)).changed(**changes)
        file = model.save(tmp_path)
        stored = nw.load(file)
        tensors, meta = reader["read"](file)
        drawn = np.array([reader["pixel"](tensors, meta, cameras[name], x, y) for x, y in pixels])
        plain = nw.Model(stored.surfels, None, stored.exposures, stored.detail_limits, stored.options)
        with torch.no_grad():
            images = [x.render(camera).image for x in (stored, plain)]
        expected, untextured = (np.array([x[row, column].tolist() for column, row in pixels]) for x in images)
        np.testing.assert_allclose(drawn, expected, atol=2e-4)
        assert (abs(expected - untextured).max() > 0.01) == (stored.options.max_hits > 0 and residual is not None)


def test_json_files(run):
    config = json.loads((run / "config.json").read_text())
    assert flat(config, "scene") == set(named(section("config.json")))
    assert flat(config["config"], "losses", "rates", "texture", "densify") == set(SYMBOLS)
    cameras = json.loads((run / "cameras.json").read_text())
    assert set(cameras) == {"train", "test"}
    for camera in [*cameras["train"].values(), *cameras["test"].values()]:
        assert set(camera) == set(named(section("cameras.json")))
    metrics = json.loads((run / "metrics.json").read_text())
    assert list(metrics) and set(metrics) == set(named(section("metrics.json")))
    for line in (run / "metrics.jsonl").read_text().splitlines():
        assert set(json.loads(line)) == set(named(section("metrics.jsonl")))


def test_checkpoint(run):
    data = (run / "checkpoint" / "tensors.safetensors").read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    groups = {name.split(".")[0] for name in json.loads(data[8 : 8 + size]) if name != "__metadata__"}
    assert groups == set(re.findall(r"`(\w+)\.\*`", section("checkpoint/")))


# docs/paper.md, docs/migrating.md, the README, and commands on any page

ROOT = DOCS.parent
PAGES = [*sorted(DOCS.glob("*.md")), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]


def commands(page: Path) -> list[list[str]]:
    """Arguments of every nexwarp command in a page's indented blocks."""
    pattern = rf"\bnexwarp ((?:{'|'.join(cli.COMMANDS)})\b[^#;\n]*)"
    blocks = re.findall(r"^    .*$", page.read_text(encoding="utf-8"), re.M)
    return [shlex.split(command) for line in blocks for command in re.findall(pattern, line)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_can_be_typed(page, monkeypatch):
    """Every command is understood, and every setting of a training exists and takes its value."""
    understood = []
    for command in cli.COMMANDS.values():
        monkeypatch.setattr(command, "__call__", lambda self, console: understood.append(self))
    for arguments in commands(page):
        assert cli.main(arguments) == 0, arguments
        command = understood.pop()
        if isinstance(command, Train):
            config = dataclasses.replace(command, resume=False)._config(Path("nowhere"))
            assert config.preset == command.preset


def test_the_paper_page_has_commands_for_all_scenes():
    page = (DOCS / "paper.md").read_text(encoding="utf-8")
    scenes = " ".join(re.findall(r"for s in ([^;]+);", page)).split() + re.findall(r"data/custom/(\w+) ", page)
    assert len(scenes) == len(set(scenes)) == 15
    typed = commands(DOCS / "paper.md")
    assert len(typed) == 12 and all("--preset" in arguments for arguments in typed)


def test_the_paper_page_lists_all_that_differs():
    page = (DOCS / "paper.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `([a-z_.]+)` \|", page, re.M)
    ours, paper = preset("default"), preset("paper")
    differ = {name for name in SYMBOLS if setting(ours, name) != setting(paper, name)} - {"preset"}
    assert set(listed) == differ and len(listed) == len(differ)


def test_examples(run, tmp_path, monkeypatch, capsys):
    """The Python in the pages runs as it stands."""
    (tmp_path / "runs" / "one").mkdir(parents=True)
    shutil.copy(run / "metrics.json", tmp_path / "runs" / "one")
    monkeypatch.chdir(tmp_path)
    (means,) = re.findall(r"```python\n(.*?)```", (DOCS / "paper.md").read_text(encoding="utf-8"), re.S)
    exec(means, {})
    metrics = json.loads((run / "metrics.json").read_text())
    assert capsys.readouterr().out == f"{ {key: metrics[key] for key in ('psnr', 'ssim', 'megabytes', 'seconds')} }\n"
    (example,) = re.findall(r"```python\n(.*?)```", (DOCS / "migrating.md").read_text(encoding="utf-8"), re.S)
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["image"].shape == (200, 300, 3) and names["image"].max() > 0.1


def test_the_readme_s_python_runs(run, tmp_path, monkeypatch, capsys):
    """As it stands, where a run of the demo is."""
    shutil.copytree(run, tmp_path / "runs" / "demo")
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    assert len([line for line in example.splitlines() if line]) <= 12
    names: dict[str, Any] = {}
    exec(example, names)
    shapes = "torch.Size([36, 48, 3]) torch.Size([36, 48]) torch.Size([36, 48, 3]) torch.Size([36, 48])"
    assert capsys.readouterr().out.splitlines()[0] == shapes
    assert names["model"].surfels.means.grad.norm() > 0


def test_the_depth_page_s_python_runs(run, tmp_path, monkeypatch):
    """It reads what its command writes."""
    shutil.copytree(run, tmp_path / "runs" / "demo")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["render", "runs/demo", "--set", "test", "--buffers"]) == 0
    (example,) = re.findall(r"```python\n(.*?)```", (DOCS / "depth.md").read_text(encoding="utf-8"), re.S)
    exec(example, {})


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1000


def test_pages_are_in_the_site_s_navigation():
    """Each page of docs/ is there, and each is reached from the first page."""
    listed = set(re.findall(r"^ +- [^:]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M))
    pages = {page.name for page in DOCS.glob("*.md")}
    assert pages <= listed
    first = (DOCS / "index.md").read_text(encoding="utf-8")
    assert pages - {"index.md"} <= set(re.findall(r"\]\(([a-z_]+\.md)", first))


def test_the_api_page_has_every_public_name():
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: nexwarp\.(\w+)$", page, re.M)) == sorted(set(nw.__all__) - {"__version__"})


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs the extra docs")
def test_the_site_builds(tmp_path):
    """All links and anchors between pages lead somewhere, and all names of the API are found."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "paper Eq. 6" in (tmp_path / "site" / "method" / "index.html").read_text(encoding="utf-8")


def test_links():
    """Every link from one document to another leads somewhere."""
    for page in PAGES:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def main(arguments: list[str]) -> int:
    """Write docs/options.md and docs/cli.md."""
    if arguments != ["--write"]:
        print("usage: python -m tests.test_docs --write", file=sys.stderr)
        return 2
    (DOCS / "options.md").write_text(options_page(), encoding="utf-8")
    (DOCS / "cli.md").write_text(commands_page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
