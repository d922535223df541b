import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.io.pictures import to_uint8
from nexwarp.model.buffers import render_buffers
from nexwarp.model.render import Frame, draw
from nexwarp.run.evaluate import evaluate
from nexwarp.train import exposure as exposure_calibration
from nexwarp.train.exposure import Observations, calibrate_exposures, choose_fit, fit_exposures, observations
from nexwarp.train.losses import as_taken, photo_losses
from nexwarp.train.recipe import Config, LossWeights
from nexwarp.train.target import Target, mean_color
from tests.narrowing import present
from tests.scene_writers import exposure_at, with_exposures, write_demo
from tests.scenes import make_camera, make_surfels, make_texture, random_scene
from tests.tolerances import assert_close
from tests.trainer_support import small, trained

K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])


def looking(x: float, turn: float = 0.0) -> nw.Camera:
    """A camera at (x, 0, 0), turned about y."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float32)
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ torch.tensor([float(x), 0.0, 0.0])
    return nw.Camera(viewmat, K, 64, 48)


def light(camera: nw.Camera, pixels: torch.Tensor, lens: tuple[float, float]) -> torch.Tensor:
    """What a lens leaves of the light at pixel coordinates (N, 2), its powers being of tan^2."""
    tangents = (pixels - torch.tensor([camera.cx, camera.cy])) / torch.tensor([camera.fx, camera.fy])
    t = tangents.square().sum(1, keepdim=True)
    return (lens[0] * t + lens[1] * t**2).exp()


def photographs(
    log_gains: torch.Tensor, outliers: float = 0.0, lens: tuple[float, float] = (0.0, 0.0)
) -> tuple[list[nw.Camera], list[torch.Tensor], list[torch.Tensor]]:
    """Photos of coloured points, each a pixel, with gains, through a lens; some pixels are of something else."""
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(900, 3, generator=generator) * torch.tensor([3.0, 1.6, 1.0]) + torch.tensor([-1.5, -0.8, 2.2])
    colors = 0.2 + 0.4 * torch.rand(900, 3, generator=generator)
    cameras, photos, seen = [], [], []
    for index, gains in enumerate(log_gains.exp().float()):
        camera = looking(0.1 * index)
        pixels, depths = camera.project(points)
        inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([64.0, 48.0])).all(1)
        column, row = pixels[inside].long().unbind(1)
        # One point a pixel, or a point's colour would be another's.
        _, first = np.unique((row * 64 + column).numpy(), return_index=True)
        kept = inside.nonzero()[:, 0][torch.from_numpy(first)]
        photo = torch.zeros(48, 64, 3, dtype=torch.uint8)
        color = colors[kept] * gains * light(camera, pixels[kept], lens)
        wrong = torch.rand(len(kept), generator=generator) < outliers
        color[wrong] = torch.rand(int(wrong.sum()), 3, generator=generator)
        photo[row[torch.from_numpy(first)], column[torch.from_numpy(first)]] = to_uint8(color[None])[0]
        cameras.append(camera)
        photos.append(photo)
        seen.append(points[kept])
    return cameras, photos, seen


def views(cameras: list[nw.Camera], photos: list[torch.Tensor], points: list[torch.Tensor]) -> list[nw.View]:
    parts = zip(cameras, photos, points, strict=True)
    return [nw.View(camera, photo, None, f"{i}", None, seen) for i, (camera, photo, seen) in enumerate(parts)]


def photo_gains(*photographs: Any) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Log gains (V, 3) and falloff that are fitted to photographs."""
    shown = views(*photographs)
    fit = fit_exposures(observations(shown), [view.camera for view in shown])
    a, b = fit.lens.tolist()
    return fit.gains, (a, b, fit.largest)


def test_gains_are_found_up_to_their_mean():
    expected = 0.3 * torch.randn(7, 3, generator=torch.Generator().manual_seed(0)).double().clamp(-1, 1)
    expected -= expected.mean(0)
    for outliers, bound in ((0.0, 0.01), (0.2, 0.02)):
        found, falloff = photo_gains(*photographs(expected, outliers))
        assert abs(falloff[0]) + abs(falloff[1]) < 0.03  # the lens is even
        assert abs(found.mean(0)).max() < 1e-6 and abs(found - expected.numpy()).max() < bound


@pytest.mark.parametrize("lens", [(-0.5, 0.0), (-0.1, -1.0), (0.3, -1.8)])
def test_the_falloff_of_the_lens_is_found(lens):
    """With gains and outliers beside it; as a function, since its two powers are alike."""
    gains = 0.3 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0)).double().clamp(-1, 1)
    gains -= gains.mean(0)
    cameras, photos, points = photographs(gains, 0.1, lens)
    found, falloff = photo_gains(cameras, photos, points)
    assert abs(found - gains.numpy()).max() < 0.03
    camera = cameras[0]
    exposures = nw.Exposures.of(torch.from_numpy(found), cameras, falloff)
    row, column = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    expected = light(camera, torch.stack([column, row], -1).reshape(-1, 2), lens).reshape(48, 64, 1)
    assert expected.min() < 0.85 and (present(exposures.falloff_of(camera)) / expected - 1).abs().max() < 0.01


def test_the_falloff_is_the_angle_s():
    """A window sees what the whole does there, and so does a camera of twice the pixels; beyond all points it ends."""
    cameras = [looking(0.0), looking(1.0)]
    exposures = nw.Exposures.of(torch.zeros(2, 3), cameras, (-0.2, -0.1, 0.25))
    whole = present(exposures.falloff_of(cameras[0]))
    assert whole.shape == (48, 64, 1) and whole.max() > 0.999
    torch.testing.assert_close(present(exposures.falloff_of(cameras[0].crop(10, 5, 20, 30))), whole[5:35, 10:30])
    K2 = K * torch.tensor([[3.0], [3.0], [1.0]])
    torch.testing.assert_close(present(exposures.falloff_of(nw.Camera(torch.eye(4), K2, 192, 144)))[1::3, 1::3], whole)
    wide = present(exposures.falloff_of(cameras[0].crop(-500, -500, 1000, 1000)))
    assert wide.min().item() == pytest.approx(np.exp(-0.3)) and wide[0, 0] == wide.min()
    assert nw.Exposures.of(torch.zeros(2, 3), cameras).falloff_of(cameras[0]) is None
    assert exposures.falloff_of(cameras[1]) is whole  # made once
    for left in range(50):
        exposures.falloff_of(cameras[0].crop(left, 0, 20, 30))
    assert torch.equal(present(exposures.falloff_of(cameras[0])), whole)
    with pytest.raises(ValueError, match=r"^falloff: expected a largest squared tangent > 0, got 0$"):
        nw.Exposures.of(torch.zeros(2, 3), cameras, (-0.2, -0.1, 0.0))


def test_known_gains_are_found_beside_saturated_skies():
    """To 2 %, though a third of each photo's points is clipped in the brighter photos; the points' colours too."""
    gains = torch.linspace(-0.5, 0.5, 11)[:, None].expand(11, 3).double()
    cameras, photos, points = photographs(gains)
    sky = [torch.where((p > 0) & (torch.arange(48)[:, None, None] < 16), (p * 2.0).clamp(max=255), p) for p in photos]
    fit = present(choose_fit(observations(views(cameras, [p.to(torch.uint8) for p in sky], points)), cameras))
    assert np.abs(np.exp(fit.gains - gains.numpy()) - 1).max() < 0.02 and (fit.lens == 0).all()


def test_a_capture_of_one_exposure_is_left_alone(tmp_path):
    """The demo, and points that are shaded by what lies around them, which looks like gains on one side alone."""
    scene = nw.load_scene(write_demo(tmp_path / "demo", width=160, height=120, views=20, points=1500))
    assert calibrate_exposures(scene, Config()) is None
    cameras, photos, points = photographs(torch.zeros(8, 3))
    even = observations(views(cameras, photos, points))
    assert choose_fit(even, cameras) is None
    assert (np.diff(even.point) >= 0).all() and (even.places == np.unique(even.places, axis=0)).all()
    side = np.where(even.places[even.point, 1] < 0.1, 1.0, -1.0)
    shaded = even._replace(color=even.color + 0.1 * side * np.linspace(-1, 1, 8)[even.view])
    assert abs(fit_exposures(shaded, cameras, vignetting=False).gains).max() > 0.02
    assert choose_fit(shaded, cameras) is None


def test_points_get_their_colours_at_the_mean_exposure(tmp_path):
    """Those of the scene without exposures, whatever the exposures of the photos; a point in no photo keeps its own."""
    scene = nw.load_scene(write_demo(tmp_path / "demo", width=48, height=36, views=24, points=400))
    exposed = with_exposures(scene)
    far = torch.tensor([[1e3, 0.0, 0.0]])
    colors = torch.cat([torch.zeros_like(exposed.colors), torch.tensor([[7, 8, 9]], dtype=torch.uint8)])
    exposed = dataclasses.replace(exposed, points=torch.cat([exposed.points, far]), colors=colors)
    colors = present(calibrate_exposures(exposed, Config())).colors
    torch.testing.assert_close(colors[-1], torch.tensor([7.0, 8.0, 9.0]) / 255)
    shown = (colors[:-1] > 0).any(1)
    assert shown.float().mean() > 0.5
    mean = float(np.exp(np.mean([np.log(exposure_at(view)) for view in scene.train])))
    ratio = colors[:-1][shown] / (mean * scene.colors[shown] / 255).clamp_min(0.05)
    assert ratio.median().item() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("most_dense", [0, 7])
def test_gains_are_the_least_squares_of_photos_and_points_together(monkeypatch, most_dense):
    """Also where a photo shows a point twice, or none; by a sparse and by a dense matrix of the photos."""
    monkeypatch.setattr(exposure_calibration, "MOST_DENSE", most_dense)
    random = np.random.default_rng(4)
    photos, points, count = 7, 30, 150
    view, point = random.integers(0, photos - 1, count), np.sort(random.integers(0, points, count))
    observed, weights = random.normal(size=count), random.uniform(0.1, 1.0, count)
    design = np.zeros((count, photos + points))
    design[np.arange(count), view] = design[np.arange(count), photos + point] = 1.0
    root = np.sqrt(weights)
    prior = np.sqrt(exposure_calibration.PRIOR) * np.eye(photos, photos + points)
    together = np.concatenate([root[:, None] * design, prior]), np.concatenate([root * observed, np.zeros(photos)])
    expected = np.linalg.lstsq(*together, rcond=None)[0][:photos]
    seen = Observations(view, point, observed[None], np.zeros(count), np.zeros((points, 3)))
    weighted = exposure_calibration.Weights(point, weights[None])
    gains = exposure_calibration.solve_gains(seen, photos, observed[None], weighted)[0]
    np.testing.assert_allclose(gains, expected - expected.mean(), rtol=0, atol=1e-10)


def test_photos_that_share_nothing_keep_their_colours():
    cameras, photos, points = photographs(torch.tensor([[0.2] * 3, [-0.2] * 3]))
    assert choose_fit(observations(views(cameras, photos, [points[0][:0]] * 2)), cameras) is None
    apart = [points[0][:100], points[1] + 1e-3]  # no point twice
    assert abs(photo_gains(cameras, photos, apart)[0]).max() < 1e-6
    white = [torch.full_like(photo, 255) for photo in photos]
    assert choose_fit(observations(views(cameras, white, points)), cameras) is None


def test_a_camera_gets_the_gains_around_it():
    cameras = [looking(x) for x in np.linspace(0, 6, 25)]
    course = 0.3 * torch.sin(torch.linspace(0, 6, 25))[:, None] * torch.tensor([1.0, 0.5, -1.0])
    exposures = nw.Exposures.of(course, cameras)
    assert (torch.stack([exposures.gains(camera).log() for camera in cameras]) - course).abs().max() < 0.01
    low, high = course.min(0).values, course.max(0).values
    for x in np.linspace(0.1, 5.9, 50):  # between the photos, too
        expected = 0.3 * np.sin(x) * torch.tensor([1.0, 0.5, -1.0])
        assert (exposures.gains(looking(x)).log() - expected).abs().max() < 0.01, x
    for x in np.linspace(-20, 30, 50):
        gains = exposures.gains(looking(x)).log()
        assert (gains >= low - 1e-6).all() and (gains <= high + 1e-6).all()
    far = exposures.gains(looking(1e6)).log()
    torch.testing.assert_close(far, exposures.mean, atol=1e-6, rtol=0)
    assert (far - course.mean(0)).abs().max() < 0.3


@pytest.mark.parametrize("falloff", [None, (-0.3, -0.2, 0.4)])
def test_a_rendering_is_times_its_gains(device: torch.device, falloff):
    scene = random_scene(40, device=device)
    surfels, texture, camera = make_surfels(scene), make_texture(device=device), make_camera(scene)
    options = nw.RenderOptions(background=(0.2, 0.5, 0.9))
    plain = nw.render(surfels, texture, camera, background=options.background)
    cameras = [camera, nw.Camera(torch.eye(4), camera.K.cpu(), camera.width, camera.height)]
    photos = nw.Exposures.of(torch.tensor([[0.3, 0.0, -0.2], [0.5, 0.1, 0.1]]), cameras, falloff).to(device)
    gains = photos.gains(camera)
    if falloff is not None:
        gains = gains * present(photos.falloff_of(camera))
        assert gains.shape == (*plain.alpha.shape, 3) and gains.min() < 0.8 * gains.max()
    out = draw(Frame(surfels, texture, camera, options, options.background, photos))
    for name in ("image", "plain", "textured"):
        assert_close(getattr(out, name), getattr(plain, name) * gains, kind="value", name=name)
    for name in ("alpha", "weights", "depths"):
        assert torch.equal(getattr(out, name), getattr(plain, name))
    buffers = render_buffers(nw.Model(surfels, texture, photos, options=options), camera)
    total = buffers.plain + buffers.textured + (1 - buffers.alpha)[..., None] * buffers.background
    assert_close(total, out.image, kind="value", name="sum")
    slots = (buffers.weights[..., None] * buffers.colors).sum(2)
    assert_close(slots, out.textured, kind="value", name="sum over the slots")


def test_brighter_than_a_saturated_pixel_is_no_error():
    """Photos of one surface, two of them clipped: losses and gradients are 0 for its true colour."""
    scene = random_scene()
    camera, surfels = make_camera(scene), make_surfels(scene)
    out = nw.render(surfels, make_texture(), camera)
    image = torch.full_like(out.image, 0.8).requires_grad_()
    textured = 0.8 * out.weights.sum(-1, keepdim=True).detach().expand_as(image)
    for gain in (1.0, 1.5, 3.0):
        photo = torch.full_like(image, 0.8 * gain).clamp(max=1.0)
        target = Target(camera, photo, 0.0, torch.tensor([gain] * 3))
        taken = as_taken(dataclasses.replace(out, image=image, textured=textured), target)
        losses = photo_losses(taken, target, LossWeights(alpha=0.0))
        assert losses["l1"] < 1e-6 and losses["dssim"] < 1e-4
        if gain > 1:
            (gradient,) = torch.autograd.grad(losses["l1"] + losses["dssim"], image)
            assert (gradient == 0).all()
        darker = as_taken(dataclasses.replace(out, image=0.3 * image), target)
        (gradient,) = torch.autograd.grad((darker.image - photo).abs().mean(), image)
        assert (gradient < 0).all()  # too dark: it is pulled up
    assert as_taken(out, Target(camera, out.image.detach(), 0.0)) is out


def test_the_mean_colour_is_that_of_the_mean_exposure():
    cameras, generator = [looking(0.1 * i) for i in range(4)], torch.Generator().manual_seed(0)
    gains = torch.tensor([[0.5], [0.8], [1.25], [2.0]]).expand(4, 3)
    exposures_ = nw.Exposures.of(gains.log(), cameras, (-0.3, -0.2, 0.4))
    scene = 0.1 + 0.2 * torch.rand(48, 64, 3, generator=generator)
    light = present(exposures_.falloff_of(cameras[0]))
    views = [nw.View(c, to_uint8(scene * g * light), None, "") for c, g in zip(cameras, gains, strict=True)]
    calibration = exposure_calibration.ExposureCalibration(exposures_, gains, torch.zeros(0, 3))
    assert mean_color(views, calibration) == pytest.approx(scene.mean((0, 1)).tolist(), abs=2e-3)


def test_training_takes_exposures_out(tmp_path):
    """Photos that grow brighter along the capture, on which a model of one exposure cannot show."""
    scene = with_exposures(nw.load_scene(write_demo(tmp_path / "demo", width=56, height=42, views=24, points=1500)))
    expected = torch.tensor([exposure_at(view) for view in scene.train]).log()
    expected -= expected.mean()
    configs = (small(iterations=150, max_surfels=400, exposures=exposed) for exposed in (True, False))
    model, without = (trained(scene, config).finish() for config in configs)
    assert (present(model.exposures).log_gains - expected[:, None]).abs().max() < 0.03
    assert evaluate(model, scene.test)["psnr"] > evaluate(without, scene.test)["psnr"] + 0.5


@pytest.mark.parametrize("change", [{"exposures": False}, {"mask_mode": "background"}])
def test_no_exposures_where_none_are_wanted(tmp_path, change):
    scene = with_exposures(nw.load_scene(write_demo(tmp_path / "demo", width=24, height=18, views=6, points=60)))
    config = small(iterations=2, max_surfels=40, **change)
    assert nw.Trainer(scene, config, "cpu").finish().exposures is None
    # A background that is known is no photo's business.
    known = dataclasses.replace(scene, background=(1.0, 1.0, 1.0))
    plain = dataclasses.replace(config, exposures=True, mask_mode="ignore")
    assert nw.Trainer(known, plain, "cpu").finish().exposures is None
    assert nw.Trainer(scene, plain, "cpu").finish().exposures is not None


def make_exposures(count: int, **changes: torch.Tensor) -> nw.Exposures:
    values = {name: torch.zeros(count, 3) for name in ("log_gains", "positions", "directions", "coefficients")}
    return nw.Exposures(values | {"mean": torch.zeros(3), "lengths": torch.ones(2)} | changes)


def test_predicted_gains_stay_within_those_of_the_photos() -> None:
    gains = torch.tensor([[-0.2, -0.1, 0.0], [0.1, 0.2, 0.3]])
    for sign, end in ((9.0, gains[1]), (-9.0, gains[0])):
        exposures = make_exposures(2, log_gains=gains, coefficients=torch.full((2, 3), sign))
        assert_close(exposures.gains(looking(0.0)), end.exp(), kind="value", name="gains")


@pytest.mark.parametrize("count", [0, 1001])
def test_exposures_of_too_few_and_too_many_photos_are_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(ValueError, match=f"exposures: expected 1 to 1,000 photos, got {count:,}"):
        make_exposures(count)
    model = nw.Model(make_surfels(random_scene(3)), None, make_exposures(2))
    for name in ("log_gains", "positions", "directions", "coefficients"):
        setattr(model.exposures, name, torch.zeros(count, 3))
    with pytest.raises(ValueError, match="expected 1 to 1,000 photos"):
        nw.load(model.save(tmp_path))
