"""Bounds of the values in files of models: within them every picture is finite."""

from collections.abc import Iterator, Mapping

import torch

from nexwarp.cameras.camera import LARGEST_DISTANCE
from nexwarp.errors import check_values
from nexwarp.kernels.activate import SHORTEST
from nexwarp.model.texture import LARGEST_RESOLUTION, NEVER

LARGEST_HALF = 65504.0
ROUNDING = 1 + 1e-6  # of the texture's resolutions

# The exponential of 80 is finite in single precision; that of a large negative number is 0, which is a valid value.
RAW = (-1e4, 80.0)

BOUNDS: dict[str, tuple[float, float]] = {
    "surfels.means": (-LARGEST_DISTANCE, LARGEST_DISTANCE),
    "surfels.raw_quats": (-1e15, 1e15),
    "surfels.log_scales": RAW,
    "surfels.logit_opacities": (-1e4, 1e4),
    "surfels.raw_gammas": RAW,
    "surfels.sh0": (-1e6, 1e6),
    "surfels.shN": (-1e6, 1e6),
    "footprints": (0.0, NEVER),
    "far_footprints": (0.0, NEVER),
    "exposures.log_gains": (-20.0, 20.0),
    "exposures.positions": (-LARGEST_DISTANCE, LARGEST_DISTANCE),
    "exposures.directions": (-2.0, 2.0),
    "exposures.coefficients": (-1e6, 1e6),
    "exposures.mean": (-1e6, 1e6),
    "exposures.lengths": (1e-15, LARGEST_DISTANCE),
    "exposures.falloff": (-1e3, LARGEST_DISTANCE),
    "texture.grid": (-LARGEST_HALF, LARGEST_HALF),
    "texture.resolutions": (0.0, LARGEST_RESOLUTION * ROUNDING),
}
MATRICES = "texture.mlp."
MATRIX_BOUNDS = (-LARGEST_HALF, LARGEST_HALF)
LARGEST_LOG_LIGHT = 20.0  # logarithm of the largest factor of a lens's falloff
SMALLEST_TANGENT = 1e-12  # squared, of a lens's falloff
LARGEST_OUTPUT = 1e12  # of a layer of the texture's MLP


def check_bounds(tensors: Mapping[str, torch.Tensor]) -> None:
    """Raise ValueError that names the tensor, by its name in a model file, if a model with it could not render."""
    tensors = {name: x.float() if x.dtype == torch.float16 else x for name, x in tensors.items()}
    for name, tensor in tensors.items():
        bounds = MATRIX_BOUNDS if name.startswith(MATRICES) else BOUNDS.get(name)
        if bounds is not None:
            check_values(name, tensor, *bounds)
    if (quats := tensors.get("surfels.raw_quats")) is not None and len(quats):
        lengths = quats.norm(dim=1)
        if lengths.min() < SHORTEST:
            where = int(lengths.argmin())
            raise ValueError(
                f"surfels.raw_quats: expected a length of at least {float(SHORTEST):g}, got 0 at index {where}"
            )
    if (falloff := tensors.get("exposures.falloff")) is not None:
        a, b, widest = falloff.tolist()
        if not widest >= SMALLEST_TANGENT:
            expected = f"a largest squared tangent of at least {SMALLEST_TANGENT:g}"
            raise ValueError(f"exposures.falloff: expected {expected}, got {widest:g}")
        # The largest value of a t + b t^2 for t from 0 to 1 is at an end or, of a concave parabola, at its vertex.
        vertex = -a * a / (4 * b) if b < 0 and 0 < -a / (2 * b) < 1 else 0.0
        if max(a + b, vertex) > LARGEST_LOG_LIGHT:
            expected = f"a t + b t^2 of at most {LARGEST_LOG_LIGHT:g}"
            raise ValueError(f"exposures.falloff: expected {expected}, got a {a:g} and b {b:g}")
    for name, largest in _largest_outputs(tensors):
        if largest > LARGEST_OUTPUT:
            raise ValueError(f"{name}: expected outputs of at most {LARGEST_OUTPUT:g}, got up to {largest:g}")


def fits_half(tensors: Mapping[str, torch.Tensor]) -> bool:
    """Whether no layer of the texture's MLP can overflow in half precision; the tensors are those of `check_bounds`."""
    return all(largest <= LARGEST_HALF for _, largest in _largest_outputs(tensors))


def _largest_outputs(tensors: Mapping[str, torch.Tensor]) -> Iterator[tuple[str, float]]:
    """Yield the name of each matrix of the MLP, and a bound of the magnitude of its layer's outputs."""
    if "texture.grid" not in tensors:
        return
    largest = tensors["texture.grid"].abs().max().item()
    matrices = [name for name in tensors if name.startswith(MATRICES)]
    for name in sorted(matrices, key=lambda name: int(name.split(".")[2])):
        largest *= tensors[name].float().abs().sum(1).max().item()
        yield name, largest
