"""Trials on validation views: one process a scene, rows in the order of their value, each result written at once.

    python -m benchmarks.trials SCENE DOWNSCALE SIZE ITERATIONS SECONDS DATA OUT ROWS.json

ROWS.json: a list of [name, settings, seed, size factor].
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import torch

from benchmarks.quality.jobs import TrainingJob
from benchmarks.quality.metrics import train_psnr
from benchmarks.quality.scenes import scene_of
from nexwarp.io.pictures import to_uint8
from nexwarp.run.evaluate import METRICS
from nexwarp.run.fit_poses import fit_poses
from nexwarp.train.presets import preset
from nexwarp.train.settings import with_settings
from nexwarp.train.trainer import Trainer


def mean(values):
    values = [v for v in values]
    return sum(values) / len(values)


@torch.no_grad()
def shares(model, views):
    """Return the share of the squared error in the outer 5 % of the frame, and where alpha is below 0.7."""
    border = low = total = pixels = 0.0
    for view in views:
        out = model.render(view.camera)
        error = (out.image.clamp(0, 1).cpu() - view.image / 255).square().mean(-1)
        height, width = error.shape
        edge = torch.ones_like(error)
        edge[height // 20 : -(height // 20), width // 20 : -(width // 20)] = 0
        thin = (out.alpha.cpu() < 0.7).float()
        border, low = border + (error * edge).sum().item(), low + (error * thin).sum().item()
        total, pixels = total + error.sum().item(), pixels + thin.mean().item() / len(views)
    return round(border / total, 3), round(low / total, 3), round(pixels, 3)


def main():
    name, downscale, size, iterations, seconds, data, out, rows = sys.argv[1:9]
    end = time.time() + float(seconds)
    job = TrainingJob(name, "inner", "trial", int(size), 0, int(iterations), int(downscale))
    scene = scene_of(job, Path(data))
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    took = 0.0
    for row, settings, seed, factor in json.loads(Path(rows).read_text()):
        if time.time() + 0.8 * took > end:
            break
        start = time.time()
        try:
            torch.cuda.empty_cache()
            config = with_settings(preset("default"), settings)
            config = dataclasses.replace(
                config, max_surfels=int(int(size) * factor), seed=seed, iterations=config.iterations * int(iterations) // 30000
            )
            trainer = Trainer(scene, config, device)
            trainer.run()
            model = trainer.finish()
            steps = time.time() - start
            images = [(to_uint8(model.render(view.camera).image.detach()).cpu(), to_uint8(view.image)) for view in scene.test]
            figures = {m: mean(METRICS[m](a, b, None) for a, b in images) for m in ("psnr", "ssim", "flip")}
            facts = {"train": train_psnr(scene, lambda camera: model.render(camera).image), "n": len(model.surfels)}
            if row == "default" and factor == 1:
                facts["shares"] = shares(model, scene.test)
                moved, _ = fit_poses(model, scene.test[:6], steps=60)
                fitted = [(to_uint8(model.render(v.camera).image.detach()).cpu(), to_uint8(v.image)) for v in moved]
                facts["poses"] = [mean(METRICS["psnr"](a, b, None) for a, b in x) for x in (images[:6], fitted)]
            took = time.time() - start
            line = {"scene": name, "row": row, "seed": seed, "factor": factor, **figures, **facts, "s": round(steps, 1)}
            line |= {"took": round(took, 1), "downscale": int(downscale), "iterations": int(iterations), "settings": settings}
        except Exception as error:
            line = {"scene": name, "row": row, "seed": seed, "factor": factor, "error": f"{type(error).__name__}: {error}"[:200]}
        with open(out, "a") as file:
            file.write(json.dumps(line) + "\n")
        del line


main()
