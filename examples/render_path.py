"""Render a camera path around a model, as PNG frames or, with PyAV, as a video.

python examples/render_path.py --model runs/demo --out runs/demo/around.mp4 --frames 120
"""

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import nexwarp as nw


def write_video(path: Path, frames: Iterable[np.ndarray], width: int, height: int) -> None:
    """Write frames (H, W, 3) of 8 bits as H.264, which takes even sizes."""
    import av

    with av.open(str(path), "w") as video:
        stream = video.add_stream("libx264", rate=30, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
        video.mux(stream.encode(None))


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
    path = nw.ellipse(list(nw.load_cameras(Path(args.model) / "cameras.json")["train"].values()), args.frames)
    scale = args.height / path[0].height if args.height else 1.0
    width, height = round(scale * path[0].width), round(scale * path[0].height)
    K = path[0].K * torch.tensor([[scale], [scale], [1.0]])
    out = Path(args.out)
    with torch.no_grad():
        pictures = (model.render(nw.Camera(camera.viewmat, K, width, height, camera.near)).image for camera in path)
        frames = ((255 * x.clamp(0, 1)).round().byte().cpu().numpy() for x in pictures)
        if out.suffix == ".mp4":
            write_video(out, frames, width, height)
        for index, frame in enumerate(frames):  # none is left where there is a video
            out.mkdir(parents=True, exist_ok=True)
            Image.fromarray(frame).save(out / f"frame_{index:04d}.png")
    print(f"{len(path)} frames of {width}x{height} in {out}")


if __name__ == "__main__":
    main()
