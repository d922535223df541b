import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nexwarp.cameras import paths
from nexwarp.cameras.camera import Camera, reduced, resized
from nexwarp.cameras.paths import ellipse, focus, interpolate, look_at, through, up_direction
from tests.narrowing import present
from tests.tolerances import assert_close

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
INTRINSICS = torch.tensor([[90.0, 0.0, 33.0], [0.0, 95.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def camera(position: torch.Tensor, target: torch.Tensor, up: torch.Tensor = UP) -> Camera:
    return Camera(look_at(position.double(), target.double(), up), INTRINSICS, 64, 48, near=0.2)


def ring(count: int = 24, radii: tuple[float, float] = (3.0, 2.0), height: float = 1.5) -> list[Camera]:
    """Cameras on a noisy ellipse about (1, -2, 0), looking more or less at (1, -2, 0.3)."""
    middle = torch.tensor([1.0, -2.0, 0.0], dtype=torch.float64)
    cameras = []
    for angle in torch.rand(count, dtype=torch.float64) * 2 * math.pi:
        offset = torch.stack([radii[0] * angle.cos(), radii[1] * angle.sin(), angle.new_tensor(height)])
        position = middle + offset + 0.05 * torch.randn(3, dtype=torch.float64)
        cameras.append(camera(position, middle + 0.3 * UP + 0.05 * torch.randn(3, dtype=torch.float64)))
    return cameras


def positions(cameras: list[Camera]) -> torch.Tensor:
    return torch.stack([each.position for each in cameras])


def similarity(scale: float) -> tuple[torch.Tensor, torch.Tensor, float]:
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    return rotation * torch.linalg.det(rotation), torch.randn(3, dtype=torch.float64), scale


def moved(each: Camera, motion: tuple[torch.Tensor, torch.Tensor, float]) -> Camera:
    """The camera after the world is rotated, scaled, then shifted."""
    rotation, shift, scale = motion
    viewmat = each.viewmat.clone()
    viewmat[:3, :3] = each.viewmat[:3, :3] @ rotation.T
    viewmat[:3, 3] = scale * each.viewmat[:3, 3] - viewmat[:3, :3] @ shift
    return Camera(viewmat, each.K, each.width, each.height, each.near)


def test_focus_is_where_the_axes_meet() -> None:
    target = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    cameras = [camera(target + 3 * torch.randn(3), target) for _ in range(5)]
    assert_close(focus(cameras), target, kind="value", name="focus")


def test_every_camera_looks_at_the_focus_upright() -> None:
    cameras = ring()
    up = up_direction(cameras)
    for each in ellipse(cameras, 30):
        x, y, depth = INTRINSICS @ (each.viewmat[:3, :3] @ focus(cameras) + each.viewmat[:3, 3])
        assert depth > 1.0 and (x / depth).item() == pytest.approx(33.0) and (y / depth).item() == pytest.approx(20.0)
        right, down = each.viewmat[0, :3], each.viewmat[1, :3]
        assert abs(right @ up) < 1e-12 and down @ up < 0
        rotation = each.viewmat[:3, :3]
        assert (rotation @ rotation.T - torch.eye(3)).abs().max() < 1e-12
        assert torch.linalg.det(rotation).item() == pytest.approx(1.0)


def test_path_is_an_ellipse_through_the_cameras_region() -> None:
    cameras = ring(count=60)
    path, given = positions(ellipse(cameras, 200)), positions(cameras)
    centre = path.mean(0)
    values = torch.linalg.svdvals(path - centre) / 10.0  # of a * cos over 200 steps: a * 10
    assert values[2] < 1e-9, "the path leaves its plane"
    assert values[0].item() == pytest.approx(3.0, rel=0.1) and values[1].item() == pytest.approx(2.0, rel=0.1)
    assert (path[:, 2].mean() - given[:, 2].mean()).abs() < 0.02
    for axis in range(2):
        low, high = torch.quantile(given[:, axis], torch.tensor([0.05, 0.95]).double())
        assert path[:, axis].max().item() == pytest.approx(high.item(), abs=0.15)
        assert path[:, axis].min().item() == pytest.approx(low.item(), abs=0.15)


def test_up_is_across_the_right_axes_however_cameras_are_tilted() -> None:
    """Half of a ring looks down from above, as people do: the mean of the upward directions leans."""
    places = [torch.tensor([math.cos(a), math.sin(a), 0.7]) * 3.0 for a in np.linspace(0.0, math.pi, 12)]
    tilted = [camera(place, torch.zeros(3)) for place in places]
    mean = -torch.stack([each.viewmat[1, :3] for each in tilted]).mean(0)
    assert mean @ UP / mean.norm() < math.cos(math.radians(10.0))
    for motion in (similarity(1.0), similarity(3.0)):
        assert up_direction([moved(each, motion) for each in tilted]) @ (motion[0] @ UP) > math.cos(math.radians(1.0))
    # Of cameras that all look one way, the right axes say nothing about the tilt: the mean of their own directions.
    alike = [camera(torch.tensor([x, 0.0, 0.0]), torch.tensor([x, 4.0, 0.0])) for x in (-1.0, 0.0, 1.0)]
    assert up_direction(alike) @ UP > 1 - 1e-9 and up_direction([]).tolist() == [0.0, -1.0, 0.0]


def test_cameras_on_a_wall_or_a_line_give_a_path_along_it() -> None:
    target = torch.tensor([0.0, 4.0, 0.0])
    places = [torch.tensor([float(x), 0.0, float(z)]) for x in range(-3, 4) for z in range(-1, 2)]
    path = positions(ellipse([camera(place, target) for place in places], 40))
    assert path[:, 1].abs().max() < 1e-9 and path[:, 2].max() > 0.5
    path = positions(ellipse([camera(torch.tensor([x, 0.0, 1.0]), target) for x in (-2.0, -1.0, 2.0)], 20))
    assert (path[:, 1:] - torch.tensor([0.0, 1.0])).abs().max() < 1e-9
    assert path[:, 0].max().item() == pytest.approx(1.7) and path[:, 0].min().item() == pytest.approx(-1.9)


def row(count: int = 15, bend: float = 0.3) -> list[Camera]:
    """Cameras on a noisy patch of the x-z plane that face +y and look, more or less, at (0, 6, 0)."""
    target = torch.tensor([0.0, 6.0, 0.0])
    places = torch.randn(count, 3, dtype=torch.float64) * torch.tensor([1.0, 0.1, 0.5])
    return [camera(place, target + (1 - bend) * place) for place in places]


PATHS = pytest.mark.parametrize(("make", "cameras_of"), [(ellipse, ring), (interpolate, row), (through, row)])


@PATHS
@pytest.mark.parametrize("scale", [1.0, 0.01, 50.0])
def test_paths_move_and_scale_with_the_cameras(make, cameras_of, scale: float) -> None:
    cameras, motion = cameras_of(), similarity(scale)
    expected = [moved(each, motion) for each in make(cameras, 23)]
    for mine, theirs in zip(make([moved(each, motion) for each in cameras], 23), expected, strict=True):
        assert (mine.viewmat - theirs.viewmat).abs().max() < 1e-7 * max(scale, 1.0)


@PATHS
def test_paths_take_the_rest_from_the_first_camera(make, cameras_of, device: torch.device) -> None:
    path = make([each.to(device, torch.float32) for each in cameras_of()], 5)
    assert len(path) == 5
    for each in path:
        assert each.viewmat.dtype == torch.float32 and each.device.type == device.type
        assert each.K.equal(INTRINSICS.float().to(device)) and (each.width, each.height, each.near) == (64, 48, 0.2)


def test_a_path_through_cameras_passes_every_one_in_turn() -> None:
    cameras = ring(6)
    path = through(cameras, 2001)
    errors = [(torch.stack([each.viewmat for each in path]) - c.viewmat).abs().amax((1, 2)) for c in cameras]
    assert all(error.min() < 2e-2 for error in errors)
    order = [error.argmin().item() for error in errors]
    assert order == sorted(order) and order[0] == 0 and order[-1] == 2000
    assert errors[0][0] < 1e-9 and errors[-1][-1] < 1e-9 and len(through(cameras, 1)) == 1


@pytest.mark.parametrize("make", [through, interpolate])
def test_interpolation_is_smooth(make: Callable[..., list[Camera]]) -> None:
    """Neither the way nor the direction jumps from one frame to the next, at the keys included."""
    path = torch.stack([each.viewmat for each in make(ring(8), 2000)])
    first = path.diff(dim=0).flatten(1).norm(dim=1)
    second = path.diff(n=2, dim=0).flatten(1).norm(dim=1)
    assert first.max() < 8 * first.mean() and second.max() < 0.05 * first.mean()
    rotations = path[:, :3, :3]
    assert (rotations @ rotations.mT - torch.eye(3)).abs().max() < 1e-12


def walk(count: int = 60, arc: float = 2 * math.pi) -> list[Camera]:
    """Cameras held by hand on the way along an arc about the origin: they sway, roll and look about it."""
    cameras = []
    for angle in torch.linspace(0.0, arc, count, dtype=torch.float64):
        place = torch.stack([3.0 * angle.cos(), 3.0 * angle.sin(), angle.new_tensor(1.0)])
        sway, aim, roll = 0.1 * torch.randn(3, 3, dtype=torch.float64)
        cameras.append(camera(place + sway, 2 * aim, UP + roll))
    return cameras


def test_a_walk_by_hand_becomes_a_steady_path() -> None:
    from scipy.spatial import ConvexHull

    cameras = walk()
    path = interpolate(cameras, 60)
    up, (viewmats, places), given = up_direction(cameras), paths.camera_poses(path), positions(cameras)
    assert up @ UP > math.cos(math.radians(3.0))
    assert (viewmats[:, 0, :3] @ up).abs().max() < 1e-12 and (viewmats[:, 1, :3] @ up).max() < 0.0, "no roll"
    hull = torch.from_numpy(ConvexHull(given).equations)
    assert (places @ hull[:, :3].T + hull[:, 3]).max() < 0.01, "within the hull of the cameras"
    unsteady, steady = (x.diff(n=2, dim=0).norm(dim=1).mean() for x in (given, places))
    assert steady < 0.2 * unsteady
    aims, own = (m[:, 2, :3].diff(n=2, dim=0).norm(dim=1).mean() for m in (viewmats, paths.camera_poses(cameras)[0]))
    assert aims < 0.2 * own
    assert (places[:, :2].norm(dim=1) > 2.7).all(), "as far away as the photos were"
    seen = viewmats[:, :3, 3] @ INTRINSICS.T  # the origin, which the cameras look at
    x, y = (seen[:, :2] / seen[:, 2:]).unbind(1)
    assert (seen[:, 2] > 0).all() and ((x - 33).abs() < 12).all() and ((y - 20).abs() < 12).all()


def test_an_ellipse_suits_cameras_around_a_subject_that_they_look_at() -> None:
    assert paths.suited_path(walk()) == paths.suited_path(ring(count=60)) == "ellipse"
    outwards = [camera(place, 2 * place) for place in positions(walk())]
    aside = [camera(place, place + torch.linalg.cross(place, UP)) for place in positions(walk())]
    for others in (walk(arc=math.pi), row(), outwards, aside, [ONE], []):
        assert paths.suited_path(others) == "interpolate"


def test_a_subject_is_what_cameras_all_around_have_in_their_middle() -> None:
    cameras = ring(count=60)
    centre, radius = present(paths.subject(cameras))
    assert_close(centre, focus(cameras), kind="value", name="centre")
    depths = [(each.viewmat[:3, :3] @ centre + each.viewmat[:3, 3])[2].item() for each in cameras]
    assert radius == pytest.approx(float(np.median(depths)) * 64 / 90 / 2)
    beside = [each.crop(22, 0, 42, 48) for each in cameras]
    assert paths.suited_path(beside) == "ellipse" and paths.subject(beside) is None
    assert all(paths.subject(others) is None for others in (walk(arc=math.pi), row(), [ONE], []))


ONE = camera(torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
ASIDE = camera(torch.zeros(3), torch.tensor([1.0, 0.0, 0.0]))
PARALLEL = "cameras: expected two or more with axes that are not parallel"


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        *((make, [[]], "cameras: expected at least one, got none") for make in (ellipse, interpolate, through)),
        *((make, [[ONE, ASIDE], 0], "count: expected at least 1, got 0") for make in (ellipse, interpolate, through)),
        *((ellipse, [each], PARALLEL) for each in ([ONE], [ONE, ONE])),
        (ellipse, [[ONE, ASIDE]], "cameras: expected at least two distinct centres"),
        *(
            (make, [each], f"cameras: expected at least two distinct ones, got {len(each)}")
            for make in (interpolate, through)
            for each in ([ONE], 3 * [ONE])
        ),
        (look_at, [UP, 3 * UP, UP], "up: expected a direction across the line"),
    ],
)
def test_degenerate_cameras_are_refused(make: Callable[..., Any], given: list[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(*given)


def test_resized_camera_sees_the_same_from_top_to_bottom() -> None:
    one = ONE  # 64 x 48, fx 90, fy 95, cx 33, cy 20
    wide = resized(one, 256, 96)
    assert (wide.width, wide.height, wide.fx, wide.fy) == (256, 96, 180.0, 190.0)
    assert wide.viewmat.equal(one.viewmat) and wide.near == one.near
    for y in (0.0, 48.0):
        assert (y * 2 - wide.cy) / wide.fy == pytest.approx((y - one.cy) / one.fy)
    # The rays in the middle third of the wide picture are those of the old one.
    assert (128 - 64 - wide.cx) / wide.fx == pytest.approx((0 - one.cx) / one.fx) and resized(one, 64, 48) is one
    with pytest.raises(ValueError, match="height: expected at least 1, got 0"):
        resized(one, 64, 0)
    small = reduced(one, 24)
    assert (small.width, small.height) == (32, 24) and small.K.equal(resized(one, 32, 24).K)
    for each in (resized(one.to(torch.float32), 101, 77), one.to(torch.float16), one.to(torch.float64)):
        assert [each.fx, each.fy, each.cx, each.cy] == each.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    assert reduced(one, 48) is reduced(one, 100) is one
    thin = Camera(one.viewmat, one.K, 2, 48, near=0.2)
    assert reduced(thin, 5).width == 1  # 2 * 5 / 48 is less than half a pixel


def turned(each: Camera) -> Rotation:
    return Rotation.from_matrix(each.viewmat[:3, :3].numpy())


def test_cameras_between_lie_on_the_way_to_a_neighbour_that_looks_alike() -> None:
    """Of a row of three: the middle one goes to either side, the others to either too; a fourth looks elsewhere."""
    ahead = torch.tensor([0.0, 9.0, 0.0], dtype=torch.float64)
    row = [torch.tensor([x, 0.0, 0.0], dtype=torch.float64) for x in (0.0, 1.0, 3.0)]
    cameras = [camera(each, each + ahead + 0.5 * each) for each in row]
    cameras.append(camera(row[0] - 0.1 * UP, row[0] - ahead))
    seen = set()
    for seed in range(40):
        made = paths.between(cameras, torch.Generator().manual_seed(seed))
        assert_close(made[3].viewmat, cameras[3].viewmat, kind="value", name="viewmat")
        for one, new in zip(cameras[:3], made[:3], strict=True):
            x = (new.position - one.position)[0].item()
            others = [c for c in cameras[:3] if c is not one]
            shares = [x / (c.position - one.position)[0].item() for c in others]
            turns = (turned(new) * turned(one).inv()).as_rotvec()
            full = [(turned(c) * turned(one).inv()).as_rotvec() for c in others]
            fits = [abs(turns - s * f).max() < 1e-12 and -0.5 <= s <= 1.5 for s, f in zip(shares, full, strict=True)]
            assert any(fits) and (new.position - one.position)[1:].abs().max() < 1e-12
            assert torch.equal(new.K, one.K) and (new.width, new.height, new.near) == (64, 48, 0.2)
            seen.add(round(shares[fits.index(True)], 1))
    assert {-0.5, 0.0, 0.5, 1.0, 1.5} <= seen  # all of the way, and beyond its ends
