import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.data import Scene
from nexwarp.train.recipe import DensifyConfig
from tests.trainer_support import small

pytestmark = pytest.mark.usefixtures("small_preset")

SMALL = small(iterations=40, densify=DensifyConfig(every=5))


def run(scene: Scene, until: int | None = None, **options: Any) -> nw.Trainer:
    trainer = nw.Trainer(scene, SMALL, "cpu", **options)
    trainer.run(until=until)
    return trainer


def test_wrong_arguments_are_named(scene: Scene) -> None:
    wrong: Any
    for wrong in ({"scene": "demo"}, {"config": {}}, {"callbacks": [3]}, {"losses": {"own": 3}}):
        with pytest.raises(TypeError, match=rf"^{next(iter(wrong))}"):
            nw.train(**({"scene": scene, "config": SMALL, "device": "cpu"} | wrong))


def test_an_own_loss_is_added_and_reported(scene: Scene) -> None:
    targets: list[nw.Target] = []

    def darkness(rendering: nw.Rendering, target: nw.Target) -> torch.Tensor:
        targets.append(target)
        return 20.0 * rendering.image.square().mean()

    reports: list[nw.StepReport] = []
    with_loss = nw.train(scene, SMALL, device="cpu", callbacks=[reports.append], losses={"darkness": darkness})
    plain = nw.train(scene, SMALL, device="cpu")
    assert all("darkness" in step.losses for step in reports) and len(targets) == SMALL.iterations
    camera = scene.test[0].camera
    with torch.no_grad():
        dark, bright = (model.render(camera).image.mean().item() for model in (with_loss, plain))
    assert dark < 0.95 * bright


@pytest.mark.parametrize(
    ("losses", "error", "match"),
    [
        ({"l1": lambda r, t: r.alpha.mean()}, ValueError, r"expected names other than l1, .*, got 'l1'"),
        ({"own": lambda r, t: r.alpha}, ValueError, r"losses\['own'\]: expected a scalar .*, got shape \(36, 48\)"),
        ({"own": lambda r, t: 0.5}, TypeError, r"losses\['own'\]: expected a floating scalar tensor, got float"),
        ({"own": lambda r, t: r.ids.sum()}, TypeError, r"losses\['own'\]: .*, got torch\.int64"),
    ],
)
def test_losses_that_do_not_fit_are_named(scene, losses, error, match):
    with pytest.raises(error, match=match):
        run(scene, 1, losses=losses)


def parts(scene: Scene) -> dict[str, Any]:
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    images, cameras, names = ([getattr(view, name) for view in views] for name in ("image", "camera", "name"))
    return {"images": images, "cameras": cameras, "points": scene.points, "colors": scene.colors, "names": names}


@pytest.mark.parametrize("kind", ["uint8", "float", "numpy", "stacked"])
def test_a_scene_in_memory_is_the_scene_of_its_files(scene: Scene, kind: str) -> None:
    given = parts(scene)
    if kind == "float":
        given["images"] = [image / 255.0 for image in given["images"]]
        given["colors"] = given["colors"].double() / 255.0
    elif kind == "numpy":
        given |= {"images": [x.numpy() for x in given["images"]], "points": given["points"].numpy().astype(np.float64)}
    elif kind == "stacked":
        given["images"] = torch.stack(given["images"])
    made = nw.Scene.from_tensors(**given)
    assert made.scale == pytest.approx(scene.scale, rel=1e-5) and made.path == Path("memory")
    for ours, theirs in ((made.train, scene.train), (made.test, scene.test)):
        assert [view.name for view in ours] == [view.name for view in theirs]
        for one, other in zip(ours, theirs, strict=True):
            assert torch.equal(one.image, other.image) and one.mask is None
            assert torch.equal(one.camera.viewmat, other.camera.viewmat) and one.camera.near == other.camera.near
    assert torch.equal(made.points, scene.points) and torch.equal(made.colors, scene.colors)


def test_a_scene_in_memory_keeps_copies_and_trains(scene: Scene) -> None:
    given = parts(scene)
    given["masks"] = [None, torch.ones(36, 48, dtype=torch.bool), *[torch.arange(48).expand(36, 48) > 8] * 8]
    given["images"] = [image.clone() for image in given["images"]]
    made = nw.Scene.from_tensors(**given | {"test_every": 0, "names": None})
    given["images"][0].zero_()
    assert made.train[0].image.any() and not made.test and len(made.train) == 10
    assert [view.name for view in made.train] == [str(index) for index in range(10)]
    assert made.train[0].mask is None and made.train[1].mask is None and made.train[2].mask is not None
    model = nw.train(made, dataclasses.replace(SMALL, iterations=8), device="cpu")
    assert len(model.surfels) > 0 and model.meta["iteration"] == 8


def changed(index: int, value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [value if i == index else x for i, x in enumerate(values)]


@pytest.mark.parametrize(
    ("argument", "change", "error", "match"),
    [
        ("images", changed(3, "photo"), TypeError, r"^images\[3\]: expected a torch.Tensor or numpy.ndarray, got str$"),
        ("images", changed(3, torch.ones(36, 48, 3) * 2), ValueError, r"^images\[3\]: .* \[0, 1\], got 2 to 2$"),
        ("images", changed(3, torch.ones(36, 40, 3)), ValueError, r"^cameras\[3\]: .* 40x36, got 48x36$"),
        ("cameras", lambda x: x[1:], ValueError, r"^cameras: expected 10, one for each image, got 9$"),
        ("cameras", changed(2, None), TypeError, r"^cameras\[2\]: expected a nexwarp.Camera, got NoneType$"),
        ("points", lambda x: x.long(), TypeError, r"^points: expected a floating dtype, got torch.int64$"),
        ("points", lambda x: torch.where(x == x[5], torch.inf, x), ValueError, r"^points: .* at index .5"),
        ("colors", lambda x: x[1:], ValueError, r"^colors: expected shape \(200, 3\), got \(199, 3\)$"),
        ("names", changed(4, "../x"), ValueError, r"^names\[4\]: '../x' leaves the images folder"),
        ("names", changed(4, "view_002.png"), ValueError, r"^names\[4\]: .* 'view_002.png' as of names\[2\]$"),
        ("masks", changed(1, torch.zeros(36, 48) > 0), ValueError, r"^masks\[1\]: .* that count, got none$"),
        ("test_every", lambda x: 1, ValueError, r"^test_every: expected 0, or at least 2, got 1$"),
    ],
)
def test_what_makes_no_scene_is_named(scene, argument, change, error, match):
    given = parts(scene) | {"masks": [None] * 10, "test_every": 8}
    with pytest.raises(error, match=match):
        nw.Scene.from_tensors(**given | {argument: change(given[argument])})
