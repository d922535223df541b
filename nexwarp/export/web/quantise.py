"""Quantisation of a scene's arrays for its file; FORMAT.md describes it.

Surfels are sorted along a Morton curve, and each chunk of 256 neighbours has ranges of its own, so that a surfel far
away costs the others no precision.
"""

import numpy as np

from nexwarp.model.texture import NEVER

CHUNK = 256
MORTON_BITS = 10
LOG_RANGE = (-60.0, 80.0)  # natural logarithms of scales and detail limits
SMALLEST = 1e-26
HALF_WIDTH = 1 / np.sqrt(2)  # largest magnitude of x and y of a rotation whose w is the largest component
TURN = np.sin(np.pi / 8)  # likewise of z, as quarter turns about z are free too
QUAT_BITS = (11, 11, 10)


def morton_order(means: np.ndarray) -> np.ndarray:
    """Return the indices (N,) of surfels along a Morton curve through the ranks of their coordinates."""
    count = len(means)
    code = np.zeros(count, np.int64)
    for axis in range(3):
        ranks = np.empty(count, np.int64)
        ranks[np.argsort(means[:, axis], kind="stable")] = np.arange(count)
        cells = ranks * 2**MORTON_BITS // max(count, 1)
        for bit in range(MORTON_BITS):
            code |= ((cells >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def encode_chunks(values: np.ndarray, dtype: type, size: int = CHUNK) -> tuple[np.ndarray, np.ndarray]:
    """Return codes of (N, C) values, and value of code 0 and step (chunks, C, 2) for each column of `size` rows."""
    if len(values) == 0:
        return np.zeros(values.shape, dtype), np.zeros((0, values.shape[1], 2), np.float32)
    starts = np.arange(0, len(values), size)
    largest = np.iinfo(dtype).max
    low = np.minimum.reduceat(values, starts).astype(np.float32)
    high = np.maximum.reduceat(values, starts).astype(np.float32)
    steps = ((high.astype(np.float64) - low) / largest).astype(np.float32)
    first, step = (np.repeat(x, size, axis=0)[: len(values)].astype(np.float64) for x in (low, steps))
    codes = np.rint((values - first) / np.where(step > 0, step, 1.0))
    return np.clip(codes, 0, largest).astype(dtype), np.stack([low, steps], axis=-1)


def encode_band(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise SH coefficients (N, B, 3) of one degree to (N, 3 B) codes, with one range for all values of a chunk."""
    count, width = len(coefficients), 3 * coefficients.shape[1]
    codes, ranges = encode_chunks(coefficients.astype(np.float64).reshape(-1, 1), np.uint8, CHUNK * width)
    return codes.reshape(count, width), ranges


def _half_turns(quats: np.ndarray) -> np.ndarray:
    """Return the products (4, 4, N) of quaternions (4, N) with 1, i, j, k."""
    w, x, y, z = quats
    return np.array([(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)])


def encode_quats(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise unit quaternions (N, 4), wxyz, of surfels.

    A surfel looks the same after half turns about its axes, and after a quarter turn about z that swaps its axes. So
    w can be the largest component, and |z| at most sin(22.5 degrees): fewer values, finer steps.
    Returns codes (N,) of x, y (11 bits each) and z (10 bits), and whether the axes were swapped (N,).
    """
    w, x, y, z = straight = quats.astype(np.float64).T
    quarter = np.sqrt(0.5) * np.array([w - z, x + y, y - x, z + w])
    # The surfel's eight rotations: q, and q times a quarter turn, each times 1, i, j, k.
    turned = np.concatenate([_half_turns(straight), _half_turns(quarter)])
    best = np.argmax(np.abs(turned[:, 0]), axis=0)
    swapped = best >= 4
    w, x, y, z = np.take_along_axis(turned, best[None, None], axis=0)[0]
    flip = np.where(w < 0, -1.0, 1.0)
    code = np.zeros(len(quats), np.uint32)
    shift = 0
    for value, bits, limit in zip((x, y, z), QUAT_BITS, (HALF_WIDTH, HALF_WIDTH, TURN), strict=True):
        largest = 2**bits - 1
        steps = np.rint((value * flip / limit + 1) / 2 * largest)
        code |= np.clip(steps, 0, largest).astype(np.uint32) << np.uint32(shift)
        shift += bits
    return code, swapped


def log_of(values: np.ndarray) -> np.ndarray:
    """Return natural logarithms, within the range of the file."""
    return np.log(np.maximum(values.astype(np.float64), SMALLEST)).clip(*LOG_RANGE)


def encode_limits(limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return codes of logarithms of detail limits (N, 2), 0 for 0, 65535 for NEVER; that of code 1 and step (2,)."""
    known = (limits > 0) & (limits < NEVER)
    logs = log_of(limits)
    low, high = (logs[known].min(), logs[known].max()) if known.any() else (0.0, 0.0)
    scale = np.array([low, (high - low) / 65533], np.float32)
    codes = np.clip(np.rint((logs - scale[0]) / (scale[1] or 1.0)) + 1, 1, 65534)
    return np.where(limits >= NEVER, 65535, np.where(limits > 0, codes, 0)).astype(np.uint16), scale


def encode_levels(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise a hash grid (L, T, F) to codes and (L, 2) ranges, one for each level."""
    levels = [encode_chunks(level.astype(np.float64).reshape(-1, 1), np.uint8, level.size) for level in grid]
    codes = np.stack([codes for codes, _ in levels]).reshape(grid.shape)
    return codes, np.concatenate([ranges[:, 0] for _, ranges in levels])
