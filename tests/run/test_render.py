"""Projections of `nexwarp render`, and what of its options is refused."""

import pytest

from nexwarp.errors import SettingError
from nexwarp.run.render import RenderOrder

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "cube"}, "--camera: expected pinhole, panorama, fisheye, got"),
        ({"fov": 0.0, "camera": "fisheye"}, "--fov: expected 1 to 360"),
        ({"fov": 90.0}, "--fov: expected together with --camera fisheye"),
        ({"buffers": True, "camera": "panorama"}, "--buffers: expected together with --camera pinhole"),
    ],
)
def test_options_that_do_not_fit_are_named(options, message):
    with pytest.raises(SettingError, match=message):
        RenderOrder(**options).check()
