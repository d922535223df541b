import numpy as np
import pytest

from nexwarp.cli import commands
from nexwarp.cli import main as cli
from nexwarp.errors import FormatError
from nexwarp.run.folder import PHOTOS_FILE
from nexwarp.run.photo_table import load_photo_table
from nexwarp.viewer.world import camera_to_world
from tests.viewer.support import Client, serving, session_of, wait_for

HEADER = b"photo,split,psnr,sharpness\n"
DAMAGED = [
    b"", b"photo\n", b"\xff\xfe", HEADER + b"a,train\n", HEADER + b"a,train,x,1\n", HEADER + b"a,train,nan,1\n",
    HEADER + b'"a,train,1,1\n', HEADER + b"a" * 2**18 + b",train,1,1\n", HEADER + b"a,train,1,1\n" * 2**20,
]  # fmt: skip


def test_photos_are_read_as_they_were_written_the_worst_first(tmp_path):
    assert load_photo_table(tmp_path / "none.csv") == {}
    (tmp_path / "photos.csv").write_bytes(HEADER + b'b.png,test,inf,2\n"a, ""b"".png",train,20.5,0.25\n')
    table = load_photo_table(tmp_path / "photos.csv")
    assert list(table.items()) == [('train/a, "b".png', (20.5, 0.25)), ("test/b.png", (float("inf"), 2.0))]


@pytest.mark.parametrize("content", DAMAGED, ids=range(len(DAMAGED)))
def test_damaged_tables_are_refused_in_one_line(tmp_path, content):
    (tmp_path / "photos.csv").write_bytes(content)
    with pytest.raises(FormatError, match=r"^[^\n]*photos.csv: expected the photos of a run [^\n]{1,400}$"):
        load_photo_table(tmp_path / "photos.csv")


def test_a_run_is_viewed_with_its_photos_or_a_warning(run, monkeypatch, capsys):
    pytest.importorskip("viser")
    listed = []
    monkeypatch.setattr(
        commands, "show_until_interrupted", lambda viewer, _: listed.append(list(viewer.options.figures))
    )
    good = (run / PHOTOS_FILE).read_bytes()
    view = ["view", str(run), "--port", "0", "--device", "cpu"]
    for content in (good, b"damaged"):
        (run / PHOTOS_FILE).write_bytes(content)
        assert cli.main(view) == 0
    (run / PHOTOS_FILE).write_bytes(good)
    assert len(listed[0]) == len(good.splitlines()) - 1 and not listed[1]
    assert capsys.readouterr().out.count("warning: ") == 1


def test_a_chosen_photo_is_gone_to_and_its_option_shown(model):
    """Names are escaped; a choice that the panel does not offer is dropped."""
    hostile = "train/<img src=x onerror=alert(1)>"
    figures = {"train/3.png": (12.0, 0.5), hostile: (13.0, 0.25), "train/1.png": (30.0, 0.75)}
    with serving(model, figures=figures) as viewer, Client(viewer) as client:
        client.look()
        photos, notes, listed = "", [""], [""]
        for message in client.hear():
            props = message.get("props", {})
            if props.get("label") == "Worst first":
                photos, listed = message["uuid"], props["options"]
            if photos and "content" in (shown := props | message.get("updates", {})):
                notes.append(shown["content"])
                if "exclude" in notes[-1]:
                    break
        assert list(listed) == ["12.00 dB train/3.png", f"13.00 dB {hostile}", "30.00 dB train/1.png"]
        assert "<code>--exclude 3.png</code>" in notes[-1] and "medians 13.00 dB, 0.5" in notes[-1]
        session = session_of(viewer)
        for wrong in ("none", 3, None):
            client.send("GuiUpdateMessage", uuid=photos, updates={"value": wrong})
        for label, option in ((listed[1], "--exclude &#x27;&lt;img src=x"), (listed[2], "--exclude 1.png")):
            client.send("GuiUpdateMessage", uuid=photos, updates={"value": label})
            for message in client.hear():
                notes.append(message.get("updates", {}).get("content", ""))
                if option in notes[-1]:
                    break
        place = viewer.world.to_browser(camera_to_world(session.cameras["train/1.png"])[:3, 3])
        wait_for(lambda: np.allclose(session.client.camera.position, place, atol=1e-5))
        assert not any("<img" in note for note in notes)
    with serving(model) as viewer, Client(viewer) as client:
        client.look()
        labels = []
        for message in client.hear():
            labels.append(message.get("props", {}).get("label"))
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                break
        assert "Go to" in labels and "Worst first" not in labels
