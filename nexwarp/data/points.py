"""The initial points of a training: sparse points without outliers, in an even distribution, with sizes."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

MIN_TRACK_LENGTH = 3
ROBUST_SIGMAS = 3.0
SIGMA_FROM_MAD = 1.4826  # of a normal distribution
NEIGHBORS = 3
NORMAL_NEIGHBORS = 12


@dataclass(frozen=True)
class InitialPoints:
    """Points in the order of farthest point sampling: every prefix covers the scene evenly; all float32."""

    means: torch.Tensor  # (M, 3), world frame
    colors: torch.Tensor  # (M, 3), sRGB in [0, 1]
    scales: torch.Tensor  # (M,), world units, > 0
    normals: torch.Tensor  # (M, 3), unit, of the planes fitted to each point's 12 nearest points; of either sign

    def joined(self, other: "InitialPoints") -> "InitialPoints":
        """Return these points, followed by others."""
        names = [field.name for field in dataclasses.fields(self)]
        return InitialPoints(**{name: torch.cat([getattr(self, name), getattr(other, name)]) for name in names})


def initial_points(
    points: torch.Tensor,
    colors: torch.Tensor,
    count: int,
    *,
    track_lengths: torch.Tensor | None = None,
    errors: torch.Tensor | None = None,
    filter_outliers: bool = True,
) -> InitialPoints:
    """Choose the initial points of a training; points at the same position count once.

    Args:
        points: (P, 3) float, world frame, finite; at least one.
        colors: (P, 3) uint8 sRGB, or float in [0, 1].
        count: largest number of points, 1 or more.
        track_lengths: (P,) integer, number of photos that a point was triangulated from; 0 if unknown.
        errors: (P,) float, mean reprojection errors in pixels; negative if unknown.
        filter_outliers: drop points seen in fewer than 3 photos or with an error above median + 3 robust
            sigmas, as far as `track_lengths` and `errors` are given; at most half of the points.
    """
    xyz = points.detach().cpu().double().numpy()
    srgb = colors.detach().cpu()
    rgb = (srgb.float() / 255.0 if srgb.dtype == torch.uint8 else srgb.float().clamp(0.0, 1.0)).numpy()
    if filter_outliers:
        keep = inliers(
            len(xyz),
            None if track_lengths is None else track_lengths.detach().cpu().numpy(),
            None if errors is None else errors.detach().cpu().double().numpy(),
        )
        xyz, rgb = xyz[keep], rgb[keep]
    order = farthest_points(xyz, count)
    means = xyz[order]
    return InitialPoints(
        means=torch.from_numpy(means.astype(np.float32)),
        colors=torch.from_numpy(rgb[order]),
        scales=torch.from_numpy(predecessor_scales(means).astype(np.float32)),
        normals=torch.from_numpy(plane_normals(xyz, means).astype(np.float32)),
    )


def inliers(count: int, track_lengths: np.ndarray | None, errors: np.ndarray | None) -> np.ndarray:
    """Return the ascending indices of the points that pass the outlier filter; at least half of all `count` points.

    Takes track lengths (P,) integer, 0 if unknown, or None, and errors (P,) in pixels, negative if unknown, or None.
    """
    short = np.zeros(count, dtype=bool)
    if track_lengths is not None:
        short = (track_lengths > 0) & (track_lengths < MIN_TRACK_LENGTH)
    error = np.zeros(count) if errors is None else np.where(np.isnan(errors), np.inf, errors)
    known = error[(error >= 0) & np.isfinite(error)]
    bound = np.inf
    if len(known):
        median = np.median(known)
        bound = median + ROBUST_SIGMAS * SIGMA_FROM_MAD * np.median(np.abs(known - median))
    keep = ~short & (error <= bound)
    half = (count + 1) // 2
    if keep.sum() < half:  # mostly two-view points: keep the better half, long tracks first
        keep[np.lexsort((error, short))[:half]] = True
    return np.flatnonzero(keep)


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return (min(count, distinct),) int64 indices of points (P, 3) float64, each the farthest from those before it.

    Of several points at one position only the first is used. The first index is deterministic but not always 0, since
    fpsample's `start_idx` refers to the order of its own tree (0.3.3 and 1.0.2).
    """
    from fpsample import bucket_fps_kdline_sampling

    # fpsample uses float32: centring the points keeps its precision far from the origin.
    centred = (points - points.mean(axis=0)).astype(np.float32)
    # Duplicates are removed: once only duplicates are left, fpsample repeats an index.
    distinct = np.sort(np.unique(centred, axis=0, return_index=True)[1])
    if len(distinct) == 1:
        return distinct
    height = int(np.clip(np.log2(len(distinct)) - 8, 1, 9))  # of its tree: measured best at 9 for 400,000 points
    order = bucket_fps_kdline_sampling(
        np.ascontiguousarray(centred[distinct]), min(count, len(distinct)), h=height, start_idx=0
    )
    return distinct[order.astype(np.int64)]


def predecessor_scales(means: np.ndarray) -> np.ndarray:
    """Half the root mean square distance (M,) float64 of each point (M, 3) to its 3 nearest predecessors.

    The search is exact. The first three points use their nearest points among all. At least 1e-6 of the points' extent.
    """
    from scipy.spatial import cKDTree

    count = len(means)
    extent = float(np.linalg.norm(means.max(axis=0) - means.min(axis=0)))
    squared = np.zeros(count)
    tree = cKDTree(means)
    pending = np.arange(NEIGHBORS, count)
    neighbors = 4 * NEIGHBORS
    while len(pending):
        neighbors = min(2 * neighbors, count)
        distances, indices = tree.query(means[pending], k=neighbors, workers=-1)
        earlier = indices < pending[:, None]
        done = earlier.sum(axis=1) >= NEIGHBORS
        # Neighbours are sorted by distance, so the first 3 predecessors among them are the nearest ones.
        rank = np.cumsum(earlier[done], axis=1)
        chosen = earlier[done] & (rank <= NEIGHBORS)
        squared[pending[done]] = (distances[done] ** 2 * chosen).sum(axis=1) / NEIGHBORS
        pending = pending[~done]
    for index in range(min(NEIGHBORS, count)):
        others = np.delete(((means - means[index]) ** 2).sum(axis=1), index)
        nearest = np.partition(others, NEIGHBORS)[:NEIGHBORS] if len(others) > NEIGHBORS else others
        squared[index] = nearest.mean() if len(nearest) else 0.0
    return np.maximum(0.5 * np.sqrt(squared), 1e-6 * (extent or 1.0))


def plane_normals(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3) of the planes fitted to the 12 of the points (P, 3) nearest to each position `at` (M, 3).

    All are float64; the sign is arbitrary.
    """
    from scipy.spatial import cKDTree

    count = min(NORMAL_NEIGHBORS, len(points))
    _, indices = cKDTree(points).query(at, k=[*range(1, count + 1)], workers=-1)
    offsets = points[indices] - points[indices].mean(axis=1, keepdims=True)
    # Eigenvalues are ascending: the first eigenvector is the direction of least variance.
    _, vectors = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)
    return vectors[:, :, 0]
