"""`nexwarp eval`."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, cast

from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Flag_, Run_, option
from nexwarp.data import View
from nexwarp.data.scene import SceneSource
from nexwarp.errors import MissingError, SceneError
from nexwarp.io.json_files import Json, write_json
from nexwarp.model.model import Model
from nexwarp.run.evaluate import check_metrics, evaluate
from nexwarp.run.fit_poses import fit_poses
from nexwarp.run.folder import METRICS_FILE, RENDERS_FOLDER, locked_run, read_metrics
from nexwarp.run.opened import OpenedModel, open_model
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import MASK_MODES


@dataclass
class Eval:
    """Evaluate a run on the test views of its scene, or a model on those of --scene."""

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    scene: Annotated[str | None, option("SCENE", "the folder of the training")] = None
    """Folder of the scene, if it has moved; required for a model alone."""
    metrics: Annotated[tuple[str, ...], option("{psnr,ssim,flip,lpips} ...", "psnr ssim")] = ("psnr", "ssim")
    """Metrics to compute; flip needs the extra `flip`, lpips a file of weights (docs/quality.md)."""
    refine_poses: Flag_ = False
    """Fit each test pose to its photo before it is judged, the model fixed; metrics.json says so."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Evaluate."""
        device = pick_device(self.device)
        check_metrics(self.metrics, device)
        opened = open_model(self.run)  # before a lock is written to a foreign folder
        source = self._source(opened)
        opened.folder.mkdir(exist_ok=True)
        with locked_run(opened.folder, partial(display.warn, console)):
            opened = open_model(self.run)  # another process may have changed it
            model = opened.model.to(device)
            with display.loading(console) as progress:
                scene = source.load(progress)
            if not scene.test:
                raise SceneError(f"{scene.path}: expected test views, found none")
            views = scene.test
            facts = read_metrics(opened.folder)
            facts.pop("test_poses", None)  # of an earlier evaluation
            if self.refine_poses:
                with display.counting(console, "fitting test poses", len(views)) as done:
                    views, moves = fit_poses(model, views, progress=done)
                facts["test_poses"] = {**moves}
            mask_mode = MASK_MODES[0] if opened.config is None else opened.config.mask_mode
            results = evaluate_run(
                model, views, opened.folder, console, facts, mask_mode=mask_mode, metrics=self.metrics
            )
        rows = figures(results, self.metrics)
        fitted = ", poses fitted to their photos" if self.refine_poses else ""
        console.print(display.results_table(rows, f"{source.name}: {len(scene.test)} test views{fitted}"))

    def _source(self, opened: OpenedModel) -> SceneSource:
        """Return the scene to evaluate on."""
        if opened.source is not None:
            return opened.source if self.scene is None else dataclasses.replace(opened.source, path=self.scene)
        if self.scene is None:
            raise MissingError(
                f"{self.run}: expected the photos to compare with, got a model alone; give --scene SCENE"
            )
        return SceneSource(self.scene)


def figures(results: Mapping[str, Json], metrics: Sequence[str] = ("psnr", "ssim")) -> dict[str, str]:
    """Return test metrics as rows of a table."""
    rows = {}
    for name in metrics:
        value = results[name]
        if name == "psnr":
            text = f"{math.inf if value is None else value:.2f} dB"
        else:
            text = "not available" if value is None else f"{value:.4f}"
        rows[f"test {name.upper()}"] = text
    return rows


def evaluate_run(
    model: Model,
    views: Sequence[View],
    run: Path,
    console: Console,
    facts: dict[str, Json],
    *,
    mask_mode: str,
    metrics: Sequence[str] = ("psnr", "ssim"),
    ranks: Ranks | None = None,
) -> dict[str, Json]:
    """Evaluate a model on test views and write metrics.json with `facts`; return its entries. See `evaluate`."""
    renders = run / RENDERS_FOLDER
    with display.counting(console, "evaluating", len(views)) as done:
        results = evaluate(
            model, views, renders=renders, mask_mode=mask_mode, metrics=metrics, progress=done, ranks=ranks
        )
    entries = facts | cast(dict[str, Json], results)
    write_json(run / METRICS_FILE, _finite(entries))
    return entries


def _finite(value: Json) -> Json:
    """Return JSON with null for infinity, which JSON does not have: the PSNR of equal pictures."""
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
