import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nexwarp.viewer.session import MeasureEditor
from nexwarp.viewer.world import LEAST_ALPHA, Viewpoint, camera_to_world, surface_point, vertical_fov
from tests.viewer.support import Client, serving, session_of, wait_for


def test_points_are_those_of_the_whole_picture(model, camera) -> None:
    view = Viewpoint(camera_to_world(camera), vertical_fov(camera), 64, 48)
    with torch.no_grad():
        out = model.bare().render(view.bands(1.0, 0.01, model.surfels.means)[0])
    hits, focal = 0, 24 / math.tan(0.5 * view.fov)
    for row, column in ((8 * i, 8 * j) for i, j in np.ndindex(6, 8)):
        point = surface_point(model, view, ((column + 0.5) / 64, (row + 0.5) / 48), 0.01)
        assert (point is None) == (float(out.alpha[row, column]) < LEAST_ALPHA)
        if point is not None:
            hits += 1
            x, y, depth = (point - view.pose[:3, 3]) @ view.pose[:3, :3]
            assert depth == pytest.approx(float(out.median_depth[row, column]), rel=1e-5)
            under = focal * x / depth + 32, focal * y / depth + 24
            assert under == pytest.approx((column + 0.5, row + 0.5), abs=1e-3), "under the click"
    assert 5 < hits < 48


def test_two_clicks_are_measured_and_the_third_begins_anew(model) -> None:
    """A click on no surface says so, one on a frustum goes through it, and nonsense is dropped."""
    described: list[tuple[np.ndarray, float]] = []

    def describe(points: np.ndarray, length: float) -> list[str]:
        described.append((points, length))
        return ["described"]

    with serving(model, measured=describe) as viewer, Client(viewer) as client:
        client.look()
        switch = client.control("Measure")
        session = session_of(viewer)
        wait_for(lambda: session.viewpoint is not None and session.viewpoint.width == 96)
        view, editor = session.viewpoint, session.measure
        assert isinstance(editor, MeasureEditor) and view is not None
        ray = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "modifier": None}

        def click(*place: float, **values: object) -> None:
            client.send("ScenePointerMessage", **(ray | {"event_type": "click", "screen_pos": (place,)} | values))

        def click_frustum() -> None:
            at = {"instance_index": None, "screen_pos": (0, 0), "owner": str(session.client.client_id)}
            client.send("SceneNodeClickMessage", name="/cameras/train/0.png", **ray, **at)

        grid = [(0.1 * x, 0.1 * y) for x in range(10) for y in range(10)]
        points = {place: point for place in grid if (point := surface_point(model, view, place, 0.01)) is not None}
        hits = list(points)
        assert grid[0] not in points
        click(*hits[0])  # not yet
        client.send("GuiUpdateMessage", uuid=switch, updates={"value": True})
        wait_for(lambda: bool(editor.active.value))
        for count, place in ((1, hits[0]), (2, hits[-1]), (1, hits[1])):
            click(math.nan, -1e9)  # the upper left corner
            wait_for(lambda: "No surface" in editor.note.content)
            for wrong in ((), (1.0,), ("x", "y"), (None, None), (0.1, 0.2, 0.3)):
                asyncio.run(editor.clicked(SimpleNamespace(screen_pos=wrong)))  # type: ignore[arg-type]
            assert not editor.clicks
            click(0.5, 0.5, event_type="rect-select")
            click(0.5, 0.5, ray_origin=None)
            click_frustum()
            click(*place)
            wait_for(lambda: editor.note.content == "described")
            assert len(described[-1][0]) == count
            np.testing.assert_allclose(described[-1][0][-1], points[place], atol=1e-9)
            last = viewer.world.to_browser(points[place])
            np.testing.assert_allclose(editor.balls[count - 1].position, last, atol=1e-5)
            assert [mark.visible for mark in (*editor.balls, editor.line)] == [True, count == 2, count == 2]
            if count == 2:
                np.testing.assert_allclose(editor.line.points[0, 1], last, atol=1e-5)
                editor.length.value = math.nan  # type: ignore[misc]
                editor.update()
                assert described[-1][1] == 1e-3
        np.testing.assert_allclose(session.client.camera.position, (0, 0, -4))
        client.send("GuiUpdateMessage", uuid=switch, updates={"value": False})
        wait_for(lambda: not editor.balls[0].visible)
        click(*hits[0])
        click_frustum()
        wait_for(lambda: not np.allclose(session.client.camera.position, (0, 0, -4)))
        assert not len(editor.points) and not editor.clicks
