"""Warp's start: without its notes, and without a warning where there is no NVIDIA driver.

Warp prints a banner when it starts and a line for each module that it loads, at its default log level, LOG_INFO. Users
of nexwarp do not know these modules. `warp.config.log_level = warp.LOG_INFO` after `import nexwarp` shows the lines.
"""

import ctypes
import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

DRIVERS = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1")

if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


@functools.cache  # looking for the driver takes as long as a launch
def start_warp() -> None:
    """Initialise Warp, which does nothing the second time. Without a driver, Warp's warning of that is not printed."""
    if _has_driver():
        wp.init()
        return
    with _without_stderr():
        wp.init()


def _has_driver() -> bool:
    """Whether the NVIDIA driver can be loaded, as Warp looks for it."""
    for name in DRIVERS:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Discard what native code writes to stderr, which Python's `sys.stderr` does not see."""
    try:
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
