"""Makes a run with an old version of nexwarp: `python make.py TREE SCENE RUN [OPTION...]`, TREE being its checkout.

The run is tiny: 24 surfels, 6 iterations, a texture of 2 levels. Of its checkpoints the one before the last is kept, so
that a resumed training has a step to do; since 2026-11-29 that needs the option `--checkpoint-every 1`. `picture.npy`
is the old version's rendering of the first test view, float32.
"""

import importlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch


def first_of(tree: str, *names: str) -> Any:
    """Import the first module that the version has."""
    return importlib.import_module(next(x for x in names if Path(tree, f"{x.replace('.', '/')}.py").is_file()))


def main(tree: str, scene: str, run: str, *options: str) -> None:
    sys.path.insert(0, tree)
    torch.set_num_threads(1)
    config = first_of(tree, "nexwarp.train.recipe", "nexwarp.train.config", "nexwarp.config", "nexwarp.trainer")
    presets = first_of(tree, "nexwarp.train.recipe", "nexwarp.train.presets", "nexwarp.config", "nexwarp.trainer")
    densify = first_of(tree, "nexwarp.train.recipe", "nexwarp.train.densify", "nexwarp.densify")
    evaluate = first_of(tree, "nexwarp.run.evaluate", "nexwarp.evaluate")
    cli = first_of(tree, "nexwarp.cli.main", "nexwarp.cli")
    texture = config.TextureConfig(levels=2, table_size=2**6, width=8)
    presets.PRESETS["default"] = config.Config(texture=texture, densify=densify.DensifyConfig(every=3), sh_degree=1)
    pictures, to_uint8 = [], evaluate.to_uint8

    def record(image: torch.Tensor) -> torch.Tensor:
        pictures.append(image)
        return to_uint8(image)

    evaluate.to_uint8 = record
    flags = ["--iterations", "6", "--max-surfels", "24", "--device", "cpu"]
    assert cli.main(["train", scene, "--run", run, *flags, *options]) == 0
    folder = Path(run)
    np.save(folder / "picture.npy", pictures[0].numpy().astype(np.float32))
    shutil.rmtree(folder / "renders")
    settings = json.loads((folder / "config.json").read_text())
    settings["scene"]["path"] = "/scene"
    (folder / "config.json").write_text(json.dumps(settings, indent=2) + "\n")
    if (folder / "checkpoint.old").exists():
        shutil.rmtree(folder / "checkpoint")
        (folder / "checkpoint.old").rename(folder / "checkpoint")


main(*sys.argv[1:])
