import numpy as np
import pytest
import torch

from nexwarp.data import initial_points
from nexwarp.data.points import farthest_points, inliers, predecessor_scales


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, 3)) * [1.0, 2.0, 0.3] + [10.0, -5.0, 3.0]


def brute_force_order(points: np.ndarray, count: int, start: int) -> list[int]:
    order, distance = [start], np.full(len(points), np.inf)
    while len(order) < count:
        distance = np.minimum(distance, ((points - points[order[-1]]) ** 2).sum(axis=1))
        order.append(int(distance.argmax()))
    return order


def brute_force_scales(means: np.ndarray) -> np.ndarray:
    scales = []
    for index, mean in enumerate(means):
        others = means[:index] if index >= 3 else np.delete(means, index, axis=0)
        scales.append(0.5 * np.sqrt(np.sort(((others - mean) ** 2).sum(axis=1))[:3].mean()))
    return np.array(scales)


@pytest.mark.parametrize("count", [2, 3, 9, 100, 1500])
def test_sampling_is_farthest_first(count):
    points = cloud(count)
    order = farthest_points(points, count)
    assert order.tolist() == brute_force_order(points, count, int(order[0]))
    for fewer in (1, 10, 777):
        assert np.array_equal(farthest_points(points, fewer), order[:fewer]), "prefixes agree"


def test_far_from_the_origin_costs_no_precision_and_duplicates_count_once():
    points = np.round(cloud(500) * 1024) / 1024
    assert np.array_equal(farthest_points(points + 4096.0, 500), farthest_points(points, 500))
    points = np.repeat(cloud(40), 3, axis=0)
    order = farthest_points(points, 120)
    assert len(order) == 40 and len(np.unique(points[order], axis=0)) == 40


@pytest.mark.parametrize("count", [2, 3, 4, 5, 60, 2000])
def test_scales_against_brute_force(count):
    means = cloud(count)[farthest_points(cloud(count), count)]
    np.testing.assert_allclose(predecessor_scales(means), brute_force_scales(means), rtol=1e-9)
    # Sorted along a line, predecessors lie on one side and far down the neighbour lists.
    means = np.concatenate([cloud(count // 4), cloud(count, 1) * 0.01])
    np.testing.assert_allclose(predecessor_scales(means), brute_force_scales(means), rtol=1e-9)


def test_points_keep_their_colors_and_follow_scaling():
    points = torch.from_numpy(cloud(400)).float()
    colors = torch.randint(0, 256, (400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    chosen = initial_points(points, colors, 150)
    assert chosen.means.shape == (150, 3) and chosen.colors.shape == (150, 3) and chosen.scales.shape == (150,)
    assert all(tensor.dtype == torch.float32 for tensor in (chosen.means, chosen.colors, chosen.scales))
    index = torch.cdist(chosen.means.double(), points.double()).argmin(dim=1)
    assert torch.equal(points[index], chosen.means) and len(index.unique()) == 150
    torch.testing.assert_close(chosen.colors, colors[index].float() / 255)
    doubled = initial_points(2 * points, colors, 150)
    assert torch.equal(doubled.means, 2 * chosen.means)
    torch.testing.assert_close(doubled.scales, 2 * chosen.scales)


def test_fewer_points_than_wanted():
    chosen = initial_points(torch.from_numpy(cloud(7)).float(), torch.zeros(7, 3), 1000)
    assert len(chosen.means) == 7
    single = initial_points(torch.ones(1, 3), torch.ones(1, 3), 5)
    assert single.means.tolist() == [[1.0, 1.0, 1.0]] and single.scales.item() > 0.0
    assert (predecessor_scales(np.zeros((10, 3))) > 0.0).all()
    assert (predecessor_scales(np.concatenate([np.zeros((10, 3)), np.ones((1, 3))])) >= 1e-6 * 3**0.5 * 0.999).all()


def test_filter_drops_planted_outliers_and_little_else():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(cloud(1000)).float()
    points[:50] += 100.0
    tracks = torch.from_numpy(rng.integers(3, 12, 1000).astype(np.int32))
    errors = torch.from_numpy(rng.normal(0.7, 0.1, 1000).astype(np.float32))
    tracks[:25] = 2
    errors[25:50] = 4.0
    colors = torch.zeros(1000, 3)
    kept = initial_points(points, colors, 1000, track_lengths=tracks, errors=errors)
    assert kept.means[:, 0].max() < 60.0 and 940 <= len(kept.means) <= 950
    everything = initial_points(points, colors, 1000, track_lengths=tracks, errors=errors, filter_outliers=False)
    assert len(everything.means) == 1000


def test_filter_keeps_the_better_half():
    errors = np.arange(11.0)
    assert inliers(11, np.array([2] * 9 + [3, 4]), errors).tolist() == [0, 1, 2, 3, 9, 10]
    # Unknown errors do not count against a point.
    errors = np.where(np.arange(100) % 2 == 0, -1.0, 0.5)
    assert len(inliers(100, None, errors)) == 100
    assert inliers(4, None, np.array([0.5, 0.5, 0.5, np.nan])).tolist() == [0, 1, 2]
