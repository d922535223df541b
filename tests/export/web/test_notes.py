import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from nexwarp.errors import FormatError, MissingError, SettingError
from nexwarp.export.web.export import INDEX, Note, Page, export_web, read_notes, static_files
from nexwarp.export.web.scene_file import SCENE_FILE
from nexwarp.run.export import ExportOrder
from tests.export.web import support
from tests.export.web.support import CHROMIUM, FINISHED, PageTab, named_cameras, web_model

HOSTILE = '</script><img src=x onerror="nexwarp.hacked = 1">__TITLE__ <!-- & \u2028'
FIRST = "nexwarp.notes.notes[0].button"


class Metas(HTMLParser):
    """The <meta> elements of a page, content by name or property."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep a meta element."""
        values = dict(attrs)
        if tag == "meta" and (name := values.get("property") or values.get("name")):
            self.found[name] = values.get("content") or ""


@pytest.mark.parametrize("out", ["page", "page.html"])
def test_what_a_person_writes_is_in_the_page(tmp_path, monkeypatch, out):
    monkeypatch.setattr("nexwarp.export.web.export.bake", lambda *_, **__: None)
    monkeypatch.setattr("nexwarp.export.web.export.encode_baked", lambda *_: {})
    model, camera = web_model(5)
    page = Page("<Title>", HOSTILE, (1.0, 0.5, 0.0), (Note((0.0, 1.0, 2.0), HOSTILE),), "https://example.org/x/", 0.25)
    files = export_web(model, named_cameras(camera), tmp_path / out, page=page)
    index = (tmp_path / out / INDEX if out == "page" else tmp_path / out).read_text(encoding="utf-8")
    picture = "index.preview.jpg" if out == "page" else "page.preview.jpg"
    metas = Metas(index).found
    assert metas["og:title"] == "<Title>" and metas["og:description"] == metas["description"] == HOSTILE
    assert metas["og:image"] == f"https://example.org/x/{picture}" and metas["theme-color"] == "#ff8000"
    with Image.open(next(file for file in files if file.name == picture)) as image:
        assert image.format == "JPEG" and image.size == (camera.width, camera.height)
    (notes,) = re.findall(r'<script id="notes" type="application/json">(.*?)</script>', index)
    assert json.loads(notes) == [{"point": [0, 1, 2], "text": HOSTILE}] and "<img src=x" not in index
    if out == "page":
        assert {file.relative_to(tmp_path / out).as_posix() for file in files} == {*static_files(), SCENE_FILE, picture}
        header, _ = support.read_sections((tmp_path / out / SCENE_FILE).read_bytes())
        assert header["options"]["background"] == [1.0, 0.5, 0.0] and header["metres"] == 0.25
        assert header["surfels"] == 5


@pytest.mark.parametrize(
    "content, words",
    [
        ("[", "expected JSON"),
        ("{}", "expected a list"),
        ('[{"point": [1, 2, 3], "text": "a"}, 7]', "entry 2: point: expected three numbers"),
        ('[{"point": [1, 2], "text": "a"}]', "entry 1: point: expected three numbers [x, y, z], got [1, 2]"),
        ('[{"point": [1, 2, 1%s], "text": "a"}]' % ("0" * 400), "entry 1: point"),
        ('[{"point": [1, 2, 3], "text": 5}]', "entry 1: text: expected 1 to 500 characters in quotes, got 5"),
    ],
)
def test_bad_notes_give_one_line(tmp_path, content, words):
    file = tmp_path / "notes.json"
    file.write_text(content)
    with pytest.raises(FormatError) as caught:
        ExportOrder("web", annotations=file).check()
    assert str(caught.value).startswith(f"{file}: ") and words in str(caught.value) and "\n" not in str(caught.value)


def test_options_of_pages_alone(tmp_path):
    with pytest.raises(MissingError, match=r"none\.json: no such file"):
        read_notes(tmp_path / "none.json")
    with pytest.raises(SettingError, match="--url: expected an address"):
        ExportOrder("web", url="javascript:alert(1)").check()
    with pytest.raises(SettingError, match="expected together with --format web, got --format ply"):
        ExportOrder(title="x").check()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.timeout(300)
def test_notes_are_where_their_points_are(open_tab, site, cameras):
    tab: PageTab = open_tab(390, 300)
    first = cameras["0.png"].viewmat.double().inverse().numpy()
    points = [(first @ [*place, 1])[:3].tolist() for place in ((0.1, 0.05, 2.0), (-0.3, -0.2, 2.5))]
    notes = json.dumps([{"point": point, "text": HOSTILE} for point in points]).replace("<", "\\u003c")
    tab.files[INDEX] = site[INDEX].replace(b'type="application/json">[]', f'type="application/json">{notes}'.encode())
    tab.open("?renderer=baked")
    viewmat, (fx, fy, cx, cy) = (tab.value(f"nexwarp.pose.camera(390, 300, 1).{name}") for name in ("viewmat", "K"))
    for index, point in enumerate(points):
        x, y, z, _ = np.array(viewmat).reshape(4, 4) @ [*point, 1]
        box = tab.page.locator("#labels b").nth(index).bounding_box()
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert z > 0 and middle == pytest.approx((fx * x / z + cx, fy * y / z + cy), abs=1.5)
    assert tab.page.locator("#labels span").first.text_content() == HOSTILE
    assert tab.page.locator("#labels img").count() == 0 and not tab.value("'hacked' in nexwarp")
    # A chosen note is looked at; behind the camera there is none.
    tab.page.locator("#labels b").nth(1).click()
    tab.wait(FINISHED)
    target = tab.value("nexwarp.pose.target")
    assert target == pytest.approx(points[1], abs=1e-3)
    tab.value("nexwarp.pose = nexwarp.pose.turned(Math.PI, 0, true)")
    tab.wait(FINISHED)
    assert tab.value(f"{FIRST}.hidden") and not tab.errors
