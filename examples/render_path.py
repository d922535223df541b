"""Render a camera path around a model, as PNG frames or, with PyAV, as a video.

python examples/render_path.py --model runs/demo --out runs/demo/around.mp4 --frames 120
python examples/render_path.py --model runs/demo --out runs/demo/around --frames 12
"""

import argparse
import dataclasses
from pathlib import Path

import torch

import nexwarp as nw
from nexwarp.cameras.camera import resized
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cameras.paths import ellipse
from nexwarp.io.pictures import save_png, to_uint8
from nexwarp.io.video import video_writer


def main() -> None:
    """Fit an ellipse to the training cameras and render along it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="runs/demo")
    parser.add_argument("--out", default="runs/demo/around", help="folder of PNG files, or a video ending in .mp4")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--height", type=int, help="of the frames, pixels; by default that of the photos")
    parser.add_argument("--white", action="store_true", help="put the scene on white")
    args = parser.parse_args()
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu")
    if args.white:
        model.options = dataclasses.replace(model.options, background=(1.0, 1.0, 1.0))
    path = ellipse(list(load_cameras(Path(args.model) / "cameras.json")["train"].values()), args.frames)
    height = args.height or path[0].height
    width = round(path[0].width * height / path[0].height)
    cameras = [resized(camera, width, height) for camera in path]
    out = Path(args.out)
    with torch.no_grad():
        if out.suffix == ".mp4":
            with video_writer(out, width, height, fps=30.0) as append:
                for camera in cameras:
                    append(to_uint8(model.render(camera).image))
        else:
            for index, camera in enumerate(cameras):
                save_png(out / f"frame_{index:04d}.png", model.render(camera).image)
    print(f"{len(cameras)} frames of {width}x{height} in {out}")


if __name__ == "__main__":
    main()
