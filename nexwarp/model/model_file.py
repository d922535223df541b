"""Model files: one safetensors file with JSON metadata, written atomically; docs/format.md describes it."""

import dataclasses
import json
import operator
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import cast

import torch

from nexwarp.cameras.cameras_file import origin_of
from nexwarp.errors import FormatError, MissingError, check_finite, check_number, check_tensors, check_version
from nexwarp.io.files import check_tensors_header, one_line, write_atomically
from nexwarp.io.json_files import Json, parse_json
from nexwarp.model.bounds import check_bounds, fits_half
from nexwarp.model.compact import CODE_NAMES, CODED, NOISE, NOISES, TYPES_2, decode, encode, texture_sensitivity
from nexwarp.model.exposures import SHAPES, Exposures
from nexwarp.model.model import Model
from nexwarp.model.options import RenderOptions, check_removed
from nexwarp.model.surfels import PARAMETERS, Surfels
from nexwarp.model.texture import NEVER, DetailLimits, NeuralTexture, Texture, TextureShape, registered_texture

FORMAT_VERSION = 1
COMPACT_VERSION = 3  # of compact files, which older readers cannot read; 2 was theirs before they had streams
SUFFIX = ".safetensors"
MODEL_FILE = "model.safetensors"
KIND = "kind"  # in the metadata of a texture: the name of a registered class
OWN = "own_texture."  # first part of the names of its tensors
FRAME = "COLMAP world, cameras x right, y down, z forward"
DTYPES = ("F16", "F32")
CODED_SHAPES = "shapes"  # in the metadata of a compact file: of its coded tensors, by name

LARGEST_LENGTH = 1e15
# Tensor names in the file of DetailLimits' attributes; the format keeps its first names.
DETAIL_LIMITS = {"nearest": "footprints", "farthest": "far_footprints"}
# Names of all tensors but the texture's.
FIXED_NAMES = {
    *(f"surfels.{name}" for name in PARAMETERS),
    *DETAIL_LIMITS.values(),
    *(f"exposures.{name}" for name in SHAPES),
}
# Options that files of nexwarp 0.1 do not have.
LATER_OPTIONS = ("exposure", "detail_limits", "order")


def save_model(path: str | os.PathLike[str], model: Model, *, compact: bool | float = False) -> Path:
    """Write a model, see `Model.save`: surfels, exposures and limits in float32, grid and MLP in half precision."""
    from safetensors.torch import save

    noise = NOISE if compact is True else float(compact)
    if compact:
        check_number("compact", noise, *NOISES)
    tensors = {f"surfels.{name}": x for name, x in model.surfels.state_dict().items()}
    shape = _texture_record(model.texture)
    for name, x in _stored_state(model.texture).items():
        tensors[name] = x.clone() if name.startswith(OWN) or name == "texture.resolutions" else x.half()
    if model.detail_limits is not None:
        tensors |= {stored: getattr(model.detail_limits, name) for name, stored in DETAIL_LIMITS.items()}
    if model.exposures is not None:
        tensors |= {f"exposures.{name}": x for name, x in model.exposures.state_dict().items()}
    tensors = {name: x.detach().cpu() for name, x in tensors.items()}
    shapes = {name: list(x.shape) for name, x in tensors.items() if name in CODED}
    if compact:
        tensors = encode(tensors, texture_sensitivity(model), noise)
    tensors = {name: x.contiguous() for name, x in tensors.items()}
    meta = {
        **model.meta,
        **dataclasses.asdict(model.options),
        "low_pass": False,  # which older versions expect
        "format_version": COMPACT_VERSION if compact else FORMAT_VERSION,
        "frame": FRAME,
        "texture": shape,
        **({CODED_SHAPES: shapes} if compact else {}),
    }
    file = Path(path)
    if file.suffix != SUFFIX or file.is_dir():
        file = file / MODEL_FILE
    write_atomically(file, save(tensors, {"nexwarp": json.dumps(meta)}))
    return file


def _texture_record(texture: Texture | None) -> dict[str, Json] | None:
    """Return what a file says of a texture; TypeError or ValueError for one that `load` could not make again."""
    if texture is None:
        return None
    if type(texture) is NeuralTexture:
        return cast(dict[str, Json], texture.config)
    name, config = type(texture).__name__, getattr(texture, "config", None)
    if registered_texture(name) is not type(texture):
        raise TypeError(
            f"texture: expected a nexwarp.NeuralTexture or a registered class, got {name}; nexwarp.load can only make "
            "classes again that nexwarp.register_texture knows"
        )
    if not isinstance(config, Mapping):
        raise TypeError(f"texture.config: expected the keyword arguments of {name}, got {config!r:.60}")
    record: dict[str, Json] = {KIND: name, "config": dict(config)}
    try:
        again = _own_texture(json.loads(json.dumps(record))).state_dict()
    except Exception as error:  # whatever the class raises
        raise ValueError(f"texture.config: {name} cannot be made of it ({one_line(error)})") from error
    state = texture.state_dict()
    shapes = ({key: (x.dtype, x.shape) for key, x in tensors.items()} for tensors in (state, again))
    if operator.ne(*shapes):
        raise ValueError(f"texture.config: expected arguments that give tensors as those of the {name} to save")
    for key, x in state.items():
        if x.dtype != torch.float32:
            raise ValueError(f"texture.{key}: expected float32, which files keep, got {x.dtype}")
        check_finite(f"texture.{key}", x)
    return record


def _own_texture(record: Mapping[str, Json]) -> Texture:
    """Make a registered texture of its record in a file; ValueError where nobody has registered it."""
    kind = registered_texture(str(record[KIND]))
    if kind is None:
        raise ValueError(f"texture: expected {record[KIND]!r:.60} to be registered, see nexwarp.register_texture")
    config = record["config"]
    assert isinstance(config, dict)
    with torch.random.fork_rng(devices=[]):  # a training goes on after it is saved
        return kind(**config)


def load(path: str | os.PathLike[str]) -> Model:
    """Load a model onto the CPU, as it was trained: without edits. The scene's photos are not needed.

    Args:
        path: a run folder or a model file.

    Raises:
        FileNotFoundError: the folder or the file does not exist.
        ValueError: the file is not a nexwarp model, has another format version, is damaged, its tensors do not fit, or
            it uses what was removed.
    """
    from safetensors import SafetensorError, safe_open

    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    path = Path(path)
    if path.is_dir():
        path = path / MODEL_FILE
    if not path.is_file():
        raise MissingError(f"{path}: expected a model file, or a run folder with a {MODEL_FILE}")
    try:
        check_tensors_header(path)
        with safe_open(path, "pt") as file:
            meta = _read_metadata(path, (file.metadata() or {}).get("nexwarp"))
            version = cast(int, meta["format_version"])
            compact = version != FORMAT_VERSION
            options = _read_options(meta)
            texture = _empty_texture(meta)
            texture_shapes = {name: list(x.shape) for name, x in _stored_state(texture).items()}
            # Tensors that this version does not know are passed over.
            known = FIXED_NAMES | texture_shapes.keys() | (CODE_NAMES if compact else set())
            names = [name for name in file.keys() if name in known]
            kinds = {name: (file.get_slice(name).get_dtype(), file.get_slice(name).get_shape()) for name in names}
            coded = {1: {}, 2: TYPES_2, 3: dict.fromkeys(CODED, "U8")}[version]
            shapes = _read_shapes(meta, kinds) if version == COMPACT_VERSION else None
            _check_kinds(kinds, texture_shapes, coded, shapes or {})
            tensors = {name: file.get_tensor(name) for name in names}
        return _make_model(decode(tensors, shapes) if compact else tensors, options, texture, meta)
    except FormatError:
        raise
    except (SafetensorError, OSError) as error:
        raise FormatError(f"{path}: expected a safetensors file, but it cannot be read ({one_line(error)})") from None
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError, OverflowError) as error:
        raise FormatError(f"{path}: expected the tensors of a nexwarp model ({one_line(error)})") from None


def _read_metadata(path: Path, text: str | None) -> dict[str, Json]:
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
    return meta


def _read_options(meta: dict[str, Json]) -> RenderOptions:
    """Remove the options from the metadata and return them; raise ValueError or TypeError for an invalid value."""
    check_removed(meta)
    names = [field.name for field in dataclasses.fields(RenderOptions)]
    missing = [name for name in names if name not in meta and name not in LATER_OPTIONS]
    if missing:
        raise ValueError(f"metadata: expected {missing[0]}, found none")
    values: dict[str, object] = {name: meta.pop(name) for name in names if name in meta}
    if isinstance(color := values["background"], list):
        values["background"] = tuple(color)
    origin_of(meta)
    for name in ("near", "scene_scale", "smooth_sh"):
        if name in meta:
            check_number(name, meta[name], 0.0, LARGEST_LENGTH)
    return RenderOptions(**values)  # type: ignore[arg-type]  # the constructor checks the types


def _empty_texture(meta: dict[str, Json]) -> Texture | None:
    """Make the texture whose record is taken out of the metadata; allocate nothing, even for huge sizes."""
    shape = meta.pop("texture")
    if shape is None:
        return None
    if not isinstance(shape, dict):
        raise ValueError(f"texture: expected the settings of a texture, got {shape!r:.60}")
    if "parts" in shape:
        raise ValueError("texture: expected one texture: models merged from blocks were removed after 7f7bd6c")
    if KIND in shape:
        return _own_texture(shape)
    known = {name: x for name, x in shape.items() if name in TextureShape.__annotations__}
    with torch.device("meta"):
        return NeuralTexture(**cast(TextureShape, known))


def _stored_state(texture: Texture | None) -> dict[str, torch.Tensor]:
    """Return a texture's parameters and buffers by their names in a file."""
    if texture is None:
        return {}
    prefix = "texture." if type(texture) is NeuralTexture else OWN
    return {f"{prefix}{name}": x for name, x in texture.state_dict().items()}


def _read_shapes(meta: dict[str, Json], names: Iterable[str]) -> dict[str, list[int]]:
    """Remove the shapes of a compact file's coded tensors from the metadata and return those of its own."""
    stored = meta.pop(CODED_SHAPES, None)
    shapes: dict[str, list[int]] = {}
    for name in set(CODED).intersection(names):
        shape = stored.get(name) if isinstance(stored, dict) else None
        if not isinstance(shape, list) or not shape or any(type(n) is not int or not 0 <= n < 2**31 for n in shape):
            raise ValueError(f"metadata: expected the shape of {name}, got {shape!r:.60}")
        shapes[name] = cast(list[int], shape)
    return shapes


def _check_kinds(
    kinds: Mapping[str, tuple[str, list[int]]],
    texture_shapes: Mapping[str, list[int]],
    coded: Mapping[str, str],
    coded_shapes: Mapping[str, list[int]],
) -> None:
    """Check the dtypes of all tensors and the shapes of the texture's before anything is allocated."""
    for name, (dtype, stored) in kinds.items():
        if name in coded and dtype != coded[name]:
            raise ValueError(f"{name}: expected {coded[name]}, got {dtype}")
        if name not in coded and dtype not in DTYPES:
            raise ValueError(f"{name}: expected float16 or float32, got {dtype}")
        if name in coded_shapes and len(stored) != 1:
            raise ValueError(f"{name}: expected a stream of bytes, got shape {stored}")
        shape = coded_shapes.get(name, stored)
        if texture_shapes.get(name, shape) != shape:
            raise ValueError(f"{name}: expected shape {texture_shapes[name]}, got {shape}")
    missing = sorted(texture_shapes.keys() - kinds.keys())
    if missing:
        raise ValueError(f"expected the tensor {missing[0]}, found none")


def _make_model(
    tensors: Mapping[str, torch.Tensor], options: RenderOptions, texture: Texture | None, meta: dict[str, Json]
) -> Model:
    """Make a model from a full file's tensors and metadata; raise an error if they do not fit."""
    surfels = Surfels(_part(tensors, "surfels."))
    limits, stored = None, {name: tensors[name] for name in DETAIL_LIMITS.values() if name in tensors}
    if stored:
        check_tensors({name: (x, (len(surfels),)) for name, x in stored.items()}, dtype=torch.float32)
        # Files of older versions may have only one of the two.
        without = {"footprints": torch.zeros(len(surfels)), "far_footprints": torch.full((len(surfels),), NEVER)}
        limits = DetailLimits(*(without | stored).values())
    parts = _part(tensors, "exposures.")
    exposures = Exposures(parts) if parts else None
    check_bounds(tensors)
    if type(texture) is NeuralTexture:
        texture = NeuralTexture(**texture.config)
        texture.load_state_dict(_part(tensors, "texture."))
        texture.half_precision = fits_half(tensors)
    elif texture is not None:
        own = _part(tensors, OWN)
        for name, x in own.items():
            check_finite(f"{OWN}{name}", x)
        texture.load_state_dict(own)
    return Model(surfels, texture, exposures, limits, options, meta)


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors with a prefix in their names, as float32, by the names without it."""
    return {name[len(prefix) :]: x.float() for name, x in tensors.items() if name.startswith(prefix)}
