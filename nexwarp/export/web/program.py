"""What the hosts of the WGSL renderer share: constants of the shaders, layout of the buffers, values of a frame.

`page/renderer.js` does the same in the browser; a test compares the constants and buffers of both.
"""

from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.export.web.scene_data import ExposureData, SceneData
from nexwarp.model.texture import FOCAL_WITHOUT_DOWN_WEIGHTING

TILE = 16
SCAN_BLOCK = 1024  # elements of a workgroup of scan.wgsl
SORT_BLOCK = 2048  # pairs of a workgroup of sort.wgsl
MODES = ("image", "plain", "textured", "ids", "depth", "weights", "normals", "alpha")
FRAME_BYTES = 12 * 16
MOST_UNROLLED = 1200  # blocks of an MLP that is unrolled
MOST_UNIFORM = 2**16  # bytes of a uniform buffer


@dataclass(frozen=True)
class Program:
    """Constants of the shaders for one scene.

    Attributes:
        constants: names to WGSL literals.
        features: features an entry of the grid.
        half: whether the MLP is computed in half precision.
        unrolled: whether the MLP is unrolled.
        uniform: whether its weights are in a uniform buffer.
    """

    constants: dict[str, str]
    features: int
    half: bool
    unrolled: bool
    uniform: bool

    @classmethod
    def of(cls, scene: SceneData, sharing: int, half: bool, unrolled: bool, uniform: bool) -> "Program":
        """Derive the constants; `sharing` threads share a surfel's tile rows."""
        options, texture = scene.options, scene.texture
        stored = scene.sh.shape[1]
        plain_degree = min(options.sh_degree, round(stored**0.5) - 1)
        shape = None if texture is None else texture.shape
        degree = 0 if shape is None else shape["sh_degree"]
        used = (min(options.sh_degree, degree) + 1) ** 2
        features = 2 if shape is None else shape["features"]
        levels = 1 if shape is None else shape["levels"]
        unsigned = {
            "K": options.max_hits,
            "SHARING": sharing,
            "RECORD": 5 if options.low_pass else 4,
            "SH_COEFFICIENTS": stored,
            "PLAIN_COEFFICIENTS": (plain_degree + 1) ** 2,
            "TOTAL": -(-len(scene) * sharing // SCAN_BLOCK),
            "LEVELS": levels,
            "MASK": 0 if shape is None else shape["table_size"] - 1,
            "INPUTS": -(-levels * features // 4),
            "WIDTH": 1 if shape is None else -(-shape["width"] // 4),
            "HIDDEN": 0 if shape is None else shape["hidden_layers"],
            "BLOCKS": -(-((degree + 1) ** 2) // 4),
            "USED_COEFFICIENTS": used,
            "USED_BLOCKS": -(-used // 4),
        }
        flags = {
            "LOW_PASS": options.low_pass,
            "LIMITS": scene.limits is not None,
            "TEXTURED": texture is not None,
            "RESIDUAL": shape is not None and shape["residual"],
            "CLAMP": options.clamp_texture,
        }
        constants = {name: f"{value}u" for name, value in unsigned.items()}
        constants |= {name: "true" if value else "false" for name, value in flags.items()}
        program = cls(constants, features, half, unrolled, uniform)
        blocks = mlp_blocks(program)
        fits = blocks * (32 if half else 64) <= MOST_UNIFORM
        return replace(program, unrolled=unrolled and blocks <= MOST_UNROLLED, uniform=uniform and fits)

    def number(self, name: str) -> int:
        """Return the value of a constant."""
        return int(self.constants[name][:-1])

    def source(self, name: str) -> str:
        """Return the WGSL text of a shader, with constants and what it includes."""
        if name in ("scan", "sort"):
            return shader(name)
        parts, lines = [shader("common"), shader(name)], []
        if name == "shade":
            scalar = "f16" if self.half else "f32"
            kind, size = ("uniform", f", {mlp_blocks(self)}") if self.uniform else ("storage, read", "")
            lines = ["enable f16;"] if self.half else []
            lines += [f"alias Scalar = {scalar};", f"alias Weight = vec4<{scalar}>;"]
            lines.append(f"@group(0) @binding(6) var<{kind}> mlp: array<mat4x4<{scalar}>{size}>;")
            mlp = unrolled_mlp(self) if self.unrolled else shader("mlp")
            parts = [shader("common"), shader(f"features{self.features}"), shader("shade"), mlp]
        lines += [
            f"const {name}: {'u32' if value.endswith('u') else 'bool'} = {value};"
            for name, value in self.constants.items()
        ]
        return "\n".join([*lines, *parts])


def unrolled_mlp(program: Program) -> str:
    """Return `mlp_color` of mlp.wgsl without loops: activations stay in registers."""
    inputs, width, hidden = (program.number(name) for name in ("INPUTS", "WIDTH", "HIDDEN"))
    lines = ["fn mlp_color(x: ptr<function, array<Weight, INPUTS>>, direction: vec3f) -> vec3f {"]
    lines += [f"    let h0_{i} = (*x)[{i}];" for i in range(inputs)]
    at = 0

    def product(layer: int) -> str:
        nonlocal at
        terms = [f"block_product({at + i}u, h{layer}_{i})" for i in range(inputs)]
        at += inputs
        return " + ".join(terms)

    for layer in range(hidden):
        lines += [f"    let h{layer + 1}_{o} = activation({product(layer)});" for o in range(width)]
        inputs = width
    blocks, used = program.number("BLOCKS"), program.number("USED_BLOCKS")
    lines += [f"    let b{block} = basis({block}u, direction) * used({block}u);" for block in range(used)]
    lines.append("    var color = vec3f(0.0);")
    for channel in range(3):
        for block in range(blocks):
            text = product(hidden)
            if block < used:
                lines.append(f"    color[{channel}] += dot({text}, b{block});")
    return "\n".join([*lines, "    return color;", "}"])


def mlp_blocks(program: Program) -> int:
    """Return the number of 4 x 4 blocks of the MLP."""
    inputs, width, hidden = (program.number(name) for name in ("INPUTS", "WIDTH", "HIDDEN"))
    last = 3 * program.number("BLOCKS")
    return inputs * last if hidden == 0 else width * (inputs + (hidden - 1) * width + last)


@cache
def shader(name: str) -> str:
    """Return the text of a .wgsl file."""
    return files("nexwarp.export.web").joinpath(f"shaders/{name}.wgsl").read_text(encoding="utf-8")


def geometry_rows(scene: SceneData) -> np.ndarray:
    """Return (N, 12) float32: mean, opacity; quaternion; scales, gammas."""
    columns = [scene.means, scene.opacities[:, None], scene.quats, scene.scales, scene.gammas]
    return np.concatenate(columns, axis=1, dtype=np.float32)


def packed_matrices(matrices: list[np.ndarray]) -> np.ndarray:
    """Return the MLP's matrices in the order of shade.wgsl: (blocks, 4 columns, 4 rows) float32."""
    *hidden, last = matrices
    coefficients = len(last) // 3
    padded = -(-coefficients // 4) * 4
    by_channel = np.zeros((3, padded, last.shape[1]), np.float32)
    by_channel[:, :coefficients] = last.reshape(coefficients, 3, -1).transpose(1, 0, 2)
    blocks = []
    for matrix in (*hidden, by_channel.reshape(3 * padded, -1)):
        rows, columns = (-(-size // 4) * 4 for size in matrix.shape)
        whole = np.zeros((rows, columns), np.float32)
        whole[: matrix.shape[0], : matrix.shape[1]] = matrix
        # (row block, row, column block, column) to (row block, column block, column, row)
        blocks.append(whole.reshape(rows // 4, 4, columns // 4, 4).transpose(0, 2, 3, 1).reshape(-1, 4, 4))
    return np.concatenate(blocks)


def level_rows(resolutions: np.ndarray) -> np.ndarray:
    """Return the resolutions padded to (64,), the length of the uniform array."""
    padded = np.zeros(64, np.float32)
    padded[: len(resolutions)] = resolutions
    return padded


def frame_values(
    scene: SceneData,
    camera: Camera,
    capacity: int,
    *,
    mode: str,
    slot: int,
    texel_step: int,
    least_weight: float,
    exposures: ExposureData | None,
) -> bytes:
    """Return the uniform values of a frame, struct Frame of common.wgsl."""
    viewmat = camera.viewmat.detach().cpu().double().numpy()
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    texture_focal = camera.focal
    if scene.texture is not None and not scene.texture.shape["down_weighting"]:
        texture_focal = FOCAL_WITHOUT_DOWN_WEIGHTING
    gains, falloff = np.ones(3), np.array([0.0, 0.0, 1.0, 0.0])
    if exposures is not None:
        gains = exposures.gains(viewmat)
        falloff[:3] = exposures.falloff
        falloff[3] = float(falloff[0] != 0 or falloff[1] != 0)
    depths = depth_range(scene, viewmat) if mode == "depth" else (0.0, 1.0)
    floats = [
        *viewmat[:3].ravel(),
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        *(*position, camera.near),
        *(*scene.options.background, texture_focal),
        *(*gains, camera.focal),
        *falloff,
        *(least_weight, *depths, 0.0),
    ]
    columns, rows = tile_grid(camera)
    size = (-(-camera.width // texel_step), -(-camera.height // texel_step))
    words = [camera.width, camera.height, columns, rows, len(scene), capacity, MODES.index(mode), slot]
    words += [*size, texel_step, int(scene.texture is not None)]
    return np.array(floats, np.float32).tobytes() + np.array(words, np.uint32).tobytes()


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Return the columns and rows of tiles of an image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


def depth_range(scene: SceneData, viewmat: np.ndarray) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of the depths of surfels before the camera, for the colour scale."""
    depths = scene.means @ viewmat[2, :3] + viewmat[2, 3]
    depths = depths[depths > 0]
    if len(depths) == 0:
        return 0.0, 1.0
    low, high = np.percentile(depths[:: max(len(depths) // 10_000, 1)], [2, 98])
    return float(low), float(max(high, low * (1 + 1e-6) + 1e-6))
