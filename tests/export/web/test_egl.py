"""The page's shaders without a browser, as `benchmarks.page` times them."""

import re

import pytest

from benchmarks import page
from nexwarp.cameras.cameras_file import CAMERAS_FILE, save_cameras
from nexwarp.export.baked_scene import ATLAS_FILE, BAKED_FILE


def test_the_shaders_draw_what_load_baked_renders(site, cameras, tmp_path, capsys):
    moderngl = pytest.importorskip("moderngl")
    try:
        moderngl.create_context(standalone=True, backend="egl").release()
    except Exception as error:  # whatever a machine without EGL raises
        pytest.skip(f"no EGL: {error}")
    for name in (BAKED_FILE, ATLAS_FILE):
        (tmp_path / name).write_bytes(site[name])
    save_cameras(tmp_path / CAMERAS_FILE, {"train": {}, "test": cameras})
    assert page.main([str(tmp_path), "--cameras", str(tmp_path), "--size", "160x90"]) == 0
    decibels = re.search(r"([\d.]+) dB to nexwarp.load_baked", capsys.readouterr().out)
    assert decibels is not None and float(decibels[1]) > 45
