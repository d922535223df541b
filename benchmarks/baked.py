"""Compares a run with its baked form, what the page draws without WebGPU: PSNR against photos, and sizes.

    python -m benchmarks.baked runs/demo --scene demo

bakes the run and prints the mean PSNR against the photos of the training and test views: of the run, of its baked form
as the page's files hold it, and the largest loss of one view; and the PSNR between the two.
"""

import statistics
import time
from pathlib import Path
from typing import Annotated

import torch
import tyro

import nexwarp as nw
from nexwarp.data import demo_folder
from nexwarp.export.bake.fit import bake
from nexwarp.export.web.atlas import as_stored, encode_baked
from nexwarp.run.metrics import psnr


def main(run: Annotated[Path, tyro.conf.Positional], scene: str, downscale: int = 1) -> int:
    """Bake a run and compare.

    Args:
        run: run folder.
        scene: folder of its scene, or `demo`.
        downscale: that of the training.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = nw.load(run).to(device)
    sets = nw.load_cameras(run)
    cameras = {name: camera for views in sets.values() for name, camera in views.items()}
    start = time.perf_counter()
    baked = bake(model, list(cameras.values()))
    seconds = time.perf_counter() - start
    files = {name: len(content) for name, content in encode_baked(baked, cameras).items()}
    print(f"{seconds:.0f} s on {device}; atlas {baked.layout.width}x{baked.layout.height}; bytes: {files}")
    stored = as_stored(baked)
    photos = nw.load_scene(demo_folder() if scene == "demo" else scene, downscale=downscale)
    for name, views in (("training", photos.train), ("test", photos.test)):
        figures = []
        for view in views:
            camera = view.camera.to(device)
            photo = torch.as_tensor(view.image).to(device).float() / 255
            factors = 1.0 if model.exposures is None else model.exposures.factors(camera)
            with torch.no_grad():
                exact = model.render(camera).image.clamp(0, 1)
                image = (stored.render(camera) * factors).clamp(0, 1)
            figures.append([float(psnr(a, b)) for a, b in ((exact, photo), (image, photo), (image, exact))])
        neural, ours, between = (statistics.mean(column) for column in zip(*figures, strict=True))
        worst = max(a - b for a, b, _ in figures)
        print(
            f"{len(figures)} {name} views: neural {neural:.2f} dB, baked {ours:.2f} dB against photos, "
            f"largest loss {worst:.2f} dB; baked against neural {between:.2f} dB"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
