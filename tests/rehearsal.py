"""Training, evaluating and rendering a tiny scene, which launches the kernels of a run."""

import dataclasses

import torch

import nexwarp as nw
from nexwarp.run.evaluate import evaluate
from nexwarp.train.recipe import REFERENCE_ITERATIONS, Config

WIDTH, HEIGHT, POINTS = 64, 48, 100
ITERATIONS = 8


def rehearse(config: Config, device: torch.device) -> None:
    """Train for a few steps, evaluate and render on a tiny scene with these settings; seed the generators like a run.

    The steps cover every SH degree, rounds of density control and steps after the last round, in the order of a full
    run. The choice of surfels to relocate runs too.
    """
    scene = tiny_scene()
    trainer = nw.Trainer(scene, tiny(config), device)
    trainer.run()
    if config.densify.relocate:
        trainer.densifier.unneeded(trainer.model(), trainer.views.cameras)
    model = trainer.finish()
    evaluate(model, scene.test)
    with torch.no_grad():
        out = model.render(scene.test[0].camera)
        out.splat_error(out.alpha)


def tiny(config: Config) -> Config:
    """Return settings for `ITERATIONS` steps, with the sizes reduced that no kernel depends on."""
    step = REFERENCE_ITERATIONS // ITERATIONS  # iterations of a full run per iteration of this one
    return dataclasses.replace(
        config,
        iterations=ITERATIONS,
        max_surfels=POINTS,
        sh_every=2 * step,  # SH degrees of the steps: 0 1 1 2 2 3 3 3
        texture=dataclasses.replace(config.texture, table_size=2**10),
        densify=dataclasses.replace(config.densify, start=0, every=3, stop=ITERATIONS * step),
    )


def tiny_scene() -> nw.Scene:
    """Make a scene of one photo of noise, for training and testing, and random points in front of its camera."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(POINTS, 3, generator=generator) * 2 - 1
    photo = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[WIDTH, 0.0, WIDTH / 2], [0.0, WIDTH, HEIGHT / 2], [0.0, 0.0, 1.0]])
    colors = torch.randint(0, 256, (POINTS, 3), generator=generator, dtype=torch.uint8)
    scene = nw.Scene.from_tensors([photo], [nw.Camera(viewmat, K, WIDTH, HEIGHT)], points, colors, test_every=0)
    return dataclasses.replace(scene, test=scene.train)
