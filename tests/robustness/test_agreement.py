"""Every render agrees with the dense reference, in values and gradients."""

from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.model.render import Frame, draw, jitter_factors
from tests.render_support import BACKGROUND, BUFFERS, assert_gradients, loss, reference_render, rigid_gradient, twin
from tests.scenes import make_camera, make_surfels, make_texture, named_scene
from tests.tolerances import FLIPS, assert_close, assert_same_ids

CASES = [
    # scene ("wide" is rendered by distance, "jittered" looks up points that are moved at random), textured (True, False
    # or "residual"), max_hits, sh_degree, clamp_texture
    ("random", True, 2, 3, False),
    ("random", True, 1, 1, True),
    ("random", True, 3, 2, True),
    ("random", False, 2, 3, False),
    ("random", True, 0, 3, False),
    ("layered", True, 2, 3, False),
    ("layered", True, 8, 0, True),
    ("layered", False, 1, 2, False),
    ("off_centre", True, 8, 2, False),
    ("off_centre", True, 2, 3, True),
    ("specks", True, 2, 3, False),
    ("near", True, 2, 3, False),
    ("random", "residual", 2, 3, False),
    ("layered", "residual", 5, 1, False),
    ("off_centre", "residual", 1, 2, False),
    ("random", "residual", 0, 3, False),
    ("wide", True, 2, 3, False),
    ("jittered", True, 1, 3, False),
    ("jittered", True, 2, 3, False),
    ("jittered", True, 4, 3, False),
]


@pytest.mark.parametrize("row", [torch.float64, torch.float32, torch.float16])
@pytest.mark.parametrize(("name", "textured", "max_hits", "sh_degree", "clamp_texture"), CASES)
def test_render_agrees_with_the_reference(name, textured, max_hits, sh_degree, clamp_texture, row, device):
    """Values, and gradients with respect to every parameter, to the feature grid, the MLP and the camera.

    The row float16 is float32 with the texture in half precision, the default on CUDA; its parameters are rounded
    to half precision first, since those are the ones that are rendered.
    """
    half = row == torch.float16
    if half and (device.type == "cpu" or not textured):
        pytest.skip("half precision is for textures on CUDA")
    if name == "jittered" and row != torch.float64:
        pytest.skip("the points are drawn in float64")
    dtype = torch.float32 if half else row
    scene = named_scene(name, dtype, device)
    surfels, camera = make_surfels(scene), make_camera(scene)
    residual = textured == "residual"
    texture = make_texture(dtype=dtype, device=device, residual=residual) if textured else None
    if texture is not None:
        texture.half_precision = half
        if half:
            texture.half().float()
    order = "distance" if name == "wide" else "depth"
    options: dict[str, Any] = {"max_hits": max_hits, "background": BACKGROUND, "sh_degree": sh_degree}
    options |= {"clamp_texture": clamp_texture, "order": order}
    flips = 0.0 if dtype == torch.float64 else FLIPS

    surfels64, texture64 = twin(surfels), twin(texture)
    camera64 = make_camera(scene | {"viewmat": scene["viewmat"].double().cpu(), "K": scene["K"].double().cpu()})
    jitter = jitter_factors(camera, max_hits, 2.0) if name == "jittered" else None
    if jitter is None:
        out = nw.render(surfels, texture, camera, **options)
    else:
        out = draw(Frame(surfels, texture, camera, nw.RenderOptions(**options), BACKGROUND, jitter=jitter))
        options["shares"] = jitter.cpu()
    expected = reference_render(surfels64, texture64, camera64, **options)
    loss(out).backward()
    loss(expected).backward()

    assert out.ids.dtype == torch.int32 and out.image.dtype == dtype
    assert_same_ids(out.ids, expected.ids, name="ids", allow_flips=flips)
    for buffer in BUFFERS:
        mine, theirs = getattr(out, buffer), getattr(expected, buffer)
        assert_close(mine, theirs, kind="value", name=buffer, precision=row, allow_flips=flips)
    assert_gradients(surfels, surfels64, row)
    if texture is not None:
        assert_gradients(texture, texture64, row)
    moved, expected_move = rigid_gradient(camera.viewmat), rigid_gradient(camera64.viewmat)
    assert_close(moved, expected_move, kind="gradient", name="viewmat", precision=row)
