"""Tables with one SIMD vector in each of a few slots, whose slots are read and replaced whole."""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.native.simd import simd_functions
from nexwarp.native.simd.snippets import TYPES, filled

# Whole slots at once: element by element, Clang takes the table apart into numbers and puts vectors together again, at
# the cost of seconds of its time and of some of the kernel's.
_SLOT_AT = """
    wp::vec_t<WIDTH, NUMBER> v;
    __builtin_memcpy(&v, table.data[j], sizeof(v));
    return v;
"""

_ADJOINT_SLOT_AT = """
    reals_t g, total;
    __builtin_memcpy(&g, &adj_ret, sizeof(g));
    __builtin_memcpy(&total, adj_table.data[j], sizeof(total));
    total = total + g;
    __builtin_memcpy(adj_table.data[j], &total, sizeof(total));
"""

_WITH_SLOT = """
    __builtin_memcpy(table.data[j], &v, sizeof(v));
    return table;
"""


@functools.cache
def slot_functions(real: type, width: int, slots: int, for_gradients: bool = False) -> SimpleNamespace:
    """Make the tables of `width` > 1 reals or integers a slot; `for_gradients` as in `simd_functions`.

    Returns:
        `reals_by_slot` and `integers_by_slot`, types of tables, and functions: reals_at(table, j), which is
        differentiable, and integers_at(table, j), a slot; with_reals(table, j, v) and with_integers(table, j, v), the
        table with another slot j.
    """
    f = simd_functions(real, width, for_gradients)
    reals, integers, integer = f.reals, f.integers, f.integer
    reals_by_slot = wp.types.matrix(shape=(slots, width), dtype=real)
    integers_by_slot = wp.types.matrix(shape=(slots, width), dtype=integer)

    def snippet(text: str, **replaced: str) -> str:
        return filled(text, real, width, **replaced)

    @wp.func_native(snippet(_SLOT_AT, NUMBER="REAL"), adj_snippet=snippet(TYPES + _ADJOINT_SLOT_AT))
    def reals_at(table: reals_by_slot, j: wp.int32) -> reals: ...

    @wp.func_native(snippet(_SLOT_AT, NUMBER="INT"))
    def integers_at(table: integers_by_slot, j: wp.int32) -> integers: ...

    @wp.func_native(_WITH_SLOT)
    def with_reals(table: reals_by_slot, j: wp.int32, v: reals) -> reals_by_slot: ...

    @wp.func_native(_WITH_SLOT)
    def with_integers(table: integers_by_slot, j: wp.int32, v: integers) -> integers_by_slot: ...

    return SimpleNamespace(
        reals_by_slot=reals_by_slot,
        integers_by_slot=integers_by_slot,
        reals_at=reals_at,
        integers_at=integers_at,
        with_reals=with_reals,
        with_integers=with_integers,
    )
