import math
import shutil
import socket

import pytest

from nexwarp.viewer.modes import Settings
from tests.cli.support import refused
from tests.viewer.support import Client, serving, wait_for


def test_one_line_for_what_cannot_be_shown(run, tiny_folder, tmp_path, capsys, monkeypatch):
    refused(capsys, ["view", str(tmp_path / "none")], str(tmp_path / "none"), "expected a run folder")
    shutil.copytree(run, tmp_path / "early")
    (tmp_path / "early" / "model.safetensors").unlink()
    refused(capsys, ["view", str(tmp_path / "early")], "model.safetensors")
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        refused(capsys, ["view", str(run), "--port", port], "--port", port, "in use", "another")
        new = ["train", str(tiny_folder), "--run", str(tmp_path / "new"), "--view", "--port", port]
        refused(capsys, new, "--port", "in use")
    assert not (tmp_path / "new").exists()
    refused(capsys, ["view", str(run), "--port", "70000"], "--port", "65535", "70000")
    refused(capsys, ["view", str(run), "--host", "203.0.113.1"], "--host", "203.0.113.1")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    refused(capsys, ["view", str(run)], "viser", "pip install 'nexwarp[viewer]'")


def test_clients_look_for_themselves_and_come_and_go(model):
    with serving(model) as viewer:
        with Client(viewer) as one, Client(viewer) as two:
            one.look()
            two.look()
            mode = two.control("Show")
            wait_for(lambda: len(viewer.sessions) == 2)
            sessions = list(viewer.sessions.values())
            two.send("GuiUpdateMessage", uuid=mode, updates={"value": "alpha"})
            wait_for(lambda: {s.settings.mode for s in sessions} == {"image", "alpha"})
            wait_for(lambda: all(s.drawn_scale == 1.0 and s.drawn_version == s.version for s in sessions))
            assert {s.viewpoint and s.viewpoint.width for s in sessions} == {96}
        wait_for(lambda: not viewer.sessions)
        with Client(viewer) as late:  # finds everything as the first did
            late.look(position=(0, 0, -3))
            assert late.picture().ndim == 3


def test_nonsense_is_dropped_and_hurts_nobody(model, capfd):
    with serving(model) as viewer, Client(viewer) as good, Client(viewer) as bad:
        good.look()
        bad.look()
        mode = bad.control("Show")
        wait_for(lambda: len(viewer.sessions) == 2)
        session = viewer.sessions[max(viewer.sessions)]
        slider = session.controls["max_hits"]
        uuid = slider._impl.uuid
        wait_for(lambda: session.drawn_version == session.version)
        version = session.version
        others = {name: control._impl.uuid for name, control in session.controls.items()}
        wrong_values = [(uuid, value) for value in ("many", "2", None, [1, 2], 2.5, math.nan, {"a": 1})]
        wrong_values += [(others["slot"], True), (others["as_trained"], 1), (mode, "rm -rf")]
        for control, value in wrong_values:
            bad.send("GuiUpdateMessage", uuid=control, updates={"value": value})
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"removed": True})
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"update_cb": None})
        bad.send("GuiUpdateMessage", uuid="of an older page", updates={"value": 3})
        bad.send("ShareUrlRequest")
        click = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "screen_pos": (0, 0), "modifier": None}
        bad.send("SceneNodeClickMessage", name="/cameras/none", instance_index=None, **click)
        for wrong in ({"fov": 0.0}, {"fov": math.nan}, {"wxyz": (0, 0, 0, 0)}, {"position": (math.nan, 0, 0)}):
            bad.look(**wrong)
        for size in (0, 10**9):
            bad.look(image_width=size)
        bad.send("GuiUpdateMessage", uuid=others["sh_degree"], updates={"value": -5})
        bad.send("GuiUpdateMessage", uuid=uuid, updates={"value": 99})
        wait_for(lambda: session.settings.max_hits == 8 and slider.value == 8)  # set one after the other
        assert session.settings == Settings(max_hits=8, sh_degree=0) and session.version == version + 2
        assert not slider._impl.removed and session.viewpoint is not None
        assert session.viewpoint.width == 96 and math.isfinite(session.viewpoint.fov)
        bad.socket.send(b"\xc1 no message at all")
        wait_for(lambda: len(viewer.sessions) == 1)  # it is shown out
        good.look(position=(0.5, 0, -3))
        assert good.picture().ndim == 3
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err, out + err
