"""Powers of 2 and binary logarithms, which GPUs have instructions for: base e would multiply by ln 2 before or after.

Accurate to 2 units in the last place, as Warp's `fast_math` makes of base e. They have no adjoint. CPUs take the
compiler's own functions: it knows that they give the same result again.
"""

from __future__ import annotations

from nexwarp import native
from nexwarp.native import snippet

_FAST = """
    float result;
    asm("INSTRUCTION.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(v));
    return result;
"""
_POWER = snippet(_FAST.replace("INSTRUCTION", "ex2"), "return __builtin_elementwise_exp2(v);")
_LOGARITHM = snippet(_FAST.replace("INSTRUCTION", "lg2"), "return __builtin_elementwise_log2(v);")


@native.func_native(_POWER, double="return ::exp2(v);")
def power_of_2(v: real) -> real:
    """Return 2 to the power of v."""


@native.func_native(_LOGARITHM, double="return ::log2(v);")
def binary_logarithm(v: real) -> real:
    """Return the logarithm of v to base 2."""
