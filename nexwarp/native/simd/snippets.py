"""What the snippets share: their two vector types, and the filling of what they leave open.

A snippet is C++ for Clang, which turns arithmetic on its vector types into SIMD instructions. It names REAL, INT (the
integer of REAL's size) and WIDTH; `g` is the vector whose elements SUM_OF_G adds up to `sum`.
"""

import warp as wp

TYPES = """
    typedef REAL reals_t __attribute__((ext_vector_type(WIDTH)));
    typedef INT integers_t __attribute__((ext_vector_type(WIDTH)));
"""


def filled(text: str, real: type, width: int, **replaced: str) -> str:
    """Return a snippet with its open names filled: first those of `replaced`, then the types and the width."""
    wide = real is wp.float64
    # The sum of the elements by halves: in order it would be one addition after another.
    halves = [f"const auto g{n // 2} = g{n}.lo + g{n}.hi;" for n in (16, 8, 4) if n <= width]
    names = {
        "SUM_OF_G": f"const auto g{width} = g; {' '.join(halves)} const REAL sum = g2[0] + g2[1];",
        "REAL": "double" if wide else "float",
        "INT": "wp::int64" if wide else "wp::int32",
        "WIDTH": str(width),
    }
    for key, value in (replaced | names).items():
        text = text.replace(key, value)
    return text
