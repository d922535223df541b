"""The web page of a scene: a folder for a web server, or one HTML file."""

import base64
import html
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from urllib.parse import urljoin

import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.errors import FormatError, MissingError
from nexwarp.export.bake import Progress, bake
from nexwarp.export.fit import Views
from nexwarp.export.web.baked import encode_baked
from nexwarp.export.web.scene_file import SCENE_FILE, encode_scene
from nexwarp.io.files import write_together
from nexwarp.io.json_files import read_json
from nexwarp.io.pictures import encoded, to_uint8
from nexwarp.model.model import Model

INDEX = "index.html"
IMPORT_MAP = '{"imports": {"nexwarp/": "./"}}'
STYLE_LINK = '<link rel="stylesheet" href="style.css">'
DESCRIPTION = "A scene to move through in the browser"
BACKGROUND = "#14161a"  # of the page, while it loads
MOST_NOTES, LONGEST_NOTE, FARTHEST_NOTE = 200, 500, 1e9
POSTER_WIDTH = 640
POSTER_QUALITY = 75


@dataclass(frozen=True)
class Note:
    """A text at a point (3) of the scene."""

    point: tuple[float, float, float]
    text: str


@dataclass(frozen=True)
class Page:
    """What a page says and shows beside its scene.

    Attributes:
        title: its heading, and that of its link preview.
        caption: a text below the heading, and in its link preview.
        background: another colour behind the surfels than the model's, sRGB.
        notes: texts at points of the model's frame.
        url: address that the page will have, for the picture of its link preview.
        metres: length of a unit of the model's frame, which a headset shows; None is unknown.
    """

    title: str = "nexwarp"
    caption: str = ""
    background: tuple[float, float, float] | None = None
    notes: tuple[Note, ...] = ()
    url: str = ""
    metres: float | None = None


def read_notes(path: Path) -> tuple[Note, ...]:
    """Read notes from a JSON list of {"point": [x, y, z], "text": "..."}.

    FormatError: a line that names the file, the entry and what was expected. MissingError: no such file.
    """
    try:
        entries = read_json(path, finite=True)
    except FileNotFoundError as error:
        raise MissingError(str(error)) from None
    except ValueError as error:
        raise FormatError(str(error)) from None
    if not isinstance(entries, list) or len(entries) > MOST_NOTES:
        raise FormatError(f"{path}: expected a list of at most {MOST_NOTES} notes")
    notes = []
    for number, entry in enumerate(entries, 1):
        point, text = (entry.get("point"), entry.get("text")) if isinstance(entry, dict) else (None, None)
        numbers = point if isinstance(point, list) and {type(x) for x in point} <= {int, float} else []
        if len(numbers) != 3 or max(map(abs, numbers)) > FARTHEST_NOTE:
            raise FormatError(f"{path}: entry {number}: point: expected three numbers [x, y, z], got {point!r:.60}")
        x, y, z = map(float, numbers)
        if not isinstance(text, str) or not 0 < len(text.strip()) <= LONGEST_NOTE:
            expected = f"expected 1 to {LONGEST_NOTE} characters in quotes"
            raise FormatError(f"{path}: entry {number}: text: {expected}, got {text!r:.60}")
        notes.append(Note((x, y, z), text.strip()))
    return tuple(notes)


def export_web(
    model: Model,
    cameras: Mapping[str, Camera],
    out: Path,
    views: Views = (),
    *,
    quality: str = "quantised",
    page: Page = Page(),
    progress: Progress = lambda *_: None,
) -> list[Path]:
    """Write the page of a scene, and return its files; it starts at the first of the cameras by name.

    `out` is a file name that ends in .html, or a folder; `quality` of the scene file is "quantised" or "full";
    `views`, by default the cameras, and `progress` are those of `nexwarp.export.bake.bake`.
    """
    single = out.suffix == ".html"
    picture = f"{out.stem if single else Path(INDEX).stem}.preview.jpg"
    content, shown = dict(static_files()), model
    if page.background is not None:  # photos were taken before the model's own, so that one is baked
        options = replace(model.options, background=page.background)
        shown = Model(model.surfels, model.texture, model.exposures, model.detail_limits, options, model.meta)
        color = "#" + bytes(round(255 * x) for x in page.background).hex()
        content |= {name: content[name].replace(BACKGROUND.encode(), color.encode()) for name in (INDEX, "style.css")}
    poster = _poster(shown, next(iter(cameras.values()))) if cameras else None
    content[INDEX] = _index(content[INDEX].decode(), page, "" if poster is None else picture).encode()
    facts: dict[str, object] = {"metres": page.metres}
    content[SCENE_FILE] = encode_scene(
        shown, cameras, quality=quality, facts={"title": page.title, **facts}, poster=poster
    )
    if cameras and len(model.surfels):
        scene = bake(model, views or list(cameras.values()), progress=progress)
        content |= encode_baked(scene, shown, cameras, facts)
    if single:
        content = {out.name: one_file(content)}
        out = out.parent
    if poster is not None:
        content[picture] = poster
    files = {out / name: data for name, data in sorted(content.items(), key=lambda item: item[0] != INDEX)}
    write_together(files)  # the page itself last
    return list(files)


def _index(text: str, page: Page, picture: str) -> str:
    """Return the HTML of a page, from the text that all pages have; what a person wrote is text, never HTML."""
    caption = html.escape(page.caption)
    notes = json.dumps([{"point": note.point, "text": note.text} for note in page.notes]).replace("<", "\\u003c")
    links = [f'<meta property="og:description" content="{caption or DESCRIPTION}">']
    if picture:
        links.append(f'<meta property="og:image" content="{html.escape(urljoin(page.url, picture))}">')
    for before, after in (
        ("__TITLE__", html.escape(page.title)),
        (f'name="description" content="{DESCRIPTION}">', f'name="description" content="{caption or DESCRIPTION}">'),
        ('<p id="caption">', f'<p id="caption">{caption}'),
        ('<link rel="icon"', "\n".join([*links, '<link rel="icon"'])),
        ('type="application/json">[]', f'type="application/json">{notes}'),
    ):
        text = text.replace(before, after)
    return text


@cache
def static_files() -> Mapping[str, bytes]:
    """Return the content of the files that every page has."""
    package = files("nexwarp.export.web")
    content = {item.name: item.read_bytes() for item in package.joinpath("page").iterdir() if item.is_file()}
    shaders = [item for item in package.joinpath("shaders").iterdir() if item.name.endswith(".wgsl")]
    content |= {f"shaders/{item.name}": item.read_bytes() for item in shaders}
    return dict(sorted(content.items()))


def one_file(content: Mapping[str, bytes]) -> bytes:
    """Return a page's files as one HTML file: modules in the import map, the others as elements with base64 text."""
    encoded = {name: base64.b64encode(data).decode() for name, data in content.items()}
    scripts = {name: f"data:text/javascript;base64,{text}" for name, text in encoded.items() if name.endswith(".js")}
    modules = {f"nexwarp/{name}": address for name, address in scripts.items()}
    assets = "".join(
        f'<script type="application/octet-stream" id="asset:{name}">{text}</script>\n'
        for name, text in encoded.items()
        if name != INDEX and not name.endswith((".js", ".css"))
    )
    page = content[INDEX].decode()
    first_script = page.index("<script", page.index("<body"))
    head, body = page[:first_script], page[first_script:]
    head = head.replace(IMPORT_MAP, json.dumps({"imports": modules}))
    head = head.replace(STYLE_LINK, f"<style>{content['style.css'].decode()}</style>")
    # The scripts look for the assets.
    return f"{head}{assets}{body}".encode()


@torch.no_grad()
def _poster(model: Model, camera: Camera) -> bytes:
    """Return a JPEG picture of a camera, at most 640 pixels wide."""
    scale = min(POSTER_WIDTH / max(camera.width, camera.height), 1.0)
    small = resized(camera, max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
    pixels = to_uint8(model.render_image(small)).cpu().numpy()
    return encoded(pixels, format="JPEG", quality=POSTER_QUALITY, optimize=True)
