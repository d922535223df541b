import math

import pytest
import scipy.special
import torch

from nexwarp.kernels.types import MAX_SH_DEGREE
from tests.reference.collect import Shape, View, collect
from tests.reference.hashgrid import encode, hash_corners
from tests.reference.render import Texture, render
from tests.reference.sh import basis, plain_colors
from tests.scenes import Scene, intrinsics, random_scene, rigid
from tests.tolerances import assert_close

FLOATS = ("means", "quats", "scales", "opacities", "gammas")


def tensor(*values: float | tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def view_of(scene: Scene) -> View:
    """The intrinsics of `scene` as the reference takes them."""
    (fx, _, cx), (_, fy, cy), _ = scene["K"].tolist()
    return View(fx, fy, cx, cy, scene["width"], scene["height"], scene["near"])


def sheets(
    *surfels: tuple[float, float], scale: tuple[float, float] = (0.2, 0.1)
) -> tuple[Shape, torch.Tensor, torch.Tensor]:
    """Surfels (z, opacity) that face the camera on its axis, primary colours in turn, and the camera's matrix."""
    z, opacities = tensor(*surfels).unbind(-1)
    count = len(surfels)
    quats, scales = tensor((1, 0, 0, 0)).expand(count, -1), tensor(scale).expand(count, -1)
    means = torch.stack([0 * z, 0 * z, z], dim=-1)
    shape = Shape(means, quats, scales, opacities, tensor((1.0, 1.5)).expand(count, -1))
    return shape, torch.eye(3, dtype=torch.float64)[torch.arange(count) % 3], torch.eye(4, dtype=torch.float64)


# Five by five pixels; the centre of pixel [2, 2] is the principal point, a pixel is 0.2 wide at depth 2.
VIEW = View(10.0, 10.0, 2.5, 2.5, 5, 5, 0.01)


def value_of(number: torch.Tensor, expected: float | list[float], name: str) -> None:
    assert_close(number, torch.tensor(expected, dtype=torch.float64), kind="value", name=name)


def test_basis_is_the_real_form_of_scipys() -> None:
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    polar, azimuth = directions[:, 2].acos(), torch.atan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(MAX_SH_DEGREE + 1):
        for order in range(-degree, degree + 1):
            values = scipy.special.sph_harm_y(degree, abs(order), polar.numpy(), azimuth.numpy())
            columns.append(torch.as_tensor(values.imag if order < 0 else values.real) * (math.sqrt(2) if order else 1))
    assert_close(basis(directions, MAX_SH_DEGREE), torch.stack(columns, dim=-1), kind="value", name="basis")


def test_plain_color_by_hand() -> None:
    """Seen along +z, degree 1 adds 0.4886 times coefficient 2; negative colours are cut."""
    sh = torch.zeros(1, 4, 3, dtype=torch.float64)
    sh[0, 0] = tensor(1.0, 0.0, -9.0)
    sh[0, 2] = tensor(0.0, 1.0, 0.0)
    colors = plain_colors(sh, tensor((1.0, 2.0, 7.0)), tensor(1.0, 2.0, 3.0), 3)
    value_of(colors[0], [0.5 + 0.28209479177387814, 0.5 + 0.4886025119029199, 0.0], "colors")
    colors = plain_colors(sh, tensor((1.0, 2.0, 7.0)), tensor(1.0, 2.0, 3.0), 0)
    value_of(colors[0], [0.5 + 0.28209479177387814, 0.5, 0.0], "colors at degree 0")


def test_one_surfel_by_hand() -> None:
    hits = collect(*sheets((2.0, 0.8)), VIEW, 1)
    value_of(hits.alpha[2, 2], 0.8, "centre: u = v = 0")
    value_of(hits.alpha[2, 3], 0.8 * math.exp(-0.5), "one pixel right: u = 1, gamma 1")
    value_of(hits.alpha[2, 4], 0.8 * math.exp(-2.0), "two pixels right: u = 2")
    value_of(hits.alpha[3, 2], 0.8 * math.exp(-4.0), "one pixel down: v = 2, gamma 1.5, so |v|^3 / 2 = 4")
    value_of(hits.alpha[0, 2], 0.0, "two pixels up: v = 4, below the cut-off")
    value_of(hits.depths[2, 2, 0], 2.0, "depth")
    assert hits.ids[2, 3].tolist() == [0] and hits.ids[0, 2].tolist() == [-1]
    assert not hits.weights[0, 2].any() and not hits.depths[0, 2].any() and not hits.plain.any()


def test_cut_off_and_cap() -> None:
    kept, cut = 1.001 / 255, 0.999 / 255
    value_of(collect(*sheets((2.0, kept)), VIEW, 0).alpha[2, 2], kept, "just above 1/255")
    value_of(collect(*sheets((2.0, cut)), VIEW, 0).alpha[2, 2], 0.0, "just below 1/255")
    value_of(collect(*sheets((2.0, 1.0)), VIEW, 0).alpha[2, 2], 0.99, "capped")


def test_two_layers_by_hand() -> None:
    """In front of (back, first in the list) alpha 0.8 stands alpha 0.5."""
    scene = sheets((3.0, 0.8), (2.0, 0.5))
    for max_hits in (0, 1, 2, 4):
        hits = collect(*scene, VIEW, max_hits)
        red, green = (0.4 if max_hits < 2 else 0.0), (0.5 if max_hits < 1 else 0.0)
        value_of(hits.plain[2, 2], [red, green, 0.0], f"plain, K = {max_hits}")
        value_of(hits.alpha[2, 2], 0.9, f"alpha, K = {max_hits}")
        value_of(hits.weights[2, 2], [0.5, 0.4, 0.0, 0.0][:max_hits], f"weights, K = {max_hits}")
        value_of(hits.depths[2, 2], [2.0, 3.0, 0.0, 0.0][:max_hits], f"depths, K = {max_hits}")
        assert hits.ids[2, 2].tolist() == [1, 0, -1, -1][:max_hits]


def test_nearer_wins_a_tie_of_weights() -> None:
    """0.8 x 0.25 is 0.2 to the last bit."""
    assert collect(*sheets((3.0, 0.25), (2.0, 0.2)), VIEW, 1).ids[2, 2].tolist() == [1]
    assert collect(*sheets((3.0, 0.25), (2.0, 0.2)), VIEW, 2).ids[2, 2].tolist() == [1, 0]


def test_the_walk_stops_behind_the_hit_that_makes_the_pixel_opaque() -> None:
    """0.02, 4e-4, 8e-6: the third hit is blended, the fourth is not."""
    hits = collect(*sheets(*((z, 0.98) for z in (2.0, 3.0, 4.0, 5.0))), VIEW, 8)
    assert hits.ids[2, 2].tolist() == [0, 1, 2, -1, -1, -1, -1, -1]
    value_of(hits.weights[2, 2, :4], [0.98, 0.0196, 0.000392, 0.0], "weights")
    value_of(1 - hits.alpha[2, 2], 8e-6, "transmittance")


def test_near_tests_the_depth_of_the_hit() -> None:
    """Tilted by 45 degrees about y and centred behind the camera, the first surfel is met at depth 3.

    It still goes first: centres sort by signed depth.
    """
    shape, colors, viewmat = sheets((-1.0, 0.5), (2.0, 0.5), scale=(1e3, 1e3))
    shape = shape._replace(
        means=tensor((4.0, 0.0, -1.0), (0.0, 0.0, 2.0)),
        quats=tensor((math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0), (1.0, 0.0, 0.0, 0.0)),
    )
    for near, ids, depths in ((0.01, [0, 1], [3.0, 2.0]), (2.0, [0, -1], [3.0, 0.0]), (3.001, [-1, -1], [0.0, 0.0])):
        hits = collect(shape, colors, viewmat, VIEW._replace(near=near), 2)
        assert hits.ids[2, 2].tolist() == ids
        value_of(hits.depths[2, 2], depths, "depths")


def test_hash_by_hand() -> None:
    """(3, -2, 0) maps to (5, 4, 0); 4 x 2654435761 = 2027808452 modulo 2^32; xor 5 is 2027808449."""
    corners = torch.tensor([[3, -2, 0], [0, 0, 0], [-1, 1, 7], [123456, -654321, 2**30]])
    expected = [2027808449, 0]
    expected.append(2 ^ 2654435761 ^ (13 * 805459861 % 2**32))
    expected.append(246911 ^ (1308642 * 2654435761 % 2**32) ^ ((2**31 - 1) * 805459861 % 2**32))
    assert hash_corners(corners, 2**32).tolist() == expected
    assert hash_corners(corners, 2**4).tolist() == [value % 16 for value in expected]


def test_encode_at_a_corner_and_between() -> None:
    """At a corner the entry, between two corners their mean; times 1 - exp(-1 / 2 pi) where f = s t."""
    grid = torch.randn(2, 16, 3, dtype=torch.float64)
    resolutions = tensor(2.0, 4.0)
    features = encode(tensor((1.5, -1.0, 0.0), (1.75, -1.0, 0.0)), tensor(5.0, 5.0), grid, resolutions, focal=10.0)
    entries = hash_corners(torch.tensor([[3, -2, 0], [4, -2, 0], [6, -4, 0], [7, -4, 0]]), 16).tolist()
    factors = 1 - math.exp(-1 / (2 * math.pi)), 1 - math.exp(-0.25 / (2 * math.pi))
    expected = torch.stack([
        torch.cat([factors[0] * grid[0, entries[0]], factors[1] * grid[1, entries[2]]]),
        torch.cat([
            factors[0] * (grid[0, entries[0]] + grid[0, entries[1]]) / 2,
            factors[1] * grid[1, entries[3]],
        ]),
    ])  # fmt: skip
    assert_close(features, expected, kind="value", name="features")


def make_field(sh_degree: int = 3) -> Texture:
    count = 3 * (sh_degree + 1) ** 2
    mlp = [0.6 * torch.randn(shape, dtype=torch.float64) for shape in ((6, 4), (5, 6), (count, 5))]
    return Texture(torch.randn(2, 8, 2, dtype=torch.float64), tensor(1.0, 2.5), mlp)


def test_the_field_is_asked_where_the_pixel_sees_the_surfel() -> None:
    """One level whose features are linear in x shows the position: one cell holds the whole surfel."""
    shape, _, _ = sheets((2.0, 0.8), scale=(0.3, 0.3))
    viewmat = rigid((1.0, 0.0, 0.0, 0.0), (-0.5, -0.5, -1.0))
    shape = shape._replace(means=shape.means + tensor(0.5, 0.5, 1.0))
    corners = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    grid = torch.zeros(1, 2**12, 3, dtype=torch.float64)
    entries = hash_corners(corners, 2**12)
    assert len(set(entries.tolist())) == 8
    grid[0, entries] = corners.double()
    # Resolution 0.25 puts x in [0, 4) into one cell, where the features are x / 4.
    texture = Texture(grid, tensor(0.25), [torch.eye(3, dtype=torch.float64)])
    out = render(shape, torch.zeros(1, 1, 3, dtype=torch.float64), texture, viewmat, VIEW, max_hits=1)
    factor = 1 - math.exp(-((10 / (0.25 * 2.0)) ** 2) / (2 * math.pi))
    # Pixel [3, 2] sees the surfel 0.2 below the axis, at (0.5, 0.7, 3) in the world.
    expected = (0.5 + 0.28209479177387814 * (factor * tensor(0.5, 0.7, 3.0) / 4)) * out.weights[3, 2, 0]
    assert_close(out.textured[3, 2], expected, kind="value", name="textured")


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("sh_degree", [1, 3])
def test_gradients_of_the_whole_render(sh_degree: int, textured: bool) -> None:
    scene = random_scene(3, seed=5, width=4, height=3, sh_degree=sh_degree, dtype=torch.float64)
    scene["K"] = intrinsics(5.0, 6.0, 1.7, 1.4)
    scene["sh"] = 0.3 * scene["sh"]
    field = make_field(sh_degree)
    given = (*(scene[key] for key in (*FLOATS, "sh", "viewmat")), field.grid, *field.mlp)
    inputs = tuple(value.detach().clone().requires_grad_() for value in given)

    def picture(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        texture = Texture(tensors[7], field.resolutions, tensors[8:]) if textured else None
        shape, background = Shape(*tensors[:5]), (0.2, 0.4, 0.6)
        out = render(shape, tensors[5], texture, tensors[6], view_of(scene), background=background)
        return out.image, out.plain, out.textured, out.depths, out.weights, out.alpha

    assert picture(*inputs)[5].max() > 0.3 and torch.autograd.gradcheck(picture, inputs, fast_mode=True)
