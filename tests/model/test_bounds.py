import functools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import nexwarp as nw
from nexwarp.model.bounds import BOUNDS
from nexwarp.model.model_file import load, save_model
from tests.model_file_support import rewrite
from tests.narrowing import present
from tests.scenes import make_camera, make_surfels, random_scene
from tests.tolerances import assert_finite

DENORMAL = 1e-44
VALUES = (math.nan, math.inf, -math.inf, 1e30, -1e30, 3e38, 0.0, DENORMAL, -1.0)
MATRICES = tuple(f"texture.mlp.{index}.weight" for index in (0, 2, 4))
TENSORS = (*BOUNDS, *MATRICES)

# What must be refused: not finite pictures, or a value that the format excludes.
REFUSED = {
    "exposures.lengths": (0.0, DENORMAL, -1.0),
    "exposures.positions": (1e30, -1e30),
    "exposures.falloff": (1e30,),
    "surfels.means": (1e30, 3e38),
    "surfels.log_scales": (1e30, 3e38),
    "surfels.raw_gammas": (1e30, 3e38),
    "surfels.logit_opacities": (1e30, -1e30),
    "surfels.sh0": (3e38,),
    "surfels.shN": (3e38,),
    "footprints": (-1.0, 3e38),
    "far_footprints": (-1.0, 3e38),
    "texture.grid": (1e30, -1e30, 3e38),
    "texture.mlp.0.weight": (1e30, 3e38),
}


@functools.cache
def tiny_camera() -> nw.Camera:
    camera = make_camera(random_scene(12, width=16, height=12))
    return nw.Camera(camera.viewmat.detach(), camera.K, camera.width, camera.height)


def tiny_model() -> nw.Model:
    """A model with every tensor that the format has."""
    torch.manual_seed(0)
    texture = nw.NeuralTexture(levels=2, table_size=16, min_resolution=1.0, max_resolution=4.0, width=8, residual=True)
    torch.nn.init.normal_(texture.grid)
    cameras = [tiny_camera.__wrapped__() for _ in range(3)]
    for index, camera in enumerate(cameras):
        camera.viewmat[:3, 3] += 0.3 * index
    exposures = nw.Exposures.of(0.2 * torch.randn(3, 3), cameras, (-0.3, -0.2, 0.4))
    limits = nw.DetailLimits(torch.full((12,), 0.05), torch.full((12,), 0.2))
    return nw.Model(make_surfels(random_scene(12, width=16, height=12)), texture, exposures, limits)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model file, all in single precision."""
    file = save_model(tmp_path_factory.mktemp("model"), tiny_model())
    rewrite(file, lambda tensors, _: tensors.update({name: x.float() for name, x in tensors.items()}))
    return file


@pytest.fixture
def file(stored: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(stored, tmp_path / "model.safetensors"))


def with_number(content: bytes, name: str, value: float) -> bytes:
    """Replace the first number of a tensor in the content of a safetensors file."""
    size = int.from_bytes(content[:8], "little")
    place = 8 + size + json.loads(content[8 : 8 + size])[name]["data_offsets"][0]
    return content[:place] + torch.tensor([value]).numpy().tobytes() + content[place + 4 :]


def check_pictures(model: nw.Model, camera: nw.Camera, name: str) -> None:
    with torch.no_grad():
        out = model.render(camera)
        for part in ("image", "alpha", "depths", "expected_depth", "normals"):
            assert_finite(getattr(out, part), f"{part} with {name}")


def check_message(error: Exception, file: Path, name: str) -> None:
    text = str(error)
    assert text.startswith(str(file)) and "\n" not in text and len(text) < 600, text
    assert name.split(".")[-1] in text or name in text, text
    assert "expected" in text and "got" in text, text


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", TENSORS)
def test_a_number_is_refused_or_renders_finite(stored, file, device, name, value):
    file.write_bytes(with_number(stored.read_bytes(), name, value))
    try:
        model = load(file)
    except ValueError as error:
        check_message(error, file, name)
        return
    assert math.isfinite(value) and value not in REFUSED.get(name, ()), f"{name} with {value} loads"
    check_pictures(model.to(device), tiny_camera().to(device), f"{name} = {value}")


def test_half_precision_is_left_where_it_could_overflow(stored: Path, file: Path) -> None:
    for value, fits in ((1.0, True), (65504.0, False)):
        file.write_bytes(with_number(stored.read_bytes(), MATRICES[0], value))
        assert present(load(file).texture).half_precision == fits


def test_the_bounds_are_those_of_every_tensor(stored: Path) -> None:
    tensors: dict[str, torch.Tensor] = {}
    rewrite(stored, lambda found, _: tensors.update(found))
    assert set(TENSORS) == tensors.keys()


@pytest.mark.parametrize("name", sorted(BOUNDS.keys() - {"exposures.falloff", "surfels.raw_quats"}))
@pytest.mark.parametrize("end", [0, 1])
def test_bounds_themselves_render_finite(file, device, name, end):
    """All elements at an end of the range at once, up to the float32 value next to it."""
    value = torch.nextafter(torch.tensor(BOUNDS[name][end]), torch.tensor(1.0)).item()
    rewrite(file, lambda tensors, _: tensors.update({name: torch.full_like(tensors[name], value)}))
    check_pictures(load(file).to(device), tiny_camera().to(device), f"{name} = {value}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surfels.raw_quats": torch.zeros(12, 4)}, "surfels.raw_quats: expected a length of at least 1e-12, got 0"),
        ({"exposures.falloff": torch.tensor([60.0, -30.0, 0.4])}, "expected a t + b t^2 of at most 20, got a 60 and b"),
        ({"exposures.falloff": torch.tensor([90.0, -95.0, 0.4])}, "expected a t + b t^2 of at most 20, got a 90 and b"),
        ({"exposures.falloff": torch.tensor([0.1, 0.1, 1e-20])}, "squared tangent of at least 1e-12, got 1e-20"),
        (dict.fromkeys(("texture.grid", *MATRICES), 1e4), "texture.mlp.2.weight: expected outputs of at most 1e+12"),
    ],
)
def test_numbers_that_fail_together_are_refused(file, change, message):

    def apply(tensors: dict[str, torch.Tensor], _: dict[str, Any]) -> None:
        for name, value in change.items():
            tensors[name] = value if isinstance(value, torch.Tensor) else torch.full_like(tensors[name], value)

    rewrite(file, apply)
    with pytest.raises(ValueError) as caught:
        load(file)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("key", ["background", "near", "scene_scale", "smooth_sh"])
def test_a_number_of_the_metadata_is_refused_or_renders_finite(file, key, value):
    rewrite(file, lambda _, meta: meta.update({key: [0.1, value, 0.2] if key == "background" else value}))
    try:
        model = load(file)
    except ValueError as error:
        check_message(error, file, key)
        return
    assert math.isfinite(value) and abs(value) < 1e30
    check_pictures(model, tiny_camera(), f"{key} = {value}")
