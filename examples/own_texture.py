"""Train a texture of your own: features on three planes, or features of each surfel with a small MLP.

python examples/own_texture.py Triplane --steps 700 --out runs/own_texture
"""

import argparse
import dataclasses

import torch
from torch import nn

import nexwarp as nw


@nw.register_texture  # so that model files can hold it
class Triplane(nw.Texture):
    """Features on three planes, added to the surfels' plain colours."""

    residual, rates = True, (2e-2, 2e-4)
    config = {"size": 256, "features": 8}  # arguments that make another of the same shape # noqa: RUF012

    def __init__(self, size: int = 256, features: int = 8) -> None:
        super().__init__()
        self.planes, self.layer = nn.Parameter(torch.zeros(3, features, size, size)), nn.Linear(features, 3)

    def colors(self, hits: nw.Hits, camera: nw.Camera) -> torch.Tensor:  # noqa: D102
        at = torch.tanh(hits.points.reshape(1, -1, 3) / 4.0)  # in [-1, 1]
        places = torch.stack([at[..., [1, 2]], at[..., [0, 2]], at[..., [0, 1]]])  # (3, 1, P, 2)
        features = nn.functional.grid_sample(self.planes, places, align_corners=False).sum(0)
        return self.layer(features[:, 0].T).view(hits.points.shape)


@nw.register_texture
class SurfelFeatures(nw.Texture):
    """Features of each surfel, whose rows follow the surfels, and an MLP."""

    residual, per_surfel = True, ("features",)
    config = property(lambda self: {"surfels": len(self.features)})

    def __init__(self, surfels: int) -> None:
        super().__init__()
        self.features = nn.Parameter(0.1 * torch.randn(surfels, 16))
        self.mlp = nn.Sequential(nn.Linear(16 + 3, 32), nn.ReLU(), nn.Linear(32, 3))

    def colors(self, hits: nw.Hits, camera: nw.Camera) -> torch.Tensor:  # noqa: D102
        directions = hits.directions[:, :, None].expand(hits.points.shape)
        return self.mlp(torch.cat([self.features[hits.ids.clamp_min(0).long()], directions], dim=-1))


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("texture", choices=("Triplane", "SurfelFeatures"))
parser.add_argument("--steps", type=int, default=700)
parser.add_argument("--out", default="runs/own_texture")
args, config = parser.parse_args(), nw.preset("default")
rates = dataclasses.replace(config.rates, means=(5e-4, 5e-6), scales=0.025, opacities=0.05, sh0=0.0125)  # a short run
config = dataclasses.replace(config, iterations=args.steps, max_surfels=3000, rates=rates)
texture = Triplane if args.texture == "Triplane" else lambda scene, surfels: SurfelFeatures(len(surfels))
print(nw.train(nw.load_scene("demo"), config, texture=texture).save(args.out))
