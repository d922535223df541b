"""C++ snippets that Warp has no function for."""

from collections.abc import Callable

import warp as wp


def for_both_reals(make: Callable[[type], wp.Function]) -> wp.Function:
    """Make one native function of two overloads, for float32 and float64, from a factory over the scalar type."""
    function = make(wp.float32)
    function.add_overload(make(wp.float64))
    return function
