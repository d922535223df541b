"""What compute-sanitizer says is understood, and what it is to look at runs. No compute-sanitizer is needed."""

import pytest

from tests.robustness.sanitize import errors_in, render_odd_sizes, train_and_render

BANNER = "========= COMPUTE-SANITIZER\n4 training steps and 2 frames on cuda\n"


@pytest.mark.parametrize(
    ("output", "errors"),
    [
        (BANNER + "========= ERROR SUMMARY: 0 errors\n", 0),
        (BANNER + "========= ERROR SUMMARY: 1 error\n", 1),
        (BANNER + "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)\n", 0),
        (BANNER + "========= RACECHECK SUMMARY: 3 hazards displayed (2 errors, 1 warning)\n", 2),
        ("========= ERROR SUMMARY: 2 errors\n" + BANNER + "========= ERROR SUMMARY: 0 errors\n", 2),  # two processes
        ("ERROR SUMMARY: 0 errors\n", None),  # printed by somebody else
    ],
)
def test_summaries_are_understood(output, errors):
    assert errors_in(output) == errors


def test_steps_frames_and_odd_sizes_run(device):
    """All K where kernels are compiled in seconds."""
    train_and_render(device)
    render_odd_sizes(device, range(9) if device.type == "cuda" else (2,))
