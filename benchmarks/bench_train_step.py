"""One default training step in the middle of a run: SH of degree 3, splat errors, all losses, Adam."""

from collections.abc import Sequence
from dataclasses import replace

import torch

import nexwarp as nw
from benchmarks.scenes import GARDEN, SurfelScene, cloud, garden, saharov, workload
from benchmarks.suite import Options
from benchmarks.timing import Measurement, figure, mean_ms
from nexwarp.data import Scene, View
from nexwarp.io.pictures import to_uint8
from nexwarp.train.recipe import Config, TextureConfig
from nexwarp.train.trainer import Trainer

MIDDLE = 10_000  # iteration
POINTS = 1000


def run(options: Options) -> list[Measurement]:
    if options.quick:
        scenes = workload(replace(options, model=None))
    elif options.cuda:
        scenes = [garden(GARDEN, 1558, 1039, options.data), saharov(data=options.data), cloud(5_000, 240, 160)]
    else:
        scenes = [cloud(5_000, 240, 160)]
    return [m for scene in scenes for m in step(scene, options)]


def step(scene: SurfelScene, options: Options) -> list[Measurement]:
    trainer = make_trainer(scene, options)
    one = options.time("training step", trainer.step, **scene.facts)
    count = 3 if options.quick else 200 if options.cuda else 5
    rate = 1e3 / mean_ms(trainer.step, count, options.device)
    note = f"{count} steps in a row, density control included as it falls due. {scene.note}".strip()
    facts = scene.facts | {"note": note}
    return [one, figure("training rate", rate, options.device, unit="it/s", **facts)]


def make_trainer(scene: SurfelScene, options: Options) -> Trainer:
    """Trainer with default settings (small tables on scenes for a CPU) that goes on from the scene's surfels."""
    count = len(scene.surfels)
    large = count >= 20_000
    # The garden of the paper has photos enough for the largest table, whatever is drawn here.
    table = 2**20 if count >= GARDEN else None
    shape = (
        TextureConfig(table_size=table) if large else TextureConfig(levels=8, table_size=2**15, features=2, width=32)
    )
    config = Config(max_surfels=count, texture=shape)
    surfels = scene.surfels.to(options.device)
    trainer = Trainer(training_scene(scene, options), config, options.device)
    # Trainer starts from few surfels; before the first step its optimizer has no state that the new ones must fit.
    for name, parameter in trainer.surfels.named_parameters():
        parameter.data = getattr(surfels, name).detach().clone()
    trainer.densifier.errors = torch.zeros_like(trainer.surfels.logit_opacities.detach())
    trainer.iteration = MIDDLE
    return trainer


@torch.no_grad()
def training_scene(scene: SurfelScene, options: Options) -> Scene:
    """Return a scene to train on: with the scene's photos, or else with renderings of its surfels alone."""
    images: Sequence[torch.Tensor] = scene.photos
    cameras = scene.cameras
    if not images:
        moved = scene.to(options.device)
        images = [to_uint8(nw.render(moved.surfels, None, camera).image).cpu() for camera in moved.cameras]
    generator = torch.Generator().manual_seed(3)
    chosen = torch.randperm(len(scene.surfels), generator=generator)[:POINTS]
    points = scene.surfels.means.detach().cpu()[chosen]
    # With points of its own a view has depths to compare with and an exposure, as photos have.
    views = [
        View(camera.to("cpu"), image, None, f"{i:03d}", points=points)
        for i, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    centers = torch.stack([camera.position for camera in cameras]).cpu()
    return Scene(
        train=views,
        test=[],
        points=points,
        colors=torch.full((len(points), 3), 128, dtype=torch.uint8),
        track_lengths=torch.full((len(points),), 3, dtype=torch.int32),
        reprojection_errors=torch.zeros(len(points)),
        scale=1.1 * float((centers - centers.mean(0)).norm(dim=1).max()),
        path=options.data,
    )
