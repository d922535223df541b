"""What a baked file shows: the scene of a page without WebGPU, or of a glTF file, read back and rendered."""

import base64
import dataclasses
import io
import os
import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nexwarp import ops
from nexwarp.cameras.camera import Camera
from nexwarp.errors import FormatError, MissingError, check_range, check_values, check_version
from nexwarp.io.files import one_line
from nexwarp.io.json_files import READ_ERRORS, parse_json
from nexwarp.model.bounds import check_bounds
from nexwarp.model.exposures import Exposures
from nexwarp.model.options import Color, color_tensor
from nexwarp.model.render import antialiased, pinhole_of
from nexwarp.model.surfels import Activated
from nexwarp.model.texture import NEVER, DetailLimits
from nexwarp.ops.atlas import Cut, draw_atlas

BAKED_FILE, ATLAS_FILE, GLB = "baked.nxb", "atlas.webp", ".glb"
MAGIC, GLB_MAGIC = b"NXWBAKED", b"glTF"
FORMAT_VERSION = 1
LONGEST_HEADER = 4 * 2**20
MOST_BYTES, MOST_RATIO = 2**27, 128  # of what a file unpacks to: so many, and so many times its size
LARGEST_SIDE = 16384
HARD = 1000.0  # gamma of a rectangle
DTYPES = {"u8": "<u1", "u16": "<u2", "f32": "<f4"}
Header = dict[str, Any]  # of JSON: what does not fit raises one of READ_ERRORS
ACCESSORS = {"VEC2": 2, "VEC3": 3}


@dataclass(frozen=True)
class BakedScene:
    """What a baked file shows: N surfels with texels of one atlas, blended by the depth of their centres.

    Attributes:
        shape: their geometry; the surfels of a glTF file are cards, rectangles of half the sides `scales`.
        texels: (height, width, 4) float32: what is added to the surfels' colours, or the colour and alpha of cards.
        boxes: (N, 4) u0, v0, u1, v1 of the texels on the surfels, in units of the scales.
        rects: (N, 4) column and row of the first texel's centre, and from there to the last one's.
        harmonics: (N, 1, 3) and (N, C - 1, 3) SH coefficients of the surfels' colours; None for cards.
        limits: beyond which surfels are blurred; None blurs none.
        exposures: exposures of the photos; None is the mean one.
        background: colour behind the surfels; black for a glTF file, which has none.
        exposure: of cards: by what their colours were multiplied, from the photos' mean exposure, so as not to clip.
        cut: of cards that are cut out, and tested for depth; None blends.
    """

    shape: Activated
    texels: torch.Tensor
    boxes: torch.Tensor
    rects: torch.Tensor
    harmonics: tuple[torch.Tensor, torch.Tensor] | None = None
    limits: DetailLimits | None = None
    exposures: Exposures | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exposure: float = 1.0
    cut: Cut | None = None

    def to(self, device: torch.device | str) -> "BakedScene":
        """Return the scene on a device."""
        parts = {name: getattr(self, name) for name in ("texels", "boxes", "rects", "limits", "exposures")}
        moved: dict[str, Any] = {name: x.to(device) for name, x in parts.items() if x is not None}
        moved["shape"] = Activated(*(x.to(device) for x in self.shape))
        if self.harmonics is not None:
            moved["harmonics"] = tuple(x.to(device) for x in self.harmonics)
        return dataclasses.replace(self, **moved)

    def render(self, camera: Camera, *, background: Color | None = None) -> torch.Tensor:
        """Render the scene on its device; differentiable in texels, harmonics and opacities.

        Args:
            camera: in the run's frame, as `nexwarp.load_cameras` gives them, whichever way up a glTF file stands.
            background: another colour behind the surfels than that of the file.

        Returns:
            (H, W, 3) float32 sRGB, not clamped, at the photos' exposure where the file has exposures.
        """
        camera = camera.to(self.texels.device)
        shape, boxes = antialiased(self.shape, camera, self.limits), self.boxes
        if self.limits is not None:
            boxes = boxes * (self.shape.scales / shape.scales).repeat(1, 2)
        colors = torch.zeros_like(shape.means)
        if self.harmonics is not None:
            colors = ops.plain_colors(self.harmonics, shape.means, camera.position, 3)
        pinhole, viewmat = pinhole_of(camera, shape.means), camera.viewmat.to(shape.means)
        projection = ops.project(*shape, colors, viewmat)
        tiles = ops.intersect_tiles(shape, projection, viewmat, pinhole)
        cards = self.harmonics is None
        image, alpha = draw_atlas(
            projection, tiles, pinhole, self.texels, (boxes, self.rects), cards=cards, cut=self.cut
        )
        color = color_tensor(self.background if background is None else background, image, 3)
        image = image + (1 - alpha)[..., None] * color
        return image if self.exposures is None else image * self.exposures.factors(camera)

    def render_at_mean(self, camera: Camera, background: tuple[float, float, float]) -> torch.Tensor:
        """Render a scene without exposures at the photos' mean exposure, as is the background."""
        dimmed = tuple(self.exposure * x for x in background)
        return self.render(camera, background=dimmed) / self.exposure

    @torch.no_grad()
    def overdraw(self, camera: Camera) -> float:
        """Return how many quads a pixel of a camera lies in, by 32 x 32 pixels: what a GPU shades, most of it unseen.

        A surfel's quad, two triangles, is the rectangle around its hits of at least 1/255.
        """
        camera = camera.to(self.texels.device)
        shape = antialiased(self.shape, camera, self.limits)
        records = ops.project(*shape, torch.zeros_like(shape.means), camera.viewmat.to(shape.means)).records
        x, y = (((torch.arange(32) + 0.5) / 32 * size).to(records) for size in (camera.width, camera.height))
        rays = torch.cartesian_prod((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
        rays = torch.nn.functional.pad(rays, (0, 1), value=1.0).T
        quads = 0
        for across, along, facing, last in (part.unbind(1) for part in records.split(4096)):
            limits = 2 * (255 * across[:, 3:]).log().clamp_min(0)
            cosines = facing[:, :3] @ rays
            inside = last[:, 3:] / cosines > camera.near
            for axis, gammas in ((across, along[:, 3:]), (along, facing[:, 3:])):
                inside &= (axis[:, :3] @ rays / cosines).abs() < limits.pow(0.5 / gammas)
            quads += int(inside.sum())
        return quads / rays.shape[1]


def card_scene(
    geometry: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    texels: torch.Tensor,
    rects: torch.Tensor,
    cut: Cut | None,
    exposure: float,
) -> BakedScene:
    """Return a scene of cards: their centres (N, 3), quats (N, 4) and half sides (N, 2), and the rest of its fields."""
    ones = torch.ones_like(geometry[2])
    shape = Activated(*geometry, ones[:, 0], HARD * ones)
    return BakedScene(shape, texels, torch.cat([-ones, ones], dim=1), rects, cut=cut, exposure=exposure)


def load_baked(path: str | os.PathLike[str]) -> BakedScene:
    """Read what `nexwarp export --format web` or `--format glb` has baked, onto the CPU, to render it.

    A page is read as browsers without WebGPU draw it. A glTF file is read as a program draws it that tests cut-outs
    for depth, or sorts blended cards by the depth of their centres.

    Args:
        path: a page (.html), its folder, `baked.nxb` beside its atlas, or a .glb file of nexwarp.

    Returns:
        The scene.

    Raises:
        MissingError: no such file, or a page without a baked scene.
        FormatError: the file is damaged, newer, or not of nexwarp.
    """
    path = Path(path)
    try:
        if path.suffix == GLB:
            return _read_cards(path.read_bytes())
        return _read_surfels(*_page_parts(path))
    except FileNotFoundError:
        raise MissingError(f"{path}: expected a page or a .glb file with a baked scene, found none") from None
    except (*READ_ERRORS, struct.error, zlib.error, OverflowError, IndexError, SyntaxError) as error:
        raise FormatError(f"{path}: expected a baked scene of nexwarp ({one_line(error)})") from None


def _page_parts(path: Path) -> tuple[bytes, bytes]:
    """Return the content of `baked.nxb` and of its atlas, in a page or beside it."""
    if path.suffix == ".html":
        found = [
            re.search(rf'id="asset:{re.escape(name)}">([A-Za-z0-9+/=]*)</script>'.encode(), path.read_bytes())
            for name in (BAKED_FILE, ATLAS_FILE)
        ]
        if found[0] is not None and found[1] is not None:
            return base64.b64decode(found[0][1], validate=True), base64.b64decode(found[1][1], validate=True)
    folder = path if path.is_dir() else path.parent
    file = path if path.suffix == ".nxb" else folder / BAKED_FILE
    return file.read_bytes(), (folder / ATLAS_FILE).read_bytes()


def _read_surfels(content: bytes, picture: bytes) -> BakedScene:
    """Read the surfels of a page; web/FORMAT.md describes them."""
    magic, version, length = struct.unpack_from("<8sII", content)
    if magic != MAGIC or not length <= min(LONGEST_HEADER, len(content) - 16):
        raise ValueError(f"expected {MAGIC.decode()} and a header at the start")
    check_version(version, FORMAT_VERSION)
    header = parse_json("header", content[16 : 16 + length])
    count, coefficients, exposures = header["surfels"], header["sh_coefficients"], header["exposures"]
    shapes: dict[str, tuple[str, list[int]]] = {
        "means": ("f32", [count, 3]),
        "quats": ("u16", [count, 4]),
        "scales": ("f32", [count, 2]),
        "opacities": ("f32", [count]),
        "gammas": ("f32", [count, 2]),
        "farthest": ("f32", [count]),
        "boxes": ("f32", [count, 4]),
        "rects": ("u16", [count, 4]),
        "sh0": ("f32", [count, 3]),
        "shN": ("u8", [count, coefficients - 1, 3]),
    }
    if exposures is not None:
        shapes["exposures"] = ("f32", [exposures["count"], 9])
    arrays = _sections(content[16 + length :], header["sections"], shapes)
    atlas, degrees = header["atlas"], np.floor(np.sqrt(np.arange(1, coefficients))).astype(int)
    texels = (_pixels(picture, "RGB").float() - 128) * (atlas["scale"] / 127)
    if texels.shape[:2] != (atlas["height"], atlas["width"]):
        raise ValueError(f"atlas: expected {atlas['width']}x{atlas['height']} pixels")
    rects = arrays["rects"]
    ends = rects[:, :2] + rects[:, 2:]
    if not ((rects[:, 2:] >= 1).all() and (ends <= ends.new_tensor([atlas["width"], atlas["height"]])).all()):
        raise ValueError("rects: expected texels inside the atlas")
    steps = arrays["shN"] - 128
    ranges = steps.new_tensor(header["sh_ranges"])[torch.from_numpy(degrees) - 1]
    used = (header["options"]["sh_degree"] + 1) ** 2
    shape = Activated(*(arrays[name] for name in Activated._fields))
    shape = shape._replace(quats=shape.quats / 65535 * 2 - 1)
    farthest = arrays["farthest"].clamp(max=NEVER)
    named = {"means": shape.means, "raw_quats": shape.quats, "sh0": arrays["sh0"], "shN": ranges}
    check_bounds({"far_footprints": farthest, **{f"surfels.{name}": x for name, x in named.items()}})
    limits = {"scales": (1e-30, 1e15), "opacities": (0.0, 1.0), "gammas": (1.0, 1e15), "boxes": (-1e15, 1e15)}
    for name, bounds in limits.items():
        check_values(name, arrays[name], *bounds)
    check_values("atlas", texels, -1e6, 1e6)
    return BakedScene(
        shape,
        torch.nn.functional.pad(texels, (0, 1)),
        arrays["boxes"],
        torch.cat([rects[:, :2], rects[:, 2:] - 1], dim=1),
        (arrays["sh0"][:, None], (steps.sign() * (steps / 127).square() * ranges[:, None])[:, : used - 1]),
        DetailLimits(torch.zeros(count), farthest),
        None if exposures is None else _exposures(exposures, arrays["exposures"]),
        tuple(float(x) for x in header["options"]["background"]),  # type: ignore[arg-type]  # three, or an error above
    )


def _sections(
    content: bytes, entries: list[Header], shapes: dict[str, tuple[str, list[int]]]
) -> dict[str, torch.Tensor]:
    """Return the sections of a file as float32, checked against their dtypes and shapes before they are unpacked."""
    stored = {entry["name"]: (entry["dtype"], entry["shape"]) for entry in entries}
    if stored != shapes:
        raise ValueError("sections: expected those that the header describes")
    sizes = {name: int(DTYPES[dtype][2]) * int(np.prod(shape, dtype=object)) for name, (dtype, shape) in shapes.items()}
    if min(sizes.values()) < 0 or sum(sizes.values()) > MOST_BYTES + MOST_RATIO * len(content):
        raise ValueError("sections: expected fewer bytes")
    arrays = {}
    for entry in entries:
        name, start = entry["name"], entry["offset"]
        part = content[start : start + entry["bytes"]]
        data = zlib.decompressobj().decompress(part, sizes[name] + 1) if entry["encoding"] == "deflate" else part
        if start < 0 or len(data) != sizes[name]:
            raise ValueError(f"section {name}: expected {sizes[name]} bytes, got {len(data)}")
        values = np.frombuffer(data, DTYPES[entry["dtype"]]).reshape(entry["shape"]).astype(np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"section {name}: expected finite values")
        arrays[name] = torch.from_numpy(values)
    return arrays


def _exposures(header: Header, rows: torch.Tensor) -> Exposures:
    """Make exposures of their header and rows: position, direction and coefficients of each photo."""
    names = ("mean", "lengths", "falloff", "lowest", "highest")
    values = {name: torch.tensor(header[name], dtype=torch.float32) for name in names}
    # Of the photos' gains the file has the range alone.
    gains = values.pop("lowest").repeat(len(rows), 1)
    gains[-1] = values.pop("highest")
    parts = zip(("positions", "directions", "coefficients"), rows.split(3, dim=1), strict=True)
    buffers = {"log_gains": gains, **values, **dict(parts)}
    check_bounds({f"exposures.{name}": x for name, x in buffers.items()})
    return Exposures(buffers)


def _read_cards(content: bytes) -> BakedScene:
    """Read the rectangles of a glTF file that `export.glb` has written."""
    from scipy.spatial.transform import Rotation

    magic, version, _, length, kind = struct.unpack_from("<4sIII4s", content)
    if magic != GLB_MAGIC or version != 2 or kind != b"JSON" or length > min(LONGEST_HEADER, len(content) - 28):
        raise ValueError("expected a binary glTF 2.0 file")
    tree, binary = parse_json("glTF", content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    material = tree["materials"][primitive["material"]]
    corners, places = (_accessor(tree, binary, primitive["attributes"][x]) for x in ("POSITION", "TEXCOORD_0"))
    texture = tree["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    picture = _pixels(_view(tree, binary, tree["images"][texture["source"]]["bufferView"]), "RGBA")
    first, second, third, fourth = corners.double().unbind(1)
    across, along = (second - first) / 2, (fourth - first) / 2
    sizes = torch.stack([across.norm(dim=1), along.norm(dim=1)], dim=1)
    slanted = torch.stack([(first + third - second - fourth).norm(dim=1), (across * along).sum(1).abs().sqrt()], dim=1)
    check_values("POSITION", corners, -1e15, 1e15)
    if not ((sizes > 0).all() and (slanted < 0.05 * sizes.amax(1, True)).all()):
        raise ValueError("POSITION: expected rectangles of four corners")
    x, y = across / sizes[:, :1], along / sizes[:, 1:]
    frames = torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1).numpy()
    quats = torch.from_numpy(np.roll(Rotation.from_matrix(frames).as_quat(), 1, axis=1)).float()
    size = torch.tensor([picture.shape[1], picture.shape[0]])
    first_place = places[:, 0] * size - 0.5
    last = torch.stack([places[:, 1, 0] - places[:, 0, 0], places[:, 3, 1] - places[:, 0, 1]], dim=1) * size
    if not ((first_place > -1).all() and (last >= 0).all() and (first_place + last < size).all()):
        raise ValueError("TEXCOORD_0: expected texels inside the texture")
    if material["alphaMode"] not in ("MASK", "BLEND"):
        raise ValueError(f"alphaMode: expected MASK or BLEND, got {material['alphaMode']!r:.20}")
    cut = Cut(float(material.get("alphaCutoff", 0.5))) if material["alphaMode"] == "MASK" else None
    if cut is not None:
        check_range("alphaCutoff", cut.cutoff, 0.0, 1.0)
    geometry = (corners.mean(1), quats, sizes.float())
    extras = tree["asset"].get("extras")
    exposure = float(extras.get("exposure", 1.0)) if isinstance(extras, dict) else 1.0
    check_range("exposure", exposure, 1e-6, 1.0)
    return card_scene(geometry, picture.float() / 255, torch.cat([first_place, last], dim=1), cut, exposure)


def _view(tree: Header, binary: bytes, index: int) -> bytes:
    view = tree["bufferViews"][index]
    start = view.get("byteOffset", 0)
    if not 0 <= start <= start + view["byteLength"] <= len(binary):
        raise ValueError(f"bufferViews: expected at most {len(binary)} bytes")
    return binary[start : start + view["byteLength"]]


def _accessor(tree: Header, binary: bytes, index: int) -> torch.Tensor:
    """Return the float32 values (quads, 4, columns) of an accessor."""
    accessor = tree["accessors"][index]
    columns, start = ACCESSORS[accessor["type"]], accessor.get("byteOffset", 0)
    if accessor["componentType"] != 5126:
        raise ValueError("accessors: expected float32")
    values = np.frombuffer(_view(tree, binary, accessor["bufferView"]), "<f4", accessor["count"] * columns, start)
    return torch.from_numpy(values.reshape(-1, 4, columns).copy())


def _pixels(content: bytes, mode: str) -> torch.Tensor:
    """Decode a picture to (height, width, channels) uint8."""
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        if max(image.size) > LARGEST_SIDE:
            raise ValueError(f"atlas: expected at most {LARGEST_SIDE} pixels a side, got {image.size}")
        return torch.from_numpy(np.array(image.convert(mode)))
