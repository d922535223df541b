"""`nexwarp eval`."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Run_, option
from nexwarp.data import Scene
from nexwarp.errors import SceneError
from nexwarp.io.json_files import write_json
from nexwarp.model.model import Model
from nexwarp.model.model_file import load
from nexwarp.run.evaluate import evaluate
from nexwarp.run.folder import (
    METRICS_FILE,
    read_metrics,
    read_run,
)


@dataclass
class Eval:
    """Evaluate a run on the test views of its scene."""

    run: Run_
    """Run folder."""
    scene: Annotated[str | None, option("SCENE", "where it was trained from")] = None
    """Folder of the scene, if it moved."""
    metrics: Annotated[tuple[str, ...], option("{psnr,ssim,flip,lpips} ...", "psnr ssim")] = ("psnr", "ssim")
    """Figures to give; flip and lpips need the extras `flip` and `lpips`."""
    device: Device_ = None
    """Where to compute."""

    def __call__(self, console: Console) -> None:
        """Evaluate."""
        device = pick_device(self.device)
        source, config, _ = read_run(self.run)
        model = load(self.run).to(device)
        if self.scene is not None:
            source = dataclasses.replace(source, path=self.scene)
        with display.loading(console) as progress:
            scene = source.load(progress)
        options = {"mask_mode": config.mask_mode, "metrics": self.metrics}
        rows = figures(evaluate_run(model, scene, self.run, console, options), self.metrics)
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views"))


def figures(results: dict[str, Any], metrics: Sequence[str] = ("psnr", "ssim")) -> dict[str, str]:
    """Rows of a table: the metrics of the test views."""
    shown = {name: "not available" if results[name] is None else f"{results[name]:.4f}" for name in metrics}
    if "psnr" in shown:
        shown["psnr"] = f"{results['psnr']:.2f} dB"
    return {f"test {name.upper()}": value for name, value in shown.items()}


def evaluate_run(
    model: Model,
    scene: Scene,
    run: Path,
    console: Console,
    options: dict[str, Any],
    facts: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Evaluate a model on its test views and write metrics.json, keeping the facts that an older one holds."""
    if not scene.test:
        raise SceneError(f"{scene.path}: expected test views, found none")
    with display.counting(console, "evaluating", len(scene.test)) as done:
        results = evaluate(
            model,
            scene.test,
            renders=run / "renders",
            progress=done,
            **options,
        )
    metrics = {**(read_metrics(run) if facts is None else facts), **results}
    write_json(run / METRICS_FILE, metrics)
    return metrics
