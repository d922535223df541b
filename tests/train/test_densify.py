import dataclasses
import math
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import pytest
import torch
from torch import nn

import nexwarp as nw
from nexwarp.cameras.camera import reduced
from nexwarp.model.graphs import without_graphs
from nexwarp.model.render import draw
from nexwarp.model.surfels import PARAMETERS
from nexwarp.train import densify
from nexwarp.train.densify import DensityControl, split_surfels
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.recipe import Config, DensifyConfig
from tests.ranks_support import run_ranks
from tests.reference.collect import rotations
from tests.scenes import make_surfels, random_scene
from tests.trainer_support import OFTEN, small

COPIED = ("raw_quats", "logit_opacities", "raw_gammas", "sh0", "shN")
MOMENTS = ("exp_avg", "exp_avg_sq")


def make(count: int = 40, seed: int = 0, opacity: float | None = None) -> tuple[nw.Surfels, torch.optim.Adam]:
    """Surfels of all orientations and shapes, and an Adam that has stepped once, so that it has moments."""
    scene = random_scene(count, seed=seed)
    if opacity is not None:
        scene["opacities"] = torch.full((count,), opacity)
    surfels = make_surfels(scene)
    rates = {"log_scales": 1e-5, "logit_opacities": 1e-6}
    groups = [{"params": [getattr(surfels, name)], "lr": rates.get(name, 1e-3), "name": name} for name in PARAMETERS]
    optimizer = torch.optim.Adam(groups)
    step(surfels, optimizer)
    return surfels, optimizer


def step(surfels: nw.Surfels, optimizer: torch.optim.Adam) -> None:
    """One Adam step on a loss whose gradient differs in every element."""
    losses = [(p * torch.linspace(0.5, 1.5, p.numel()).view(p.shape)).sum() for p in surfels.parameters()]
    torch.stack(losses).sum().backward()
    optimizer.step()
    optimizer.zero_grad()


def rows_of(surfels: nw.Surfels) -> dict[str, torch.Tensor]:
    return {name: getattr(surfels, name).detach().clone() for name in PARAMETERS}


def moments_of(surfels: nw.Surfels, optimizer: torch.optim.Adam) -> dict[str, torch.Tensor]:
    state = optimizer.state
    return {f"{key} of {name}": state[getattr(surfels, name)][key].clone() for name in PARAMETERS for key in MOMENTS}


def state_of(surfels: nw.Surfels, optimizer: torch.optim.Adam) -> dict[str, torch.Tensor]:
    return rows_of(surfels) | moments_of(surfels, optimizer)


def assert_rows(now: dict[str, torch.Tensor], rows: Any, before: dict[str, torch.Tensor], old_rows: Any) -> None:
    """Fail unless some rows are what others were before."""
    for name, values in now.items():
        assert torch.equal(values[rows], before[name][old_rows]), name


def sharp_kernel(surfels: nw.Surfels, row: int, points: torch.Tensor, gamma: float = 400.0) -> torch.Tensor:
    """exp(-(|u|^2g + |v|^2g) / 2) of a surfel at world `points` (P, 3), by an explicit rotation matrix."""
    rotation = rotations(surfels.raw_quats[row : row + 1].detach().double())[0]
    local = (points - surfels.means[row].detach().double()) @ rotation
    u, v = (local[:, :2] / surfels.scales[row].detach().double()).unbind(-1)
    return torch.exp(-(u.abs() ** (2 * gamma) + v.abs() ** (2 * gamma)) / 2)


def densifier_of(surfels: nw.Surfels, budget: int = 10_000, **changes: Any) -> DensityControl:
    control = DensityControl(surfels, Config(densify=DensifyConfig(**changes)))
    control.max_surfels = budget
    return control


def split(surfels: nw.Surfels, optimizer: torch.optim.Optimizer, chosen: torch.Tensor) -> None:
    """Split some surfels; second children are appended."""
    rows = torch.cat([torch.arange(len(surfels)), chosen])
    sides = torch.zeros_like(rows)
    sides[chosen], sides[len(surfels) :] = -1, 1
    split_surfels(surfels, optimizer, rows, sides)


def counts(rows: torch.Tensor, before: int) -> tuple[int, int]:
    """How many surfels a round split, and how many it pruned."""
    parents = len(rows.unique())
    return len(rows) - parents, before - parents


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def moments(parameter: nn.Parameter, optimizer: torch.optim.Optimizer) -> tuple[str, torch.Tensor | None]:
    """The name of a state of the parameter's shape, and the state; None before the first step."""
    state = optimizer.state.get(parameter, {})
    return next(((k, x.clone()) for k, x in state.items() if x.shape == parameter.shape), ("", None))


def test_children_tile_their_parent():
    """With hard edges, parent(x) = child(x) + child(x) everywhere in its plane: no gap, no overlap."""
    surfels, optimizer = make(12, seed=3)
    before = nw.Surfels(rows_of(surfels))
    chosen = torch.tensor([0, 3, 4, 9])
    split(surfels, optimizer, chosen)
    assert len(surfels) == 16
    uv = 3 * torch.rand(4000, 2, dtype=torch.float64) - 1.5
    edge = torch.minimum((uv.abs() - 1).abs().amin(1), uv.abs().amin(1))  # of the parent, and where its children meet
    uv = uv[edge > 0.01]
    for first, second in zip(chosen.tolist(), range(12, 16), strict=True):
        rotation = rotations(before.raw_quats[first : first + 1].detach().double())[0]
        offsets = (uv * before.scales[first].detach().double()) @ rotation[:, :2].T
        points = before.means[first].detach().double() + offsets
        whole = sharp_kernel(before, first, points)
        halves = sharp_kernel(surfels, first, points), sharp_kernel(surfels, second, points)
        assert 0.2 < whole.mean() < 0.8
        torch.testing.assert_close(halves[0] + halves[1], whole, rtol=0, atol=1e-3)


def test_split_copies_everything_else_and_leaves_others_alone():
    surfels, optimizer = make(20, seed=1)
    old = state_of(surfels, optimizer)
    chosen = torch.tensor([0, 6, 13])
    others = [i for i in range(20) if i not in chosen.tolist()]
    split(surfels, optimizer, chosen)
    now = state_of(surfels, optimizer)
    assert_rows(now, others, old, others)
    for rows in (chosen, slice(20, None)):
        assert_rows({name: now[name] for name in COPIED}, rows, old, chosen)
    for key, moments in moments_of(surfels, optimizer).items():
        assert len(moments) == 23 and bool((moments[others] != 0).all()), key
        assert not moments[chosen].any() and not moments[20:].any(), key


def test_choice_is_without_replacement_and_proportional_to_error():
    """P(i among the first two) = p_i + sum over j of p_j p_i / (1 - p_j); zero, negative and NaN errors never."""
    errors = torch.tensor([1.0, 2.0, 0.0, 4.0, 8.0, 0.5, float("nan"), 3.0, -1.0])
    surfels, _ = make(len(errors))
    densifier = densifier_of(surfels)
    p = errors.nan_to_num(0.0).clamp_min(0).double()
    p = p / p.sum()
    again = torch.tensor([[p[j] * p[i] / (1 - p[j]) if i != j else 0 for j in range(len(p))] for i in range(len(p))])
    expected = p + again.sum(1)
    draws, counts, source = 6000, torch.zeros(len(p), dtype=torch.float64), generator(1)
    for _ in range(draws):
        chosen = densifier._choose(errors, 2, source)
        assert len(set(chosen.tolist())) == 2
        counts[chosen] += 1
    assert counts[[2, 6, 8]].tolist() == [0, 0, 0]
    live = expected > 0
    deviation = (counts - draws * expected)[live] / (draws * expected * (1 - expected))[live].sqrt()
    assert deviation.abs().max() < 4.0, f"{deviation.tolist()} standard deviations off"
    assert deviation.square().sum() < 20.0  # of 6 degrees of freedom: one in 400


@pytest.mark.parametrize("budget", [20, 21, 50, 333])
def test_budget_holds_over_many_rounds(budget):
    surfels, optimizer = make(20, opacity=0.5)
    densifier = densifier_of(surfels, budget=budget)
    source = generator()
    for _ in range(80):
        count = len(surfels)
        densifier.accumulate(torch.rand(count, generator=source))
        more, pruned = counts(densifier.step(optimizer, source), count)
        assert pruned == 0 and len(surfels) == count + more
        assert more == min(budget, math.floor(1.05 * count + 1e-9)) - count
        assert len(surfels) <= budget and densifier.errors.shape == (len(surfels),)
    assert len(surfels) == budget


def addresses(surfels: nw.Surfels, optimizer: torch.optim.Adam, densifier: DensityControl) -> list[int]:
    """Of all tensors that a CUDA graph of a training step reads and writes."""
    moments = [x for state in optimizer.state.values() for x in state.values()]
    return [x.data_ptr() for x in (*surfels.parameters(), *moments, densifier.errors)]


def test_at_the_budget_children_take_the_rows_of_pruned_surfels():
    """Tensors stay where they are; rows of others stay as they are, children start without moments."""
    surfels, optimizer = make(20)
    gone = [2, 11, 17]
    with torch.no_grad():
        surfels.logit_opacities.copy_(torch.linspace(1.0, 0.5, 20))
        surfels.logit_opacities[gone[:2]] = -8.0
    densifier = densifier_of(surfels, budget=20, fraction=0.1)  # and one for the unneeded surfel
    parents = [4, 7, 19]
    errors = torch.zeros(20)
    errors[[*parents, *gone]] = 1.0
    densifier.accumulate(errors)
    unneeded = torch.zeros(20, dtype=torch.bool)
    unneeded[gone[2]] = True
    before, old = addresses(surfels, optimizer, densifier), state_of(surfels, optimizer)
    alone, alone_optimizer = make(20)
    alone.load_state_dict(surfels.state_dict())
    assert counts(densifier.step(optimizer, generator(), unneeded), 20) == (3, 3)
    assert addresses(surfels, optimizer, densifier) == before and not densifier.errors.any()
    split(alone, alone_optimizer, torch.tensor(parents))
    others = [i for i in range(20) if i not in (*gone, *parents)]
    assert_rows(state_of(surfels, optimizer), others, old, others)
    now, apart = state_of(surfels, optimizer), state_of(alone, alone_optimizer)
    assert_rows(now, [*parents, *gone], apart, [*parents, 20, 21, 22])
    assert not any(moments[[*parents, *gone]].any() for moments in moments_of(surfels, optimizer).values())


@pytest.mark.parametrize(
    ("budget", "at_cap", "faint", "more", "pruned"),
    [(20, True, 3, 3, 3), (20, False, 3, 0, 0), (21, True, 2, 3, 2), (21, False, 3, 1, 3)],
)
def test_prune_at_the_cap_is_a_choice_and_other_rounds_prune(budget, at_cap, faint, more, pruned):
    surfels, optimizer = make(20, opacity=0.5)
    with torch.no_grad():
        surfels.logit_opacities[:faint] = -8.0
    densifier = densifier_of(surfels, budget=budget, prune_at_cap=at_cap, fraction=0.05 if more == 1 else 0.2)
    densifier.accumulate(torch.eye(20)[10] if more == 1 else torch.ones(20))
    assert counts(densifier.step(optimizer, generator()), 20) == (more, pruned)
    assert len(surfels) == 20 + more - pruned and densifier.errors.shape == (len(surfels),)
    assert int((surfels.opacities < 0.4).sum()) == faint - pruned


@pytest.mark.parametrize(("fraction", "candidates", "more"), [(0.0, 16, 0), (0.05, 16, 1), (0.5, 1, 1), (0.5, 16, 4)])
def test_pruned_surfels_go_where_too_few_are_split(fraction, candidates, more):
    """The fraction of the surfels and those that have an error are bounds; rows without a child are removed."""
    surfels, optimizer = make(20)
    gone = [1, 5, 6, 19]
    with torch.no_grad():
        opacities = torch.linspace(0.0051, 0.99, 20).double()
        opacities[gone] = torch.tensor([0.001, 0.0049, 1e-6, 0.004999]).double()
        surfels.logit_opacities.copy_(opacities.logit())
    densifier = densifier_of(surfels, budget=20, fraction=fraction)
    stay = [i for i in range(20) if i not in gone]
    errors = torch.zeros(20)
    errors[stay[:candidates]] = 1.0
    errors[gone] = 9.0
    densifier.accumulate(errors)
    means = surfels.means.detach().clone()
    assert counts(densifier.step(optimizer, generator()), 20) == (more, 4)
    assert len(surfels) == 16 + more and bool((surfels.opacities > 0.005).all())
    assert densifier.errors.shape == (16 + more,) and all(len(p) == 16 + more for p in optimizer.state)
    unmoved = [bool((surfels.means == mean).all(dim=1).any()) for mean in means[stay]]
    assert unmoved.count(False) == more and not any(bool((surfels.means == x).all(dim=1).any()) for x in means[gone])


def test_chosen_ones_are_removed_but_never_the_most_opaque():
    surfels, optimizer = make(5)
    with torch.no_grad():
        surfels.logit_opacities.copy_(torch.tensor([0.0, 1.0, -9.0, 2.0, 0.5]))
    old = state_of(surfels, optimizer)
    densifier = densifier_of(surfels, fraction=0.0, prune_opacity=0.0)
    densifier.accumulate(torch.arange(5.0))
    assert densifier.step(optimizer, unneeded=torch.zeros(5, dtype=torch.bool)).tolist() == [0, 1, 2, 3, 4]
    kept = [1, 2, 3]
    assert densifier.step(optimizer, unneeded=torch.tensor([True, False, False, True, True])).tolist() == kept
    assert_rows(state_of(surfels, optimizer), slice(None), old, kept)
    assert densifier.errors.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("kind", [torch.optim.Adam, lambda p, lr: torch.optim.SGD(p, lr, momentum=0.9)])
@pytest.mark.parametrize("budget", [24, 80])
def test_a_loop_of_ones_own_takes_along_what_belongs_to_surfels(kind, budget):
    """Parameters of a module, a buffer and plain tensors follow the row map; an optimizer's state, too."""
    surfels = make_surfels(random_scene(20))
    extra: Any = nn.Module()
    extra.register_parameter("features", nn.Parameter(torch.rand(20, 5)))
    extra.register_buffer("numbers", torch.arange(20))
    optimizer = kind([{"params": surfels.parameters()}, {"params": extra.parameters()}], lr=1e-3)
    control = nw.DensityControl(surfels, nw.Config(max_surfels=budget, densify=DensifyConfig(fraction=0.4)))
    for _ in range(3):
        numbers, (key, state) = extra.numbers.clone(), moments(extra.features, optimizer)
        before = len(surfels)
        control.accumulate(torch.rand(before))
        gone = torch.arange(before) < 2 if before == budget else None  # replaced in place
        rows = control.step(optimizer, generator(), gone, along=[(extra, "features"), (extra, "numbers")])
        assert len(surfels) == len(rows) >= before and torch.equal(extra.numbers, numbers[rows])
        assert optimizer.param_groups[1]["params"] == [extra.features]
        children = torch.bincount(rows)[rows] > 1
        now = optimizer.state.get(extra.features, {}).get(key)
        if state is not None:
            assert torch.equal(now[~children], state[rows[~children]]) and not now[children].any()
        (sum(p.sum() for p in surfels.parameters()) + extra.features.square().sum()).backward()
        optimizer.step()
    assert len(surfels) == min(budget, 54)


def test_rounds_come_when_the_paper_says():
    surfels, _ = make(4)
    densifier = densifier_of(surfels)
    assert [i for i in range(30_001) if densifier.due(i)] == list(range(600, 25_000, 100))
    assert densifier.active(24_999) and not densifier.active(25_000)


# Relocation: the surfels that the training views need least make room for others


def test_what_no_image_shows_goes_first(tiny_scene: nw.Scene) -> None:
    """Surfels outside of all images and behind opaque ones; what is removed is nowhere more than what stays is."""
    trainer = nw.Trainer(tiny_scene, small(iterations=30), "cpu")
    surfels = trainer.surfels
    hidden = torch.arange(0, len(surfels), 7)
    with torch.no_grad():
        surfels.means[hidden[::2]] += 1e4
        surfels.logit_opacities[hidden[1::2]] = -20.0
    cameras = [view.camera for view in tiny_scene.train]

    def least_contributing(share: float) -> torch.Tensor:
        return densifier_of(surfels, relocate=share).unneeded(trainer.model(), cameras)

    chosen = least_contributing(len(hidden) / len(surfels) + 1e-6)
    assert torch.equal(chosen.nonzero()[:, 0], hidden)
    chosen = least_contributing(0.5)
    assert chosen.sum() == len(surfels) // 2 and chosen[hidden].all()
    most = torch.zeros(len(surfels))
    for camera in cameras:  # at full size, a sum of weights is that of half the size but for aliasing
        out = nw.render(surfels, None, camera)
        most = torch.maximum(most, out.splat_error(torch.full_like(out.alpha, 1 / out.alpha.numel())))
    assert most[chosen].mean() < 0.2 * most[~chosen].mean() and not least_contributing(0.0).any()


@pytest.mark.cuda
def test_graphs_measure_the_same(tiny_scene: nw.Scene) -> None:
    """Of cameras of one size, the first is launched and the second captured; without graphs all are launched."""
    model = nw.Trainer(tiny_scene, small(iterations=30), "cuda").model()
    cameras = [view.camera.to("cuda") for view in tiny_scene.train]
    cameras.append(reduced(cameras[0], cameras[0].height - 4))
    first, second = (Mock(side_effect=torch.clone) for _ in range(2))
    control = densifier_of(model.surfels)
    with patch.object(densify, "draw", wraps=draw) as drawn:
        control.unneeded(model, cameras, first)
        assert drawn.call_count == 3 < len(cameras)
        with without_graphs():
            control.unneeded(model, cameras, second)
        assert drawn.call_count == 3 + len(cameras)
    torch.testing.assert_close(first.call_args.args, second.call_args.args)


def test_ranks_share_the_views(tiny_scene: nw.Scene, tmp_path: Path) -> None:
    """Each renders some of them, and all choose what one process would."""
    model = nw.Trainer(tiny_scene, small(iterations=30), "cpu").model()
    control = densifier_of(model.surfels, relocate=0.3)
    cameras = [view.camera for view in tiny_scene.train]

    def work(ranks: Ranks) -> object:
        with patch.object(densify, "draw", wraps=draw) as drawn:
            return control.unneeded(model, cameras[ranks.rank :: ranks.size], ranks.largest).tolist(), drawn.call_count

    found = run_ranks(3, work, tmp_path)
    expected = control.unneeded(model, cameras)
    counts = [len(cameras[rank::3]) for rank in range(3)]
    assert found == [[expected.tolist(), count] for count in counts] and 0 < expected.sum() < len(expected)


def test_rounds_at_the_budget_relocate_in_the_first_part_of_density_control() -> None:
    surfels = make_surfels(random_scene(100))
    schedule = DensifyConfig(start=1, stop=1000, every=5, relocate=0.1)
    config = Config(max_surfels=100, densify=schedule)
    densifier = DensityControl(surfels, config)
    due = [i for i in range(1, 1001) if densifier.due(i) and densifier.relocates(i)]
    assert due == list(range(50, 600, 50))
    assert DensityControl(surfels, dataclasses.replace(config, max_surfels=102)).relocates(50)
    assert not DensityControl(surfels, dataclasses.replace(config, max_surfels=103)).relocates(50)
    never = dataclasses.replace(config, densify=dataclasses.replace(schedule, relocate=0.0))
    assert not DensityControl(surfels, never).relocates(50)
    with pytest.raises(ValueError, match=r"relocate: expected at least 0 and at most 0\.5, got 0\.6"):
        DensifyConfig(relocate=0.6)


def test_others_take_their_place(tiny_scene: nw.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    removed = []

    def first(control, model, cameras):
        removed.append((trainer.iteration, len(model.surfels), len(cameras)))
        return torch.arange(len(model.surfels)) < control.config.relocate * len(model.surfels)

    monkeypatch.setattr(DensityControl, "unneeded", first)
    config = small(iterations=120, densify=dataclasses.replace(OFTEN, relocate=0.2, prune_opacity=0.0, fraction=0.2))
    budget = 50
    trainer = nw.Trainer(tiny_scene, dataclasses.replace(config, max_surfels=budget), "cpu")
    counts: dict[int, int] = {}
    trainer.run(observe=lambda progress: counts.update({progress.iteration: progress.surfels}))
    assert [iteration for iteration, *_ in removed] == [30]
    assert all(before[1:] == (budget, len(tiny_scene.train)) for before in removed)
    assert counts[30] == counts[33] == budget, "as many are split as were removed"
