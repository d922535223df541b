"""Training: the laws of the loop, its schedules and its starting point, and what it learns from real photos."""

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.camera import Camera
from nexwarp.data import Scene, View, initial_points
from nexwarp.run.evaluate import evaluate
from nexwarp.train import floaters as floaters_module
from nexwarp.train import trainer as trainer_module
from nexwarp.train.checkpoint import load_checkpoint, save_checkpoint
from nexwarp.train.config import MIN_SURFELS, Config, LearningRates, TextureConfig
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.initial import initial_surfels, quats_towards, texture_shape
from nexwarp.train.losses import LossWeights
from nexwarp.train.presets import config_from_dict, preset
from nexwarp.train.trainer import Trainer
from tests.reference.collect import rotations
from tests.tolerances import assert_close

pytestmark = pytest.mark.usefixtures("one_torch_thread", "few_looks")

FOX = Path(__file__).parents[2] / "shared" / "data" / "fox"
TEXTURE = TextureConfig(levels=4, table_size=2**10, width=16)
# Rounds of density control at 3, 6 and 9 of 12 iterations, so that a short run has them all.
OFTEN = DensifyConfig(every=3)


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene


def small(**changes: Any) -> Config:
    settings: dict[str, Any] = {"iterations": 12, "max_surfels": 120, "texture": TEXTURE, "densify": OFTEN}
    return Config(**(settings | changes))


def state_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Every tensor that the future of a run depends on."""
    state: dict[str, torch.Tensor] = dict(trainer._named_parameters())
    for name, parameter in list(state.items()):
        state |= {f"adam.{name}.{k}": v for k, v in trainer.optimizer.state[parameter].items()}
    state |= {"errors": trainer.densifier.errors, "generator": trainer.generator.get_state()}
    state |= {"order": torch.tensor(trainer.order), "iteration": torch.tensor(trainer.iteration)}
    return {name: value.detach().clone() for name, value in state.items()}


def assert_same_state(one: Trainer, other: Trainer) -> None:
    first, second = state_of(one), state_of(other)
    assert first.keys() == second.keys()
    different = [name for name, value in first.items() if not torch.equal(value, second[name])]
    assert not different, different


def trained(scene: Scene, config: Config) -> Trainer:
    trainer = Trainer(scene, config, "cpu")
    trainer.run()
    return trainer


def mean_psnr(trainer: Trainer, views: list[View]) -> float:
    return evaluate(trainer.model(), views)["psnr"]


# Repeatability


@pytest.mark.parametrize("stop", [6, 7, 11])
def test_resuming_changes_nothing(scene, tmp_path, stop):
    """Straight to 12 = up to `stop`, saved, restored elsewhere, and on to 12: bit for bit."""
    straight = trained(scene, small())
    assert len(straight.surfels) > 60  # it has split
    first = Trainer(scene, small(), "cpu")
    for _ in range(stop):
        first.step()
    first.save(tmp_path)
    second = Trainer(scene, small(), "cpu")
    torch.manual_seed(99)
    second.restore(tmp_path)
    assert_same_state(second, first)
    second.run()
    assert_same_state(second, straight)


def test_resuming_without_a_texture_changes_nothing(scene, tmp_path):
    config = small(max_hits=0, iterations=4)
    straight = trained(scene, config)
    first, second = Trainer(scene, config, "cpu"), Trainer(scene, config, "cpu")
    first.step()
    first.save(tmp_path)
    second.restore(tmp_path)
    second.run()
    for name, value in straight.surfels.state_dict().items():
        assert torch.equal(second.surfels.state_dict()[name], value), name
    fresh = Trainer(scene, config, "cpu")
    assert torch.equal(straight.texture.grid, fresh.texture.grid)  # nothing trains what nothing shows


def test_same_seed_same_run_and_other_seeds_differ(scene):
    first = trained(scene, small(seed=1))
    torch.rand(5)  # the state before has no say
    assert_same_state(first, trained(scene, small(seed=1)))
    other = trained(scene, small(seed=2))
    assert not torch.equal(first.surfels.raw_quats[:60], other.surfels.raw_quats[:60])
    assert not torch.equal(next(first.texture.mlp.parameters()), next(other.texture.mlp.parameters()))
    assert first.order != other.order


@pytest.mark.cuda
def test_deterministic_runs_are_the_same_on_cuda(scene):
    runs = []
    for _ in range(3):
        trainer = Trainer(scene, small(iterations=60, max_surfels=400, deterministic=True), "cuda")
        trainer.run()
        runs.append(trainer)
    assert not torch.are_deterministic_algorithms_enabled()
    for other in runs[1:]:
        assert_same_state(other, runs[0])
    first, *others = (trainer.finish() for trainer in runs)
    assert first.exposures is not None and first.detail_limits is not None
    for model in others:
        assert model.state_dict().keys() == first.state_dict().keys()
        for name, value in first.state_dict().items():
            assert torch.equal(model.state_dict()[name], value), name


@pytest.mark.parametrize("damage", ["missing", "shape", "settings", "scene"])
def test_a_checkpoint_that_does_not_fit_is_refused(scene, tmp_path, damage):
    trainer = Trainer(scene, small(), "cpu")
    trainer.step()
    trainer.save(tmp_path)
    tensors, state = load_checkpoint(tmp_path)
    config = small()
    if damage == "missing":
        tensors.pop("densify.errors")
    elif damage == "shape":
        tensors["texture.grid"] = tensors["texture.grid"][:, :8].contiguous()
    elif damage == "settings":
        config = small(iterations=24)
    else:
        scene = dataclasses.replace(scene, train=scene.train[:-1])
    save_checkpoint(tmp_path, tensors, state)
    with pytest.raises(ValueError) as caught:
        Trainer(scene, config, "cpu").restore(tmp_path)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path}: expected a checkpoint of this run") and "\n" not in message, message


# Learning


def test_it_learns(scene):
    # On black: on the photos' mean colour a run starts with less to learn.
    trainer = Trainer(scene, small(iterations=80, max_surfels=400, background=(0.0, 0.0, 0.0)), "cpu")
    before, losses = mean_psnr(trainer, scene.train), []
    trainer.run(lambda progress: losses.append(progress.loss()))
    epoch = len(scene.train)
    assert all(math.isfinite(loss) for loss in losses)
    assert sum(losses[-epoch:]) < 0.8 * sum(losses[:epoch])
    after = mean_psnr(trainer, scene.train)
    assert after >= before + 2.0, f"{before:.2f} -> {after:.2f} dB"


def test_progress_tells_what_happened(scene):
    trainer = Trainer(scene, small(), "cpu")
    seen: list[nw.StepReport] = []
    trainer.run(seen.append)
    assert [p.iteration for p in seen] == list(range(1, 13))
    assert seen[-1].surfels == len(trainer.surfels)
    for p in seen:
        assert p.loss() == pytest.approx(sum(x.item() for x in p.losses.values()), rel=1e-6)
        error = (p.image.detach().double().clamp(0, 1) - p.target.double()).square().mean().item()
        assert p.psnr() == pytest.approx(-10 * math.log10(error), abs=1e-4)
    always = {"l1", "dssim", "texture", "alpha", "opacity", "grid"}
    for p in seen:
        assert set(p.losses) == always | ({"border"} if p.iteration % 4 == 0 else {"depth"})
    counts = [p.surfels for p in seen]
    assert all(later == before for i, (before, later) in enumerate(itertools.pairwise(counts)) if i % 3 != 1)
    assert counts[2] == 63 == int(1.05 * counts[0])
    assert max(counts) <= 120


def test_budget_holds_in_training(scene):
    fast = DensifyConfig(every=3, fraction=0.5)
    trainer, counts = Trainer(scene, small(iterations=15, max_surfels=64, densify=fast), "cpu"), []
    trainer.run(lambda p: counts.append(p.surfels))
    assert counts[0] == 32 and max(counts) == 64


@pytest.mark.skipif(not FOX.is_dir(), reason=f"{FOX} is not there")
@pytest.mark.timeout(400)
def test_it_learns_from_real_photos():
    """Fox at downscale 8: 5 dB more on views it has not seen than after the first iteration."""
    scene = nw.load_scene(FOX, downscale=8)
    config = Config(iterations=200, max_surfels=3000, texture=TextureConfig(levels=8, table_size=2**14))
    trainer = Trainer(scene, config, "cpu")
    trainer.step()
    before = mean_psnr(trainer, scene.test)
    trainer.run()
    after = mean_psnr(trainer, scene.test)
    assert len(trainer.surfels) <= 3000
    assert after >= before + 5.0, f"{before:.2f} -> {after:.2f} dB"


# Schedules


def test_rates_are_log_linear_between_their_ends(scene):
    config = small(iterations=9, rates=LearningRates(mlp=(1e-3, 1e-5)))
    trainer, rates = Trainer(scene, config, "cpu"), []
    trainer.run(lambda _: rates.append([group["lr"] for group in trainer.optimizer.param_groups]))
    r, s = config.rates, scene.scale
    constant = [r.quats, r.scales, r.opacities, r.gammas, r.sh0, r.shN]
    assert rates[0] == pytest.approx([1.6e-4 * s, *constant, 1e-3, 1e-3], rel=1e-12)
    assert rates[-1] == pytest.approx([1.6e-6 * s, *constant, 1e-5, 1e-5], rel=1e-12)
    logs = torch.tensor(rates, dtype=torch.float64).log()
    assert logs.diff(n=2, dim=0).abs().max() < 1e-9
    for step, row in enumerate(rates):
        assert row[0] == pytest.approx(1.6e-4 * s * 100 ** (-step / 8), rel=1e-9)


def test_groups_hold_every_parameter_once(scene):
    trainer = Trainer(scene, small(), "cpu")
    grouped = [p for group in trainer.optimizer.param_groups for p in group["params"]]
    everything = [p for _, p in trainer._named_parameters()]
    assert len(grouped) == len(everything) and {id(p) for p in grouped} == {id(p) for p in everything}
    assert all(group["eps"] == 1e-15 and group["betas"] == (0.9, 0.999) for group in trainer.optimizer.param_groups)


@pytest.mark.parametrize(("iterations", "every"), [(30_000, 1000), (3000, 100), (60, 2)])
def test_one_degree_is_unlocked_every_thousand_iterations_of_thirty(scene, iterations, every):
    trainer = Trainer(scene, small(iterations=iterations), "cpu")
    degrees = {}
    for iteration in (1, every - 1, every, 2 * every - 1, 2 * every, 3 * every - 1, 3 * every, iterations):
        trainer.iteration = iteration
        degrees[iteration] = trainer.render_options().sh_degree
    assert degrees == {i: min(3, i // every) for i in degrees} and degrees[iterations] == 3
    lower = Trainer(scene, small(iterations=iterations, sh_degree=1), "cpu")
    lower.iteration = iterations
    assert lower.render_options().sh_degree == 1 and lower.surfels.sh.shape[1] == 4


@pytest.mark.parametrize(
    ("iterations", "rounds"),
    [(30_000, (500, 25_000, 100)), (3000, (50, 2500, 10)), (60_000, (1000, 50_000, 200)), (600, (10, 500, 10))],
)
def test_rounds_stretch_with_the_run(scene, iterations, rounds):
    config = Trainer(scene, small(iterations=iterations, densify=DensifyConfig()), "cpu").densifier.config
    assert (config.start, config.stop, config.every) == rounds


def test_views_are_drawn_without_replacement(scene):
    trainer, drawn = Trainer(scene, small(iterations=24, border=0.0, exposures=False), "cpu"), []
    photos = [view.image.float() / 255 for view in scene.train]

    def note(progress: Any) -> None:
        drawn.append(next(i for i, photo in enumerate(photos) if torch.equal(photo, progress.target)))

    trainer.run(note)
    epochs = [drawn[:8], drawn[8:16], drawn[16:]]
    assert all(sorted(epoch) == list(range(8)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


# Settings


def test_paper_is_the_paper():
    """The numbers of recipe.md 3.9, spelt out."""
    p = preset("paper")
    assert (p.preset, p.iterations, p.max_hits, p.sh_degree, p.sh_every) == ("paper", 30_000, 2, 3, 1000)
    assert p.more_hits_from == 0
    assert (p.max_surfels, p.background, p.low_pass) == (400_000, (0.0, 0.0, 0.0), False)
    assert (p.clamp_image, p.clamp_texture, p.filter_points, p.orient_points) == (True, False, False, False)
    assert p.coarse == 0.0
    assert p.losses == LossWeights(
        dssim=0.2, alpha=0.005, texture=0.5, opacity=0.01, grid=0.01, depth=0.0, alpha_hits=8
    )
    assert (p.border, p.mask_mode, p.footprints, p.smooth_sh) == (0.0, "ignore", False, 0.0)
    assert (p.exposures, p.metering, p.vignetting) == (False, False, False)
    assert p.rates == LearningRates(
        means=(1.6e-4, 1.6e-6),
        quats=1e-3,
        scales=5e-3,
        opacities=0.025,
        gammas=1e-3,
        sh0=2.5e-3,
        shN=1.25e-4,
        grid=(1e-3, 1e-5),
        mlp=(1e-3, 1e-3),
    )
    assert p.texture == TextureConfig(
        levels=16,
        table_size=2**20,
        features=2,
        min_resolution=16.0,
        max_resolution=256.0,
        width=64,
        hidden_layers=2,
        sh_degree=None,
        residual=False,
        down_weighting=True,
    )
    assert p.densify == DensifyConfig(
        start=500, stop=25_000, every=100, fraction=0.05, prune_opacity=0.005, prune_at_cap=False, floaters=False
    )


def test_default_prunes_at_the_cap_and_filters_points():
    p = preset("default")
    assert p == Config() and p.densify.prune_at_cap and p.densify.floaters and p.filter_points and not p.clamp_image
    assert p.texture.min_resolution is None and p.texture.max_resolution is None
    assert p.texture.residual and p.background is None and p.border > 0 and p.losses.depth > 0


def test_unknown_preset_is_refused():
    with pytest.raises(ValueError, match=r"^preset: expected one of default, paper, got 'papr'$"):
        preset("papr")


@pytest.mark.parametrize("config", [Config(), preset("paper"), small(background=(0.1, 0.5, 1.0), seed=3)])
def test_config_survives_json(config):
    again = config_from_dict(json.loads(json.dumps(config.as_dict())))
    assert again == config and again.as_dict() == config.as_dict()


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d | {"surfels": 3},
        lambda d: d | {"rates": d["rates"] | {"colour": 1.0}},
        lambda d: d | {"texture": 3},
        lambda d: d | {"iterations": "many"},
        lambda _: [],
    ],
)
def test_unknown_settings_are_refused(change):
    with pytest.raises(ValueError, match=r"^config: expected the settings of a nexwarp run") as caught:
        config_from_dict(change(Config().as_dict()))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_surfels", MIN_SURFELS - 1),
        ("max_surfels", 0),
        ("iterations", 0),
        ("max_hits", 9),
        ("max_hits", -1),
        ("more_hits_from", -1),
        ("sh_degree", 4),
    ],
)
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected at least .*, got {value}$"):
        Config(**{name: value})


def test_a_scene_without_training_views_is_refused(scene):
    with pytest.raises(ValueError, match="expected at least one training view, got none"):
        Trainer(dataclasses.replace(scene, train=[]), small(), "cpu")


# The starting point


def rescaled(scene: Scene, factor: float) -> Scene:
    """The same scene in other units."""

    def moved(view: View) -> View:
        c = view.camera
        viewmat = c.viewmat.clone()
        viewmat[:3, 3] *= factor
        camera = nw.Camera(viewmat, c.K, c.width, c.height, near=c.near * factor)
        assert view.points is not None
        return dataclasses.replace(view, camera=camera, points=view.points * factor)

    return dataclasses.replace(
        scene,
        train=[moved(view) for view in scene.train],
        test=[moved(view) for view in scene.test],
        points=scene.points * factor,
        scale=scene.scale * factor,
    )


@pytest.mark.parametrize("factor", [100.0, 1e-3])
def test_texture_follows_the_scale_of_the_scene(scene, factor):
    one, other = texture_shape(scene, small()), texture_shape(rescaled(scene, factor), small())
    assert other["min_resolution"] == pytest.approx(one["min_resolution"] / factor, rel=1e-4)
    assert other["max_resolution"] == pytest.approx(one["max_resolution"] / factor, rel=1e-4)
    ends = ("min_resolution", "max_resolution")
    assert {k: v for k, v in one.items() if k not in ends} == {k: v for k, v in other.items() if k not in ends}


@pytest.mark.parametrize(("factor", "look"), [(64.0, False), (1 / 64, False), (64.0, True)])
def test_training_does_not_depend_on_the_scale_of_the_scene(scene, factor, look, monkeypatch):
    """By a power of two most roundings are the same, too; Adam carries on what others leave as it does gradients."""
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    monkeypatch.setattr(floaters_module, "NEARER", 4.0)  # so that there are some
    texture = dataclasses.replace(TEXTURE, min_resolution=None, max_resolution=None)
    often = dataclasses.replace(OFTEN, floaters=look)
    config = small(iterations=40, texture=texture, densify=often)
    runs = [Trainer(s, config, "cpu") for s in (scene, rescaled(scene, factor))]
    counts = []
    for step in range(config.iterations):
        one, other = (torch.stack(list(trainer.step().losses.values())) for trainer in runs)
        assert_close(other, one, kind="gradient", name=f"losses of step {step}")
        counts.append(len(runs[0].surfels))
    assert len(runs[1].surfels) == counts[-1] and (counts[-1] < max(counts)) == look
    images = [t.model().render(t.views.cameras[0]).image for t in runs]
    assert_close(images[1], images[0], kind="gradient", name="image")


def test_surfels_settle_with_two_hits(scene):
    """Up to 25,000 of 30,000 iterations, a run with more is one with two; `more_hits_from` 0 has all from the start."""
    two, four, early = (
        Trainer(scene, small(iterations=12, max_hits=hits, more_hits_from=start), "cpu")
        for hits, start in ((2, 25_000), (4, 25_000), (4, 0))
    )
    assert [t.render_options().max_hits for t in (two, four, early)] == [2, 2, 4]
    for iteration in range(1, 13):
        for trainer in (two, four, early):
            trainer.step()
        if iteration < 10:
            assert_same_state(four, two)
        now = [t.render_options().max_hits for t in (two, four, early)]
        assert now == [2, 2 if iteration < 10 else 4, 4]
    assert not torch.equal(four.texture.grid, two.texture.grid)
    assert four.finish().options.max_hits == 4
    for hits in (0, 1):
        few = Trainer(scene, small(iterations=12, max_hits=hits), "cpu")
        assert few.render_options().max_hits == hits


def test_floaters_are_looked_for_while_there_is_time_to_learn_what_was_behind(scene, monkeypatch):
    """Every 3 of 60 iterations, from 50 on, where densification ends; at the end a last time."""
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    looks = []

    def first(model, cameras, nearest, generator, *, last):
        looks.append((trainer.iteration, len(model.surfels), generator.initial_seed()))
        assert last == (trainer.iteration == 60)
        return torch.arange(len(model.surfels)) == 0

    monkeypatch.setattr(trainer_module, "floaters", first)
    trainer = Trainer(scene, small(iterations=60, densify=dataclasses.replace(OFTEN, floaters=True)), "cpu")
    counts = {}
    trainer.run(observe=lambda progress: counts.update({progress.iteration: progress.surfels}))
    assert [look[0] for look in looks] == [51, 54, 57, 60]
    assert len({seed for _, _, seed in looks}) == 4
    assert all(counts[iteration] == count - 1 for iteration, count, _ in looks)


def test_without_points_nothing_tells_of_floaters(scene, monkeypatch):
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    monkeypatch.setattr(trainer_module, "floaters", lambda *_, **__: pytest.fail("looked"))
    blind = dataclasses.replace(scene, train=[dataclasses.replace(view, points=None) for view in scene.train])
    trained(blind, small(iterations=30, densify=dataclasses.replace(OFTEN, floaters=True)))


def test_looking_for_floaters_changes_nothing_where_there_are_none(scene, monkeypatch):
    monkeypatch.setattr(trainer_module, "FLOATERS_EVERY", 1)
    monkeypatch.setattr(floaters_module, "LEAST_SHARE", 2.0)
    monkeypatch.setattr(floaters_module, "LAST_SHARE", 2.0)
    with_look, without = (
        trained(scene, small(iterations=30, densify=dataclasses.replace(OFTEN, floaters=on))) for on in (True, False)
    )
    assert_same_state(with_look, without)


def test_finest_cells_are_the_pixels_of_nearly_all_views(scene):
    """Against the definition, point by point: the 95th percentile of f / t over what the views see."""
    densities = []
    for view in scene.train:
        c = view.camera
        for point in scene.points.double():
            x, y, t = (c.viewmat[:3, :3].double() @ point + c.viewmat[:3, 3].double()).tolist()
            inside = 0 <= c.fx * x / t + c.cx < c.width and 0 <= c.fy * y / t + c.cy < c.height
            if t > c.near and inside:
                densities.append(math.sqrt(c.fx * c.fy) / t)
    shape = texture_shape(scene, small())
    expected = torch.tensor(densities).double().quantile(0.95).item()
    assert shape["max_resolution"] == pytest.approx(expected, rel=1e-3)
    assert shape["min_resolution"] == pytest.approx(min(64 / scene.scale, expected / 4), rel=1e-3)


@pytest.mark.parametrize(
    ("pixels", "power"), [(21_600_000, 16), (9_000_000, 15), (330_000_000, 20), (1000, 12), (10**12, 20)]
)
def test_the_table_is_as_large_as_the_photos_can_fill(scene, pixels, power):
    """A tenth of a number for each pixel, 8 levels of 4 numbers an entry, and at most the paper's size."""
    each = pixels // len(scene.train)
    camera = Camera(torch.eye(4), torch.eye(3), 1000, each // 1000) if each >= 1000 else scene.train[0].camera
    views = [dataclasses.replace(view, camera=camera) for view in scene.train]
    sized = dataclasses.replace(scene, train=views)
    shape = texture_shape(sized, small(texture=TextureConfig(max_resolution=64.0)))
    assert shape["table_size"] == 2**power
    assert texture_shape(sized, small())["table_size"] == TEXTURE.table_size


def test_given_resolutions_are_kept(scene):
    config = small(texture=dataclasses.replace(TEXTURE, min_resolution=3.0, max_resolution=50.0))
    assert texture_shape(scene, config) == dataclasses.asdict(config.texture) | {"sh_degree": 3}


def directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)


def turn_cases() -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    torch.manual_seed(0)
    quats = torch.randn(200, 4)
    axes = rotations(quats)[:, :, 2]
    across = torch.linalg.cross(axes, directions(200))
    return {
        "random": (directions(200), quats),
        "aligned": (axes, quats),
        "opposite": (-axes, 5 * quats),
        "square": (torch.nn.functional.normalize(across, dim=-1), quats),
    }


@pytest.mark.parametrize("case", ["random", "aligned", "opposite", "square"])
def test_surfels_turn_to_their_normals_by_the_least_angle(case):
    normals, quats = turn_cases()[case]
    turned = quats_towards(normals, quats)
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(len(turned)), rtol=0, atol=1e-5)
    z = rotations(turned)[:, :, 2]
    cosines = (z * normals).sum(-1)
    torch.testing.assert_close(cosines.abs(), torch.ones(len(z)), rtol=0, atol=1e-5)
    # The rotation between both has the angle that the axis had from the nearer of +-normal.
    unit = torch.nn.functional.normalize(quats, dim=-1).double()
    half = (unit * turned.double()).sum(-1).abs()
    between = (rotations(unit)[:, :, 2] * normals.double()).sum(-1).abs()
    torch.testing.assert_close(2 * half.square() - 1, between, rtol=0, atol=1e-5)


@pytest.mark.parametrize("orient", [True, False])
@pytest.mark.parametrize("budget", [16, 101, 100_000])
def test_initial_surfels(scene, budget, orient):
    """Half the budget at most, opacity 0.1, gamma 1 + e^-5, colours of the points, on fitted planes or at random."""
    config = small(max_surfels=budget, orient_points=orient)
    surfels = initial_surfels(scene, config, torch.Generator().manual_seed(0))
    points = initial_points(
        scene.points,
        scene.colors,
        budget // 2,
        track_lengths=scene.track_lengths,
        errors=scene.reprojection_errors,
    )
    count = len(surfels)
    assert count == len(points.means) and count <= budget // 2
    assert torch.equal(surfels.means, points.means)
    full = torch.full
    torch.testing.assert_close(surfels.opacities, full((count,), 0.1))
    torch.testing.assert_close(surfels.gammas, full((count, 2), 1 + math.exp(-5)))
    torch.testing.assert_close(surfels.scales, points.scales[:, None].expand(-1, 2))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * surfels.sh[:, 0], points.colors)
    assert not surfels.sh[:, 1:].any() and surfels.sh.shape == (count, 16, 3)
    facing = (rotations(surfels.quats)[:, :, 2] * points.normals).sum(-1).abs()
    assert bool((facing > 1 - 1e-4).all()) == orient


def test_paper_takes_all_points(scene):
    """No filter and no planes: the preset's surfels may sit on points that the default leaves out."""
    config = dataclasses.replace(preset("paper"), max_surfels=100_000)
    surfels = initial_surfels(scene, config, torch.Generator().manual_seed(0))
    assert len(surfels) == len(scene.points.unique(dim=0))
    default = initial_surfels(scene, dataclasses.replace(config, filter_points=True), torch.Generator().manual_seed(0))
    assert len(default) < len(surfels)
