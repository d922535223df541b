"""safetensors files: a bound of their headers."""

from pathlib import Path

from nexwarp.errors import FormatError

LONGEST_HEADER = 2**20  # bytes; that of a model has about 5,000


def check_tensors_header(path: Path) -> None:
    """Raise FormatError if a safetensors file's header is long: parsing one of 100,000 tensors takes seconds."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
    # A file whose header would not fit is damaged, which its reader says.
    if LONGEST_HEADER < size <= path.stat().st_size:
        raise FormatError(
            f"{path}: expected a safetensors header of at most {LONGEST_HEADER:,} bytes, a few tensors, got {size:,}"
        )
