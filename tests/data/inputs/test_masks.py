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


def palette(colors, used=None, **options):
    """Writer of a palette file of colours; `used` are the indices of pixels that do not count, and that do."""

    def write(file, mask):
        unused, counted = (0, 1) if used is None else used
        image = Image.fromarray(np.where(mask, counted, unused).astype(np.uint8))
        image.putpalette(np.array(colors, np.uint8).tobytes())
        image.save(file, **options)

    return write


def values(dtype, unused, counted, mode=None):
    return lambda file, mask: Image.fromarray(np.where(mask, counted, unused).astype(dtype), mode).save(file)


def rgba(color, around, mode="RGBA"):
    """Writer of a transparent file: a colour with alpha where the mask counts, another elsewhere."""
    return lambda file, mask: Image.fromarray(np.uint8(np.where(mask[..., None], color, around)), mode).save(file)


BLACK, WHITE = (0, 0, 0), (255, 255, 255)
VOC = [BLACK, (128, 0, 0), (0, 128, 0), (128, 128, 0)]
RAMP = [(i, i, i) for i in range(256)]
KINDS = {
    "0 and 1": values(np.uint8, 0, 1),
    "1 bit": lambda file, mask: Image.fromarray(mask).save(file),
    "RGB": lambda file, mask: write_mask(file, mask, "RGB"),
    "16 bits": values(np.uint16, 0, 65535),
    "16 bits around the threshold": values(np.uint16, 32767, 32768),
    "16 bits of 0 and 1": values(np.uint16, 0, 1),
    "white before black": palette([WHITE, BLACK], (1, 0)),
    "black before white": palette([BLACK, WHITE]),
    "white before black, 1 bit": palette([WHITE, BLACK], (1, 0), bits=1),
    "quantised": lambda file, mask: Image.fromarray(mask * np.uint8(255)).convert("RGB").quantize(2).save(file),
    "quantised grey": palette([(250, 250, 250), (3, 3, 3), (90, 90, 90)], (2, 0)),
    "red before black": palette([(255, 0, 0), BLACK], (1, 0)),
    "transparent index": palette([WHITE, WHITE], transparency=0),
    "labels of VOC": palette(VOC, (0, 3)),
    "label of VOC that is dark": palette(VOC, (0, 1)),
    "labels of a grey ramp": palette(RAMP, (0, 5)),
    "labels of other colours": palette([(31, 119, 180), (255, 127, 14), (44, 160, 44)]),
    "RGBA": rgba((*WHITE, 255), (*WHITE, 0)),
    "RGBA, opaque": rgba((*WHITE, 255), (*BLACK, 255)),
    "LA": rgba((255, 255), (255, 0), "LA"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_masks_of_every_kind(tmp_path, kind):
    path = make_scene(tmp_path / "scene", names=["0.png", "1.png"])
    (path / "masks").mkdir()
    KINDS[kind](path / "masks" / "0.png", MASK)
    KINDS["0 and 1"](path / "masks" / "1.tif.png", MASK)  # of no photo
    mask = views_of(load_scene(path))[0].mask
    assert mask is not None and np.array_equal(mask.numpy(), MASK)


def test_tiff_masks_are_not_turned_and_floats_are_refused(tmp_path):
    path = make_scene(tmp_path / "scene")
    (path / "masks").mkdir()
    Image.fromarray(MASK * np.uint8(255)).save(path / "masks" / "03.png", "TIFF", tiffinfo={274: 3})
    assert np.array_equal(views_of(load_scene(path))[3].mask.numpy(), MASK)
    Image.fromarray(MASK.astype(np.float32)).save(path / "masks" / "03.png", "TIFF")
    with pytest.raises(ValueError, match=r"masks/03.png: expected 8 or 16 bits a channel, got floats"):
        load_scene(path)


def test_masks_go_with_smaller_photos(tmp_path):
    path = make_scene(tmp_path / "scene")
    coarse = MASK[:18, :24]
    write_mask(path / "masks" / "01.png", np.kron(coarse, np.ones((2, 2))))
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
