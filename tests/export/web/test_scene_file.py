import base64
import json
import re
import struct
import zlib
from functools import cache, partial

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.export.web.export import one_file, static_files
from nexwarp.export.web.quantise import CHUNK, encode_chunks, encode_limits, encode_quats, morton_order
from nexwarp.export.web.scene_file import SCENE_FILE, encode_scene, scene_arrays
from nexwarp.kernels import sh
from nexwarp.model.options import RenderOptions
from nexwarp.model.texture import NEVER
from tests.export.web import support
from tests.export.web.support import named_cameras, read_sections, read_surfels, web_model
from tests.reference.collect import rotations


@cache
def content_of(quality: str = "quantised") -> bytes:
    model, camera = web_model()
    return encode_scene(model, named_cameras(camera), quality=quality, facts={"title": "a & b"}, poster=b"picture")


def test_a_full_file_holds_every_bit():
    model, _ = web_model()
    expected, (header, arrays) = scene_arrays(model), read_sections(content_of("full"))
    for name in ("means", "quats", "scales", "opacities", "gammas", "limits", "sh"):
        np.testing.assert_array_equal(arrays[name], expected[name])
    distances = np.linalg.norm(arrays["means"] - np.array(header["center"]), axis=1)
    assert (distances < header["radius"]).sum() == len(distances) // 2
    assert header["options"]["background"] == list(model.options.background)
    assert isinstance(model.texture, nw.NeuralTexture)
    np.testing.assert_array_equal(arrays["grid"], model.texture.grid.detach().numpy())
    np.testing.assert_array_equal(np.float32(header["texture"]["resolutions"]), model.texture.resolutions.numpy())
    weights = [matrix.detach().numpy().ravel() for matrix in model.texture.mlp.parameters()]
    np.testing.assert_array_equal(arrays["mlp"], np.concatenate(weights))
    np.testing.assert_array_equal(arrays["exposures"], expected["exposures"])


def test_a_quantised_file_holds_the_surfels_in_morton_order():
    model, _ = web_model()
    order = morton_order(model.surfels.means.detach().numpy())
    surfels, expected = read_surfels(content_of()), scene_arrays(model)
    for name, bound in (("means", 1e-4), ("opacities", 0.002), ("sh", 0.02)):
        np.testing.assert_allclose(surfels[name], expected[name][order], atol=bound, err_msg=name)
    for name in ("scales", "gammas"):  # the axes may be swapped
        values, wanted = (np.sort(x, axis=1) for x in (surfels[name], expected[name][order]))
        np.testing.assert_allclose(values, wanted, rtol=0.01, err_msg=name)
    np.testing.assert_allclose(surfels["limits"], expected["limits"][order], rtol=1e-3)


def test_values_in_chunks_return_within_half_a_step():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((3 * CHUNK + 7, 2)) * [1.0, 1e3]
    values[CHUNK : 2 * CHUNK] = 5.0  # a chunk of one value
    for dtype in (np.uint8, np.uint16):
        codes, ranges = encode_chunks(values, dtype)
        steps = np.repeat(ranges[..., 1], CHUNK, axis=0)[: len(values)]
        rounding = 2e-7 * np.abs(values).max(0)
        assert (np.abs(support.decode_chunks(codes, ranges) - values) <= 0.5 * steps * 1.001 + 2 * rounding).all()


def test_rotations_return_the_same_surfel():
    rng = np.random.default_rng(1)
    quats = rng.standard_normal((2000, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    code, swapped = encode_quats(quats)
    decoded = support.decode_quats(code).astype(np.float64)
    expected, actual = (rotations(torch.from_numpy(x)).mT.numpy() for x in (quats, decoded))
    u, v = np.where(swapped[:, None, None], expected[:, [1, 0]], expected[:, :2]).transpose(1, 0, 2)
    for axis, wanted in ((actual[:, 0], u), (actual[:, 1], v), (actual[:, 2], expected[:, 2])):
        # Axes are lines: the surfel is the same with an axis reversed.
        angles = np.arccos(np.clip(np.abs((axis * wanted).sum(1)), 0, 1))
        assert angles.max() < 2e-3
    assert 0.2 < swapped.mean() < 0.8


def test_detail_limits_keep_their_ends():
    limits = np.array([[0.0, NEVER], [1e-3, 2.0], [0.5, 3.0]], np.float32)
    codes, scale = encode_limits(limits)
    np.testing.assert_allclose(support.decode_limits(codes, scale), limits, rtol=1e-4)
    assert support.decode_limits(codes, scale)[0].tolist() == [0, np.float32(NEVER)]


def test_the_morton_order_is_a_permutation_of_neighbours():
    means = np.random.default_rng(2).uniform(size=(4096, 3))
    order = morton_order(means)
    assert sorted(order.tolist()) == list(range(4096))
    extents = [np.ptp(means[order[i : i + CHUNK]], axis=0).max() for i in range(0, 4096, CHUNK)]
    assert np.median(extents) < 0.6


@pytest.mark.parametrize("quality", ["full", "quantised"])
def test_an_empty_scene(quality):
    model, camera = web_model(1)
    empty = {name: value[:0] for name, value in model.surfels.state_dict().items()}
    content = encode_scene(nw.Model(nw.Surfels(empty), None), {"a": camera}, quality=quality)
    header, _ = read_sections(content)
    assert header["surfels"] == 0 and header["texture"] is None and read_surfels(content)["sh"].shape == (0, 16, 3)


def test_numbers_of_the_header_are_those_of_the_scene():
    model, camera = web_model(options=RenderOptions(max_hits=3, sh_degree=2))
    header, _ = read_sections(encode_scene(model, named_cameras(camera), facts={"title": "a & b"}, poster=b"picture"))
    assert header["surfels"] == 60 and header["title"] == "a & b"
    cameras = header["cameras"]
    assert [entry["name"] for entry in cameras] == ["a.png", "b.png"]
    np.testing.assert_allclose(cameras[0]["viewmat"], camera.viewmat.double().flatten().numpy(), rtol=1e-8)
    assert cameras[1]["width"] == 20 and cameras[1]["K"][2] == pytest.approx(camera.cx - 2)
    sections = header["sections"]
    names = [entry["name"] for entry in sections]
    assert names[0] == "poster" and names[-1] == "grid" and names.index("sh") < names.index("mlp")
    assert all(entry["offset"] % 8 == 0 for entry in sections)


@cache
def damaged() -> dict[str, bytes]:
    """Files that the page must refuse, by what is wrong with them."""
    content = content_of()
    length = struct.unpack_from("<I", content, 12)[0]
    header, changed = support.header_of(content), partial(support.rebuilt, content)

    def entry(name: str, **values: object) -> bytes:
        return changed(sections=[{**e, **values} if e["name"] == name else e for e in header["sections"]])

    texture, options = header["texture"], header["options"]
    large = [{**e, "shape": [3, 2**30, 2]} if e["name"] == "grid" else e for e in header["sections"]]
    huge = changed(texture={**texture, "table_size": 2**30}, sections=large)
    last = next(e for e in header["sections"] if e["name"] == "sh")
    begin, end = 16 + length + last["offset"], 16 + length + last["offset"] + last["bytes"]
    bombed = content[:begin] + zlib.compress(bytes(50_000_000))[: end - begin].ljust(end - begin, b"\0") + content[end:]
    return {
        "empty": b"",
        "newer version": content[:8] + struct.pack("<I", 2) + content[12:],
        "endless header": content[:12] + struct.pack("<I", 2**32 - 1) + content[16:],
        "no JSON": content[:16] + b"x" * length + content[16 + length :],
        "a list": content[:12] + struct.pack("<I", 2) + b"[]" + content[16 + length :],
        "ends in the header": content[: 16 + length // 2],
        "ends in the grid": content[:-8],
        "many surfels": changed(surfels=2**24),
        "half a surfel": changed(surfels=0.5),
        "other SH": changed(sh_coefficients=7),
        "a table of any size": changed(texture={**texture, "table_size": 2**26}),
        "a grid of 8 GB": huge,
        "endless levels": changed(texture={**texture, "levels": 10**9}),
        "K of 100": changed(options={**options, "max_hits": 100}),
        "no options": changed(options=None),
        "sections of nothing": changed(sections=[None]),
        "other shape": entry("means", shape=[60, 3]),
        "behind the end": entry("grid", offset=10**12),
        "more than it has": entry("grid", bytes=10**9),
        "a bomb": bombed,
        "low-pass filter": changed(options={**options, "low_pass": True}),
        "SH of degree 4": changed(sh_coefficients=25),
    }


def page_of() -> tuple[str, dict[str, bytes]]:
    """The one file, and what it is made of."""
    content = {**static_files(), SCENE_FILE: content_of()}
    return one_file(content).decode(), content


def test_one_file_holds_every_module_and_asset():
    page, content = page_of()
    (text,) = re.findall(r'<script type="importmap">(.*?)</script>', page)
    modules = json.loads(text)["imports"]
    imported = set()
    for name, data in content.items():
        if name.endswith(".js"):
            prefix, encoded = modules.pop(f"nexwarp/{name}").split(",")
            assert prefix == "data:text/javascript;base64" and base64.b64decode(encoded) == data
            imported |= set(re.findall(r'from "([^"]+)"', data.decode()))
        elif not name.endswith((".css", ".html")):
            (encoded,) = re.findall(rf'id="asset:{re.escape(name)}">([^<]*)</script>', page)
            assert base64.b64decode(encoded) == data
    assert modules == {} and imported <= {f"nexwarp/{name}" for name in content}
    # The assets come before the scripts that look for them.
    assert page.index('id="asset:scene.nxw"') < page.index('import "nexwarp/viewer.js"')


def test_the_page_names_no_other_server():
    page, content = page_of()
    texts = [data.decode() for name, data in content.items() if name.endswith((".js", ".css", ".wgsl", ".html"))]
    for text in [page, *texts]:
        found = re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}[^\s\"']*", text)
        assert [url for url in found if "www.w3.org" not in url] == []  # names of XML, not addresses


@pytest.mark.parametrize("name", ["shaders/common.wgsl", "baked_shaders.js"])
def test_spherical_harmonics_of_shaders_have_the_kernels_constants(name: str) -> None:
    """All digits, and no other constants: pictures would not show half a percent of one."""
    text = static_files()[name].decode()
    basis = text[text.index("0.28209") : text.rindex("3.0 * ")]
    constants = {float(number) for number in re.findall(r"(?<![\w.])\d+\.\d+", basis)} - {2.0, 3.0, 4.0, 0.0}
    assert constants == {sh.BAND_0, sh.BAND_1, *sh.BAND_2, *sh.BAND_3}
