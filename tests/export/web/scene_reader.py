"""A reader of scene files and baked scenes, written from FORMAT.md and independent of the writer and the page."""

import io
import json
import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from PIL import Image

from nexwarp.export.bake import Baked
from nexwarp.export.web.baked import encode_harmonics, encode_picture
from nexwarp.export.web.quantise import CHUNK
from nexwarp.model.detail_limits import NEVER
from nexwarp.model.surfels import Surfels

DTYPES = {"u8": "<u1", "u16": "<u2", "u32": "<u4", "f16": "<f2", "f32": "<f4"}


def read_sections(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header, and the arrays of the sections by name."""
    version, length = struct.unpack_from("<II", content, 8)
    assert version == 1
    header = json.loads(content[16 : 16 + length])
    arrays = {}
    for entry in header["sections"]:
        start = 16 + length + entry["offset"]
        stored = content[start : start + entry["bytes"]]
        data = zlib.decompress(stored) if entry["encoding"] == "deflate" else stored
        arrays[entry["name"]] = np.frombuffer(data, DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return header, arrays


def read_surfels(content: bytes) -> dict[str, np.ndarray]:
    """The surfels of a scene file, float32."""
    header, arrays = read_sections(content)
    if header["quality"] == "full":
        return arrays
    ranges, count, bands = arrays["ranges"], header["surfels"], round(header["sh_coefficients"] ** 0.5)
    columns = np.repeat(np.arange(7, 7 + bands), [3 * (2 * band + 1) for band in range(bands)])
    data = {
        "means": decode_chunks(arrays["means"].T, ranges[:, :3]),
        "quats": decode_quats(arrays["quats"]),
        "scales": np.exp(decode_chunks(arrays["scales"].T, ranges[:, 3:5])),
        "opacities": arrays["opacities"].astype(np.float32) / 255,
        "gammas": np.maximum(np.exp(decode_chunks(arrays["gammas"].T, ranges[:, 5:7])), 1),
        "sh": decode_chunks(arrays["sh"].T, ranges[:, columns]).reshape(count, bands**2, 3),
    }
    if "limits" in arrays:
        data["limits"] = decode_limits(arrays["limits"].T, arrays["limits_scale"])
    return data


def decode_chunks(codes: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """The (N, C) float32 values of codes."""
    whole = np.repeat(ranges, CHUNK, axis=0)[: len(codes)]
    return whole[..., 0] + whole[..., 1] * codes.astype(np.float32)


def decode_quats(code: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions, wxyz."""
    x = ((code & 2047) / 2047 * 2 - 1) * np.sqrt(0.5)
    y = (((code >> 11) & 2047) / 2047 * 2 - 1) * np.sqrt(0.5)
    z = ((code >> 22) / 1023 * 2 - 1) * np.sin(np.pi / 8)
    w = np.sqrt(np.maximum(1 - x**2 - y**2 - z**2, 0.0))
    quats = np.stack([w, x, y, z], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def decode_limits(codes: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(N, 2) float32 detail limits."""
    values = np.exp(scale[0] + scale[1] * (codes.astype(np.float32) - 1))
    return np.where(codes == 65535, np.float32(NEVER), np.where(codes == 0, 0, values)).astype(np.float32)


def decode_harmonics(codes: np.ndarray, ranges: list[float]) -> np.ndarray:
    """The (N, C - 1, 3) float32 coefficients of a baked scene."""
    steps = codes.astype(np.float32) - 128
    degrees = np.floor(np.sqrt(np.arange(codes.shape[1]) + 1)).astype(int)
    return (np.sign(steps) * (steps / 127) ** 2 * np.array(ranges, np.float32)[degrees - 1][:, None]).astype(np.float32)


def decode_atlas(codes: torch.Tensor, scale: float) -> torch.Tensor:
    """The float32 atlas of codes."""
    return (codes.float() - 128) * (scale / 127)


def as_stored(baked: Baked) -> Baked:
    """A baked scene with the colours that its files hold."""
    picture, scale = encode_picture(baked.atlas)
    with Image.open(io.BytesIO(picture)) as image:
        codes = torch.from_numpy(np.array(image.convert("RGB")))
    state = dict(baked.surfels.state_dict())
    state["shN"] = torch.from_numpy(decode_harmonics(*encode_harmonics(baked.surfels))).to(state["shN"])
    return replace(baked, surfels=Surfels(state), atlas=decode_atlas(codes, scale).to(baked.atlas))
