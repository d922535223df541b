import pytest
import torch

import nexwarp as nw
from nexwarp.ops.adam import Stepped, adam_step
from nexwarp.train.optimizer import FusedAdam, grid_factors, set_rates
from nexwarp.train.recipe import LossWeights
from tests.tolerances import assert_close

WEIGHTS = LossWeights(grid=0.01)
RATES = {"small": 1e-2, "odd": 3e-3, "grid": 1e-1}


def make_parameters(device: torch.device) -> tuple[nw.NeuralTexture, dict[str, torch.nn.Parameter]]:
    texture = nw.NeuralTexture(4, 2**6, 2, 4.0, 64.0).to(device)
    with torch.no_grad():
        texture.grid.uniform_(-1, 1)
    others = {"small": torch.nn.Parameter(torch.randn(3, device=device))}
    others["odd"] = torch.nn.Parameter(torch.randn(37, 7, device=device))
    # More than one launch takes, and some without values.
    rest = {f"{i} more": torch.nn.Parameter(torch.randn(i // 2, 3, device=device)) for i in range(20)}
    return texture, {**others, "grid": texture.grid, **rest}


def make_optimizer(parameters: dict[str, torch.nn.Parameter]) -> FusedAdam:
    rates = {name: torch.tensor(RATES.get(name, 2e-3), device=x.device) for name, x in parameters.items()}
    return FusedAdam([{"params": [x], "lr": rates[name]} for name, x in parameters.items()], eps=1e-15)


def test_steps_are_those_of_torch(device: torch.device) -> None:
    torch.manual_seed(0)
    texture, ours = make_parameters(device)
    torch.manual_seed(0)
    twin, theirs = make_parameters(device)
    theirs = {name: torch.nn.Parameter(x.detach().double()) for name, x in theirs.items()}
    optimizer = make_optimizer(ours)
    groups = [{"params": [x], "lr": RATES.get(name, 2e-3)} for name, x in theirs.items()]
    reference = torch.optim.Adam(groups, eps=1e-15)
    optimizer.regularise(texture, grid_factors(texture, WEIGHTS, 2.0))
    for step in range(30):
        for name, parameter in ours.items():
            scale = 10.0 ** (-step if name == "odd" else 0)  # gradients that fade far below the epsilon's square root
            parameter.grad = scale * torch.randn_like(parameter)
            theirs[name].grad = parameter.grad.double()
        cells = twin.resolutions.double() * 2.0
        loss = WEIGHTS.grid * (theirs["grid"].square().sum((1, 2)) / cells**3).sum()
        loss.backward()
        optimizer.step()
        reference.step()
        assert optimizer.grid_loss is not None
        assert_close(optimizer.grid_loss, loss, kind="value", name="grid loss")
    for name, parameter in ours.items():
        assert_close(parameter, theirs[name], kind="value", name=name)
        for key in ("exp_avg", "exp_avg_sq"):
            expected = reference.state[theirs[name]][key]
            assert_close(optimizer.state[parameter][key], expected, kind="value", name=f"{key} of {name}")
        assert optimizer.state[parameter]["step"] == 30


def test_epsilon_is_added_after_the_bias_correction(device: torch.device) -> None:
    """With gradients as small as epsilon, which early steps would otherwise see hundreds of times smaller."""
    ours = torch.nn.Parameter(torch.ones(5, device=device))
    theirs = torch.nn.Parameter(ours.detach().double())
    optimizer, reference = FusedAdam([{"params": [ours], "lr": 0.1}], eps=0.1), torch.optim.Adam([theirs], 0.1, eps=0.1)
    for _ in range(3):
        ours.grad = 0.1 * torch.rand_like(ours)
        theirs.grad = ours.grad.double()
        optimizer.step()
        reference.step()
    assert_close(ours, theirs, kind="value", name="parameter")


def test_half_copy_is_the_grid(device: torch.device) -> None:
    texture, parameters = make_parameters(device)
    optimizer = make_optimizer(parameters)
    optimizer.regularise(texture, None)
    for _ in range(2):
        texture.grid.grad = torch.randn_like(texture.grid)
        optimizer.step()
        assert torch.equal(texture.half_copy(), texture.grid.detach().half())
    assert optimizer.grid_loss is None
    with torch.no_grad():
        texture.grid.neg_()
    assert torch.equal(texture.half_copy(), texture.grid.detach().half())
    texture.load_state_dict({**texture.state_dict(), "grid": torch.ones_like(texture.grid)})
    assert (texture.half_copy() == 1).all()


@pytest.mark.parametrize("shape", [(5, 1, 1), (5, 8, 1), (3, 1024, 1), (2, 1024, 2)])
def test_grids_of_any_size_are_regularised(shape: tuple[int, int, int], device: torch.device) -> None:
    """Levels smaller than a thread's values and than a SIMD vector's, and several threads a level."""
    torch.manual_seed(1)
    factors = torch.rand(shape[0], device=device)
    ours = torch.randn(shape, device=device)
    theirs = ours.double().requires_grad_()
    expected = (factors.double()[:, None, None] * theirs.square()).sum()
    (grad,) = torch.autograd.grad(expected, theirs)
    step, rate = torch.ones((), device=device), torch.tensor(0.1, device=device)
    moments = Stepped(ours, torch.zeros_like(ours), torch.zeros_like(ours), None, step, rate)
    loss = adam_step([moments], betas=(0.9, 0.999), epsilon=1e-15, factors=factors)
    assert loss is not None
    assert_close(loss, expected, kind="value", name="loss")
    assert_close(moments.mean, 0.1 * grad, kind="value", name="mean")
    assert_close(moments.square, 0.001 * grad.square(), kind="value", name="square")
    assert_close(ours, theirs - 0.1 * grad.sign(), kind="value", name="grid")


def test_rates_in_tensors_are_the_same_numbers(device: torch.device) -> None:
    """As a CUDA graph reads them: in the tensors that the groups have."""
    ends = [(1e-3, 1e-5), (0.0, 0.0), (0.5, 0.5)]
    leaves = [torch.zeros(1, device=device, requires_grad=True) for _ in ends]
    numbers, tensors = (
        torch.optim.SGD([{"params": [x], "lr": rate, "ends": end} for x, end in zip(leaves, ends, strict=True)])
        for rate in (1.0, torch.tensor(1.0, device=device))
    )
    for group in tensors.param_groups:
        group["lr"] = group["lr"].clone()
    held = [group["lr"] for group in tensors.param_groups]
    for iteration in (1, 7, 30):
        for optimizer in (numbers, tensors):
            set_rates(optimizer, iteration, 30)
        expected = [group["lr"] for group in numbers.param_groups]
        assert torch.equal(torch.stack(held).cpu(), torch.tensor(expected))
    assert expected == pytest.approx([last for _, last in ends])


@pytest.mark.parametrize(
    ("values", "settings"),
    [(torch.zeros(3, dtype=torch.float16), {}), (torch.zeros(3, 2).T, {}), (torch.zeros(3), {"eps": 1e-8})],
)
def test_what_its_kernel_cannot_step_is_refused(values: torch.Tensor, settings: dict[str, float]) -> None:
    optimizer = FusedAdam([{"params": [torch.nn.Parameter(torch.zeros(4))], "lr": 0.1}], eps=1e-15)
    with pytest.raises(ValueError, match="mine: expected"):
        optimizer.add_param_group({"params": [torch.nn.Parameter(values)], "lr": 0.1, "name": "mine", **settings})
