"""Level of detail: PSNR of a run's test views against the share of its surfels, as a table and a picture.

Usage: `python -m benchmarks.detail RUN [--out FILE.png]`. The run's model must hold its surfels in the order of their
share of the training pictures, as finished trainings since 0.3 do.
"""

import argparse
import datetime
import platform
from pathlib import Path
from statistics import fmean

import torch

from nexwarp.data import Scene
from nexwarp.model.detail import pick_surfels, surfel_count, texture_levels
from nexwarp.model.model import Model
from nexwarp.run.folder import read_run
from nexwarp.run.metrics import psnr
from nexwarp.run.opened import open_model

SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)


@torch.no_grad()
def mean_psnr(model: Model, scene: Scene) -> float:
    """Return the mean PSNR of the test views in dB."""
    return fmean(psnr(model.render(view.camera).image.cpu(), view.image) for view in scene.test)


def measure(model: Model, scene: Scene) -> list[tuple[float, int, int, float, float]]:
    """Return share, surfels, levels, PSNR by order and PSNR of as many random surfels with the whole texture."""
    rows = []
    count = len(model.surfels)
    shuffled = torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(model.device)
    for share in SHARES:
        kept = surfel_count(share, count)
        levels = 0 if model.texture is None else texture_levels(share, len(model.texture.resolutions))
        best = mean_psnr(model.at_detail(share), scene)
        rows.append((share, kept, levels, best, mean_psnr(pick_surfels(model, shuffled[:kept]), scene)))
    return rows


def draw(rows: list[tuple[float, int, int, float, float]], file: Path) -> None:
    """Draw the table as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.0, 3.2), layout="constrained")
    shares = [100.0 * row[0] for row in rows]
    axis.plot(shares, [row[3] for row in rows], "o-", label="largest share of the pictures first")
    axis.plot(shares, [row[4] for row in rows], "s--", color="0.5", label="as many random surfels, whole texture")
    axis.set(xlabel="surfels [%]", ylabel="PSNR of the test views [dB]", xscale="log")
    axis.set_xticks(shares, [f"{share:g}" for share in shares])
    axis.minorticks_off()
    axis.grid(alpha=0.25)
    axis.legend(loc="upper left")
    figure.savefig(file, dpi=110)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--out", type=Path, help="picture to write")
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    scene, model = read_run(options.run)[0].load(), open_model(options.run).model.to(device)
    rows = measure(model, scene)
    print(f"{options.run.name}, {platform.machine()}, {device.type}, {datetime.date.today()}")
    print("| share | surfels | texture levels | PSNR [dB] | random surfels [dB] |\n|---|---|---|---|---|")
    for share, kept, levels, best, chance in rows:
        print(f"| {share:.0%} | {kept:,} | {levels} | {best:.2f} | {chance:.2f} |")
    if options.out is not None:
        draw(rows, options.out)


if __name__ == "__main__":
    main()
