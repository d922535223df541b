"""The basis functions of spherical harmonics (paper Sec. 4.1) as C++ expressions; see `nexwarp.kernels.sh`."""

from nexwarp.kernels.sh import BAND_0, BAND_1, BAND_2, BAND_3


def basis_terms(degree: int, *, suffix: str, one: str = "") -> list[str]:
    """Return the (degree + 1)^2 expressions in x, y, z, of a unit direction, and xx, yy, zz, their squares.

    Args:
        degree: SH degree, 0 to 3.
        suffix: of numbers, "f" for floats.
        one: what the constant term is multiplied by to have the type of the others; nothing for numbers.
    """
    c, d, f = BAND_2, BAND_3, suffix
    terms = [
        f"{BAND_0}{f}" + (f" * {one}" if one else ""),
        f"-{BAND_1}{f} * y",
        f"{BAND_1}{f} * z",
        f"-{BAND_1}{f} * x",
        f"{c[0]}{f} * x * y",
        f"-{c[0]}{f} * y * z",
        f"{c[1]}{f} * (2.0{f} * zz - xx - yy)",
        f"-{c[0]}{f} * x * z",
        f"{c[2]}{f} * (xx - yy)",
        f"-{d[0]}{f} * y * (3.0{f} * xx - yy)",
        f"{d[1]}{f} * x * y * z",
        f"-{d[2]}{f} * y * (4.0{f} * zz - xx - yy)",
        f"{d[3]}{f} * z * (2.0{f} * zz - 3.0{f} * xx - 3.0{f} * yy)",
        f"-{d[2]}{f} * x * (4.0{f} * zz - xx - yy)",
        f"{d[4]}{f} * z * (xx - yy)",
        f"-{d[0]}{f} * x * (xx - 3.0{f} * yy)",
    ]
    return terms[: (degree + 1) ** 2]
