"""How close is close enough: the one table of tolerances, and a comparison whose failures explain themselves.

Rows: float64 and float32 are whole passes in that type; float16 stands for the default on CUDA, float32
passes with a half-precision texture. Bounds are on the relative L2 error |a - e| / |e|; float64 also bounds
the largest error by the largest value. They come from the arithmetic (rounding times the length of the sums),
not from what the kernels happened to reach.
"""

import torch

TOLERANCES = {
    torch.float64: {"value": 1e-9, "gradient": 1e-9},
    torch.float32: {"value": 2e-5, "gradient": 1e-3},
    torch.float16: {"value": 2e-3, "gradient": 3e-2},
}

FLIPS = 0.005  # fraction of pixels that may flip in float32: a hit on the alpha cut-off, two hits of equal weight
ACTIVATION = 2e-6  # how far an activated value may come back from the one given to `Surfels.from_activated`
FLOOR = 1e-12  # norm below which an expected tensor counts as zero
WEB_PSNR = {"full": 50.0, "quantised": 40.0}  # least PSNR, dB, of the web page's pictures, by the scene file's quality


def assert_close(
    actual: torch.Tensor, expected: torch.Tensor, *, kind: str, name: str, precision=None, allow_flips: float = 0.0
) -> None:
    """Fail unless `actual` is finite and within the table's tolerance of `expected`, of any dtype.

    `kind` is "value" or "gradient"; `precision` is the table's row where the dtype of `actual` does not tell it. Of
    images (H, W, ...), at most the fraction `allow_flips` of pixels, the worst ones, is left out.
    """
    assert actual.shape == expected.shape, f"{name}: shape {tuple(actual.shape)}, not {tuple(expected.shape)}"
    assert_finite(actual, name)
    precision = precision or actual.dtype
    tolerance = TOLERANCES[precision][kind]
    actual = actual.detach().double().cpu()
    expected = expected.detach().double().cpu()
    error = (actual - expected).abs()
    if allow_flips:
        per_pixel = error.reshape(error.shape[0] * error.shape[1], -1)
        flipped = per_pixel.sum(-1).topk(int(allow_flips * len(per_pixel))).indices
        error = per_pixel.index_fill(0, flipped, 0.0).reshape(error.shape)
    relative = error.norm().item() / max(expected.norm().item(), FLOOR)
    worst = error.max().item() / max(expected.abs().max().item(), FLOOR) if error.numel() else 0.0
    good = relative <= tolerance and (precision != torch.float64 or worst <= tolerance)
    assert good, (
        f"{name}: {kind} off by {relative:.3g} (relative L2), {worst:.3g} (largest error / largest value). "
        f"{str(precision).removeprefix('torch.')} allows {tolerance:g}. " + describe_worst(error, actual, expected)
    )


def assert_equal(actual: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """Fail unless tensors of the same names have the same values, to the last bit."""
    assert actual.keys() == expected.keys()
    different = [name for name, x in expected.items() if not torch.equal(actual[name], x)]
    assert not different, different


def assert_same_ids(actual: torch.Tensor, expected: torch.Tensor, *, name: str, allow_flips: float = 0.0) -> None:
    """Fail unless the integer images (H, W, K) agree in all pixels but at most the fraction `allow_flips`."""
    assert actual.shape == expected.shape, f"{name}: shape {tuple(actual.shape)}, not {tuple(expected.shape)}"
    actual, expected = actual.long().cpu(), expected.long().cpu()
    error = (actual != expected).double()
    flipped = error.flatten(2).amax(-1) if error.numel() else error.new_zeros(error.shape[:2])
    assert flipped.sum().item() <= allow_flips * flipped.numel(), (
        f"{name}: {int(flipped.sum())} of {flipped.numel()} pixels differ. " + describe_worst(error, actual, expected)
    )


def assert_finite(tensor: torch.Tensor, name: str) -> None:
    """Fail, naming the first element that is NaN or infinite."""
    bad = ~torch.isfinite(tensor)
    assert not bad.any(), f"{name}: {int(bad.sum())} elements are not finite, first {bad.nonzero()[0].tolist()}"


def describe_worst(error: torch.Tensor, actual: torch.Tensor, expected: torch.Tensor) -> str:
    """Say where the largest error is, and what stood there."""
    if not error.numel():
        return "No elements."
    where = tuple(int(i) for i in torch.unravel_index(error.argmax(), error.shape))
    return f"Worst at {where}: actual {actual[where].item():.9g}, expected {expected[where].item():.9g}"
