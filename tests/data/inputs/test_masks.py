"""Masks: what they leave out, in every format and size."""

import numpy as np
import pytest
from PIL import Image

from nexwarp.data import load_scene
from tests.data.inputs.support import MASK, edit, write_mask
from tests.data.test_scene import make_scene, views_of
from tests.scene_writers import write_nerfstudio


@pytest.mark.parametrize("name", ["03.png.png", "03.png", "03.jpg"])
def test_masks_beside_the_photos(tmp_path, name):
    path = make_scene(tmp_path / "scene")
    mask = np.kron(MASK[:9, :12], np.ones((4, 4))) > 0 if name.endswith("jpg") else MASK
    write_mask(path / "masks" / name, mask)
    for view in views_of(load_scene(path)):
        assert (view.mask is None) == (view.name != "03.png")
        assert view.mask is None or np.array_equal(view.mask.numpy(), mask)
    assert all(view.mask is None for view in views_of(load_scene(path, masks=None)))


def test_masks_of_names_with_folders_and_of_another_folder(tmp_path):
    path = make_scene(tmp_path / "scene", names=["left/a.jpg", "right/a.jpg"])
    write_mask(path / "cut" / "right" / "a.png", MASK)
    masks = {view.name: view.mask for view in views_of(load_scene(path, masks="cut"))}
    assert masks["left/a.jpg"] is None and np.array_equal(masks["right/a.jpg"].numpy(), MASK)


def test_masks_of_labels_and_of_all_kinds(tmp_path):
    path = make_scene(tmp_path / "scene")
    (path / "masks").mkdir()
    Image.fromarray(MASK.astype(np.uint8)).save(path / "masks" / "01.png")  # 0 and 1
    write_mask(path / "masks" / "02.png", MASK, "1")
    write_mask(path / "masks" / "03.png", MASK, "RGB")
    write_mask(path / "masks" / "04.png", np.ones((36, 48)))
    Image.fromarray(np.where(MASK, 65535, 0).astype(np.uint16)).save(path / "masks" / "05.png")
    masks = [view.mask for view in views_of(load_scene(path))]
    assert all(np.array_equal(masks[index].numpy(), MASK) for index in (1, 2, 3, 5)) and masks[4] is None


def test_masks_go_with_smaller_photos(tmp_path):
    path = make_scene(tmp_path / "scene")
    coarse = MASK[:18, :24]
    write_mask(path / "masks" / "01.png", np.kron(coarse, np.ones((2, 2))))
    scene = load_scene(path, downscale=2)
    assert np.array_equal(views_of(scene)[1].mask.numpy(), coarse)
    (path / "images_2").mkdir()
    for file in (path / "images").iterdir():
        Image.open(file).resize((24, 18)).save(path / "images_2" / file.name)
    assert np.array_equal(views_of(load_scene(path, images="images_2"))[1].mask.numpy(), coarse)


def test_a_reduced_pixel_counts_where_all_of_it_does(tmp_path):
    path = make_scene(tmp_path / "scene")
    write_mask(path / "masks" / "01.png", MASK)
    expected = MASK.reshape(12, 3, 16, 3).all(axis=(1, 3))
    assert np.array_equal(views_of(load_scene(path, downscale=3))[1].mask.numpy(), expected)


def test_masks_are_undistorted_with_their_photos(distorted, tmp_path):
    """A photo that is white where the mask counts stays so."""
    path = write_nerfstudio(distorted["OPENCV"], tmp_path / "scene")
    mask = np.zeros((72, 96))
    mask[20:50, 30:70] = 1
    write_mask(path / "cut.png", mask)
    Image.fromarray((mask[..., None] * np.full(3, 255)).astype(np.uint8)).save(path / "images" / "view_003.png")
    edit(path, lambda data: [f.update(mask_path="cut.png") for f in data["frames"] if "view_003" in f["file_path"]])
    view = views_of(load_scene(path))[3]
    white = view.image[:, :, 0] >= 128
    assert view.mask.shape == white.shape and (view.mask != white).float().mean() < 0.01
    assert 0.1 < view.mask.float().mean() < 0.3
