"""Train on photos, cameras and points that lie in memory, without files of a scene.

python examples/train_from_tensors.py --steps 1000 --out runs/from_tensors
"""

import argparse
import dataclasses

import torch

import nexwarp as nw


def scene_in_memory(downscale: int) -> nw.Scene:
    """Replace this by your own data; here, the photos, cameras and points of the built-in demo stand for it."""
    demo = nw.load_scene("demo", downscale=downscale)
    views = demo.train + demo.test
    return nw.Scene.from_tensors(
        images=[view.image.float() / 255.0 for view in views],  # (H, W, 3) in [0, 1]; uint8 and numpy are fine, too
        cameras=[nw.Camera(view.camera.viewmat, view.camera.K, *view.image.shape[1::-1]) for view in views],
        points=demo.points,  # (P, 3) world units; without points, training starts from random ones
        colors=demo.colors,
    )


def mean_psnr(model: nw.Model, views: list[nw.View]) -> float:
    """Mean PSNR of a model's renderings in dB."""
    with torch.no_grad():
        images = [model.render(view.camera).image.clamp(0, 1).cpu() for view in views]
    errors = [(image - view.image / 255.0).square().mean() for image, view in zip(images, views, strict=True)]
    return (-10.0 * torch.stack(errors).log10()).mean().item()


def main() -> None:
    """Train, and tell how the PSNR grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--downscale", type=int, default=2, help="reduce the demo's photos of 96x72 by this factor")
    parser.add_argument("--out", default="runs/from_tensors")
    args = parser.parse_args()
    scene = scene_in_memory(args.downscale)
    config = dataclasses.replace(nw.preset("default"), iterations=args.steps, max_surfels=3000)

    def report(step: nw.StepReport) -> None:
        if step.iteration % max(args.steps // 10, 1) in (0, 1):
            print(f"step {step.iteration}: {step.psnr():.2f} dB on its training view, {step.surfels} surfels")

    model = nw.train(scene, config, callbacks=[report])
    print(f"test views: {mean_psnr(model, scene.test):.2f} dB")
    print(f"saved: {model.save(args.out)}")


if __name__ == "__main__":
    main()
