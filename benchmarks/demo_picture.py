"""The picture of the README: two test views of the demo with their passes.

Usage: `nexwarp train demo && python -m benchmarks.demo_picture runs/demo --out docs/demo.png`.
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

from nexwarp.data.views import View
from nexwarp.io.files import written_aside
from nexwarp.io.pictures import side_by_side, to_uint8
from nexwarp.model.buffers import render_buffers
from nexwarp.model.model import Model
from nexwarp.run.folder import read_run
from nexwarp.run.opened import open_model
from notebooks.figures import surfel_colours

CAPTIONS = ("photo (held out)", "rendering", "plain pass (N)", "textured pass (sum W T)", "heaviest surfel")
VIEWS = (0, 2)  # of the test views
GAP = 4  # pixels between rows
COLOURS = 256  # of the PNG file, which thus takes less than half


def draw_row(model: Model, view: View, captions: tuple[str, ...] | None) -> torch.Tensor:
    """Return photo, rendering, both passes and heaviest surfels side by side, (H, W, 3) uint8."""
    buffers = render_buffers(model, view.camera)
    drawn = (buffers.image, buffers.plain, buffers.textured, surfel_colours(buffers.ids[..., 0]))
    return side_by_side([view.image, *(to_uint8(each.cpu()) for each in drawn)], GAP, captions)


def main() -> None:
    """Render and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of the demo")
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    options = parser.parse_args()
    model, views = open_model(options.run).model, read_run(options.run)[0].load().test
    rows = [draw_row(model, views[index], None if number else CAPTIONS) for number, index in enumerate(VIEWS)]
    white = torch.full((GAP, rows[0].shape[1], 3), 255, dtype=torch.uint8)
    pixels = torch.cat([rows[0], *(part for row in rows[1:] for part in (white, row))])
    with written_aside(options.out) as temporary:
        Image.fromarray(pixels.numpy()).quantize(COLOURS).save(temporary, format="PNG", optimize=True)


if __name__ == "__main__":
    main()
