"""Writer of scene files: one binary file with a JSON header that the web page streams; FORMAT.md describes it."""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.paths import camera_poses, focus, up_direction
from nexwarp.errors import FormatError, SettingError
from nexwarp.export.web.quantise import CHUNK, encode_levels, quantised
from nexwarp.export.web.scene_data import SceneData, array_of
from nexwarp.model.model import Model

SCENE_FILE = "scene.nxw"
QUALITIES = ("quantised", "full")
MAGIC = b"NXWSCENE"
FORMAT_VERSION = 1
LARGEST_HEADER = 4 * 2**20
ALIGNMENT = 8
DTYPES = {"u1": "u8", "u2": "u16", "u4": "u32", "f2": "f16", "f4": "f32"}
MOST_CAMERAS = 200


def encode_scene(
    model: Model,
    cameras: Mapping[str, Camera],
    *,
    quality: str = "quantised",
    title: str = "",
    poster: bytes | None = None,
) -> bytes:
    """Return the content of a scene file of a quality, with cameras by name; of more than 200, every n-th is kept.

    `poster` is a JPEG picture that is shown until the scene is loaded.
    """
    if quality not in QUALITIES:
        raise SettingError(f"--quality: expected {' or '.join(QUALITIES)}, got {quality!r:.60}")
    scene = SceneData.of(model)
    if quality == "full":
        names = ("means", "quats", "scales", "opacities", "gammas", "limits", "sh")
        arrays = {name: array for name in names if (array := getattr(scene, name)) is not None}
    else:
        arrays = quantised(scene)
    if scene.exposures is not None:
        arrays["exposures"] = scene.exposures["poses"]
    if scene.texture is not None:
        grid = array_of(scene.texture.grid).astype(np.float16)  # as in model files
        weights = np.concatenate([array_of(matrix).ravel() for matrix in scene.texture.mlp.parameters()])
        if quality == "full":
            arrays |= {"mlp": weights, "grid": grid}
        else:
            codes, ranges = encode_levels(grid)
            arrays |= {"mlp": weights.astype(np.float16), "grid_ranges": ranges, "grid": codes}
    header = scene_header(scene, cameras, title) | {"quality": quality}
    return joined_file(MAGIC, header, arrays, poster)


def joined_file(
    magic: bytes, header: Mapping[str, object], arrays: Mapping[str, np.ndarray], poster: bytes | None = None
) -> bytes:
    """Return the file of a header and its sections; arrays are compressed where that saves at least 2 %."""
    entries: list[dict[str, object]] = []
    parts: list[bytes] = []
    # Offsets depend on the header's length and it on them: they are counted from the end of the header.
    position = 0

    def add(name: str, dtype: str, shape: Sequence[int], content: bytes, compress: bool) -> None:
        nonlocal position
        packed = zlib.compress(content, 9) if compress else content
        encoding = "deflate" if len(packed) < 0.98 * len(content) else "raw"
        stored = packed if encoding == "deflate" else content
        entry = {"name": name, "dtype": dtype, "shape": list(shape), "encoding": encoding}
        entries.append({**entry, "offset": position, "bytes": len(stored)})
        parts.append(stored + bytes(-len(stored) % ALIGNMENT))
        position += len(parts[-1])

    if poster is not None:
        header = {**header, "poster": {"type": "image/jpeg"}}
        add("poster", "u8", [len(poster)], poster, compress=False)
    for name, array in arrays.items():
        content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        add(name, DTYPES[array.dtype.str[1:]], array.shape, content, compress=True)
    text = json.dumps({**header, "sections": entries}, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    if len(text) > LARGEST_HEADER:
        raise FormatError(f"header: expected at most {LARGEST_HEADER:,} bytes, got {len(text):,}")
    return b"".join([magic, struct.pack("<II", FORMAT_VERSION, len(text)), text, *parts])


def scene_header(scene: SceneData, cameras: Mapping[str, Camera], title: str) -> dict[str, object]:
    """Return the header without quality and sections."""
    options, texture, exposures = scene.options, scene.texture, scene.exposures
    kept = list(cameras.items())[:: -(-len(cameras) // MOST_CAMERAS) or 1]
    views = [camera for _, camera in kept]
    low, high = (np.percentile(scene.means, q, axis=0) if len(scene) else np.zeros(3) for q in (2, 98))
    center, up = _surroundings(views, (low + high) / 2)
    header: dict[str, object] = {
        "format_version": FORMAT_VERSION,
        "generator": "nexwarp",
        "title": title,
        "surfels": len(scene),
        "sh_coefficients": scene.sh.shape[1],
        "chunk": CHUNK,
        "options": {
            "max_hits": options.max_hits,
            "background": list(options.background),
            "sh_degree": options.sh_degree,
            "clamp_texture": options.clamp_texture,
            "exposure": options.exposure,
            "detail_limits": scene.limits is not None,
        },
        "texture": None,
        "exposures": None,
        "near": views[0].near if views else 0.01,
        "cameras": [_camera_entry(name, camera) for name, camera in kept],
        "start": 0,
        "center": _floats(center),
        "up": _floats(up),
        "bounds": [_floats(low), _floats(high)],
        "poster": None,
    }
    if texture is not None:
        header["texture"] = {**texture.config, "resolutions": _floats(array_of(texture.resolutions))}
    if exposures is not None:
        numbers = {name: _floats(values) for name, values in exposures.items() if name != "poses"}
        header["exposures"] = {"count": len(exposures["poses"]), **numbers}
    return header


def _surroundings(cameras: Sequence[Camera], middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point to orbit around, and the upward direction."""
    up = up_direction(cameras).numpy()
    if not cameras:
        return middle, up
    viewmats, _ = camera_poses(cameras)
    try:
        center = focus(cameras)
    except ValueError:  # parallel axes
        return middle, up
    ahead = (viewmats[:, :3, :3] @ center + viewmats[:, :3, 3])[:, 2] > 0
    return (center.numpy() if bool(ahead.float().mean() > 0.5) else middle), up


def _camera_entry(name: str, camera: Camera) -> dict[str, object]:
    return {
        "name": name,
        "viewmat": _floats(camera.viewmat.detach().double().cpu().numpy()),
        "K": _floats(np.array([camera.fx, camera.fy, camera.cx, camera.cy])),
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
    }


def _floats(values: np.ndarray) -> list[float]:
    """Numbers with the digits that single precision needs."""
    return [float(f"{x:.9g}") for x in np.asarray(values, np.float64).ravel().tolist()]
