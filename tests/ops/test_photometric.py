import itertools

import pytest
import torch

from nexwarp.kernels import launch
from nexwarp.kernels.photometric import WEIGHT_EPSILON
from nexwarp.ops.photometric import photometric_terms
from tests.narrowing import present, total
from tests.reference import losses as reference
from tests.tolerances import assert_close

pytestmark = pytest.mark.usefixtures("restore_threads")

DTYPES = [torch.float32, torch.float64]
NAMES = ("image", "textured", "weights")
FACTORS = {"l1": 0.8, "texture": 0.5, "alpha": 0.3}
SUBSETS = [names for count in (1, 2, 3) for names in itertools.combinations(FACTORS, count)]


def inputs(height: int = 7, width: int = 9, slots: int = 2) -> dict[str, torch.Tensor]:
    """Image, textured, weights, which want gradients, and a target further away from them than a finite difference."""

    def noise(*shape: int) -> torch.Tensor:
        return (torch.randint(2, shape) * 2 - 1) * (0.05 + 0.2 * torch.rand(shape, dtype=torch.float64))

    target = torch.rand(height, width, 3, dtype=torch.float64)
    weights = 0.1 + 0.3 * torch.rand(height, width, slots, dtype=torch.float64)
    total = weights.sum(-1, keepdim=True)
    image, textured = target + noise(height, width, 3), (target + noise(height, width, 3)) * total
    given = {"image": image, "textured": textured, "weights": weights}
    return {name: x.requires_grad_() for name, x in given.items()} | {"target": target}


def expected_terms(given: dict[str, torch.Tensor], factors: dict[str, float]) -> dict[str, torch.Tensor]:
    image, textured, weights, target = given.values()
    terms = {
        "l1": lambda: reference.l1(image.clamp(0, 1), target),
        "texture": lambda: reference.texture(textured, weights, target),
        "alpha": lambda: reference.alpha(weights),
    }
    return {name: factor * terms[name]() for name, factor in factors.items()}


def terms_of(
    given: dict[str, torch.Tensor], factors: dict[str, float] = FACTORS
) -> tuple[torch.Tensor | None, torch.Tensor | None, torch.Tensor | None]:
    image, textured, weights, target = given.values()
    return photometric_terms(image, textured, weights, target, **factors)


def moved(given: dict[str, torch.Tensor], device: torch.device, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    return {name: x.detach().to(device, dtype).requires_grad_(x.requires_grad) for name, x in given.items()}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("names", SUBSETS, ids="+".join)
@pytest.mark.parametrize("size", [(7, 9, 1), (7, 9, 2), (7, 9, 5), (1, 1, 2), (1, 300, 2), (300, 1, 2)])
def test_terms_are_the_references(device, size, names, dtype):
    factors = {name: FACTORS[name] for name in names}
    given = inputs(*size)
    expected = expected_terms(given, factors)
    leaves = moved(given, device, dtype)
    actual = dict(zip(FACTORS, terms_of(leaves, factors), strict=True))
    assert {name for name, term in actual.items() if term is not None} == set(names)
    for name in names:
        assert_close(present(actual[name]), expected[name], kind="value", name=name)
    # Each term has a cotangent of its own.
    scales = {name: 2.0 + index for index, name in enumerate(names)}
    wanted_terms: list[dict[str, torch.Tensor | None]] = [actual, {**expected}]
    totals = [total(scales[name] * present(terms[name]) for name in names) for terms in wanted_terms]
    gradients = [
        torch.autograd.grad(loss, [source[name] for name in NAMES], allow_unused=True)
        for loss, source in zip(totals, (leaves, given), strict=True)
    ]
    for name, gradient, wanted in zip(NAMES, *gradients, strict=True):
        assert (gradient is None) == (wanted is None), name
        if gradient is not None:
            assert gradient.dtype == dtype
            assert_close(gradient, wanted, kind="gradient", name=f"gradient to {name}")


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_saturated_target_counts_no_brighter_value(device: torch.device, dtype: torch.dtype) -> None:
    """Terms and gradients are those of values that equal the target there."""
    saturation = 0.6
    given = inputs()
    image, textured, weights, target = given.values()
    share = weights.sum(-1, keepdim=True) + WEIGHT_EPSILON
    clipped = (target >= saturation) & (image > target), (target >= saturation) & (textured / share > target)
    assert all(0 < x.sum() < x.numel() for x in clipped)
    errors = (image.clamp(0, 1) - target).abs(), (textured / share - target).abs()
    wanted = [error.masked_fill(mask, 0.0).mean() for error, mask in zip(errors, clipped, strict=True)]
    leaves = moved(given, device, dtype)
    actual = photometric_terms(*leaves.values(), l1=1.0, texture=1.0, saturation=saturation)[:2]
    for term, expected in zip(actual, wanted, strict=True):
        assert_close(present(term), expected, kind="value", name="term")
    found = torch.autograd.grad(total(actual), [leaves[name] for name in NAMES])
    expected_gradients = torch.autograd.grad(total(wanted), [given[name] for name in NAMES])
    for name, gradient, expected in zip(NAMES, found, expected_gradients, strict=True):
        assert_close(gradient, expected, kind="gradient", name=f"gradient to {name}")


@pytest.mark.parametrize("wanted", SUBSETS, ids="+".join)
def test_gradients_go_only_where_they_are_wanted(wanted: tuple[str, ...]) -> None:
    """Whatever subset of the terms is used, and whatever subset of the inputs asks."""
    for needed in itertools.product((False, True), repeat=3):
        given = inputs(2, 3)
        for name, need in zip(NAMES, needed, strict=True):
            given[name].requires_grad_(need)
        actual = dict(zip(FACTORS, terms_of(given), strict=True))
        expected = expected_terms(given, FACTORS)
        leaves = [given[name] for name in NAMES if given[name].requires_grad]
        totals = [total(terms[name] for name in wanted) for terms in (actual, expected)]
        if not totals[1].requires_grad:
            continue
        gradients = [torch.autograd.grad(loss, leaves, allow_unused=True) for loss in totals]
        for gradient, want in zip(*gradients, strict=True):
            assert (gradient is None) == (want is None)
            if gradient is not None:
                assert_close(gradient, want, kind="gradient", name="gradient")


def values_and_gradients(given: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    terms = terms_of(given)
    return [*map(present, terms), *torch.autograd.grad(total(terms), [given[name] for name in NAMES])]


def test_inputs_need_not_be_contiguous(device: torch.device) -> None:
    given = moved(inputs(), device, torch.float64)
    swapped = {name: x.detach().transpose(0, 1).contiguous().transpose(0, 1) for name, x in given.items()}
    turned = {name: x.requires_grad_(given[name].requires_grad) for name, x in swapped.items()}
    assert not any(x.is_contiguous() for x in turned.values())
    results = [values_and_gradients(source) for source in (given, turned)]
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_equal_colours_have_no_gradient(device: torch.device) -> None:
    target = torch.rand(4, 5, 3, device=device)
    target[0] = 0.0
    image = target.clone().requires_grad_()
    textured = torch.zeros_like(target).requires_grad_()
    weights = torch.full((4, 5, 2), 0.5, device=device).requires_grad_()
    loss = total(photometric_terms(image, textured, weights, target, l1=1.0, texture=1.0)[:2])
    to_image, to_textured, to_weights = torch.autograd.grad(loss, [image, textured, weights])
    assert not to_image.any() and not to_textured[0].any() and (to_textured[1:] < 0.0).all()
    assert not to_weights.any()  # the texture is black: no weight changes that


def test_a_nan_shows_in_its_terms_and_stays_in_its_pixel(device: torch.device) -> None:
    given = moved(inputs(), device, torch.float64)
    with torch.no_grad():
        given["weights"][3, 4, 1] = float("nan")
    terms = terms_of(given)
    assert [bool(present(term).isnan()) for term in terms] == [False, True, True]
    gradients = torch.autograd.grad(total(terms), [given[name] for name in NAMES])
    assert [int(gradient.isnan().sum()) for gradient in gradients] == [0, 3, 2]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_results_repeat_whatever_the_threads(device: str) -> None:
    given = moved(inputs(190, 270), torch.device(device), torch.float32)
    results = []
    for count in (1, 2, 3, 3):
        launch.set_num_threads(count)
        results.append(values_and_gradients(given))
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


def test_a_target_that_wants_a_gradient_is_refused() -> None:
    given = inputs()
    given["target"].requires_grad_()
    for factors in ({"l1": 1.0}, {"texture": 1.0}):
        with pytest.raises(ValueError, match="target: expected a tensor that needs no gradient"):
            terms_of(given, factors)
