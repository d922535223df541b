"""The page as one file and as a folder: complete, self-contained, with the scene's bytes."""

import base64
import json
import re

import pytest

from nexwarp.export.web.export import INDEX, export_web, one_file, static_files
from nexwarp.export.web.scene_file import SCENE_FILE, encode_scene
from nexwarp.kernels import sh
from tests.export.web.support import named_cameras, read_sections, web_model


def page_of(title: str = "demo") -> tuple[str, dict[str, bytes]]:
    """The one file, and what it is made of."""
    model, camera = web_model(5)
    content = {**static_files(), SCENE_FILE: encode_scene(model, named_cameras(camera), title=title)}
    return one_file(content).decode(), content


def test_one_file_holds_every_module_and_asset():
    page, content = page_of()
    (text,) = re.findall(r'<script type="importmap">(.*?)</script>', page)
    modules = json.loads(text)["imports"]
    imported = set()
    for name, data in content.items():
        if name.endswith(".js"):
            prefix, encoded = modules.pop(f"nexwarp/{name}").split(",")
            assert prefix == "data:text/javascript;base64" and base64.b64decode(encoded) == data
            imported |= set(re.findall(r'from "([^"]+)"', data.decode()))
        elif not name.endswith((".css", ".html")):
            (encoded,) = re.findall(rf'id="asset:{re.escape(name)}">([^<]*)</script>', page)
            assert base64.b64decode(encoded) == data
    assert modules == {} and imported <= {f"nexwarp/{name}" for name in content}
    # The assets come before the scripts that look for them.
    assert page.index('id="asset:scene.nxw"') < page.index('import "nexwarp/viewer.js"')


def test_the_page_names_no_other_server():
    page, content = page_of()
    texts = [
        page,
        *(data.decode() for name, data in content.items() if name.endswith((".js", ".css", ".wgsl", ".html"))),
    ]
    for text in texts:
        found = re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}[^\s\"']*", text)
        assert [url for url in found if "www.w3.org" not in url] == []  # names of XML, not addresses


def test_titles_are_text(tmp_path, monkeypatch):
    monkeypatch.setattr("nexwarp.export.web.export.bake", lambda *_: {})
    model, camera = web_model(5)
    files = export_web(model, named_cameras(camera), tmp_path / "page", title="<b>R&D</b>")
    assert {file.relative_to(tmp_path / "page").as_posix() for file in files} == {*static_files(), SCENE_FILE}
    index = (tmp_path / "page" / INDEX).read_text(encoding="utf-8")
    assert "&lt;b&gt;R&amp;D&lt;/b&gt;" in index and "<b>R&D" not in index and "__TITLE__" not in index
    assert read_sections((tmp_path / "page" / SCENE_FILE).read_bytes())[0]["surfels"] == 5


@pytest.mark.parametrize("name", ["shaders/common.wgsl", "baked_shaders.js"])
def test_spherical_harmonics_of_shaders_have_the_kernels_constants(name: str) -> None:
    """All digits, and no other constants: pictures would not show half a percent of one."""
    text = static_files()[name].decode()
    basis = text[text.index("0.28209") : text.rindex("3.0 * ")]
    constants = {float(number) for number in re.findall(r"(?<![\w.])\d+\.\d+", basis)} - {2.0, 3.0, 4.0, 0.0}
    assert constants == {sh.BAND_0, sh.BAND_1, *sh.BAND_2, *sh.BAND_3}
