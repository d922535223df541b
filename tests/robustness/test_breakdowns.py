"""A few of the breakdowns of breakdowns.py."""

import os
import subprocess
import sys

import pytest

from tests.robustness.breakdowns import sweep


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="mounting a disk needs Linux and root")
@pytest.mark.timeout(600)
def test_a_full_disk_or_a_kill_leaves_nothing_half_written():
    try:
        wrong = sweep(6, ["train", "render", "export"], seed=0)
    except subprocess.CalledProcessError:
        pytest.skip("this system refuses to mount a disk")
    assert wrong == []
