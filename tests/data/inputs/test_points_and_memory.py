import pytest
import torch

import nexwarp.data.scene
import nexwarp.data.views
import nexwarp.machine
from nexwarp.data import load_scene
from tests.data.test_scene import make_scene


def test_huge_clouds_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(nexwarp.data.scene, "MAX_POINTS", 10)
    path = make_scene(tmp_path / "scene")
    scene, again = load_scene(path), load_scene(path)
    assert len(scene.points) == len(scene.colors) == len(scene.track_lengths) == 10
    assert torch.equal(scene.points, again.points)


def test_photos_that_do_not_fit_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = make_scene(tmp_path / "scene")
    (path / "images_2").mkdir()
    need = 10 * 48 * 36 * 3
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: need // 3)
    monkeypatch.setattr(nexwarp.data.views, "read_image", lambda *_: pytest.fail("read"))
    with pytest.raises(ValueError, match=r"10 photos of up to 48x36 .* use downscale=2 \(.*\) or .* \(images_2\)") as e:
        load_scene(path)
    assert "\n" not in str(e.value)
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: 0)
    with pytest.raises(ValueError, match="use fewer photos"):
        load_scene(path)
    monkeypatch.undo()
    monkeypatch.setattr(nexwarp.data.scene, "available_memory", lambda: need // 3)
    load_scene(path, downscale=2)
    # A thousand photos of eight megapixels fit 8 GB at half size.
    sizes = [(3264, 2448)] * 1000
    assert nexwarp.data.scene.photos_bytes(sizes, 2, 3) < 0.9 * 7.2e9 < nexwarp.data.scene.photos_bytes(sizes, 1, 3)
    assert nexwarp.machine.available_memory() > 2**20
