"""The web page of a scene: a folder for a web server, or one HTML file."""

import base64
import html
import io
import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path

import torch

from nexwarp.cameras.camera import Camera, resized
from nexwarp.export.bake import Progress, bake
from nexwarp.export.fit import Views
from nexwarp.export.web.baked import encode_baked
from nexwarp.export.web.scene_file import SCENE_FILE, encode_scene
from nexwarp.io.files import write_together
from nexwarp.io.pictures import to_uint8
from nexwarp.model.model import Model

INDEX = "index.html"
IMPORT_MAP = '{"imports": {"nexwarp/": "./"}}'
STYLE_LINK = '<link rel="stylesheet" href="style.css">'
POSTER_WIDTH = 640
POSTER_QUALITY = 75


def export_web(
    model: Model,
    cameras: Mapping[str, Camera],
    out: Path,
    views: Views = (),
    *,
    quality: str = "quantised",
    title: str = "nexwarp",
    progress: Progress = lambda *_: None,
) -> list[Path]:
    """Write the page of a scene, and return its files; it starts at the first of the cameras by name.

    `out` is a file name that ends in .html, or a folder; `quality` of the scene file is "quantised" or "full";
    `views`, by default
    the cameras, and `progress` are those of `nexwarp.export.bake.bake`.
    """
    content = page_files(model, cameras, views, quality=quality, title=title, progress=progress)
    if out.suffix == ".html":
        content = {out.name: one_file(content)}
        out = out.parent
    files = {out / name: data for name, data in sorted(content.items(), key=lambda item: item[0] != INDEX)}
    write_together(files)  # the page itself last
    return list(files)


def page_files(
    model: Model,
    cameras: Mapping[str, Camera],
    views: Views = (),
    *,
    quality: str = "quantised",
    title: str = "nexwarp",
    progress: Progress = lambda *_: None,
) -> dict[str, bytes]:
    """Return the content of the page's files by name."""
    content = dict(static_files())
    content[INDEX] = content[INDEX].decode().replace("__TITLE__", html.escape(title)).encode()
    poster = _poster(model, next(iter(cameras.values()))) if cameras else None
    content[SCENE_FILE] = encode_scene(model, cameras, quality=quality, title=title, poster=poster)
    if cameras and len(model.surfels):
        content |= encode_baked(bake(model, views or list(cameras.values()), progress=progress), cameras)
    return content


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
    from PIL import Image

    scale = min(POSTER_WIDTH / max(camera.width, camera.height), 1.0)
    small = resized(camera, max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
    stream = io.BytesIO()
    picture = Image.fromarray(to_uint8(model.render_image(small)).cpu().numpy())
    picture.save(stream, "JPEG", quality=POSTER_QUALITY, optimize=True)
    return stream.getvalue()
