from pathlib import Path

import pytest
import torch

from nexwarp.io.pictures import THREADS, error_map, png_files, save_png, to_uint8, viridis
from tests.cli.support import picture


def test_png_returns_what_was_saved(tmp_path: Path, device: torch.device) -> None:
    image = torch.rand(7, 9, 3, device=device) * 1.4 - 0.2
    save_png(tmp_path / "new" / "a.png", image.requires_grad_())
    assert picture(tmp_path / "new" / "a.png").equal(to_uint8(image).cpu())
    save_png(tmp_path / "new" / "a.png", to_uint8(image).flip(0))
    assert picture(tmp_path / "new" / "a.png").equal(to_uint8(image).cpu().flip(0))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]
    with pytest.raises(ValueError, match=r"image: expected shape \(H, W, 3\), got \(7, 9\)"):
        save_png(tmp_path / "b.png", image[..., 0])


def test_pictures_compressed_in_threads_are_written_in_order_until_one_cannot_be(tmp_path: Path) -> None:
    images = [torch.rand(7, 9, 3) for _ in range(5 * THREADS)]
    files = [tmp_path / f"{index}.png" for index in range(len(images))]
    with png_files() as save:
        for file, image in zip(files, images, strict=True):
            save(file, image)
    assert all(picture(file).equal(to_uint8(image)) for file, image in zip(files, images, strict=True))
    files[3].unlink()
    files[3].mkdir()
    before = files[4].read_bytes()
    saved = 0
    with pytest.raises(IsADirectoryError, match=r"3\.png"), png_files() as save:
        for file, image in zip(files, images, strict=True):
            save(file, 1 - image)
            saved += 1
    assert saved < 4 + 2 * THREADS and files[4].read_bytes() == before, "nothing is written after an error"
    assert picture(files[2]).equal(to_uint8(1 - images[2])) and sorted(tmp_path.iterdir()) == sorted(files)


def test_error_map_runs_from_violet_to_yellow_at_a_quarter() -> None:
    target = torch.zeros(1, 6, 3)
    image = torch.tensor([0.0, 0.05, 0.1, 0.2, 0.25, 1.0]).view(1, 6, 1).expand(1, 6, 3)
    colours = error_map(image, target)
    assert colours.dtype == torch.uint8 and colours.shape == (1, 6, 3)
    assert colours[0, 0].tolist() == [68, 1, 84]  # viridis' ends
    assert colours[0, 4].tolist() == colours[0, 5].tolist() == [253, 231, 37]
    assert viridis()[128].tolist() == pytest.approx([33 / 255, 145 / 255, 140 / 255], abs=2 / 255)
    light = colours[0, :5].float() @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (light.diff() > 0).all(), "a larger error must be lighter"
    red, grey = torch.tensor([[[0.6, 0.0, 0.0]]]), torch.full((1, 1, 3), 0.2)
    assert error_map(red, torch.zeros(1, 1, 3)).equal(error_map(torch.zeros(1, 1, 3), grey)), "the mean of channels"
