import dataclasses
import textwrap
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import nexwarp as nw
from nexwarp import ops
from tests.narrowing import present
from tests.reference.collect import Shape, collect, rays_of
from tests.render_support import rigid_gradient, view_of
from tests.scenes import SURFEL_KEYS, Scene, make_camera, named_scene, random_scene
from tests.tolerances import FLIPS, assert_close, assert_same_ids

GEOMETRY = SURFEL_KEYS[:5]


def shade(mlp: nn.Module, features: torch.Tensor, points: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """A researcher's shading: an MLP of blended features, hit point and ray, with the alpha left alone."""
    rays = directions[:, :, None].expand(*points.shape)
    return mlp(torch.cat([features, torch.sin(points), rays], dim=-1))


def reference_hits(shape: Shape, colors: torch.Tensor, camera: nw.Camera, max_hits: int) -> nw.Hits:
    """The same buffers from the float64 reference."""
    view, (rotation, shift) = view_of(camera), (camera.viewmat[:3, :3], camera.viewmat[:3, 3])
    hits = collect(shape, colors, camera.viewmat, view, max_hits)
    rays = (rays_of(view, shift) @ rotation).reshape(view.height, view.width, 3)
    points = hits.depths[..., None] * rays[:, :, None] - shift @ rotation
    directions = nn.functional.normalize(rays, dim=-1)
    return nw.Hits(hits.ids, hits.depths, hits.weights, hits.plain, hits.alpha, points, directions)


def pipeline(
    dtype: torch.dtype, device: torch.device, channels: int, max_hits: int, reference: bool
) -> tuple[nw.Hits, torch.Tensor, dict[str, torch.Tensor]]:
    """Draw means = net(z) with own colours and shading; return all buffers, the image and the leaves' gradients."""
    scene = random_scene(seed=3, dtype=dtype, device=device)
    count = len(scene["means"])
    torch.manual_seed(11)
    net: nn.Module = nn.Linear(5, 3).double()
    mlp: nn.Module = nn.Sequential(nn.Linear(channels + 6, 8), nn.Tanh(), nn.Linear(8, channels)).double()
    z, colors = torch.randn(count, 5).double(), torch.randn(count, channels).double()
    z, colors = (x.to(device=device, dtype=dtype) for x in (z, colors))
    for module in (net, mlp):
        module.to(device=device, dtype=dtype)
    leaves = {name: scene[name].clone().requires_grad_() for name in GEOMETRY[1:]}
    leaves |= {"z": z.requires_grad_(), "colors": colors.requires_grad_()}
    camera = make_camera(scene)
    means = scene["means"] + 0.1 * net(z)
    geometry: dict[str, Any] = {"means": means} | {name: leaves[name] for name in GEOMETRY[1:]}
    if reference:
        hits = reference_hits(Shape(**geometry), colors, camera, max_hits)
    else:
        hits = nw.rasterize(**geometry, colors=colors, camera=camera, max_hits=max_hits)
    features = colors[hits.ids.clamp_min(0).long()]
    texels = torch.where((hits.ids >= 0)[..., None], shade(mlp, features, hits.points, hits.directions), 0.0)
    background = torch.linspace(-1, 1, channels, dtype=dtype, device=device)
    if reference:
        image = hits.plain + (hits.weights[..., None] * texels).sum(-2) + (1 - hits.alpha)[..., None] * background
    else:
        image = nw.compose(hits, texels, background)
    generator = torch.Generator().manual_seed(5)
    outputs = [image, *(getattr(hits, x.name) for x in dataclasses.fields(hits)[1:])]
    loss = sum((x * torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)).sum() for x in outputs)
    loss.backward()
    networks = {"net": net, "mlp": mlp}
    leaves |= {f"{kind}.{name}": x for kind, module in networks.items() for name, x in module.named_parameters()}
    gradients = {name: present(x.grad) for name, x in leaves.items()}
    return hits, image, gradients | {"camera": rigid_gradient(camera.viewmat)}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("channels", "max_hits"), [(8, 2), (1, 1), (3, 2), (21, 2)])
def test_own_colours_and_shading_through_a_network_match_the_reference(channels, max_hits, dtype, device):
    hits, image, grads = pipeline(dtype, device, channels, max_hits, False)
    expected, wanted, exact = pipeline(torch.float64, torch.device("cpu"), channels, max_hits, True)
    flips = 0.0 if dtype == torch.float64 else FLIPS
    assert_same_ids(hits.ids, expected.ids, name="ids", allow_flips=flips)
    assert_close(image, wanted, kind="value", name="image", allow_flips=flips)
    for field in dataclasses.fields(hits)[1:]:
        values = getattr(hits, field.name), getattr(expected, field.name)
        assert_close(*values, kind="value", name=field.name, allow_flips=flips)
    for name, gradient in exact.items():
        assert_close(grads[name], gradient, kind="gradient", name=name, precision=dtype)


def plain_tensors(scene: Scene, channels: int) -> dict[str, Any]:
    """Geometry of a scene, and colours (N, D) that begin with those of a smaller D."""
    generator = torch.Generator().manual_seed(2)
    colors = torch.randn(len(scene["means"]), 40, generator=generator).to(scene["means"])[:, :channels]
    return {name: scene[name] for name in GEOMETRY} | {"colors": colors}


def test_harmonics_give_the_bits_of_a_rendering(device):
    """It is the one trained path: every buffer, and gradients of a rendering without a texture."""
    scene = named_scene("layered", torch.float32, device)
    camera = make_camera(scene)
    surfels = nw.Surfels.from_activated(*(scene[name] for name in SURFEL_KEYS))
    shape: dict[str, Any] = {name: x.detach() for name, x in surfels.activated()._asdict().items()}
    shape["quats"] = surfels.raw_quats.detach()  # of any length; unit ones would be rounded twice
    hits = nw.rasterize(**shape, colors=scene["sh"], camera=camera, max_hits=4)
    out, behind = (nw.render(surfels, None, camera, 4, background) for background in (0.0, 0.5))
    for name in ("ids", "weights", "alpha"):
        assert torch.equal(getattr(hits, name), getattr(out, name)), name
    assert_close(hits.plain, out.plain, kind="value", name="plain")
    assert_close(nw.compose(hits, out.colors, 0.5), behind.image, kind="value", name="image")


def test_more_channels_change_no_other_buffer(device):
    """Each channel is blended as alone, wherever a walk's channels begin and end."""
    scene = named_scene("random", torch.float32, device)
    camera = make_camera(scene)
    most = nw.rasterize(**plain_tensors(scene, 40), camera=camera)
    for channels in (1, 2, 3, 4, 19, 20, 36):
        hits = nw.rasterize(**plain_tensors(scene, channels), camera=camera)
        assert torch.equal(hits.plain, most.plain[..., :channels])
        for name in ("ids", "depths", "weights", "alpha", "points", "directions"):
            assert torch.equal(getattr(hits, name), getattr(most, name)), name


def test_background_arrays_and_lists_of_cameras(device):
    scene = named_scene("random", torch.float32, device)
    first, second = make_camera(scene), make_camera(named_scene("random", torch.float32, device) | {"near": 3.0})
    tensors, background = plain_tensors(scene, 5), torch.randn(5, device=device)
    arrays = {name: x.cpu().double().numpy() for name, x in tensors.items()}
    bare = nw.rasterize(**tensors, camera=first, max_hits=0)
    colored = nw.rasterize(**arrays, camera=first, max_hits=0, background=background)
    assert torch.equal(colored.plain, bare.plain + (1 - bare.alpha)[..., None] * background)
    nothing = background.new_empty(*bare.weights.shape, 5)
    assert torch.equal(nw.compose(bare, nothing, background), colored.plain)
    assert torch.equal(nw.compose(bare, nothing), bare.plain)
    cameras = [first, second]
    batch, apart = nw.rasterize(**tensors, camera=cameras), [nw.rasterize(**tensors, camera=x) for x in cameras]
    texels = torch.randn(*batch.weights.shape, 5, device=device)
    images = nw.compose(batch, texels, background)
    for i, hits in enumerate(apart):
        assert torch.equal(images[i], nw.compose(hits, texels[i], background))
        for field in dataclasses.fields(hits):
            assert torch.equal(getattr(batch, field.name)[i], getattr(hits, field.name)), field.name
    empty = nw.rasterize(**{name: x[:0] for name, x in tensors.items()}, camera=first, background=background)
    assert torch.equal(empty.plain, background.expand_as(empty.plain)) and not (empty.ids + 1).any()


def test_what_does_not_fit_is_refused_by_its_name(device):
    scene = named_scene("random", torch.float32, device)
    tensors = plain_tensors(scene, 8)
    camera, means = make_camera(scene), tensors["means"]

    def refused(message: str, error: type[Exception] = ValueError, **changes: Any) -> None:
        with pytest.raises(error, match="^" + message):
            nw.rasterize(**(tensors | {"camera": camera} | changes))

    refused(r"colors: expected shape \(N=24, D=8\), got \(23, 8\)", colors=tensors["colors"][1:])
    refused("colors: expected at least 1 channel, got 0", colors=tensors["colors"][:, :0])
    refused("colors: expected 1, 4, 9 or 16 spherical harmonics .*, got 8", colors=means.new_zeros(24, 8, 3))
    refused("scales: expected dtype torch.float32, got torch.float64", TypeError, scales=tensors["scales"].double())
    halves = {name: x.half() for name, x in tensors.items()}
    refused("means: expected float32 or float64 values, got torch.float16", TypeError, **halves)
    refused("max_hits: expected at least 0 and at most 8, got 9", max_hits=9)
    refused("background: expected 8 values, got 3", background=(0, 0, 0))
    refused(r"background: expected shape \(8\), got \(3,\)", background=torch.zeros(3, device=device))
    refused("camera: expected a nexwarp.Camera or a list of them, got", TypeError, camera=[])
    refused("camera: expected cameras of one size, got", camera=[camera, camera.crop(0, 0, 5, 5)])
    double = camera.to(torch.float64)
    refused("camera.viewmat: expected dtype torch.float32, got torch.float64", TypeError, camera=double)
    hits = nw.rasterize(**tensors, camera=camera)
    with pytest.raises(ValueError, match=r"^colors: expected shape \(18, 23, 2, 8\), got \(18, 23, 2, 3\)"):
        nw.compose(hits, torch.zeros(18, 23, 2, 3, device=device))


def test_sixteen_channels_take_one_walk(device, monkeypatch):
    """The walk along the lists is what costs: 3 and 19 channels take one, 35 two."""
    walks: list[int] = []
    collect = ops.collect

    def counted(*args: Any, **options: Any) -> ops.Hits:
        walks.append(1)
        return collect(*args, **options)

    monkeypatch.setattr(ops, "collect", counted)
    scene = named_scene("random", torch.float32, device)
    for channels, count in ((3, 1), (16, 1), (19, 1), (35, 2)):
        walks.clear()
        nw.rasterize(**plain_tensors(scene, channels), camera=make_camera(scene))
        assert len(walks) == count, channels


def test_a_graph_that_would_be_cut_is_refused(device):
    """New parameters would cut it; intrinsics have no gradient."""
    scene = named_scene("random", torch.float32, device)
    camera, tensors = make_camera(scene), plain_tensors(scene, 3)
    graph = 2 * scene["gammas"].requires_grad_()
    with pytest.raises(ValueError, match=r"^gammas: .* got one of MulBackward0; nexwarp.rasterize keeps the graph"):
        nw.Surfels.from_activated(*((scene | {"gammas": graph})[name] for name in SURFEL_KEYS))
    surfels = nw.Surfels.from_activated(*((scene | {"gammas": graph.detach()})[name] for name in SURFEL_KEYS))
    wanted = dataclasses.replace(camera, K=camera.K.clone().requires_grad_())
    for draw in (lambda: nw.render(surfels, None, wanted), lambda: nw.rasterize(**tensors, camera=wanted)):
        with pytest.raises(ValueError, match=r"^camera.K: expected requires_grad=False: .* no gradient"):
            draw()
        with torch.no_grad():
            draw()


def test_the_shading_of_the_docs_reaches_all_that_it_was_made_of():
    """The code of docs/python.md as it stands, on a scene of this file."""
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    section = page.split("\n## Your own shading\n")[1].split("\n## ")[0]
    code = textwrap.dedent("\n".join(line for line in section.splitlines() if line.startswith("    ")))
    scene = named_scene("random", torch.float32, "cpu")
    camera, count = make_camera(scene), len(scene["means"])
    values: dict[str, Any] = {name: scene[name].requires_grad_() for name in GEOMETRY[1:]}
    values |= {"torch": torch, "nw": nw, "camera": camera, "count": count, "photo": torch.rand(18, 23, 3)}
    exec(code, values)
    leaves = [*(values[name] for name in ("features", *GEOMETRY[1:])), camera.viewmat]
    for x in (*leaves, *values["net"].parameters(), *values["head"].parameters()):
        assert x.grad is not None and x.grad.abs().sum() > 0
