"""Figures of the notebooks: rows of pictures with titles and colour bars, and plots, each with its origin below it."""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from benchmarks.timing import device_name

WIDTH = 9.6  # of a figure, inches

plt.rcParams.update(
    {
        "figure.dpi": 100,
        "figure.constrained_layout.use": True,
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "image.interpolation": "nearest",
        "legend.frameon": False,
    }
)


@dataclass(frozen=True)
class ImagePanel:
    """One picture of a figure: RGB without a colour bar, or numbers with a colour map."""

    title: str
    values: np.ndarray
    cmap: str | None = None
    norm: Normalize | None = None


def colour(title: str, image: torch.Tensor) -> ImagePanel:
    """An (H, W, 3) image, uint8 or float, limited to [0, 1]."""
    image = image.detach().cpu()
    return ImagePanel(title, image.numpy() if image.dtype == torch.uint8 else image.clamp(0, 1).numpy())


def scalar(title: str, values: torch.Tensor, low: float | None = None, high: float | None = None) -> ImagePanel:
    """(H, W) numbers, dark to bright; NaN is white."""
    return ImagePanel(title, values.detach().cpu().numpy(), "viridis", Normalize(low, high))


def logarithmic(title: str, values: torch.Tensor, low: float, high: float) -> ImagePanel:
    """(H, W) numbers on a logarithmic scale; numbers below `low` are white."""
    values = values.detach().cpu().double()
    return ImagePanel(title, torch.where(values >= low, values, math.nan).numpy(), "viridis", LogNorm(low, high))


def signed(title: str, values: torch.Tensor, limit: float | None = None) -> ImagePanel:
    """(H, W) numbers, blue below 0, white at 0, red above."""
    array = values.detach().cpu().numpy()
    limit = max(float(np.nanmax(np.abs(array))), 1e-12) if limit is None else limit
    return ImagePanel(title, array, "RdBu_r", Normalize(-limit, limit))


def surfel_colours(ids: torch.Tensor) -> torch.Tensor:
    """(H, W, 3): one colour for each surfel, the same in every picture; white where `ids` (H, W) is -1."""
    ids = ids.cpu().long()
    palette = 0.1 + 0.8 * torch.rand(int(ids.max().clamp_min(0)) + 1, 3, generator=torch.Generator().manual_seed(0))
    return torch.where((ids >= 0)[..., None], palette[ids.clamp_min(0)], 1.0)


def made_here(near: float) -> str:
    """Origin of a figure that is computed now: date, machine, near plane."""
    device = device_name("cuda" if torch.cuda.is_available() else "cpu")
    return f"{datetime.date.today()}, {device}, near plane {near:.3g}"


def _sign(fig: Figure, origin: str) -> None:
    fig.supxlabel(origin, x=0.995, ha="right", fontsize=6, color="0.4")


def show(panels: Sequence[ImagePanel], origin: str, columns: int | None = None, width: float = WIDTH) -> np.ndarray:
    """Draw panels row by row, `origin` below them, and return their axes, an array of rows."""
    columns = columns or len(panels)
    rows = -(-len(panels) // columns)
    bars = any(panel.cmap for panel in panels)
    height, across = panels[0].values.shape[:2]
    side = width / columns
    fig, axes = plt.subplots(
        rows,
        columns,
        figsize=(width, rows * (side * height / across * (0.84 if bars else 1.0) + 0.3) + 0.15),
        squeeze=False,
    )
    _sign(fig, origin)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, panel in zip(axes.flat, panels, strict=False):
        drawn = axis.imshow(panel.values, cmap=panel.cmap, norm=panel.norm)
        axis.set_title(panel.title)
        if panel.cmap:
            fig.colorbar(drawn, ax=axis, fraction=0.046, pad=0.02)
    return axes


def plots(count: int, origin: str, height: float = 2.6, width: float = WIDTH) -> list[Axes]:
    """Axes of `count` plots side by side, with a faint grid, and `origin` below them."""
    fig, axes = plt.subplots(1, count, figsize=(width, height + 0.15), squeeze=False, layout="constrained")
    _sign(fig, origin)
    for axis in axes.flat:
        axis.grid(alpha=0.25)
    return list(axes.flat)


def legend(axis: Axes, left: float = 1.0) -> None:
    """Add a legend beside a plot, where it covers no curve; `left` is where it begins, in widths of the plot."""
    axis.legend(loc="upper left", bbox_to_anchor=(left, 1.0), borderaxespad=0.3, fontsize=7)
