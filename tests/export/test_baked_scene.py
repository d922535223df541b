import dataclasses
import math
import re
import struct

import pytest
import torch

import nexwarp as nw
from nexwarp import ops
from nexwarp.errors import FormatError, MissingError
from nexwarp.export.bake import bake, dimmed, measure
from nexwarp.export.baked_scene import BAKED_FILE, BakedScene
from nexwarp.export.glb import CUTOFF, LEAST_ALPHA, bake_cards, make_cards, save_glb
from nexwarp.export.web.export import one_file
from nexwarp.kernels.types import ALPHA_MAX, ALPHA_MIN, TINY
from nexwarp.model.surfels import Activated
from nexwarp.ops.atlas import Cut
from tests.export.web import support
from tests.export.web.support import as_stored, psnr, ring, ring_model
from tests.narrowing import present
from tests.reference.collect import rays_of, rotations
from tests.render_support import view_of
from tests.scenes import make_camera, make_surfels, random_scene
from tests.tolerances import assert_close


@pytest.fixture(scope="module")
def cameras() -> dict[str, nw.Camera]:
    return ring()


@pytest.fixture(scope="module")
def model(cameras) -> nw.Model:
    return ring_model(cameras, 12)


@pytest.fixture(scope="module")
def baked(model, cameras):
    return bake(model, list(cameras.values()), steps=10)


@pytest.fixture(scope="module")
def files(model, cameras, tmp_path_factory) -> dict[str, bytes]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nexwarp.export.fit.FEWEST_STEPS", 10)
        return support.exported(model, cameras, tmp_path_factory.mktemp("page"))


def in_double(scene: BakedScene) -> BakedScene:
    """The scene in float64, without detail limits."""
    values = {name: getattr(scene, name).double() for name in ("texels", "rects", "boxes")}
    shape = type(scene.shape)(*(x.double() for x in scene.shape))
    sh = scene.harmonics
    harmonics = None if sh is None else (sh[0].double(), sh[1].double())
    return dataclasses.replace(scene, shape=shape, harmonics=harmonics, limits=None, **values)


def by_definition(scene: BakedScene, camera: nw.Camera) -> torch.Tensor:
    """The image (H, W, 3) in float64, differentiable: every surfel at every pixel, without detail limits."""
    shape, frames = scene.shape, rotations(scene.shape.quats.double())
    viewmat, eye = camera.viewmat.detach().double(), camera.position.detach().double()
    rays = rays_of(view_of(camera), viewmat) @ viewmat[:3, :3]
    depths = ((shape.means - eye) * frames[:, :, 2]).sum(1) / (rays @ frames[:, :, 2].T)
    offsets = eye + depths[..., None] * rays[:, None] - shape.means
    local = torch.einsum("pni,nij->pnj", offsets, frames)[..., :2] / shape.scales
    share = ((local - scene.boxes[:, :2]) / (scene.boxes[:, 2:] - scene.boxes[:, :2])).clamp(0, 1)
    texels = support.bilinear(scene.texels, scene.rects[:, :2] + share * scene.rects[:, 2:])
    if scene.harmonics is not None:
        exponents = local.square().clamp_min(TINY).pow(shape.gammas).sum(-1)
        alphas = (shape.opacities * torch.exp(-0.5 * exponents)).clamp(max=ALPHA_MAX)
        alphas = alphas.where(alphas >= ALPHA_MIN, 0.0)
        colors = (ops.plain_colors(scene.harmonics, shape.means, eye, 3) + texels[..., :3]).clamp_min(0)
    else:
        alphas, colors = texels[..., 3].clamp(max=ALPHA_MAX), texels[..., :3].clamp_min(0)
        if scene.cut is not None and scene.cut.steepness:
            alphas = torch.sigmoid(scene.cut.steepness * (texels[..., 3] - scene.cut.cutoff)).clamp(max=0.999)
            alphas = alphas.where(alphas >= ALPHA_MIN, 0.0)
        elif scene.cut is not None:
            alphas = (texels[..., 3] >= scene.cut.cutoff).double()
        alphas = alphas.where((local.abs() <= 1).all(-1), 0.0)
    alphas = alphas.where(depths > camera.near, 0.0)
    order = (shape.means @ viewmat[2, :3]).expand_as(depths) if scene.cut is None else depths
    order = order.argsort(dim=1)
    alphas = alphas.gather(1, order)
    colors = colors.gather(1, order[..., None].expand(-1, -1, 3))
    before = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas).cumprod(1)], dim=1)
    background = torch.tensor(scene.background, dtype=torch.float64)
    image = ((alphas * before[:, :-1])[..., None] * colors).sum(1) + before[:, -1:] * background
    return image.reshape(camera.height, camera.width, 3)


def random_baked(form: str, count: int = 9) -> tuple[BakedScene, nw.Camera]:
    """A scene in float64 with random texels of 5 x 4, of one surfel with one texel, and a camera."""
    raw = random_scene(count, width=37, height=27, dtype=torch.float64)
    surfels, camera = make_surfels(raw), make_camera(raw)
    camera = dataclasses.replace(camera, viewmat=camera.viewmat.detach())
    generator = torch.Generator().manual_seed(5)
    texels = torch.rand(1 + 4 * count, 6, 4, generator=generator, dtype=torch.float64)
    shape = type(surfels.activated())(*(x.detach() for x in surfels.activated()))
    tops = 1 + 4.0 * torch.arange(count, dtype=torch.float64)
    rects = torch.stack([torch.zeros_like(tops), tops, torch.full_like(tops, 4.0), torch.full_like(tops, 3.0)], dim=1)
    boxes = torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64).repeat(count, 1)
    background = (0.2, 0.5, 0.1)
    if form == "surfels":
        boxes = boxes * torch.rand(count, 4, generator=generator, dtype=torch.float64).add(0.5)
        rects[count // 2, 2:] = 0
        harmonics = (surfels.sh0.detach().clone(), surfels.shN.detach().clone())
        return BakedScene(shape, texels - 0.5, boxes, rects, harmonics, background=background), camera
    shape = shape._replace(opacities=torch.ones_like(shape.opacities), gammas=torch.full_like(shape.gammas, 1000.0))
    cut = {"blend": None, "mask": Cut(0.4), "soft": Cut(0.4, 7.0, layers=count)}[form]
    return BakedScene(shape, texels, boxes, rects, background=background, cut=cut), camera


@pytest.mark.parametrize("form", ["surfels", "blend", "mask", "soft"])
def test_images_and_gradients_are_those_of_the_definition(form, device):
    scene, camera = random_baked(form)
    trained = [scene.texels, scene.shape.opacities, *(scene.harmonics or ())]
    results = []
    for draw in (lambda: scene.to(device).render(camera).cpu(), lambda: by_definition(scene, camera)):
        for x in trained:
            x.requires_grad_().grad = None
        image = draw()
        factors = torch.rand(image.shape, generator=torch.Generator().manual_seed(1), dtype=image.dtype)
        if form != "mask":
            (image * factors).sum().backward()
        results.append((image.detach(), *(x.grad for x in trained if x.grad is not None)))
    drawn, expected = results
    assert expected[0].std() > 0.05
    assert_close(drawn[0], expected[0], kind="value", name="image")
    # Of the definition, opacities of cards have no gradient; the drawing's are zero.
    for name, actual, wanted in zip(("texels", "opacities", "sh0", "shN"), drawn[1:], expected[1:], strict=False):
        assert_close(actual, wanted, kind="gradient", name=name)
    assert form == "mask" or len(expected) == (5 if form == "surfels" else 2)


def test_a_page_is_read_as_it_is_drawn(files, model, baked, cameras, tmp_path):
    for name, content in {"one.html": one_file(files), **files}.items():
        if "/" not in name:
            (tmp_path / name).write_bytes(content)
    scenes = [nw.load_baked(tmp_path / place) for place in ("one.html", "", "index.html", BAKED_FILE)]
    for camera in cameras.values():
        images = [scene.render(camera) for scene in scenes]
        assert all(torch.equal(image, images[0]) for image in images)
        expected = by_definition(in_double(as_stored(baked)), camera).detach() * model.exposures.factors(camera)
        assert psnr(images[0], expected) > 75


@pytest.mark.parametrize("alpha", ["mask", "blend"])
def test_cards_are_read_as_they_were_written(alpha, model, cameras, tmp_path):
    pytest.importorskip("trimesh")
    cards = bake_cards(model, list(cameras.values()), alpha, steps=10)
    save_glb(tmp_path / "a.glb", cards, list(cameras.values()))
    read = nw.load_baked(tmp_path / "a.glb")
    assert read.cut == cards.cut and (read.cut is None) == (alpha == "blend")
    assert_close(read.shape.means, cards.shape.means, kind="gradient", name="means")
    assert_close(read.shape.scales, cards.shape.scales, kind="gradient", name="scales")
    assert float((read.texels - cards.texels).abs().max()) < 0.51 / 255
    assert float((read.rects - cards.rects).abs().max()) < 1e-3
    for camera in cameras.values():
        # Pixels on the edge of a cut-out may flip where its alpha is rounded.
        assert psnr(read.render(camera), cards.render(camera)) > (30 if alpha == "mask" else 45)
        expected = by_definition(in_double(read), camera)
        assert psnr(read.render(camera), expected) > (30 if alpha == "mask" else 60)


def test_cards_of_a_bright_scene_are_dimmed_not_clipped(model, cameras, tmp_path):
    """At three times the brightness, cards show what they show at one, and `render_at_mean` three times of it."""
    pytest.importorskip("trimesh")
    scene, seen = measure(model, list(cameras.values()))
    once = make_cards(model, scene, seen, "blend")
    state = {name: x.clone() for name, x in model.surfels.state_dict().items()}
    state["sh0"] = 3 * state["sh0"] + (3 - 1) * 0.5 / 0.28209479177387814  # SH are around a grey of 0.5
    state["shN"] *= 3
    three_times = nw.Model(nw.Surfels(state), None, model.exposures, options=model.options)
    bright = make_cards(three_times, dataclasses.replace(scene, texels=3 * scene.texels), seen, "blend")
    assert bright.exposure < 0.6 and bright.exposure == pytest.approx(once.exposure / 3, abs=1e-6)
    opaque = bright.texels[bright.texels[..., 3] >= LEAST_ALPHA["blend"] * CUTOFF][:, :3].amax(1)
    assert 0.001 < float((opaque == 1).double().mean()) < 0.021
    assert_close(bright.texels, once.texels, kind="value", name="texels")
    unexposed = dataclasses.replace(model.options, exposure="mean")
    assert dimmed(nw.Model(model.surfels, None, model.exposures, None, unexposed), torch.full((5, 3), 3.0)) == 1
    save_glb(tmp_path / "a.glb", bright, list(cameras.values()))
    read = nw.load_baked(tmp_path / "a.glb")
    assert read.exposure == bright.exposure
    background = (0.3, 0.6, 0.9)
    for camera in cameras.values():
        image = (read.render_at_mean(camera, background) * bright.exposure).clamp(0, 1)
        assert psnr(image, bright.render(camera, background=[x * bright.exposure for x in background])) > 45


def test_damaged_files_give_one_line(files, model, cameras, tmp_path):
    pytest.importorskip("trimesh")
    save_glb(tmp_path / "good.glb", bake_cards(model, list(cameras.values()), steps=1), list(cameras.values()))
    page, glb = one_file(files), (tmp_path / "good.glb").read_bytes()
    with pytest.raises(MissingError, match="expected a page or a"):
        nw.load_baked(tmp_path / "none.glb")
    length = struct.unpack_from("<I", glb, 12)[0]
    cases = [(page[: len(page) // 2], ".html"), (b"", ".html"), (b"", ".glb"), (glb[: 28 + length], ".glb")]
    cases += [(b"GIF8" + glb[4:], ".glb"), (glb.replace(b'"VEC3"', b'"VEC9"'), ".glb")]
    cases += [(glb.replace(b'"MASK"', b'"MARK"'), ".glb"), (glb.replace(b'"byteLength"', b'"byteLengte"'), ".glb")]
    cases.append((re.sub(rb'"exposure":\s*[01]\.', b'"exposure":7.', glb), ".glb"))
    name = f'id="asset:{BAKED_FILE}">'.encode()
    cases.append((page.replace(name, name + b"AAAA"), ".html"))
    for content, suffix in cases:
        file = tmp_path / f"bad{suffix}"
        file.write_bytes(content)
        with pytest.raises((FormatError, MissingError)) as error:
            nw.load_baked(file)
        assert re.fullmatch(r".*bad.*expected.*", str(error.value)), "one line that names the file"


def test_a_threshold_has_no_gradient_of_alpha():
    scene, camera = random_baked("mask")
    texels = scene.texels.requires_grad_()
    scene.render(camera).square().sum().backward()
    grad = present(texels.grad)
    assert grad.isfinite().all() and (grad[..., 3] == 0).all() and grad[..., :3].abs().max() > 0


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_overdraw_is_the_area_of_the_quads(turn):
    """Of surfels across the ray, also turned about it; those behind the camera, or too faint, have none."""
    count, depth, gamma, opacity = 5, 2.0, 1.3, 0.5
    quats = torch.tensor([torch.tensor(turn / 2).cos(), 0.0, 0.0, torch.tensor(turn / 2).sin()]).repeat(count, 1)
    means = torch.tensor([[0.0, 0.0, depth]]).repeat(count, 1)
    means[3, 2] = -depth
    opacities = torch.full((count,), opacity)
    opacities[4] = 1 / 300
    scales, gammas = torch.tensor([[0.3, 0.25]]).repeat(count, 1), torch.full((count, 2), gamma)
    shape = Activated(means, quats, scales, opacities, gammas)
    zeros = torch.zeros(count, 4)
    scene = BakedScene(shape, torch.zeros(2, 2, 4), zeros, zeros, (torch.zeros(count, 1, 3), torch.zeros(count, 0, 3)))
    camera = nw.Camera(torch.eye(4), torch.tensor([[90.0, 0, 50], [0, 70, 40], [0, 0, 1]]), 100, 80)
    reach = (2 * math.log(255 * opacity)) ** (0.5 / gamma)
    area = (2 * reach * 0.3 * 90 / depth) * (2 * reach * 0.25 * 70 / depth)
    assert scene.overdraw(camera) == pytest.approx(3 * area / (100 * 80), rel=0.08)
