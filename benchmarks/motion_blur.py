"""Trainings on the demo with motion blur of known motions, ray-traced from many poses in each exposure.

Usage: `python -m benchmarks.motion_blur [--poses 1 3 5] [--rates 0.5] [--turn 5] [--shift 1] [--downscale 1]
[--iterations 1200] [--device cuda]`. Each number of poses is trained once and judged on the sharp test views.
"""

import argparse
import dataclasses
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

import nexwarp as nw
from nexwarp.data import demo_folder
from nexwarp.data.demo import HEIGHT, VIEWS, WIDTH, demo_cameras
from nexwarp.data.demo_room import LAMP, build_room
from nexwarp.data.raytrace import render
from nexwarp.model.poses import PoseCorrections
from nexwarp.run.evaluate import evaluate
from nexwarp.train.initial import initial_poses
from nexwarp.train.motion_blur import decoded, encoded, moments
from nexwarp.train.presets import DEMO_SETTINGS, preset
from nexwarp.train.settings import with_settings


def blurred_demo(
    turn: float, shift: float, *, downscale: int = 1, instants: int = 9, seed: int = 11
) -> tuple[nw.Scene, torch.Tensor]:
    """The demo, whose training photos are blurred, and the true motions (V, 6) in units of `PoseCorrections`.

    Args:
        turn: length of the rotation during each exposure, pixels; its axis is random.
        shift: length of the shift, pixels; its direction is random.
        downscale: factor on the photos' size.
        instants: poses whose light is averaged.
        seed: of the motions.
    """
    scene = nw.load_scene(demo_folder(), downscale=downscale)
    cameras, count = [view.camera for view in scene.train], len(scene.train)
    ways = torch.nn.functional.normalize(
        torch.randn(2, count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1
    )
    poses = initial_like(cameras, scene, torch.cat([turn * ways[0], shift * ways[1]], -1))
    assert poses.motions is not None
    room, rig = build_room(WIDTH), demo_cameras(WIDTH, HEIGHT, VIEWS)

    def light_of(index: int) -> torch.Tensor:
        """Linear light (H, W, 3) of an exposure."""
        light = torch.zeros(HEIGHT, WIDTH, 3)
        for moment in moments(instants):
            with torch.no_grad():
                viewmat = poses.moment(cameras[index], index, moment).viewmat.double().numpy()
            sharp = render(room, viewmat.astype(np.float64), rig.K, rig.size, LAMP)
            light += decoded(torch.from_numpy(sharp).float() / 255) / instants
        return light

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        lights = list(pool.map(light_of, range(count)))
    views = []
    for view, light in zip(scene.train, lights, strict=True):
        small = torch.nn.functional.avg_pool2d(encoded(light).permute(2, 0, 1), downscale).permute(1, 2, 0)
        image = (small * 255).round().clamp(0, 255).to(torch.uint8)
        assert image.shape == view.image.shape
        views.append(dataclasses.replace(view, image=image.contiguous()))
    return dataclasses.replace(scene, train=views), poses.motions.detach()


def initial_like(cameras: list[nw.Camera], scene: nw.Scene, motions: torch.Tensor) -> PoseCorrections:
    """Poses with motions about the points about which a training turns its cameras."""
    given = initial_poses(scene, nw.Config(blur_poses=3), torch.device("cpu"))
    assert given is not None
    return PoseCorrections(cameras, scene.scale, given.pivots.tolist(), motions=motions)


def motion_errors(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Lengths (V,) of found motions minus true ones, in units of the true ones; a reversed motion is the same."""
    both = torch.stack([(found - true).norm(dim=-1), (found + true).norm(dim=-1)])
    return both.amin(0) / true.norm(dim=-1)


def main(argv: list[str] | None = None) -> int:
    """Print PSNR, SSIM and the errors of the motions of each training."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument("--refine-poses", action="store_true")
    parser.add_argument("--turn", type=float, default=5.0, help="pixels")
    parser.add_argument("--shift", type=float, default=1.0, help="pixels")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=1200)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args(argv)
    scene, true = blurred_demo(options.turn, options.shift, downscale=options.downscale)
    for count in options.poses:
        settings = {"iterations": options.iterations, "refine_poses": options.refine_poses, "blur_poses": count}
        config = with_settings(preset("default"), DEMO_SETTINGS | settings)
        start = time.perf_counter()
        trainer = nw.Trainer(scene, config, options.device)
        trainer.run()
        seconds = time.perf_counter() - start
        scores = evaluate(trainer.finish(), scene.test)
        line = f"blur_poses={count}: {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}, {seconds:.0f} s"
        if trainer.poses is not None and trainer.poses.motions is not None:
            found = trainer.poses.motions.detach().cpu()
            line += f", motions off by {motion_errors(found, true).median():.2f} (median)"
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
