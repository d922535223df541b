"""Draw one pixel of a trained scene with NumPy alone: the format of model files (docs/format.md), as a program.

python examples/read_model.py --run runs/demo --column 48 --row 36
"""

import argparse
import json
import lzma
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Tensors = dict[str, np.ndarray]

DTYPES = {"F32": np.float32, "F16": np.float16}
PRIMES = (1, 2654435761, 805459861)


def read(path: Path) -> tuple[Tensors, dict[str, Any]]:
    """Tensors by name, as float64, and the metadata."""
    data = Path(path).read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    meta = json.loads(header.pop("__metadata__")["nexwarp"])
    assert meta["format_version"] in (1, 3)
    tensors = {}
    for name, entry in header.items():
        part = body[slice(*entry["data_offsets"])]
        if entry["dtype"] == "U8":
            tensors[name] = unpack(name, part, meta["shapes"][name]).astype(np.float64)
        else:
            tensors[name] = np.frombuffer(part, DTYPES[entry["dtype"]]).reshape(entry["shape"]).astype(np.float64)
    return expand(tensors), meta


def unpack(name: str, stream: bytes, shape: list[int]) -> np.ndarray:
    """Numbers of a shape from a stream of a compact file."""
    count = int(np.prod(shape))
    digits = np.frombuffer(lzma.LZMADecompressor().decompress(stream), np.uint8)[:, None] >> np.arange(0, 8, 2) & 3
    planes = digits.reshape(-1, -(-count // 4) * 4)[:, :count].astype(np.int64)  # of digits to base 4
    folded = 4 ** np.arange(len(planes)) @ planes
    q = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
    if name in ("footprints", "far_footprints"):
        q = (q << 16).astype(np.uint32).view(np.float32)
    axis = 1 if name == "texture.grid" else 0
    return np.moveaxis(q.reshape(*shape[:axis], *shape[axis + 1 :], shape[axis]), -1, axis)


def expand(tensors: Tensors) -> Tensors:
    """Tensors of a full file from those of a compact one; those of a full file stay."""
    values = dict(tensors)
    for name in [name for name in tensors if name + ".code" in tensors]:
        q, code = values[name], values.pop(name + ".code")
        if name == "texture.grid":
            values[name] = code[:, :1] + q @ code[:, 1:]
        else:
            values[name] = code[0] + code[1] * (np.sinh(code[2] * q) if len(code) == 3 else q)
    return values


def harmonics(direction: np.ndarray, degree: int) -> np.ndarray:
    """Spherical harmonics at a unit direction: (degree + 1)^2 values."""
    x, y, z = direction
    values = [0.28209479177387814]
    values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    values += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
    values += [0.31539156525252005 * (2 * z * z - x * x - y * y)]
    values += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]
    values += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
    values += [-0.4570457994644658 * y * (4 * z * z - x * x - y * y)]
    values += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)]
    values += [-0.4570457994644658 * x * (4 * z * z - x * x - y * y)]
    values += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return np.array(values[: (degree + 1) ** 2])


def rotation(quat: np.ndarray) -> np.ndarray:
    """Matrix of a quaternion w x y z; its columns are the surfel's axes, the third one its normal."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Ray:
    """The ray of a pixel; `camera` is an entry of cameras.json."""

    def __init__(self, camera: dict[str, Any], column: int, row: int) -> None:
        viewmat, K = np.array(camera["viewmat"]), np.array(camera["K"])
        self.turn, self.move, self.near = viewmat[:3, :3], viewmat[:3, 3], camera["near"]
        self.eye = -self.turn.T @ self.move
        self.local = np.array([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0])
        self.toward = self.turn.T @ self.local
        self.focal = np.sqrt(K[0, 0] * K[1, 1])


def alpha(tensors: Tensors, i: int, ray: Ray) -> tuple[float, float]:
    """Opacity of surfel i on a ray, and the z-depth of the hit; 0 where it is not hit."""
    mean, axes = tensors["surfels.means"][i], rotation(tensors["surfels.raw_quats"][i])
    slope = axes[:, 2] @ ray.toward
    if slope == 0:
        return 0.0, 0.0
    depth = axes[:, 2] @ (mean - ray.eye) / slope
    scales, gammas = np.exp(tensors["surfels.log_scales"][i]), 1 + np.exp(tensors["surfels.raw_gammas"][i])
    opacity = 1 / (1 + np.exp(-tensors["surfels.logit_opacities"][i]))
    size, known = (ray.turn @ mean + ray.move)[2] / ray.focal, tensors.get("far_footprints", {i: np.inf})[i]
    if size > known:  # pixels are larger than in training: the surfel is blurred by what they are
        wide = np.sqrt(scales**2 + (size**2 - known**2) / 8)
        shares, scales = scales / wide, wide
        opacity, gammas = opacity * shares.prod(), 1 + (gammas - 1) * shares**2
    u, v = (ray.eye + depth * ray.toward - mean) @ axes[:, :2] / scales
    with np.errstate(over="ignore"):
        power = abs(u) ** (2 * gammas[0]) + abs(v) ** (2 * gammas[1])
    value = min(0.99, np.exp(-power / 2) * opacity)
    return (value, depth) if value >= 1 / 255 and depth > ray.near else (0.0, 0.0)


def plain_color(tensors: Tensors, i: int, ray: Ray, degree: int) -> np.ndarray:
    """Own colour of surfel i."""
    sh = np.concatenate([tensors["surfels.sh0"][i], tensors["surfels.shN"][i]])
    d = min(degree, int(len(sh) ** 0.5) - 1)
    view = tensors["surfels.means"][i] - ray.eye
    return np.maximum(0.5 + harmonics(view / np.linalg.norm(view), d) @ sh[: (d + 1) ** 2], 0)


def hits(tensors: Tensors, meta: dict[str, Any], ray: Ray) -> Iterator[tuple[float, float, int]]:
    """Weight, depth and surfel of each hit, front to back; then the transmittance that is left, with surfel -1."""
    means = tensors["surfels.means"]
    depths = (means @ ray.turn.T + ray.move)[:, 2]
    keys = np.linalg.norm(means - ray.eye, axis=1) if meta.get("order", "depth") == "distance" else depths
    left = 1.0
    # By the depth of the centres, in float32 so that ties are ties; the lower index first.
    for i in np.argsort(keys.astype(np.float32), kind="stable"):
        if left >= 1e-4 and (hit := alpha(tensors, i, ray))[0] > 0:
            yield left * hit[0], hit[1], i
            left *= 1 - hit[0]
    yield left, 0.0, -1


def texture(tensors: Tensors, shape: dict[str, Any], point: np.ndarray, depth: float, focal: float) -> np.ndarray:
    """SH coefficients (C, 3) at a world point; detail as at a z-depth with a focal length in pixels."""
    features = []
    for entries, cells in zip(tensors["texture.grid"], tensors["texture.resolutions"], strict=True):
        corner = np.floor(cells * point).astype(int)
        inside, value = cells * point - corner, 0.0
        for offset in np.ndindex(2, 2, 2):
            index = 0
            for i, prime in zip((corner + offset).tolist(), PRIMES, strict=True):
                index ^= (2 * i - 1 if i > 0 else -2 * i) * prime & 0xFFFFFFFF
            value = value + np.prod(np.where(offset, inside, 1 - inside)) * entries[index & (len(entries) - 1)]
        if shape.get("down_weighting", True):
            value = value * (1 - np.exp(-((focal / (cells * depth)) ** 2) / (2 * np.pi)))
        features.append(value)
    x = np.concatenate(features)
    for i in range(shape["hidden_layers"] + 1):
        x = tensors[f"texture.mlp.{2 * i}.weight"] @ (np.maximum(x, 0) if i else x)
    return x.reshape(-1, 3)


def textured(tensors: Tensors, meta: dict[str, Any], ray: Ray, hit: tuple[float, int], plain: np.ndarray) -> np.ndarray:
    """Colour of a textured hit, given its depth and surfel and the surfel's own colour."""
    (depth, i), shape = hit, meta["texture"]
    degree = min(meta["sh_degree"], shape["sh_degree"])
    basis = harmonics(ray.toward / np.linalg.norm(ray.toward), degree)
    # Views from closer or farther away than training get the detail of training.
    seen = min(depth, ray.focal * tensors["far_footprints"][i]) if "far_footprints" in tensors else depth
    seen = max(seen, ray.focal * tensors["footprints"][i]) if "footprints" in tensors else seen
    texel = basis @ texture(tensors, shape, ray.eye + depth * ray.toward, seen, ray.focal)[: len(basis)]
    color = plain + texel if shape.get("residual", False) else 0.5 + texel
    return np.maximum(color, 0) if meta["clamp_texture"] else color


def exposure(tensors: Tensors, ray: Ray) -> np.ndarray:
    """Factors of red, green and blue: gains from the photos around the camera, and the lens's falloff."""
    factors = np.ones(3)
    if "exposures.log_gains" in tensors:
        gains, (size, length) = tensors["exposures.log_gains"], tensors["exposures.lengths"]
        squares = ((tensors["exposures.positions"] - ray.eye) ** 2).sum(1)
        squares += size**2 * ((tensors["exposures.directions"] - ray.turn[2]) ** 2).sum(1)
        r = np.sqrt(3 * squares) / length
        predicted = tensors["exposures.mean"] + (1 + r) * np.exp(-r) @ tensors["exposures.coefficients"]
        factors = np.exp(np.clip(predicted, gains.min(0), gains.max(0)))
    if "exposures.falloff" in tensors:
        a, b, largest = tensors["exposures.falloff"]
        t = min((ray.local[0] ** 2 + ray.local[1] ** 2) / largest, 1)
        factors = factors * np.exp(a * t + b * t**2)
    return factors


def pixel(tensors: Tensors, meta: dict[str, Any], camera: dict[str, Any], column: int, row: int) -> np.ndarray:
    """Colour of one pixel."""
    if not meta.get("detail_limits", True):
        tensors = {name: x for name, x in tensors.items() if name not in ("footprints", "far_footprints")}
    if meta.get("exposure", "photos") == "mean":
        tensors = {name: x for name, x in tensors.items() if not name.startswith("exposures.")}
    ray = Ray(camera, column, row)
    *touched, (left, _, _) = hits(tensors, meta, ray)
    touched.sort(key=lambda hit: -hit[0])  # stable: of equal weights the nearer one counts as heavier
    color = left * np.array(meta["background"])
    for k, (weight, depth, i) in enumerate(touched):
        part = plain_color(tensors, i, ray, meta["sh_degree"])
        if meta["texture"] and k < meta["max_hits"]:
            part = textured(tensors, meta, ray, (depth, i), part)
        color = color + weight * part
    return color * exposure(tensors, ray)


def main() -> None:
    """Print the colour of a pixel of the first test view."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=Path("runs/demo"), help="run folder")
    parser.add_argument("--column", type=int, default=48)
    parser.add_argument("--row", type=int, default=36)
    options = parser.parse_args()
    name, camera = next(iter(json.loads((options.run / "cameras.json").read_text())["test"].items()))
    tensors, meta = read(options.run / "model.safetensors")
    color = pixel(tensors, meta, camera, options.column, options.row)
    print(f"{name}, column {options.column}, row {options.row}: {np.round(255 * color.clip(0, 1)).astype(int)}")


if __name__ == "__main__":
    main()
