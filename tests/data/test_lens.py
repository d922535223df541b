import dataclasses

import numpy as np
import pytest
import torch

from nexwarp.data.lens import MAX_PARAMETER, MIN_FOCAL, Intrinsics, Lens, pycolmap_module, undistortion
from tests.data.inputs.room import pinhole_rays

WIDTH, HEIGHT = 120, 90
F = (80.0, 83.0, 61.5, 43.0)  # fx, fy, cx, cy
LENSES = {
    "SIMPLE_RADIAL": (80.0, 61.5, 43.0, -0.1),
    "RADIAL": (80.0, 61.5, 43.0, -0.1, 0.02),
    "OPENCV": (*F, -0.15, 0.03, 0.002, -0.001),
    "FULL_OPENCV": (*F, -0.15, 0.03, 0.002, -0.001, 0.01, 0.02, 0.0, 0.001),
    "OPENCV_FISHEYE": (*F, 0.03, -0.01, 0.004, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (80.0, 61.5, 43.0, 0.01),
    "RADIAL_FISHEYE": (80.0, 61.5, 43.0, 0.01, 0.002),
    "SIMPLE_FISHEYE": (80.0, 61.5, 43.0),
    "FISHEYE": F,
    "FOV": (*F, 0.7),
    "THIN_PRISM_FISHEYE": (*F, 0.02, -0.01, 0.001, 0.001, 0.002, 0.0, 0.001, 0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (*F, 0.01, -0.01, 0.002, 0.0, 0.0, 0.0, 0.001, 0.001, 0.001, 0.0, 0.001, 0.0),
    "SIMPLE_DIVISION": (80.0, 61.5, 43.0, -0.1),
    "DIVISION": (*F, -0.1),
    "EUCM": (*F, 0.5, 1.1),
    "BROWN": (*F, -0.15, 0.03, 0.002, -0.001, 0.01, 0.02),
}


def rays_of(target: Intrinsics) -> np.ndarray:
    """(h * w, 3) rays through the pixel centres of a pinhole image."""
    pinhole = target.fx, target.fy, target.cx, target.cy
    return pinhole_rays(pinhole, target.width, target.height).reshape(-1, 3)


def lens(model: str) -> Lens:
    return Lens(model, LENSES[model], WIDTH, HEIGHT)


def test_every_model_that_colmap_has_is_here():
    known = set(pycolmap_module().CameraModelId.__members__) - {"INVALID", "PINHOLE", "SIMPLE_PINHOLE"}
    assert known | {"BROWN"} == set(LENSES) | {"EQUIRECTANGULAR"}


def test_browns_map_is_its_formula():
    """The other models are COLMAP's own code."""
    target = lens("BROWN").undistorted()
    x, y, _ = rays_of(target).T
    k1, k2, p1, p2, k3, k4 = LENSES["BROWN"][4:]
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3 + k4 * r**4
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    bent_y = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
    expected = np.stack([F[0] * bent_x + F[2], F[1] * bent_y + F[3]], axis=1)
    grid = undistortion(lens("BROWN"), target, None).grid[0].reshape(-1, 2).double().numpy()
    np.testing.assert_allclose((grid + 1) / 2 * [WIDTH, HEIGHT], expected, atol=2e-5)


@pytest.mark.parametrize("model", LENSES)
def test_pixels_come_from_where_the_lens_put_them(model):
    """A photo whose colours are its own coordinates: what is undistorted tells where each pixel came from."""
    target = lens(model).undistorted()
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    photo = torch.from_numpy(np.stack([2 * x, 2 * y, 0 * x + 7], axis=-1).astype(np.uint8))
    way = undistortion(lens(model), target, None)
    assert way.valid is None, "an undistorted image leaves no empty corner"
    seen = way.colors(photo).reshape(-1, 3).double().numpy()
    pixels = lens(model).project(rays_of(target))
    # It keeps the focal length; some of its edge lies within a pixel or two of the photo's edge.
    assert target.fx == LENSES[model][0] and target.width <= 2 * WIDTH and target.height <= 2 * HEIGHT
    assert -0.5 <= np.minimum(pixels, [WIDTH, HEIGHT] - pixels).min() <= 2.5
    inner = ((pixels > 2) & (pixels < [WIDTH - 2, HEIGHT - 2])).all(axis=1)
    assert inner.mean() > 0.85
    # A photo's value is 2 i + 1 at pixel coordinates i + 0.5: twice the coordinate.
    assert np.abs(seen[inner, :2] - 2 * pixels[inner]).max() <= 0.75 and (seen[:, 2] == 7).all()


def test_masks_take_the_nearest_pixel_and_end_with_the_photo():
    here = lens("OPENCV")
    target = here.undistorted()
    # Twice the field of view: three quarters lie outside the photo.
    wide = dataclasses.replace(target, fx=target.fx / 2, fy=target.fy / 2)
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, : WIDTH // 2] = True
    mapped = undistortion(here, wide, None).mask(mask)
    assert mapped is not None
    out = mapped.numpy().reshape(-1)
    pixels = here.project(rays_of(wide))
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        outside = ~((pixels > -1) & (pixels < [WIDTH + 1, HEIGHT + 1])).all(axis=1)
    left = pixels[:, 0] < WIDTH // 2 - 1e-3
    assert not out[outside].any() and (out[inside & left]).all()
    assert not out[inside & (pixels[:, 0] > WIDTH // 2 + 1e-3)].any() and 0.1 < inside.mean() < 0.5


@pytest.mark.parametrize(
    ("model", "params", "size", "message"),
    [
        ("TELESCOPE", F, (4, 4), "TELESCOPE is unknown to COLMAP"),
        ("INVALID", F, (4, 4), "INVALID is unknown to COLMAP"),
        ("OPENCV", F, (4, 4), "expected fx, fy, cx, cy, k1, k2, p1, p2, got 4 values"),
        ("PINHOLE", (0.0, 1.0, 2.0, 2.0), (4, 4), "expected focal lengths > 0, got 0, 1"),
        ("PINHOLE", (1.0, 1.0, 2.0, float("nan")), (4, 4), "expected finite parameters"),
        ("PINHOLE", F, (0, 4), "expected an image size of 1 to 65536 pixels, got 0x4"),
        ("PINHOLE", F, (4, 2**40), "expected an image size"),
    ],
)
def test_bad_lenses(model, params, size, message):
    with pytest.raises(ValueError, match=message):
        Lens(model, params, *size)


def test_absurd_lenses_give_finite_maps_of_bounded_size():
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(300):
        model = sorted(LENSES)[trial % len(LENSES)]
        size = 10.0 ** rng.uniform(-3, rng.choice([0, 2, 20, 300]))
        params = np.abs(rng.normal(size=len(LENSES[model])) * size) + 1e-6
        params[4:] *= rng.choice([-1, 1], len(params) - 4) if len(params) > 4 else 1
        if trial % 3:
            params[:4] = (50.0, 50.0, 20.0, 15.0)[: len(params)]
        if np.abs(params).max() > MAX_PARAMETER or params[0] < MIN_FOCAL:
            refused += 1
            with pytest.raises(ValueError, match=r"^(camera model|K: )"):
                Lens(model, tuple(params.tolist()), 40, 30)
            continue
        try:
            here = Lens(model, tuple(params.tolist()), 40, 30)
        except ValueError as error:  # the other focal length
            assert "focal lengths" in str(error)
            refused += 1
            continue
        target = here.undistorted()
        assert 1 <= target.width <= 80 and 1 <= target.height <= 60 and np.isfinite(dataclasses.astuple(target)).all()
        way = undistortion(here, target, None)
        assert way.grid.isfinite().all() and way.grid.abs().max() <= 2
    assert 20 < refused < 200
