"""The picture of the README: photo, rendering, the surfels' own colours and the surfel of each pixel, side by side.

python -m benchmarks.picture runs/train --out docs/capture.jpg
python -m benchmarks.picture runs/train --view 00009.jpg --height 360 --out docs/capture.jpg
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
from nexwarp.run.folder import open_model, read_run
from notebooks.figures import surfel_colours

CAPTIONS = ("photo (held out)", "rendering", "surfels without the texture", "surfel of each pixel")
GAP = 4  # pixels between pictures


def draw_row(model: Model, view: View) -> torch.Tensor:
    """Return the four pictures side by side, (H, W, 3) uint8."""
    buffers = render_buffers(model, view.camera)
    plain = render_buffers(model, view.camera, max_hits=0).image  # with K = 0 all hits have their own colours
    drawn = (buffers.image, plain, surfel_colours(buffers.ids[..., 0]))
    return side_by_side([view.image, *(to_uint8(each.cpu()) for each in drawn)], GAP, CAPTIONS)


def main() -> None:
    """Render and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder, whose scene is read, too")
    parser.add_argument("--view", help="name of a test view; default: the first one")
    parser.add_argument("--height", type=int, help="height of the file in pixels; default: that of the photo")
    parser.add_argument("--out", type=Path, required=True, help="JPEG file to write")
    options = parser.parse_args()
    views = {view.name: view for view in read_run(options.run).source.load().test}
    row = draw_row(open_model(options.run).model, views[options.view or next(iter(views))])
    image = Image.fromarray(row.numpy())
    if options.height is not None:
        image = image.resize((round(image.width * options.height / image.height), options.height), Image.Resampling.BOX)
    with written_aside(options.out) as temporary:
        image.save(temporary, format="JPEG", quality=90)


if __name__ == "__main__":
    main()
