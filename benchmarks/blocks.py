"""Two blocks of the demo, trained apart, merged and refined at the seam, against one training of as many surfels.

    python -m benchmarks.blocks --device cuda

Prints the PSNR of all test views, and of those of their pixels that show what is close to the seam, and how many views
each training saw.
"""

import copy
import dataclasses
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
import warp as wp

from benchmarks.timing import git_commit
from nexwarp.cameras.camera import Camera
from nexwarp.data import Scene, demo_folder, load_scene
from nexwarp.model.model import Model
from nexwarp.train.blocks import CONTEXT, BlockTrainer, block_scene, merge_blocks, split_space
from nexwarp.train.config import Config
from nexwarp.train.presets import DEMO_SETTINGS, preset
from nexwarp.train.seams import BAND, SeamTrainer
from nexwarp.train.settings import parse_settings, with_settings
from nexwarp.train.trainer import Trainer
from nexwarp.train.views import mean_color

CLOSE = 0.1  # of the scene's scale, around the seam


@dataclass(frozen=True)
class Blocks:
    """Train blocks apart and merge them."""

    scene: str = "demo"
    """Folder of a scene whose photos have one exposure, or `demo`."""
    surfels: int = 3000
    """Number of surfels of all blocks together, without their contexts."""
    count: int = 2
    """Number of blocks."""
    budget: float = 1.4
    """Budget of a block with its overlap and context, in units of its share of the surfels."""
    overlap: float = 0.1
    """How far a block reaches beyond its cell, in units of the scene's scale."""
    context: float = CONTEXT
    """Share of the points outside of a block that it starts from."""
    refine: float = 0.4
    """Views of the refinement at the seams, in units of those of a training; 0 merges finished blocks, no more."""
    band: float = BAND
    """How far from a seam the refinement trains surfels, in units of the scene's scale."""
    margin: float = 0.0
    """How far a block's surfels beyond its cell are kept, in units of the scene's scale."""
    device: str = "cpu"
    """Device: cuda or cpu."""
    settings: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set")] = ()
    """Further settings, KEY=VALUE."""
    out: Path | None = None
    """Folder for the models."""


def main(arguments: list[str] | None = None) -> int:
    options = tyro.cli(Blocks, args=arguments, description=__doc__)
    wp.config.log_level = wp.LOG_ERROR
    scene = load_scene(demo_folder() if options.scene == "demo" else options.scene)
    config = with_settings(preset("default"), DEMO_SETTINGS if options.scene == "demo" else {})
    # One background and no exposures, so that blocks agree.
    config = dataclasses.replace(config, exposures=False, background=mean_color(scene.train))
    config = with_settings(config, parse_settings(options.settings))
    cells = split_space(scene.points, options.count)
    models, seconds = [], []
    for cell in cells:
        start = time.perf_counter()
        models.append(train_block(scene, config, cell, options))
        seconds.append(round(time.perf_counter() - start, 1))
    merged = merge_blocks(models, cells, margin=options.margin * scene.scale)
    compared = {"merged": merged}
    start, views = time.perf_counter(), [config.iterations] * options.count
    if options.refine:
        views.append(round(options.refine * config.iterations))
        refinement = dataclasses.replace(config, iterations=views[-1])
        trainer = SeamTrainer(scene, copy.deepcopy(merged), refinement, band=options.band)
        trainer.run()
        compared["refined"] = trainer.finish()
    seconds.append(round(time.perf_counter() - start, 1))
    whole = Trainer(scene, dataclasses.replace(config, max_surfels=len(merged.surfels)), options.device)
    whole.run()
    alone = compared["one training"] = whole.finish()
    facts: dict[str, object] = {
        "cells": cells.tolist(),
        "surfels of blocks": [len(model.surfels) for model in models],
        "surfels": [len(merged.surfels), len(alone.surfels)],
        "views of blocks and refinement": views,
        "seconds of blocks and refinement": seconds,
        "commit": git_commit(),
    }
    for name, model in compared.items():
        everywhere, seam = psnrs(model, alone, scene, cells)
        facts[name] = {"psnr": round(everywhere, 3), "psnr at the seam": round(seam, 3)}
        if options.out is not None:
            model.save(options.out / f"{name.replace(' ', '_')}.safetensors")
    print(json.dumps(facts))
    return 0


def train_block(scene: Scene, config: Config, cell: torch.Tensor, options: Blocks) -> Model:
    budget = round(options.budget * options.surfels / options.count)
    part = block_scene(scene, cell, overlap=options.overlap, context=options.context)
    config = dataclasses.replace(config, max_surfels=budget)
    trainer = BlockTrainer(part, config, options.device, cell, overlap=options.overlap)
    trainer.run()
    return trainer.model() if options.refine else trainer.finish()


@torch.no_grad()
def psnrs(model: Model, reference: Model, scene: Scene, cells: torch.Tensor) -> tuple[float, float]:
    """Return the mean PSNR of the test views, and that of their pixels close to the seam, dB.

    Args:
        model: to be measured.
        reference: whose depths tell which pixels show what is close to the seam.
        scene: whose test views count.
        cells: of the blocks.
    """
    whole, near = [], []
    for view in scene.test:
        photo = view.image.float() / 255
        image = (model.render(view.camera).image.clamp(0, 1) * 255).round().cpu() / 255
        errors = (image - photo).square().mean(dim=-1)
        whole.append(-10 * math.log10(errors.mean().item()))
        close = seam_pixels(reference, view.camera, cells, CLOSE * scene.scale)
        if close.any():
            near.append(-10 * math.log10(errors[close].mean().item()))
    return sum(whole) / len(whole), sum(near) / max(len(near), 1)


def seam_pixels(model: Model, camera: Camera, cells: torch.Tensor, band: float) -> torch.Tensor:
    """Return (H, W) bool: pixels whose surface is within `band` world units of a side between cells."""
    depths = model.render(camera).median_depth.cpu()
    rows, columns = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    local = torch.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, torch.ones_like(rows)], -1)
    viewmat = camera.viewmat.cpu()
    places = ((local * depths[..., None]) - viewmat[:3, 3]) @ viewmat[:3, :3]
    close = torch.zeros_like(depths, dtype=torch.bool)
    for cell in cells:
        for axis in range(3):
            for side in cell[:, axis].tolist():
                close |= (places[..., axis] - side).abs() < band
    return close & (depths > 0)


if __name__ == "__main__":
    sys.exit(main())
