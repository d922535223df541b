"""Powers of 2 and binary logarithms, which GPUs have instructions for: base e would multiply by ln 2 before or after.

Accurate to 2 units in the last place, as Warp's `fast_math` makes of base e. They have no adjoint. CPUs take the
compiler's own functions: it knows that they give the same result again.
"""

import warp as wp

from nexwarp.native import for_both_reals, snippet

_FAST = """
    float result;
    asm("INSTRUCTION.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(v));
    return result;
"""


@for_both_reals
def power_of_2(real: type) -> wp.Function:
    """Return 2 to the power of v."""
    fast = snippet(_FAST.replace("INSTRUCTION", "ex2"), "return __builtin_elementwise_exp2(v);")

    @wp.func_native(fast if real is wp.float32 else "return ::exp2(v);")
    def power_of_2(v: real) -> real: ...

    return power_of_2


@for_both_reals
def binary_logarithm(real: type) -> wp.Function:
    """Return the logarithm of v to base 2."""
    fast = snippet(_FAST.replace("INSTRUCTION", "lg2"), "return __builtin_elementwise_log2(v);")

    @wp.func_native(fast if real is wp.float32 else "return ::log2(v);")
    def binary_logarithm(v: real) -> real: ...

    return binary_logarithm
