import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import nexwarp as nw
from nexwarp.data import Scene
from nexwarp.model import texture as textures
from nexwarp.train.recipe import DensifyConfig
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.trainer_support import assert_resumed_alike, small

CONFIG = small(iterations=40, max_surfels=200, densify=DensifyConfig(start=5, stop=29_000, every=5, fraction=0.3))


class Wrapped(nw.Texture):
    """A neural texture behind the protocol."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = make_texture()

    def colors(self, hits: nw.Hits, camera: nw.Camera) -> torch.Tensor:
        return self.inner.evaluate(hits.points, hits.depths, hits.directions, camera.focal)


@nw.register_texture
class Painted(nw.Texture):
    """A colour of each surfel, and one of the direction."""

    rates, per_surfel = (2e-2, 2e-4), ("grid", "mlp.numbers")  # names that a neural texture has, too
    residual = True

    def __init__(self, count: int) -> None:
        super().__init__()
        self.grid, self.mlp = nn.Parameter(torch.zeros(count, 3)), nn.Linear(3, 3)
        self.mlp.register_buffer("numbers", torch.arange(count).float())

    @property
    def config(self) -> dict[str, int]:  # type: ignore[override]
        return {"count": len(self.grid)}

    def colors(self, hits: nw.Hits, camera: nw.Camera) -> torch.Tensor:
        return self.grid[hits.ids.clamp_min(0).long()] + self.mlp(hits.directions)[:, :, None]

    def regulariser(self) -> torch.Tensor:
        return 0.1 * self.grid.square().mean()


def painted(_: Scene, surfels: nw.Surfels) -> Painted:
    return Painted(len(surfels))


def test_a_texture_behind_the_protocol_gives_the_same_picture_and_gradients() -> None:
    scene, texture = random_scene(30), Wrapped()
    surfels, camera = make_surfels(scene), make_camera(scene)
    results = []
    for each in (texture, texture.inner):
        out = nw.render(surfels, each, camera, sh_degree=3)
        gradients = torch.autograd.grad(out.image.square().sum(), [*texture.inner.parameters(), surfels.means])
        results.append([out.image, out.textured, *gradients])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True)) and results[0][1].any()
    texture.colors = lambda hits, camera: hits.points[..., :2]  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=r"texture\.colors: expected shape"):
        nw.render(surfels, texture, camera)


def test_a_file_keeps_what_is_registered_and_refuses_the_rest(tmp_path: Path) -> None:
    scene, texture = random_scene(30), Painted(30)
    surfels, camera = make_surfels(scene), make_camera(scene)
    nn.init.normal_(texture.grid)
    for compact in (False, True):
        model = nw.load(nw.Model(surfels, texture).save(tmp_path / "model.safetensors", compact=compact))
        expected = nw.render(model.surfels, texture, camera).image
        assert torch.equal(model.render(camera, background=(0, 0, 0), sh_degree=3).image, expected)
    texture.mlp.numbers = torch.arange(30)
    wrong = type("Painted", (Painted,), {})
    for kind, message in (
        (texture, "texture.config: expected arguments that give tensors"),
        (wrong(30), "texture: expected a nexwarp.NeuralTexture or a registered class, got Painted"),
        (type("Mine", (nw.NeuralTexture,), {})(), "texture: expected .*, got Mine; nexwarp.load can only make"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            nw.Model(surfels, kind).save(tmp_path / "other.safetensors")
    assert not (tmp_path / "other.safetensors").exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(textures._REGISTERED, "Painted")
        with pytest.raises(ValueError, match="texture: expected 'Painted' to be registered"):
            nw.load(tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="kind: expected another name"):
        nw.register_texture(type("Painted", (nw.Texture,), {"__module__": "elsewhere"}))
    with pytest.raises(TypeError, match="kind: expected a subclass"):
        nw.register_texture(nw.NeuralTexture)


def test_training_moves_parameters_and_rows(tiny_scene: Scene, tmp_path: Path) -> None:
    reports: list[nw.StepReport] = []
    model = nw.train(tiny_scene, CONFIG, device="cpu", texture=painted, callbacks=[reports.append])
    texture = model.texture
    assert isinstance(texture, Painted)
    assert len(texture.grid) == len(model.surfels) == 200 > reports[0].surfels and texture.grid.any()
    numbers = texture.get_buffer("mlp.numbers").long()
    assert len(numbers) == 200 and len(numbers.unique()) < 200 and numbers.max() < reports[0].surfels
    assert reports[0].losses["regulariser"] == 0 < reports[-1].losses["regulariser"]
    again = nw.load(model.save(tmp_path))
    camera = tiny_scene.test[0].camera
    assert torch.equal(again.render(camera).image, model.render(camera).image)


def test_a_checkpoint_holds_it(tiny_scene: Scene, tmp_path: Path) -> None:
    """Resumed, also where the rows are no longer those of the start, it ends with the same bits."""
    straight = nw.Trainer(tiny_scene, CONFIG, "cpu", texture=painted)
    assert straight.optimizer.param_groups[-1]["name"] == "texture"
    rows = len(straight.surfels)
    straight.run()
    assert len(straight.surfels) > rows
    assert_resumed_alike(straight, tmp_path, 20, texture=painted)
    with pytest.raises(ValueError, match="scene's photos"):
        nw.Trainer(tiny_scene, CONFIG, "cpu").restore(tmp_path)


def test_what_does_not_fit_is_refused(tiny_scene: Scene) -> None:
    trainer = nw.Trainer(tiny_scene, CONFIG, "cpu")
    for name in ("texture", "surfels"):
        with pytest.raises(AttributeError):
            setattr(trainer, name, getattr(trainer, name))
    wrong: list[tuple[Any, dict[str, Any], str]] = [
        (3, {}, "texture: expected a nexwarp.Texture"),
        (lambda *_: 3, {}, "texture: expected a function that returns a nexwarp.Texture, got int"),
        (Painted(3), {}, r"texture\.grid: expected a row for each of \d+ surfels, got 3"),
        (Wrapped().double(), {}, r"texture\.inner\.grid: expected float32"),
        (Wrapped(), {"max_hits": 0}, "texture: expected None with max_hits = 0"),
    ]
    for texture, changes, message in wrong:
        with pytest.raises((TypeError, ValueError), match=message):
            nw.train(tiny_scene, dataclasses.replace(CONFIG, **changes), device="cpu", texture=texture)
