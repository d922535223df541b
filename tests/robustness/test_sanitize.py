"""What compute-sanitizer says is understood, and what it is to look at runs. No compute-sanitizer is needed."""

import os
import stat
import sys
from functools import partial
from pathlib import Path

import pytest
import torch

from benchmarks import kernel_sweep, sanitize
from benchmarks.kernel_sweep import SIZES, Sweep, catalogue, compile_catalogue, sweep
from benchmarks.sanitize import Sanitize, check, find_tool, kernels_at_fault, parse, work
from tests.tolerances import assert_close

BANNER = "========= COMPUTE-SANITIZER\n4 training steps and 2 frames on cuda\n"
WRITE = """========= Invalid __global__ write of size 4 bytes
=========     at collect_1a2b_cuda_kernel_forward+0x1f0
=========     by thread (31,0,0) in block (2,0,0)
=========     Address 0x7f2a0c000400 is out of bounds
"""


@pytest.mark.parametrize(
    ("output", "errors"),
    [
        (BANNER + "========= ERROR SUMMARY: 0 errors\n", 0),
        (BANNER + WRITE + "========= ERROR SUMMARY: 1 error\n", 1),
        (BANNER + "========= ERROR SUMMARY: 17 errors\n", 17),
        (BANNER + "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)\n", 0),
        (BANNER + "========= RACECHECK SUMMARY: 3 hazards displayed (2 errors, 1 warning)\n", 2),
        (BANNER + "========= RACECHECK SUMMARY: 1 hazard displayed (0 errors, 1 warning)\n", 0),
        ("========= ERROR SUMMARY: 2 errors\n" + BANNER + "========= ERROR SUMMARY: 0 errors\n", 2),  # two processes
        (BANNER + "========= Error: Target application terminated before first instrumented API call\n", None),
        (BANNER + "========= Device not supported. Please refer to the documentation\n", None),
        ("ERROR SUMMARY: 0 errors\n", None),  # said by somebody else
        ("", None),
    ],
)
def test_summaries_are_understood(output, errors):
    assert parse(output).errors == errors
    assert parse(output).told and "=" not in parse(output).told


def test_what_stands_in_place_of_a_summary_is_told():
    assert parse(BANNER + "========= Device not supported.\n").told == "Device not supported."
    assert parse("").told == "no output of compute-sanitizer"


def stub(folder: Path, body: str, version: str = "2026.4.0.0") -> str:
    """A compute-sanitizer that tells its version, or notes its arguments and then does as `body` says."""
    file = folder / "compute-sanitizer"
    told = f'if [ "$1" = --version ]; then echo "Version {version} (build 1)"; exit; fi'
    file.write_text(f'#!/bin/sh\n{told}\necho "$@ $PYTORCH_NO_CUDA_MEMORY_CACHING" >> {folder}/asked\n{body}\n')
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return str(file)


@pytest.mark.parametrize(
    ("body", "clean", "told"),
    [
        ('echo "========= ERROR SUMMARY: 0 errors"', True, "memcheck: ERROR SUMMARY: 0 errors: clean"),
        ('echo "========= ERROR SUMMARY: 2 errors"', False, "memcheck: ERROR SUMMARY: 2 errors: NOT CLEAN"),
        ('echo "========= ERROR SUMMARY: 0 errors"; exit 7', False, "0 errors, exit code 7: NOT CLEAN"),
        ("exit 13", False, "memcheck: no output of compute-sanitizer, exit code 13: NOT CLEAN"),
    ],
)
def test_a_tool_is_clean_only_when_it_says_so(tmp_path, capsys, body, clean, told):
    assert check("memcheck", stub(tmp_path, body), ["program"]).clean == clean
    assert told in capsys.readouterr().out


def test_errors_are_shown(tmp_path, capsys):
    (tmp_path / "output").write_text(BANNER + WRITE + "========= ERROR SUMMARY: 1 error\n")
    assert not check("memcheck", stub(tmp_path, f"cat {tmp_path}/output"), ["program"]).clean
    out = capsys.readouterr().out
    assert (
        "Invalid __global__ write" in out and "       1 printed errors at collect_1a2b_cuda_kernel_forward+0x1f0" in out
    )


def test_places_are_told_by_their_errors():
    other = WRITE.replace("collect_1a2b", "count_3c4d")
    assert kernels_at_fault(other + WRITE * 3) == [
        "       3 printed errors at collect_1a2b_cuda_kernel_forward+0x1f0",
        "       1 printed errors at count_3c4d_cuda_kernel_forward+0x1f0",
    ]
    of_torch = WRITE.replace("collect_1a2b_cuda_kernel_forward", "void at::native::copy<(int)8, float>(float *)")
    assert kernels_at_fault(of_torch) == [
        "       1 printed errors at void at::native::copy<(int)8, float>(float *)+0x1f0"
    ]
    assert kernels_at_fault(BANNER) == []


def test_tools_are_called_as_they_want(tmp_path):
    path = stub(tmp_path, "true")
    for tool in ("memcheck", "racecheck"):
        check(tool, path, ["python", "-m", "x"], ["--report-api-errors", "no"])
    assert (tmp_path / "asked").read_text().splitlines() == [
        "--tool memcheck --report-api-errors no python -m x 1",
        "--tool racecheck --kernel-name kernel_substring=_cuda_kernel_ --report-api-errors no python -m x 1",
    ]


def test_products_without_cublas_are_products():
    a, b, v = (torch.randn(*shape, dtype=torch.float64) for shape in ((3, 5, 4), (4, 6), (4,)))
    out = torch.zeros(5, 6, dtype=torch.float64)
    half = a[0].half(), b.half()
    with sanitize.plain_products():
        found = [a @ b, a[0] @ b, torch.mm(a[0], b), torch.mm(a[0], b, out=out), out, b.T @ v]
        found += [torch._addmm_activation(torch.ones(6), a[1], b)]
        wide = torch.mm(*half, out_dtype=torch.float32)
    expected = [a @ b, *[a[0] @ b] * 4, b.T @ v, (1 + a[1] @ b).relu()]
    for x, y in zip(found, expected, strict=True):
        assert_close(x, y, kind="value", name="product")
    assert_close(wide, half[0].float() @ half[1].float(), kind="value", name="half")


def test_all_tools_run_whatever_the_first_one_found(tmp_path, monkeypatch, capsys):
    found = 'echo "========= ERROR SUMMARY: 1 error"'
    clean = 'echo "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)"'
    path = stub(tmp_path, f'case "$2" in memcheck) {found};; *) {clean};; esac')
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(sys, "executable", "true")  # which does not even render
    assert find_tool() == path
    assert Sanitize(tool="memcheck,racecheck")() == 1
    out = capsys.readouterr().out
    assert "memcheck: ERROR SUMMARY: 1 error: NOT CLEAN" in out and "(0 errors, 0 warnings): clean" in out
    assert out.splitlines()[-1] == "1 errors found in 2 runs"
    assert Sanitize(tool="racecheck")() == 0


@pytest.mark.parametrize(("tool", "version", "code"), [("racecheck", "2025.3.1.0", 2), ("memcheck", "2025.3.1.0", 0)])
def test_racecheck_of_a_version_that_fails_is_refused(tmp_path, monkeypatch, capsys, tool, version, code):
    path = stub(tmp_path, 'echo "========= ERROR SUMMARY: 0 errors"', version)
    monkeypatch.setattr(sanitize, "find_tool", lambda: path)
    monkeypatch.setattr(sys, "executable", "true")
    assert Sanitize(tool=tool)() == code
    out, err = capsys.readouterr()
    assert out.startswith(f"compute-sanitizer {version}: {path}\n")
    assert bool(err) == bool(code)
    if code:
        assert err.startswith("--tool racecheck: expected another version, such as 2026.4, got 2025.3.1.0: pip install")


def test_a_tool_that_is_missing_or_unknown_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sanitize, "find_tool", lambda: None)
    assert Sanitize(tool="memcheck")() == 2
    assert capsys.readouterr().err == "compute-sanitizer: expected on the PATH or in a CUDA toolkit, found none\n"
    assert Sanitize(tool="memcheck,valgrind")() == 2
    assert capsys.readouterr().err.startswith(
        "--tool: expected some of memcheck, racecheck, initcheck, synccheck, got "
    )


def test_a_missing_tool_is_not_found(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sanitize, "PLACES", ())
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    for name in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    assert find_tool() is None
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "cuda"))
    (tmp_path / "cuda" / "bin").mkdir(parents=True)
    assert find_tool() is None
    stub(tmp_path / "cuda" / "bin", "true")
    assert find_tool() == str(tmp_path / "cuda" / "bin" / "compute-sanitizer")
    # One that was installed with pip is there on purpose.
    packaged = tmp_path / "nvidia" / "cu13" / "compute-sanitizer"
    packaged.mkdir(parents=True)
    stub(packaged, "true")
    assert find_tool() == str(packaged / "compute-sanitizer")


def test_steps_and_frames_run(device):
    assert work(device) == {"steps": 4, "frames": 2}


def test_a_tool_without_a_summary_is_counted(tmp_path, monkeypatch, capsys):
    path = stub(tmp_path, "exit 3")
    monkeypatch.setattr(sanitize, "find_tool", lambda: path)
    monkeypatch.setattr(sys, "executable", "true")
    assert Sanitize(tool="memcheck,synccheck", sweep=True)() == 1
    assert capsys.readouterr().out.splitlines()[-1] == "0 errors found in 0 runs; 2 ended without a summary"
    assert all(line.endswith("--device cuda --sweep 1") for line in (tmp_path / "asked").read_text().splitlines())


def test_parts_share_the_sweep(tmp_path, monkeypatch):
    """Each tool is run once for each part, and parts are told to be one; initcheck's do without cuBLAS."""
    path = stub(tmp_path, 'echo "========= ERROR SUMMARY: 0 errors"')
    monkeypatch.setattr(sanitize, "find_tool", lambda: path)
    monkeypatch.setattr(sys, "executable", "true")
    assert Sanitize(tool="memcheck,initcheck", sweep=True, parts=2)() == 0
    asked = sorted(line.split("--device cuda ")[1] for line in (tmp_path / "asked").read_text().splitlines())
    plain = " --plain-products"
    assert asked == [f"--sweep --parts 2 --part {i}{x} 1" for i in (0, 1) for x in (plain, "")]


def test_no_process_at_a_time_is_one_line(capsys):
    assert Sanitize(tool="memcheck", jobs=0)() == 2
    assert capsys.readouterr().err == "--jobs: expected at least 1, got 0\n"


def test_a_part_that_is_none_is_one_line(capsys):
    assert Sanitize(device="cpu", parts=2, part=2)() == 2
    assert capsys.readouterr().err == "--part: expected 0 to 1, got 2\n"


def test_parts_are_the_whole(monkeypatch):
    """Every job of a sweep belongs to one part."""
    done: list[int] = []

    def job(i: int) -> int:
        done.append(i)
        return 1

    monkeypatch.setattr(kernel_sweep, "_jobs", lambda *_: (partial(job, i) for i in range(7)))
    assert [sweep(torch.device("cpu"), (2,), part=(i, 3)).renderings for i in range(3)] == [3, 2, 2]
    assert sorted(done) == list(range(7))


def test_the_sweep_launches_every_kernel_of_some_k(device):
    """All K, and all sizes, where kernels are compiled in seconds; see below for the CPU."""
    hits = range(9) if device.type == "cuda" else (2,)
    compile_catalogue(device, hits)
    swept = sweep(device, hits, SIZES if device.type == "cuda" else SIZES[:3])
    assert not swept.missing and swept.kernels == len(catalogue(device, hits))


@pytest.mark.slow
def test_the_sweep_launches_every_kernel_on_a_cpu(capsys):
    assert Sanitize(device="cpu", sweep=True)() == 0
    assert "158 kernels in " in capsys.readouterr().out


def test_a_kernel_that_no_rendering_launches_is_named(monkeypatch, capsys):
    monkeypatch.setattr(sanitize, "work", lambda _: {"steps": 0, "frames": 0})
    monkeypatch.setattr(sanitize, "sweep", lambda _, part: Sweep(3, 1, ["compose_1a2b"]))
    assert Sanitize(device="cpu", sweep=True)() == 1
    out, err = capsys.readouterr()
    assert "1 kernels in 3 renderings on cpu" in out and err == "not launched: compose_1a2b\n"
