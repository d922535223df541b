"""C++ snippets that Warp has no function for."""

from collections.abc import Callable
from types import FunctionType

import warp as wp


def snippet(cuda: str, cpu: str = "") -> str:
    """C++ that is `cuda` on a GPU and `cpu` on a CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


def func_native(text: str, double: str | None = None) -> Callable[[FunctionType], wp.Function]:
    """Decorate a stub that becomes a native function of two overloads, for float32 and float64.

    In the text, C++, `REAL` is the scalar type; `double` is the text for float64 where that is another one. In the
    stub's annotations, which must be strings, `real` is the scalar type, `vec2` and `vec4` are vectors, and `vec2_rows`
    and `vec4_rows` arrays of two dimensions. Decorate by `@native.func_native`: Warp knows the stubs by that name.
    """

    def overload(stub: FunctionType, real: type, text: str) -> wp.Function:
        vectors = {f"vec{length}": wp.types.vector(length=length, dtype=real) for length in (2, 4)}
        rows = {f"{name}_rows": wp.array2d(dtype=vector) for name, vector in vectors.items()}
        typed = FunctionType(stub.__code__, stub.__globals__ | {"real": real} | vectors | rows)
        typed.__annotations__ = stub.__annotations__
        return wp.func_native(text.replace("REAL", "float" if real is wp.float32 else "double"))(typed)

    def make(stub: FunctionType) -> wp.Function:
        function = overload(stub, wp.float32, text)
        function.add_overload(overload(stub, wp.float64, text if double is None else double))
        return function

    return make
