from pathlib import Path

import pytest
import torch

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data.images import image_size, read_image
from nexwarp.errors import FormatError
from nexwarp.io.pictures import display_light, linear_light, load_exr, save_exr
from tests.data.inputs.test_photos import png16
from tests.scene_writers import write_demo, write_text


def every_level() -> torch.Tensor:
    """(16, 16, 3) uint8 with all 256 levels of each channel."""
    levels = torch.arange(256, dtype=torch.uint8).reshape(16, 16)
    return torch.stack([levels, levels.T, levels.flip(0)], dim=-1)


def test_linear_light_is_read_as_the_srgb_that_it_is_of(tmp_path: Path) -> None:
    shown = every_level()
    light = linear_light(shown / 255)
    assert torch.allclose(display_light(light), shown / 255, atol=1e-6)
    save_exr(tmp_path / "a.exr", {"image": light})
    save_exr(tmp_path / "b.exr", {"image": 3 * light})
    assert image_size(tmp_path / "a.exr") == (16, 16) and read_image(tmp_path / "a.exr").equal(shown)
    assert read_image(tmp_path / "b.exr", 3.0).equal(shown)
    clipped = read_image(tmp_path / "b.exr")
    assert clipped.equal((display_light((3 * light).clamp(max=1)) * 255).round().byte()) and clipped.max() == 255
    save_exr(tmp_path / "grey.exr", {"image": light[..., 0]})
    with pytest.raises(FormatError, match="expected the channels R, G and B, got Y"):
        read_image(tmp_path / "grey.exr")
    save_exr(tmp_path / "nan.exr", {"image": light * torch.nan})
    with pytest.raises(FormatError, match="expected numbers, got NaN"):
        read_image(tmp_path / "nan.exr")


def test_all_16_bits_of_a_png_are_read(tmp_path: Path) -> None:
    shown = every_level()
    png16(tmp_path / "a.png", 255 * linear_light(shown / 255).numpy())
    assert read_image(tmp_path / "a.png", 1.0).equal(shown)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    with pytest.raises(ValueError, match=r"a\.png: expected a (whole|complete)"):
        read_image(tmp_path / "a.png", 1.0)


def test_twice_the_light_gives_twice_the_light(tmp_path: Path) -> None:
    demo, pictures = write_demo(tmp_path / "demo", 32, 24, 4, 60), {}
    for light in (1, 2):
        scene, run = write_text(demo, tmp_path / f"scene{light}"), tmp_path / f"run{light}"
        for file in (scene / "images").glob("*.png"):
            save_exr(file.with_suffix(".exr"), {"image": light * linear_light(read_image(file) / 255)})
            file.unlink()
        listed = scene / "sparse" / "0" / "images.txt"
        listed.write_text(listed.read_text().replace(".png", ".exr"))
        flags = ["--iterations", "4", "--max-surfels", "40", "--device", "cpu", "--set", "texture.table_size=1024"]
        assert cli.main(["train", str(scene), "--run", str(run), "--linear", str(light), *flags]) == 0
        assert nw.load(run).meta["white"] == light
        assert cli.main(["render", str(run), "--set", "all", "--format", "exr", "--device", "cpu"]) == 0
        found = sorted((run / "renders").rglob("*.exr"))
        pictures[light] = torch.stack([load_exr(file)[0]["image"] for file in found])
    assert len(pictures[1]) == 4 and pictures[1].std() > 0.01
    torch.testing.assert_close(pictures[2], 2 * pictures[1], rtol=1e-5, atol=1e-6)
