"""C++ snippets that Warp has no function for."""

from collections.abc import Callable

import warp as wp


def snippet(cuda: str, cpu: str = "") -> str:
    """C++ that is `cuda` on a GPU and `cpu` on a CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


def for_both_reals(make: Callable[[type], wp.Function]) -> wp.Function:
    """Make one native function of two overloads, for float32 and float64, from a factory over the scalar type."""
    function = make(wp.float32)
    function.add_overload(make(wp.float64))
    return function
