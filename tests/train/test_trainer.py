import dataclasses
import gc
import itertools
import math
import sys
import weakref
from types import SimpleNamespace

import pytest
import torch

import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.ops import ahead
from nexwarp.train.recipe import DensifyConfig, LearningRates, TextureConfig
from tests.narrowing import neural
from tests.scene_writers import with_exposures
from tests.tolerances import assert_close, assert_equal
from tests.trainer_support import OFTEN, TEXTURE, assert_resumed_alike, assert_same_state, rescaled, small, trained


def test_a_trainer_is_freed_with_its_last_reference(scene):
    """A cycle would keep a teacher's memory until the garbage collector comes, while the next one trains."""
    trainer = nw.Trainer(scene, small(), "cpu")
    trainer.step()
    left = weakref.ref(trainer)
    gc.disable()
    try:
        del trainer
        assert left() is None
    finally:
        gc.enable()


@pytest.mark.parametrize(("stop", "max_hits"), [(6, 2), (7, 2), (7, 0)])
def test_resuming_changes_nothing(scene, tmp_path, stop, max_hits):
    straight = trained(scene, small(max_hits=max_hits))
    assert len(straight.surfels) > 60  # it has split
    assert_resumed_alike(straight, tmp_path, stop)


def test_same_seed_same_run_and_other_seeds_differ(scene):
    first = trained(scene, small(seed=1))
    torch.rand(5)  # the state before has no say
    assert_same_state(first, trained(scene, small(seed=1)))
    other = trained(scene, small(seed=2))
    assert not torch.equal(first.surfels.raw_quats[:60], other.surfels.raw_quats[:60])
    assert not torch.equal(next(neural(first.texture).mlp.parameters()), next(neural(other.texture).mlp.parameters()))
    assert first.order != other.order


@pytest.mark.cuda
def test_deterministic_runs_are_the_same_on_cuda(scene):
    runs, exposed = [], with_exposures(scene)
    for _ in range(3):
        trainer = nw.Trainer(exposed, small(iterations=60, max_surfels=400, deterministic=True), "cuda")
        trainer.run()
        runs.append(trainer)
    assert not torch.are_deterministic_algorithms_enabled()
    for other in runs[1:]:
        assert_same_state(other, runs[0])
    first, *others = (trainer.finish() for trainer in runs)
    assert first.exposures is not None and first.detail_limits is not None
    for model in others:
        assert_equal(model.state_dict(), first.state_dict())


def test_progress_tells_what_happened(scene):
    trainer = nw.Trainer(scene, small(), "cpu")
    seen: list[nw.StepReport] = []
    trainer.run(seen.append)
    assert [p.iteration for p in seen] == list(range(1, 13)) and seen[-1].surfels == len(trainer.surfels)
    for p in seen:
        assert p.loss() == pytest.approx(sum(x.item() for x in p.losses.values()), rel=1e-6)
        error = (p.image.detach().double().clamp(0, 1) - p.target.double()).square().mean().item()
        assert p.psnr() == pytest.approx(-10 * math.log10(error), abs=1e-4)
    for p in seen:
        assert set(p.losses) == {"l1", "dssim", "texture", "alpha", "opacity", "grid", "depth"}
    counts = [p.surfels for p in seen]
    assert all(later == before for i, (before, later) in enumerate(itertools.pairwise(counts)) if i % 3 != 1)
    assert counts[2] == 63 == int(1.05 * counts[0]) and max(counts) <= 120


def test_seconds_have_waits_for_the_gpu_but_not_the_observer(scene, monkeypatch):
    trainer, clock = nw.Trainer(scene, small(), "cpu"), [0.0]

    def passes(seconds: float) -> None:
        clock[0] += seconds

    monkeypatch.setattr(sys.modules["nexwarp.train.trainer"], "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(trainer, "check", lambda: passes(2.0))  # as on a GPU: steps return before their work is done
    trainer.run(lambda _: passes(0.5))
    assert trainer.seconds == 2.0


def test_rates_are_log_linear_between_their_ends(scene):
    config = small(iterations=9, rates=LearningRates(mlp=(1e-3, 1e-5)))
    trainer, rates = nw.Trainer(scene, config, "cpu"), []
    trainer.run(lambda _: rates.append([group["lr"] for group in trainer.optimizer.param_groups]))
    assert trainer.optimizer.defaults["eps"] == 1e-15  # the paper's
    r, s = config.rates, scene.scale
    constant = [r.opacities, r.gammas, r.sh0]
    assert rates[0] == pytest.approx([1.6e-4 * s, r.quats, 2e-2, *constant, 6.25e-4, 1e-3, 1e-3], rel=1e-12)
    assert rates[-1] == pytest.approx([1.6e-6 * s, r.quats, 1e-3, *constant, 6.25e-5, 1e-5, 1e-5], rel=1e-12)
    assert torch.tensor(rates, dtype=torch.float64).log().diff(n=2, dim=0).abs().max() < 1e-9
    for step, row in enumerate(rates):
        assert row[0] == pytest.approx(1.6e-4 * s * 100 ** (-step / 8), rel=1e-9)


@pytest.mark.parametrize(("iterations", "every"), [(30_000, 1000), (3000, 100), (60, 2)])
def test_one_degree_is_unlocked_every_thousand_iterations_of_thirty(scene, iterations, every):
    trainer = nw.Trainer(scene, small(iterations=iterations), "cpu")
    degrees = {}
    for iteration in (1, every - 1, every, 2 * every - 1, 2 * every, 3 * every - 1, 3 * every, iterations):
        trainer.iteration = iteration
        degrees[iteration] = trainer.render_options().sh_degree
    assert degrees == {i: min(3, i // every) for i in degrees} and degrees[iterations] == 3
    lower = nw.Trainer(scene, small(iterations=iterations, sh_degree=1), "cpu")
    lower.iteration = iterations
    assert lower.render_options().sh_degree == 1 and lower.surfels.sh.shape[1] == 4


@pytest.mark.parametrize(
    ("iterations", "rounds"),
    [(30_000, (500, 25_000, 100)), (3000, (50, 2500, 10)), (60_000, (1000, 50_000, 200)), (600, (10, 500, 10))],
)
def test_rounds_stretch_with_the_run(scene, iterations, rounds):
    config = nw.Trainer(scene, small(iterations=iterations, densify=DensifyConfig()), "cpu").densifier.config
    assert (config.start, config.stop, config.every) == rounds


def test_surfels_settle_with_two_hits(scene):
    """Up to 25,000 of 30,000 iterations, a run with more is one with two; `more_hits_from` 0 has all from the start."""
    settings = [{"max_hits": hits, "more_hits_from": start} for hits, start in ((2, 25_000), (4, 25_000), (4, 0))]
    two, four, early = (nw.Trainer(scene, small(iterations=12, **each), "cpu") for each in settings)
    assert [t.render_options().max_hits for t in (two, four, early)] == [2, 2, 4]
    for iteration in range(1, 13):
        for trainer in (two, four, early):
            trainer.step()
        if iteration < 10:
            assert_same_state(four, two)
        assert [t.render_options().max_hits for t in (two, four, early)] == [2, 2 if iteration < 10 else 4, 4]
    assert not torch.equal(neural(four.texture).grid, neural(two.texture).grid) and four.finish().options.max_hits == 4
    for hits in (0, 1):
        assert nw.Trainer(scene, small(iterations=12, max_hits=hits), "cpu").render_options().max_hits == hits


def test_surfels_get_sharper_in_the_middle_of_a_run(scene):
    config, least = small(iterations=40, least_gamma=3.0), dict[int, float]()
    assert [config.least_gamma_at(i) for i in (1, 12, 22, 32, 40)] == pytest.approx([1, 1, 2, 3, 3])
    trainer = nw.Trainer(scene, config, "cpu")
    trainer.run(lambda step: least.update({step.iteration: trainer.surfels.gammas.min().item()}))
    assert least[19] < 1.1 and [least[i] for i in (20, 30, 40)] == pytest.approx([1.8, 2.8, 3.0], rel=1e-6)


@pytest.mark.parametrize("factor", [64.0, 1 / 64])
def test_training_does_not_depend_on_the_scale_of_the_scene(scene, factor):
    """By a power of two most roundings are the same, too; Adam carries on what others leave as it does gradients."""
    texture = dataclasses.replace(TEXTURE, min_resolution=None, max_resolution=None)
    config = small(iterations=40, texture=texture, densify=OFTEN)
    runs = [nw.Trainer(s, config, "cpu") for s in (scene, rescaled(scene, factor))]
    for step in range(config.iterations):
        one, other = (torch.stack(list(trainer.step().losses.values())) for trainer in runs)
        assert_close(other, one, kind="gradient", name=f"losses of step {step}")
    assert len(runs[1].surfels) == len(runs[0].surfels)
    images = [t.model().render(t.views.cameras[0]).image for t in runs]
    assert_close(images[1], images[0], kind="gradient", name="image")


def test_what_is_loaded_ahead_is_what_a_training_launches(scene, device, monkeypatch):
    launched, listed, plain = {}, {}, launch.launch

    def noted(kernel, *arguments, block_dim=launch.LAUNCH_THREADS, **rest):
        launched[kernel] = block_dim
        plain(kernel, *arguments, block_dim=block_dim, **rest)

    monkeypatch.setattr(launch, "launch", noted)
    monkeypatch.setattr(ahead, "load_ahead", lambda kernels, _: listed.update(kernels))
    model = nw.train(with_exposures(scene), small(texture=TextureConfig(table_size=2**10)), device=device)
    with torch.no_grad():
        model.render(scene.test[0].camera.to(device))
    assert launched == listed
