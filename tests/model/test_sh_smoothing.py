import math

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.cameras.paths import look_at
from nexwarp.train.finish import seen_directions, smooth_sh
from nexwarp.train.recipe import MIN_STRENGTH, Config, TextureConfig
from tests.reference.sh import basis as sh_basis
from tests.scenes import make_surfels, random_scene
from tests.tolerances import assert_close, assert_equal

SIDE = 24
CONSTANT = 0.28209479177387814  # the harmonic of degree 0
ROUGHNESS = torch.tensor([(degree * (degree + 1) / 12) ** 2 for degree in range(4) for _ in range(2 * degree + 1)])


def view(position: list[float], mask: torch.Tensor | None = None) -> nw.View:
    K = torch.tensor([[30.0, 0.0, SIDE / 2], [0.0, 30.0, SIDE / 2], [0.0, 0.0, 1.0]])
    camera = nw.Camera(look_at(torch.tensor(position), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])), K, SIDE, SIDE)
    return nw.View(camera, torch.zeros(SIDE, SIDE, 3, dtype=torch.uint8), mask, "view.png")


def around(angles: list[float]) -> list[nw.View]:
    return [view([4 * math.sin(angle), 0.5 * angle, -4 * math.cos(angle)]) for angle in angles]


def blob(device: torch.device) -> nw.Surfels:
    """A surfel in the middle, seen from all sides but its edge, and one behind all cameras."""
    generator = torch.Generator().manual_seed(3)
    means, quats = torch.tensor([[0.0, 0.0, 0.0], [0.0, 300.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    shape = means, quats, torch.full((2, 2), 0.4), torch.full((2,), 0.9), torch.ones(2, 2)
    surfels = nw.Surfels.from_activated(*shape, 0.2 * torch.randn(2, 16, 3, generator=generator))
    return surfels.to(device)


def colors(surfels: nw.Surfels, views: list[nw.View], sh: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """(V, N, 3), of SH alone, without the offset and the limit at 0 that colours have."""
    offset = 10.0
    found = []
    for v in views:
        raised = ops.plain_colors((sh[0] + offset, sh[1]), surfels.means, v.camera.position.to(surfels.device), 3)
        found.append(raised - 0.5 - CONSTANT * offset)
    return torch.stack(found).detach()


def test_directions_count_by_the_weight_that_surfels_have_there(device: torch.device) -> None:
    """Weights are the derivatives of the picture's sum by the surfels' colours; pixels beyond the mask do not count."""
    surfels = make_surfels(random_scene(20, device=device))
    mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    mask[:, : SIDE // 2] = True
    views = [*around([0.0, 0.7]), view([0.5, -0.5, -4.0], mask)]
    found, total = (x.float() for x in seen_directions(nw.Model(surfels, None), views))
    row, column = torch.triu_indices(16, 16)
    expected, expected_total = torch.zeros_like(found), torch.zeros_like(total)
    for v in views:
        camera = v.camera.to(device)
        counts = torch.ones(SIDE, SIDE, 1, device=device) if v.mask is None else v.mask[..., None].to(device)
        surfels.sh0.grad = None
        (nw.render(surfels, None, camera, max_hits=0).plain * counts)[..., 0].sum().backward()
        shown = ops.plain_colors((surfels.sh0, surfels.shN), surfels.means, camera.position, 3)[:, 0] > 0
        assert surfels.sh0.grad is not None
        weights = torch.where(shown, surfels.sh0.grad[:, 0, 0] / CONSTANT, torch.nan)
        basis = torch.stack([colors(surfels, [v], one(k, surfels))[0, :, 0] for k in range(16)], dim=1)
        expected += weights[:, None] * basis[:, row] * basis[:, column]
        expected_total += weights
    known = expected_total.isfinite()
    assert known.sum() > 10 and (expected_total[known] > 0).any()
    assert_close(total[known], expected_total[known], kind="value", name="weights")
    assert_close(found[known], expected[known], kind="value", name="products")


def one(k: int, surfels: nw.Surfels) -> tuple[torch.Tensor, torch.Tensor]:
    sh = torch.zeros(len(surfels), 16, 3, device=surfels.device)
    sh[:, k] = 1.0
    return sh[:, :1].contiguous(), sh[:, 1:].contiguous()


@pytest.mark.parametrize("strength", [MIN_STRENGTH, 1e-3, 10.0])
def test_coefficients_are_those_of_ridge_regression(device: torch.device, strength: float) -> None:
    """A minimum of what the module's docstring says, by least squares over its terms, not by their normal equations."""
    surfels, views = blob(device), around([-0.6, -0.2, 0.1, 0.5])
    before = surfels.sh.detach().clone()
    weights = torch.stack([seen_directions(nw.Model(surfels, None), [v])[1][0] for v in views]).cpu()
    directions = torch.stack([-v.camera.position for v in views]).double()
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=1), 3)  # the surfel is in the world's middle
    seen = (weights / weights.sum()).sqrt()[:, None] * basis
    terms = torch.cat([seen, strength**0.5 * torch.diag(ROUGHNESS.double().sqrt())])
    targets = torch.cat([seen @ before[0].double().cpu(), torch.zeros(16, 3, dtype=torch.float64)])
    expected = torch.linalg.lstsq(terms, targets, driver="gelsd").solution
    found = torch.cat(smooth_sh(nw.Model(surfels, None), views, strength), dim=1)[0].double().cpu()
    assert torch.equal(surfels.sh, before)
    # Harmonics of float32: what their last bits tell of unseen directions grows as strength falls.
    assert (found - expected).abs().max() < 1e-4 < (found - before[0].double().cpu()).abs().max()


def test_unseen_surfels_get_one_colour_and_none_are_no_trouble(device: torch.device) -> None:
    surfels, views = blob(device), around([-0.5, 0.5])  # one view alone is told by one colour
    sh0, shN = smooth_sh(nw.Model(surfels, None), views, 0.01)
    assert torch.equal(sh0[1], surfels.sh0[1]) and not shN[1].any() and shN[0].abs().max() > 1e-3
    empty = nw.Surfels({name: x[:0] for name, x in surfels.state_dict().items()})
    assert [x.shape for x in smooth_sh(nw.Model(empty, None), views, 0.01)] == [(0, 1, 3), (0, 15, 3)]
    flat = nw.Surfels({name: x[:, :0] if name == "shN" else x for name, x in surfels.state_dict().items()})
    for a, b in zip(smooth_sh(nw.Model(flat, None), views, 0.01), (flat.sh0, flat.shN), strict=True):
        assert torch.equal(a, b)


def test_finishing_leaves_the_training_as_it_is(tiny_scene: nw.Scene, device: torch.device) -> None:
    """A model of its own: training goes on as if none had been asked for, on CUDA with graphs recorded anew."""
    texture = TextureConfig(levels=4, table_size=2**10, width=16, hidden_layers=1)
    config = Config(iterations=40, max_surfels=200, texture=texture, deterministic=device.type == "cuda")
    asked, other = (nw.Trainer(tiny_scene, config, device) for _ in range(2))
    # At any one step there may be no graph: where lists turn out too short, the next step drops it.
    replayed: list[bool] = []

    def observe(_: nw.StepReport) -> None:
        if asked.graphs is not None:
            replayed.extend(stage.captured is not None for stage in asked.graphs.stages.values())

    asked.run(observe, until=30)
    assert any(replayed) == (device.type == "cuda")
    model = asked.finish()
    assert model.meta["smooth_sh"] == 0.01 and model.surfels is not asked.surfels
    assert model.detail_limits is not None and not torch.equal(model.surfels.shN, asked.surfels.shN)
    kept = {name: x.clone() for name, x in model.surfels.state_dict().items()}
    asked.run()
    other.run()
    assert_equal(dict(asked._named_parameters()), dict(other._named_parameters()))
    assert_equal(model.surfels.state_dict(), kept)
