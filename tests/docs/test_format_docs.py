import itertools
import json
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from docs.generate import DOCS
from examples import read_model
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cli import main as cli
from nexwarp.train.recipe import setting_names
from tests.cli.support import FLAGS, read
from tests.scene_writers import expose_photos, write_demo


@pytest.fixture(scope="module")
def run(small_preset, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    scene = write_demo(folder / "scene", width=48, height=36, views=10, points=200)
    expose_photos(scene)
    assert cli.main(["train", str(scene), "--run", str(folder / "run"), *FLAGS]) == 0
    return folder / "run"


def section(title: str) -> str:
    """Text of docs/format.md below a heading, up to the next of its kind."""
    page = (DOCS / "format.md").read_text(encoding="utf-8")
    return page.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def named(text: str) -> set[str]:
    """First cells of a text's tables."""
    return set(re.findall(r"^\| `([^`]+)` \|", text, re.M))


def header_of(file: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """What a safetensors file says of its tensors, and its metadata."""
    data = file.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    tensors = json.loads(data[8 : 8 + size])
    return tensors, tensors.pop("__metadata__", {})


def flat(data: dict[str, Any], *parts: str) -> set[str]:
    """Keys, those of the named parts with a dot."""
    return {key for key in data if key not in parts} | {f"{part}.{key}" for part in parts for key in data[part]}


def test_files(run):
    listed = named((DOCS / "format.md").read_text(encoding="utf-8").split("\n## ", 1)[0])
    optional = {"tensorboard/", "camera_path_N.json", "edit.json", "export/", "teachers/N/"}
    assert {f.name + "/" * f.is_dir() for f in run.iterdir()} == listed - optional
    assert {f.name for f in (run / "checkpoint").iterdir()} == named(section("checkpoint/"))
    assert {f.name for f in (run / "renders").iterdir()} == {"test", "compare"}
    config, cameras = read(run, "config.json"), read(run, "cameras.json")
    assert flat(config, "scene") == named(section("config.json"))
    assert flat(config["config"], "losses", "rates", "texture", "densify") == set(setting_names())
    assert set(cameras) == {"train", "test"}
    for camera in [*cameras["train"].values(), *cameras["test"].values()]:
        assert set(camera) == named(section("cameras.json"))
    assert set(read(run, "metrics.json")) == named(section("metrics.json"))
    for line in (run / "metrics.jsonl").read_text().splitlines():
        assert set(json.loads(line)) == named(section("metrics.jsonl"))
    groups = {name.split(".")[0] for name in header_of(run / "checkpoint" / "tensors.safetensors")[0]}
    assert groups == set(re.findall(r"`(\w+)\.\*`", section("checkpoint/")))


def test_tensors(run):
    """Names, types and shapes of the table are those of the file, and the keys of its metadata."""
    tensors, metadata = header_of(run / "model.safetensors")
    assert set(metadata) == {"nexwarp"}
    meta = json.loads(metadata["nexwarp"])
    text, shape = section("model.safetensors"), meta["texture"]
    sizes = {"N": tensors["surfels.means"]["shape"][0], "C - 1": 15, "V": len(read(run, "cameras.json")["train"])}
    sizes |= {"L": shape["levels"], "T": shape["table_size"], "F": shape["features"]}
    expected = {}
    for name, dtype, dimensions in re.findall(r"^\| `([a-z0-9A-Z_.]+)` \| (F\d\d) \| ([^|]+) \|", text, re.M):
        if ".I." in name:
            widths = [sizes["L"] * sizes["F"], *[shape["width"]] * shape["hidden_layers"], 48]
            for i, (inner, outer) in enumerate(itertools.pairwise(widths)):
                expected[name.replace("I", str(2 * i))] = (dtype, [outer, inner])
        else:
            wanted = [d.strip() for d in dimensions.split(",")]
            expected[name] = (dtype, [int(d) if d.isdigit() else sizes[d] for d in wanted])
    assert {name: (t["dtype"], t["shape"]) for name, t in tensors.items()} == expected
    linear = {"white"}  # of photos of linear light alone
    assert named(text.split("a JSON object:", 1)[1]) - linear == flat(meta, "texture")


def test_the_reader_draws_what_nexwarp_draws(run, tmp_path):
    """The program of examples/, executed: pixels of a test view, to rounding."""
    cameras = read(run, "cameras.json")["test"]
    name = next(iter(cameras))
    camera = load_cameras(run / "cameras.json")["test"][name]
    model = nw.load(run)
    texture = model.texture
    assert isinstance(texture, nw.NeuralTexture)
    others = list(load_cameras(run / "cameras.json")["train"].values())[:3]
    with torch.no_grad():  # more to be seen than after so few steps
        texture.grid.normal_(0, 2)
        model.surfels.log_scales.add_(0.7)
        model.surfels.raw_gammas.uniform_(-3, 1)
        model.surfels.logit_opacities.uniform_(-2, 5)
        model.surfels.shN.normal_(0, 0.2)
    count = len(model.surfels)
    model.detail_limits = nw.DetailLimits(torch.rand(count) * 0.2, torch.rand(count) * 0.4)  # within, and beyond
    gains = torch.tensor([[0.2, 0.1, 0.0], [0.0, 0.3, 0.1], [0.1, 0.0, 0.4]])
    model.exposures = nw.Exposures.of(gains, others, (-0.3, -0.4, 0.15))
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
        (True, {"order": "distance"}),
        (True, {"sh_degree": 1}),
        (None, {}),  # without a texture
    ):
        if residual is None:
            model.texture = None
        else:
            texture.residual = texture.config["residual"] = residual
        model.options = nw.RenderOptions(background=(0.2, 0.5, 0.7)).changed(**changes)
        file = model.save(tmp_path)
        stored = nw.load(file)
        tensors, meta = read_model.read(file)
        drawn = np.array([read_model.pixel(tensors, meta, cameras[name], x, y) for x, y in pixels])
        plain = nw.Model(stored.surfels, None, stored.exposures, stored.detail_limits, stored.options)
        with torch.no_grad():
            images = [x.render(camera).image for x in (stored, plain)]
        expected, untextured = (np.array([x[row, column].tolist() for column, row in pixels]) for x in images)
        np.testing.assert_allclose(drawn, expected, atol=2e-4)
        assert (abs(expected - untextured).max() > 0.01) == (stored.options.max_hits > 0 and residual is not None)


# The Python of docs/paper.md, docs/migrating.md, docs/depth.md and the README


@pytest.fixture
def execute(run, tmp_path, monkeypatch) -> Callable[[str], list[dict[str, Any]]]:
    """What executes the examples of a page in a folder with a run, runs/demo, and returns their names."""
    shutil.copytree(run, tmp_path / "runs" / "demo")
    monkeypatch.chdir(tmp_path)

    def executed(page: str) -> list[dict[str, Any]]:
        examples: list[dict[str, Any]] = []
        for text in re.findall(r"```python\n(.*?)```", (DOCS.parent / page).read_text(encoding="utf-8"), re.S):
            examples.append({"lines": len([line for line in text.splitlines() if line])})
            exec(text, examples[-1])
        return examples

    return executed


def test_the_migrating_page_s_python_runs(execute):
    (names,) = execute("docs/migrating.md")
    assert names["image"].shape == (200, 300, 3) and names["image"].max() > 0.1


def test_the_readme_s_python_runs(execute, capsys):
    (names,) = execute("README.md")
    assert names["lines"] <= 12
    shapes = "torch.Size([36, 48, 3]) torch.Size([36, 48]) torch.Size([36, 48, 3]) torch.Size([36, 48])"
    assert capsys.readouterr().out.splitlines()[0] == shapes and names["model"].surfels.means.grad.norm() > 0


def test_the_depth_page_s_python_runs(execute):
    assert cli.main(["render", "runs/demo", "--set", "test", "--buffers"]) == 0
    assert len(execute("docs/depth.md")) == 1
