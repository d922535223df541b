"""`nexwarp eval`."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Run_, option
from nexwarp.data import Scene
from nexwarp.errors import SceneError
from nexwarp.io.json_files import Json, write_json
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
        results = evaluate_run(model, scene, self.run, console, mask_mode=config.mask_mode, metrics=self.metrics)
        rows = figures(results, self.metrics)
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views"))


def figures(results: Mapping[str, Json], metrics: Sequence[str] = ("psnr", "ssim")) -> dict[str, str]:
    """Rows of a table: the metrics of the test views."""
    rows = {}
    for name in metrics:
        value = results[name]
        text = f"{value:.2f} dB" if name == "psnr" else f"{value:.4f}" if value is not None else "not available"
        rows[f"test {name.upper()}"] = text
    return rows


def evaluate_run(
    model: Model,
    scene: Scene,
    run: Path,
    console: Console,
    *,
    mask_mode: str,
    metrics: Sequence[str] = ("psnr", "ssim"),
    facts: dict[str, Json] | None = None,
) -> dict[str, Json]:
    """Evaluate a model on its test views and write metrics.json.

    Args:
        model: on the device to render on.
        scene: its photos.
        run: run folder.
        console: where to show the progress.
        mask_mode: as `evaluate` takes it.
        metrics: as `evaluate` takes them.
        facts: what the file says beside the metrics; None keeps what an older file says.

    Returns:
        What the file holds.
    """
    if not scene.test:
        raise SceneError(f"{scene.path}: expected test views, found none")
    with display.counting(console, "evaluating", len(scene.test)) as done:
        results = evaluate(
            model, scene.test, renders=run / "renders", mask_mode=mask_mode, metrics=metrics, progress=done
        )
    whole: dict[str, Json] = {**(read_metrics(run) if facts is None else facts)}
    whole |= cast(dict[str, Json], results)
    write_json(run / METRICS_FILE, whole)
    return whole
