from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch.autograd import gradcheck

import nexwarp as nw
from nexwarp.cameras.camera import visible_points
from nexwarp.ops.photometric import depth_term
from nexwarp.train import losses
from nexwarp.train.recipe import LossWeights
from tests.narrowing import present, total
from tests.reference import losses as reference
from tests.tolerances import assert_close


def arguments(slots: int = 2) -> dict[str, torch.Tensor]:
    """Inputs of `photo_losses`, leaves but for the target, which is apart from the image in every pixel."""
    target = torch.rand(13, 17, 3, dtype=torch.float64)
    image = target + (torch.randint(2, target.shape) * 2 - 1) * (0.05 + 0.2 * torch.rand_like(target))
    weights = 0.4 * torch.rand(13, 17, slots, dtype=torch.float64)
    textured = 0.5 * weights.sum(-1, keepdim=True).repeat(1, 1, 3)
    leaves = {"image": image, "textured": textured, "weights": weights}
    return {name: x.requires_grad_() for name, x in leaves.items()} | {"target": target}


def terms_of(x: dict[str, torch.Tensor], factors: LossWeights | None = None, **masks: Any) -> dict[str, torch.Tensor]:
    camera, out = cast(nw.Camera, None), cast(nw.Rendering, SimpleNamespace(**x))
    return losses.photo_losses(out, nw.Target(camera, x["target"], 0.0, **masks), factors or LossWeights())


@pytest.mark.parametrize(("slots", "counted"), [(1, 1), (2, 2), (3, 2), (4, 2)])
def test_photo_losses_are_the_papers_total(slots: int, counted: int) -> None:
    """The heaviest hits count as textured for the term of the weights alone: the texture's has all of them."""
    x = arguments(slots)
    terms = terms_of(x)
    assert set(terms) == {"l1", "dssim", "texture", "alpha"}
    image, target = x["image"].clamp(0, 1), x["target"]
    total = 0.8 * reference.l1(image, target) + 0.2 * reference.dssim(image, target)
    assert_close(terms["l1"] + terms["dssim"], total, kind="value", name="image")
    alpha = reference.alpha(x["weights"].detach()[..., :counted])
    assert_close(terms["alpha"], 0.005 * alpha, kind="value", name="alpha")
    (grad,) = torch.autograd.grad(terms["alpha"], x["weights"], retain_graph=True)
    assert bool((grad[..., :counted] < 0).all()) and not grad[..., counted:].any()
    texture = 0.5 * reference.texture(x["textured"], x["weights"], x["target"])
    assert_close(terms["texture"], texture, kind="value", name="texture")


def test_terms_without_weight_or_input_are_not_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def names(slots: int = 2, **weights: Any) -> set[str]:
        return set(terms_of(arguments(slots), LossWeights(**weights)))

    assert names(slots=0) == {"l1", "dssim"} and names(dssim=1.0) == {"dssim", "texture", "alpha"}
    monkeypatch.setattr(losses, "weighted_dssim", None)
    assert names(dssim=0, alpha=0, texture=0) == {"l1"}


# What does not count, what is empty, and depths


def test_a_mask_leaves_no_gradient_where_it_is_false() -> None:
    tensors = arguments()
    mask = torch.rand(13, 17) < 0.7
    terms = terms_of(tensors, counts=mask)
    total(terms.values()).backward()
    for name in ("image", "textured", "weights"):
        gradient = present(tensors[name].grad)
        assert not gradient[~mask].any() and gradient[mask].any(), name
    spoilt = {name: torch.where(mask[..., None], x, 0.1 * x) for name, x in tensors.items() if name != "weights"}
    again = terms_of({**tensors, **spoilt, "target": tensors["target"]}, counts=mask)
    for name in ("l1", "dssim", "texture"):
        assert_close(again[name], terms[name], kind="value", name=name)


def test_where_nothing_is_only_the_image_counts() -> None:
    tensors = arguments()
    empty = torch.rand(13, 17) < 0.4
    terms = terms_of(tensors, empty=empty)
    expected = terms_of(tensors)
    for name in ("l1", "dssim"):
        assert_close(terms[name], expected[name], kind="value", name=name)
    total(terms.values()).backward()
    for name in ("textured", "weights"):
        gradient = present(tensors[name].grad)
        assert not gradient[empty].any() and gradient[~empty].any(), name


def test_visible_points_by_hand() -> None:
    nan = float("nan")
    pixels = torch.tensor([[2.9, 1.1], [4.0, 1.0], [2.5, -0.1], [nan, 1.0], [2.5, 1.5], [0.0, 2.999], [1.0, 3.0]])
    depths = torch.tensor([2.0, 2.0, 2.0, 1.0, -2.0, 5.0, 1.0])
    places, expected = visible_points(pixels, depths, 4, 3)
    assert places.tolist() == [1 * 4 + 2, 2 * 4 + 0] and expected.tolist() == [2.0, 5.0]
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[1, 2] = False
    places, expected = visible_points(pixels, depths, 4, 3, mask)
    assert places.tolist() == [8] and expected.tolist() == [5.0]
    assert not visible_points(pixels, depths, 4, 3, torch.zeros(3, 4, dtype=torch.bool))[0].numel()
    assert not visible_points(pixels, -depths.abs(), 4, 3)[0].numel()


def test_depth_loss_by_hand(device: torch.device) -> None:
    """Two slots of weights 0.3 and 0.1 at depths 2 and 4: 2.5 in the mean, against 2; and a pixel without hits."""
    depths, weights = torch.zeros(3, 4, 2), torch.zeros(3, 4, 2)
    depths[1, 2], weights[1, 2] = torch.tensor([2.0, 4.0]), torch.tensor([0.3, 0.1])
    places, expected = torch.tensor([0, 6, 6]), torch.tensor([3.0, 2.0, 2.5])
    loss = depth_term(*(x.to(device) for x in (depths, weights, expected, places)))
    assert loss.item() == pytest.approx((0.25 + 0 + 1) / 3, abs=1e-5)


def test_what_fills_up_points_does_not_count() -> None:
    depths = (2 + torch.rand(3, 4, 2)).requires_grad_()
    weights = (0.1 + 0.4 * torch.rand(3, 4, 2)).requires_grad_()
    places, expected = torch.tensor([3, 5, 11]), torch.tensor([1.5, 3.9, 4.0])
    found = []
    for fill in (0, 5):
        padded = torch.cat([expected, expected.new_zeros(fill)]), torch.cat([places, places.new_full((fill,), 12)])
        loss = depth_term(depths, weights, *padded)
        found.append([loss.detach(), *torch.autograd.grad(loss, [depths, weights])])
    for bare, filled in zip(*found, strict=True):
        assert torch.equal(bare, filled)
    for count in (3, 0):
        none = depth_term(depths, weights, torch.zeros(count), places[:count])
        assert none.item() == 0 and not any(x.any() for x in torch.autograd.grad(none, [depths, weights]))


def test_the_loss_of_a_depth_map_is_that_of_points_in_all_pixels() -> None:
    """By hand for one pixel, by points for the rest, by finite differences for the gradients; unknown ones are out."""
    depths = (2 + torch.rand(3, 4, 2, dtype=torch.float64)).requires_grad_()
    weights = (0.1 + 0.4 * torch.rand(3, 4, 2, dtype=torch.float64)).requires_grad_()
    expected = 1.5 + 3 * torch.rand(3, 4, dtype=torch.float64)
    one = depth_term(torch.tensor([[[2.0, 4.0]]]), torch.tensor([[[0.3, 0.1]]]), torch.tensor([[2.0]]))
    assert one.item() == pytest.approx(0.25, abs=1e-5)
    expected[1, :2] = 0
    known = expected.flatten().nonzero()[:, 0]
    loss = depth_term(depths, weights, expected)
    points = depth_term(depths, weights, expected.flatten()[known], known)
    assert_close(loss, points, kind="value", name="loss")
    assert gradcheck(lambda d, w: depth_term(d, w, expected), [depths, weights])
    for gradient in torch.autograd.grad(loss, [depths, weights]):
        assert not gradient[1, :2].any() and gradient[expected > 0].any()
    assert depth_term(depths, weights, torch.zeros(3, 4, dtype=torch.float64)).item() == 0


def test_depth_loss_against_finite_differences(device: torch.device) -> None:
    depths = (2 + torch.rand(3, 4, 2, dtype=torch.float64)).requires_grad_()
    weights = (0.1 + 0.4 * torch.rand(3, 4, 2, dtype=torch.float64)).requires_grad_()
    places, expected = torch.tensor([0, 0, 5, 11]), torch.tensor([1.5, 3.9, 2.0, 4.0], dtype=torch.float64)
    points = expected.to(device), places.to(device)
    assert gradcheck(lambda d, w: depth_term(d.to(device), w.to(device), *points), [depths, weights])
