"""Kernels for test_simd, in a file of their own since Warp reads a kernel's source."""

from collections.abc import Callable
from typing import Any

import warp as wp

from nexwarp.native.simd import simd_functions
from nexwarp.native.simd.slots import slot_functions

WIDTH = 8

# By name: (function of the snippets' namespace f and the arguments a, b), for one function of arithmetic, exp_log and
# masks each. A kernel made of it writes its values and, by `wp.grad` of the contraction with g, its derivatives.
ARITHMETIC = ("times", "over", "scaled", "exp", "exp2", "log2", "pick", "at_least", "at_most")


def function_kernel(real: type, name: str) -> wp.Kernel:
    """Make the kernel that writes a function of SIMD vectors a, b > 0 and its vector-Jacobian product with g."""
    f, copies = simd_functions(real, WIDTH), simd_functions(real, WIDTH, for_gradients=True)
    reals, inner = f.reals, copies.inner
    value, differentiated = _function(real, name, f), _function(real, name, copies)

    @wp.func
    def contracted(a: reals, b: reals, g: reals):
        return inner(g, differentiated(a, b))

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        a: wp.array(dtype=reals),
        b: wp.array(dtype=reals),
        g: wp.array(dtype=reals),
        values: wp.array(dtype=reals),
        grad_a: wp.array(dtype=reals),
        grad_b: wp.array(dtype=reals),
    ):
        i = wp.tid()
        values[i] = value(a[i], b[i])
        ga, gb, _g = wp.grad(contracted)(a[i], b[i], g[i])
        grad_a[i] = ga
        grad_b[i] = gb

    return evaluate


def _function(real: type, name: str, f: Any) -> Callable[..., Any]:
    reals = f.reals
    splat, scaled, times, over, pick, below = f.splat, f.scaled, f.times, f.over, f.pick, f.below
    power_of_e, power_of_2, binary_logarithm = f.power_of_e, f.power_of_2, f.binary_logarithm
    at_least, at_most = f.at_least, f.at_most
    ONE = wp.constant(real(1.0))

    @wp.func
    def function(a: reals, b: reals):
        if wp.static(name == "times"):
            return times(a, b)
        elif wp.static(name == "over"):
            return over(a, b)
        elif wp.static(name == "scaled"):
            return scaled(b[0], a) + splat(b[1])
        elif wp.static(name == "exp"):
            return power_of_e(a)
        elif wp.static(name == "exp2"):
            return power_of_2(a)
        elif wp.static(name == "log2"):
            return binary_logarithm(a)
        elif wp.static(name == "pick"):
            return pick(below(a, b), a, b)
        elif wp.static(name == "at_least"):
            return at_least(a, ONE)
        else:
            return at_most(a, ONE)

    return function


def masks_kernel(real: type) -> wp.Kernel:
    """Make the kernel that writes every comparison of SIMD vectors, and what is made of their masks, a row each."""
    f = simd_functions(real, WIDTH)
    reals, integers, integer = f.reals, f.integers, f.integer

    @wp.kernel(enable_backward=False, module="unique")
    def compare(
        a: wp.array(dtype=reals),
        b: wp.array(dtype=reals),
        masks: wp.array2d(dtype=integers),
        some: wp.array2d(dtype=wp.int32),
    ):
        i = wp.tid()
        low = f.below(a[i], b[i])
        high = f.above(a[i], b[i], False)
        same = f.above(a[i], b[i], True)
        masks[0, i] = low
        masks[1, i] = high
        masks[2, i] = same
        masks[3, i] = f.both(low, same)
        masks[4, i] = f.either(low, high)
        masks[5, i] = f.equal_integers(low, high)
        masks[6, i] = f.less_integers(low, integers(integer(0)))
        masks[7, i] = f.pick_integers(low, integers(integer(3)), integers(integer(5)))
        some[0, i] = wp.where(f.any_of(low), 1, 0)
        some[1, i] = wp.where(f.any_of(f.both(low, high)), 1, 0)

    return compare


def slots_kernel(real: type) -> wp.Kernel:
    """Make the kernel that fills a table of two slots with a and b, swaps them, and differentiates a read slot."""
    f = simd_functions(real, WIDTH, for_gradients=True)
    s = slot_functions(real, WIDTH, 2)
    copies = slot_functions(real, WIDTH, 2, for_gradients=True)
    reals, integers, inner = f.reals, f.integers, f.inner
    reals_by_slot, integers_by_slot, integer = s.reals_by_slot, s.integers_by_slot, f.integer
    read = copies.reals_at

    @wp.func
    def second(table: reals_by_slot, g: reals):
        return inner(g, read(table, 1))

    @wp.kernel(enable_backward=False, module="unique")
    def swap(
        a: wp.array(dtype=reals),
        b: wp.array(dtype=reals),
        swapped: wp.array2d(dtype=reals),
        whole: wp.array(dtype=integers),
        grads: wp.array2d(dtype=reals),
    ):
        i = wp.tid()
        table = s.with_reals(s.with_reals(reals_by_slot(), 0, a[i]), 1, b[i])
        numbers = s.with_integers(integers_by_slot(), 1, integers(integer(7)))
        swapped[0, i] = s.reals_at(table, 1)
        swapped[1, i] = s.reals_at(table, 0)
        whole[i] = s.integers_at(numbers, 0) + s.integers_at(numbers, 1)
        gt, _g = wp.grad(second)(table, a[i])
        grads[0, i] = s.reals_at(gt, 0)
        grads[1, i] = s.reals_at(gt, 1)

    return swap
