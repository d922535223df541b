"""What compute-sanitizer says is understood, and what it is to look at runs. No compute-sanitizer is needed."""

import pytest
import torch

from tests.robustness import sanitize
from tests.robustness.sanitize import parse, render_odd_sizes, train_and_render
from tests.tolerances import assert_close

BANNER = "========= COMPUTE-SANITIZER\n4 training steps and 2 frames on cuda\n"


@pytest.mark.parametrize(
    ("output", "errors"),
    [
        (BANNER + "========= ERROR SUMMARY: 0 errors\n", 0),
        (BANNER + "========= ERROR SUMMARY: 1 error\n", 1),
        (BANNER + "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)\n", 0),
        (BANNER + "========= RACECHECK SUMMARY: 3 hazards displayed (2 errors, 1 warning)\n", 2),
        ("========= ERROR SUMMARY: 2 errors\n" + BANNER + "========= ERROR SUMMARY: 0 errors\n", 2),  # two processes
        (BANNER + "========= Error: Target application terminated before first instrumented API call\n", None),
        ("ERROR SUMMARY: 0 errors\n", None),  # printed by somebody else
        ("", None),
    ],
)
def test_summaries_are_understood(output, errors):
    assert parse(output).errors == errors
    assert parse(output).summary and "=" not in parse(output).summary


def test_products_without_cublas_are_products():
    a, b, v = (torch.randn(*shape, dtype=torch.float64) for shape in ((3, 5, 4), (4, 6), (4,)))
    out = torch.zeros(5, 6, dtype=torch.float64)
    with sanitize.plain_products():
        products = [a @ b, a[0] @ b, torch.mm(a[0], b), torch.mm(a[0], b, out=out), out, b.T @ v]
        products += [torch._addmm_activation(torch.ones(6), a[1], b)]
    expected = [a @ b, *[a[0] @ b] * 4, b.T @ v, (1 + a[1] @ b).relu()]
    for x, y in zip(products, expected, strict=True):
        assert_close(x, y, kind="value", name="product")


def test_steps_and_frames_run(device):
    assert train_and_render(device) == {"steps": 4, "frames": 2}


def test_renderings_of_odd_sizes_run(device):
    """All K where kernels are compiled in seconds."""
    hits = range(9) if device.type == "cuda" else (2,)
    assert render_odd_sizes(device, hits) == 7 * len(hits)
