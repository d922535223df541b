"""What compute-sanitizer says is understood, and what it is to look at runs. No compute-sanitizer is needed."""

import os
import stat
import sys

import pytest
import torch

from tests.robustness import sanitize
from tests.robustness.sanitize import Sanitize, check, find_tool, parse, render_odd_sizes, train_and_render
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


def stub(folder, body: str, version: str = "2026.4.0.0") -> str:
    """A compute-sanitizer that has a version, or notes its arguments and then does as `body` says."""
    file = folder / "compute-sanitizer"
    version_line = f'if [ "$1" = --version ]; then echo "Version {version} (build 1)"; exit; fi'
    file.write_text(f'#!/bin/sh\n{version_line}\necho "$@ $PYTORCH_NO_CUDA_MEMORY_CACHING" >> {folder}/asked\n{body}\n')
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return str(file)


@pytest.mark.parametrize(
    ("body", "clean", "line"),
    [
        ('echo "========= ERROR SUMMARY: 0 errors"', True, "memcheck: ERROR SUMMARY: 0 errors: clean"),
        ('echo "========= ERROR SUMMARY: 2 errors"', False, "memcheck: ERROR SUMMARY: 2 errors: NOT CLEAN"),
        ('echo "========= ERROR SUMMARY: 0 errors"; exit 7', False, "0 errors, exit code 7: NOT CLEAN"),
        ("exit 13", False, "memcheck: no output of compute-sanitizer, exit code 13: NOT CLEAN"),
    ],
)
def test_a_tool_is_clean_only_when_it_says_so(tmp_path, capsys, body, clean, line):
    assert check("memcheck", stub(tmp_path, body), ["program"]).clean == clean
    assert line in capsys.readouterr().out


def test_tools_are_called_as_they_want(tmp_path):
    path = stub(tmp_path, "true")
    for tool in ("memcheck", "racecheck"):
        check(tool, path, ["program"])
    assert (tmp_path / "asked").read_text().splitlines() == [
        "--tool memcheck program 1",
        "--tool racecheck --kernel-name kernel_substring=_cuda_kernel_ program 1",
    ]


def test_products_without_cublas_are_products():
    a, b, v = (torch.randn(*shape, dtype=torch.float64) for shape in ((3, 5, 4), (4, 6), (4,)))
    out = torch.zeros(5, 6, dtype=torch.float64)
    with sanitize.plain_products():
        products = [a @ b, a[0] @ b, torch.mm(a[0], b), torch.mm(a[0], b, out=out), out, b.T @ v]
        products += [torch._addmm_activation(torch.ones(6), a[1], b)]
    expected = [a @ b, *[a[0] @ b] * 4, b.T @ v, (1 + a[1] @ b).relu()]
    for x, y in zip(products, expected, strict=True):
        assert_close(x, y, kind="value", name="product")


def test_all_tools_run_whatever_the_first_one_found(tmp_path, monkeypatch, capsys):
    error = 'echo "========= ERROR SUMMARY: 1 error"'
    clean = 'echo "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)"'
    path = stub(tmp_path, f'case "$2" in memcheck) {error};; *) {clean};; esac')
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(sanitize, "PLACES", ())
    monkeypatch.setattr(sys, "executable", "true")  # which does not even render
    assert find_tool() == path
    assert Sanitize(tool="memcheck,racecheck")() == 1
    out = capsys.readouterr().out
    assert "memcheck: ERROR SUMMARY: 1 error: NOT CLEAN" in out and "(0 errors, 0 warnings): clean" in out
    assert Sanitize(tool="racecheck")() == 0


def test_what_cannot_run_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sanitize, "find_tool", lambda: stub(tmp_path, "true", "2025.3.1.0"))
    assert Sanitize(tool="racecheck")() == 2
    assert "--tool racecheck: expected 2026.4 or newer, got 2025.3.1.0" in capsys.readouterr().err
    monkeypatch.setattr(sanitize, "find_tool", lambda: None)
    assert Sanitize(tool="memcheck")() == 2
    assert "compute-sanitizer: expected it on the PATH" in capsys.readouterr().err
    assert Sanitize(tool="memcheck,valgrind")() == 2
    assert "--tool: expected some of memcheck, racecheck" in capsys.readouterr().err


def test_steps_and_frames_run(device):
    assert train_and_render(device) == {"steps": 4, "frames": 2}


def test_renderings_of_odd_sizes_run(device):
    """All K where kernels are compiled in seconds."""
    hits = range(9) if device.type == "cuda" else (2,)
    assert render_odd_sizes(device, hits) == 7 * len(hits)
