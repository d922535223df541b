"""Model files: one safetensors file with JSON metadata, written atomically; docs/format.md describes it."""

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from nexwarp.errors import FormatError, MissingError, check_range, check_tensors, check_version
from nexwarp.io.files import one_line, write_atomically
from nexwarp.io.json_files import Json, parse_json
from nexwarp.io.safetensors_files import check_tensors_header
from nexwarp.model.bounds import check_bounds, fits_half
from nexwarp.model.compact import DTYPES as COMPACT_DTYPES
from nexwarp.model.compact import STORED, code_names, decode, encode
from nexwarp.model.detail import ORDERED, check_detail, coarse_shape, surfel_count, texture_levels
from nexwarp.model.detail_limits import NEVER, DetailLimits
from nexwarp.model.exposures import BUFFERS, Exposures
from nexwarp.model.merged_texture import MergedTexture, make_texture
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions, check_removed
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NeuralTexture, TextureShape

FORMAT_VERSION = 1
COMPACT_VERSION = 2  # of compact files, which older readers cannot read
SUFFIX = ".safetensors"
MODEL_FILE = "model.safetensors"
FRAME = "COLMAP world, cameras x right, y down, z forward"
DTYPES = ("F16", "F32")

LARGEST_LENGTH = 1e15
# Tensor names in the file of DetailLimits' attributes; the format keeps its first names.
DETAIL_LIMITS = {"nearest": "footprints", "farthest": "far_footprints"}
# Names of all tensors but the texture's.
FIXED_NAMES = {
    *(f"surfels.{name}" for name in PARAMETERS),
    *DETAIL_LIMITS.values(),
    *(f"exposures.{name}" for name in BUFFERS),
}
CODE_NAMES = code_names()
# Options that files of nexwarp 0.1 do not have.
LATER_OPTIONS = ("exposure", "detail_limits", "order")
LATER_BUFFERS = ("falloff",)  # likewise, of exposures


def save_model(path: str | os.PathLike[str], model: Model, *, compact: bool = False) -> Path:
    """Write a model: surfels, exposures and detail limits in float32, grid and MLP in half precision.

    Args:
        path: a file name that ends in `.safetensors`; otherwise a folder, created if it does not exist, in which
            `model.safetensors` is written.
        model: the model.
        compact: write 8 and 16 bits a number instead, about a third of the size (`nexwarp.model.compact`).

    Returns:
        The file that was written.
    """
    from safetensors.torch import save

    tensors = {f"surfels.{name}": x for name, x in model.surfels.state_dict().items()}
    if model.texture is not None:
        for name, x in model.texture.state_dict().items():
            tensors[f"texture.{name}"] = x.clone() if name.endswith(("resolutions", "cells")) else x.half()
    if model.detail_limits is not None:
        tensors |= {stored: getattr(model.detail_limits, name) for name, stored in DETAIL_LIMITS.items()}
    if model.exposures is not None:
        tensors |= {f"exposures.{name}": x for name, x in model.exposures.state_dict().items()}
    tensors = {name: x.detach().cpu() for name, x in tensors.items()}
    tensors = {name: x.contiguous() for name, x in (encode(tensors) if compact else tensors).items()}
    meta = {
        **model.meta,
        **dataclasses.asdict(model.options),
        "low_pass": False,  # which older versions expect
        "format_version": COMPACT_VERSION if compact else FORMAT_VERSION,
        "frame": FRAME,
        "texture": None if model.texture is None else model.texture.config,
    }
    file = Path(path)
    if file.suffix != SUFFIX or file.is_dir():
        file = file / MODEL_FILE
    write_atomically(file, save(tensors, {"nexwarp": json.dumps(meta)}))
    return file


def load(path: str | os.PathLike[str], *, detail: float = 1.0) -> Model:
    """Load a model onto the CPU. The scene's photos are not needed.

    Args:
        path: a run folder or a model file.
        detail: read the first surfels and coarse texture levels only, as `Model.at_detail` describes.

    Raises:
        FileNotFoundError: the folder or the file does not exist.
        ValueError: the file is not a nexwarp model, has another format version, is damaged, or its tensors do not fit.
    """
    from safetensors import SafetensorError, safe_open

    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    check_detail("detail", detail)
    path = Path(path)
    if path.is_dir():
        path = path / MODEL_FILE
    if not path.is_file():
        raise MissingError(f"{path}: expected a model file, or a run folder with a {MODEL_FILE}")
    try:
        check_tensors_header(path)
        with safe_open(path, "pt") as file:
            header = _read_header(path, (file.metadata() or {}).get("nexwarp"))
            # Tensors that this version does not know are passed over.
            kinds = {
                name: (file.get_slice(name).get_dtype(), file.get_slice(name).get_shape())
                for name in file.keys()
                if name in FIXED_NAMES or name in header.texture_shapes or (header.compact and name in CODE_NAMES)
            }
            _check_kinds(path, kinds, header)
            if detail < 1.0 and header.meta.get(ORDERED) is not True:
                raise FormatError(f"{path}: expected surfels in the order of their share of the pictures, for a detail")
            if detail < 1.0 and header.compact:
                return load(path).at_detail(detail)  # codes are decoded together
            parts = {name: _first_parts(name, kinds, detail) for name in kinds if detail < 1.0}
            tensors = {n: file.get_slice(n)[parts[n]] if n in parts else file.get_tensor(n) for n in kinds}
    except FormatError:
        raise
    except (SafetensorError, OSError) as error:
        raise FormatError(f"{path}: expected a safetensors file, but it cannot be read ({one_line(error)})") from None
    try:
        if detail < 1.0 and header.texture is not None and "parts" not in header.texture:
            resolutions = tensors["texture.resolutions"]
            shape = coarse_shape(cast(TextureShape, header.texture), resolutions, len(resolutions))
            header = dataclasses.replace(header, texture=cast(dict[str, Json], shape))
        return _make_model(header, tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        raise _no_model(path, error) from None


def _first_parts(name: str, kinds: Mapping[str, tuple[str, list[int]]], detail: float) -> tuple[slice, ...]:
    """Return the part of a tensor that a detail has."""
    shape = kinds[name][1]
    everything = tuple(slice(size) for size in shape)
    if name.startswith("surfels.") or name in DETAIL_LIMITS.values():
        return (slice(surfel_count(detail, shape[0])), *everything[1:])
    if name.startswith("texture.") and "texture.grid" in kinds:  # a merged texture is read whole
        all_levels, _, features = kinds["texture.grid"][1]
        levels = texture_levels(detail, all_levels)
        if name in ("texture.grid", "texture.resolutions"):
            return (slice(levels), *everything[1:])
        if name == "texture.mlp.0.weight":
            return (everything[0], slice(levels * features))
    return everything


@dataclass(frozen=True)
class _Header:
    """A model file's metadata.

    Attributes:
        options: the options of the rendering.
        texture: the arguments of `NeuralTexture`; None for a model without texture.
        texture_shapes: names and shapes of the texture's tensors.
        meta: the other entries.
        compact: whether the tensors are coded.
    """

    options: RenderOptions
    texture: dict[str, Json] | None
    texture_shapes: dict[str, list[int]]
    meta: dict[str, Json]
    compact: bool


def _make_model(header: _Header, tensors: Mapping[str, torch.Tensor]) -> Model:
    """Make a model from a file's metadata and tensors; raise an error if they do not fit."""
    if header.compact:
        tensors = decode(tensors)
    surfels = Surfels(_part(tensors, "surfels."))
    limits = None
    if any(stored in tensors for stored in DETAIL_LIMITS.values()):
        for stored in DETAIL_LIMITS.values():
            if stored in tensors:
                check_tensors({stored: (tensors[stored], (len(surfels),))}, dtype=torch.float32)
        # Files of older versions may have only one of the two.
        nearest = tensors.get(DETAIL_LIMITS["nearest"], surfels.means.new_zeros(len(surfels)))
        farthest = tensors.get(DETAIL_LIMITS["farthest"], surfels.means.new_full((len(surfels),), NEVER))
        limits = DetailLimits(nearest.detach(), farthest.detach())
    parts = _part(tensors, "exposures.")
    missing = [name for name in BUFFERS if name not in parts and name not in LATER_BUFFERS]
    if parts and missing:
        raise ValueError(f"expected the tensor exposures.{missing[0]}, found none")
    exposures = Exposures(**parts) if parts else None
    check_bounds(tensors)
    texture = None
    if header.texture is not None:
        texture = make_texture(header.texture)
        texture.load_state_dict(_part(tensors, "texture."))
        for prefix, part in _simple_textures(texture):
            own = {f"texture.{name}": x for name, x in _part(tensors, prefix).items()}
            check_bounds(own)
            part.half_precision = fits_half(own)
    return Model(surfels, texture, exposures, limits, header.options, header.meta)


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors with a prefix in their names, as float32, by the names without it."""
    return {name[len(prefix) :]: x.float() for name, x in tensors.items() if name.startswith(prefix)}


def _simple_textures(texture: NeuralTexture) -> list[tuple[str, NeuralTexture]]:
    """Return a texture, or the parts of a merged one, with the prefixes of their tensors."""
    if isinstance(texture, MergedTexture):
        return [(f"texture.parts.{index}.", part) for index, part in enumerate(texture.textures)]
    return [("texture.", texture)]


def _read_header(path: Path, text: str | None) -> _Header:
    """Read the metadata; allocate nothing of the sizes that it gives."""
    if text is None:
        raise FormatError(f"{path}: expected a nexwarp model, but the file has no nexwarp metadata")
    try:
        meta = parse_json(f"{path}: nexwarp metadata", text.encode("utf-8", "surrogatepass"))
    except ValueError:
        meta = None
    if not isinstance(meta, dict):
        raise FormatError(f"{path}: expected a JSON object as the nexwarp metadata, got {text[:40]!r}")
    try:
        check_version(meta.get("format_version"), COMPACT_VERSION)
    except ValueError as error:
        raise FormatError(f"{path}: {error}") from None
    try:
        options = _read_options(meta)
        texture, shapes = meta.pop("texture"), {}
        if not isinstance(texture, (dict, type(None))):
            raise ValueError(f"texture: expected the settings of a texture, got {texture!r:.60}")
        if texture is not None:
            with torch.device("meta"):  # allocates nothing, even if the metadata gives huge sizes
                state = make_texture(texture).state_dict()
            shapes = {f"texture.{name}": list(x.shape) for name, x in state.items()}
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _no_model(path, error) from None
    return _Header(options, texture, shapes, meta, compact=meta["format_version"] == COMPACT_VERSION)


def _check_kinds(path: Path, kinds: Mapping[str, tuple[str, list[int]]], header: _Header) -> None:
    """Check the dtypes of all tensors and the shapes of the texture's before anything is allocated."""
    try:
        for name, (dtype, shape) in kinds.items():
            coded = COMPACT_DTYPES.get(name) if header.compact else None
            if coded is not None and dtype != STORED[coded]:
                raise ValueError(f"{name}: expected {STORED[coded]}, got {dtype}")
            if coded is None and dtype not in DTYPES:
                raise ValueError(f"{name}: expected float16 or float32, got {dtype}")
            expected = header.texture_shapes.get(name, shape)
            if expected != shape:
                raise ValueError(f"{name}: expected shape {expected}, got {shape}")
        missing = sorted(header.texture_shapes.keys() - kinds.keys())
        if missing:
            raise ValueError(f"expected the tensor {missing[0]}, found none")
    except ValueError as error:
        raise _no_model(path, error) from None


def _no_model(path: Path, error: Exception) -> FormatError:
    return FormatError(f"{path}: expected the tensors of a nexwarp model ({one_line(error)})")


def _read_options(meta: dict[str, Json]) -> RenderOptions:
    """Remove the options from the metadata and return them; raise ValueError or TypeError for an invalid value."""
    names = [field.name for field in dataclasses.fields(RenderOptions)]
    missing = [name for name in names if name not in meta and name not in LATER_OPTIONS]
    if missing:
        raise ValueError(f"metadata: expected {missing[0]}, found none")
    check_removed(meta)
    values: dict[str, object] = {name: meta.pop(name) for name in names if name in meta}
    if isinstance(color := values["background"], list):
        values["background"] = tuple(color)
    for name in ("near", "scene_scale", "smooth_sh"):
        if name in meta:
            value = meta[name]
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ValueError(f"{name}: expected a number, got {value!r:.60}")
            check_range(name, value, 0.0, LARGEST_LENGTH)
    return RenderOptions(**values)  # type: ignore[arg-type]  # the constructor checks the types
