import struct
import zlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from nexwarp.data import load_scene
from tests.data.inputs import room
from tests.data.test_scene import views_of

GREY = np.array([0.299, 0.587, 0.114])  # of ITU-R BT.601, as PIL converts to grey


def grey(photo: np.ndarray) -> np.ndarray:
    return np.repeat(np.round(photo @ GREY)[..., None], 3, axis=-1)


def one_bit(photo: np.ndarray) -> np.ndarray:
    return np.where(grey(photo) >= 128, 255, 0)


def save(file, photo, mode="RGB", **options):
    Image.fromarray(photo).convert(mode).save(file, **options)


def save_rotated(file, photo, orientation):
    exif = Image.Exif()
    exif[274] = orientation
    save(file, photo, exif=exif, quality=98)


def png16(file, photo, color=2, alpha=False):
    """Write a PNG file of 16 bits: colour type 2 is RGB, 0 grey, 4 and 6 with alpha."""
    values = np.round((photo if color in (2, 6) else grey(photo)[..., :1]) * (65535 / 255))
    if alpha:
        values = np.concatenate([values, np.full((*values.shape[:2], 1), 30_000)], axis=-1)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", photo.shape[1], photo.shape[0], 16, color, 0, 0, 0))]
    chunks += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(x)) + n + x + struct.pack(">I", zlib.crc32(n + x)) for n, x in chunks)
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def tiff(file, photo, dtype="<u1", scale=1.0, photometric=2, more=None):
    """Write a TIFF file of `photo` * `scale` in a number type; `more` is the tag and the value of a further channel."""
    values = photo.astype(float) if photometric == 2 else grey(photo)[..., :1]
    values = (65535 if dtype[1:] == "u2" else 255) - values * scale if photometric == 0 else values * scale
    values = values if dtype[1] == "f" else np.round(values)
    if more is not None:
        values = np.concatenate([values, np.full((*values.shape[:2], 1), more[1])], axis=-1)
    options: dict[str, Any] = {} if more is None else {"extrasamples": [more[0]], "planarconfig": 1}
    values = values.squeeze().astype(dtype)
    tifffile.imwrite(file, values, byteorder=">" if dtype[0] == ">" else "<", photometric=photometric, **options)


def pgm(file, photo, largest):
    values = np.round(grey(photo)[..., 0] * (largest / 255)).astype(">u2")
    file.write_bytes(f"P5 {room.WIDTH} {room.HEIGHT} {largest}\n".encode() + values.tobytes())


def pfm(file, photo):
    values = (grey(photo)[..., 0] / 255).astype("<f4")
    file.write_bytes(f"Pf\n{room.WIDTH} {room.HEIGHT}\n-1.0\n".encode() + values.tobytes())


def bits(file, photo, **options):
    Image.fromarray(one_bit(photo)[..., 0] > 0).save(file, **options)


def reversed_palette(file, photo, **options):
    """Grey of which index 0 is white."""
    image = Image.fromarray((255 - grey(photo)[..., 0]).astype(np.uint8))
    image.putpalette(np.repeat(np.arange(256)[::-1], 3).astype(np.uint8).tobytes())
    image.save(file, **options)


def transparent(file, photo, mode, **options):
    image = Image.fromarray(photo).convert("L" if mode[0] == "L" else "RGB")
    image.putalpha(Image.new("L", image.size, 90))
    image.convert(mode).save(file, **options)


def exr(file, photo):
    import OpenEXR

    parts = {"RGB": np.ascontiguousarray(photo / 255, np.float32)}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, parts).write(str(file))


def same(photo: np.ndarray) -> np.ndarray:
    return photo


FLOATS = "expected 8 or 16 bits a channel, got floats, whose range is unknown; convert it"
INTEGERS = "expected 8 or 16 bits a channel, got signed or 32-bit integers, whose range is unknown; convert it"
UNKNOWN = "could not decode it: no format is known; photos have 8 or 16 bits a channel"
# Suffix, writer, and the right pixels or the refusal.
KINDS: dict[str, tuple[str, Callable[..., None], Any]] = {
    **{f"{suffix} of RGB": (suffix, save, same) for suffix in ("png", "bmp", "ppm", "tga", "tif")},
    "jpg": ("jpg", partial(save, quality=98, subsampling=0), same),
    "jpg of YCbCr 4:2:0": ("jpg", partial(save, quality=98), same),
    "jpg of CMYK": ("jpg", partial(save, mode="CMYK", quality=98), same),
    "webp": ("webp", partial(save, lossless=True), same),
    "jp2": ("jp2", save, same),
    "gif of grey": ("gif", partial(save, mode="L"), grey),
    "png of grey": ("png", partial(save, mode="L"), grey),
    "png of 1 bit": ("png", bits, one_bit),
    "png of a reversed palette": ("png", reversed_palette, grey),
    "png of a transparent palette": ("png", partial(reversed_palette, transparency=3), grey),
    "png of RGBA": ("png", partial(transparent, mode="RGBA"), same),
    "png of LA": ("png", partial(transparent, mode="LA"), grey),
    "png of 16 bits": ("png", png16, same),
    "png of 16-bit RGBA": ("png", partial(png16, color=6, alpha=True), same),
    "png of 16-bit grey": ("png", partial(png16, color=0), grey),
    "png of 16-bit LA": ("png", partial(png16, color=4, alpha=True), grey),
    "pgm of 16 bits": ("pgm", partial(pgm, largest=65535), grey),
    "pgm of 10 bits": ("pgm", partial(pgm, largest=1023), grey),
    **{f"tif of {c}": ("tif", partial(save, compression=c), same) for c in ("tiff_lzw", "tiff_deflate", "packbits")},
    "tif of CMYK": ("tif", partial(save, mode="CMYK"), same),
    "tif of 1 bit": ("tif", partial(bits, compression="group4"), one_bit),
    "tif of premultiplied RGBA": ("tif", partial(tiff, more=(1, 255)), same),
    "tif of RGBA": ("tif", partial(tiff, more=(2, 90)), same),
    "tif of LA": ("tif", partial(transparent, mode="LA"), grey),
    "tif of premultiplied LA": ("tif", partial(tiff, photometric=1, more=(1, 255)), grey),
    "tif of white as 0": ("tif", partial(tiff, photometric=0), grey),
    "tif of 16 bits": ("tif", partial(tiff, dtype="<u2", scale=257), same),
    "tif of 16 bits, big-endian": ("tif", partial(tiff, dtype=">u2", scale=257), same),
    "tif of 16-bit grey": ("tif", partial(tiff, dtype="<u2", scale=257, photometric=1), grey),
    "tif of 16-bit grey, white as 0": ("tif", partial(tiff, dtype="<u2", scale=257, photometric=0), "0 as black"),
    "tif of 16-bit RGBA": ("tif", partial(tiff, dtype="<u2", scale=257, more=(2, 30_000)), same),
    "tif of grey floats": ("tif", partial(tiff, dtype="<f4", scale=1 / 255, photometric=1), FLOATS),
    "tif of floats": ("tif", partial(tiff, dtype="<f4", scale=1 / 255), UNKNOWN),
    "tif of signed 16 bits": ("tif", partial(tiff, dtype="<i2", scale=100, photometric=1), INTEGERS),
    "tif of 32 bits": ("tif", partial(tiff, dtype="<u4", scale=1e6, photometric=1), INTEGERS),
    "tif of signed 32 bits": ("tif", partial(tiff, dtype="<i4", scale=1e6, photometric=1), INTEGERS),
    "pfm": ("ppm", pfm, FLOATS),
    "OpenEXR as png": ("png", exr, UNKNOWN),
    **{f"tif turned by tag {tag}": ("tif", partial(save, tiffinfo={274: tag}), same) for tag in range(1, 9)},
    "tif of LZW turned by tag 6": ("tif", partial(save, tiffinfo={274: 6}, compression="tiff_lzw"), same),
    **{f"{suffix} turned": (suffix, partial(save_rotated, orientation=6), same) for suffix in ("jpg", "png", "webp")},
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_photos_of_every_kind(tmp_path, kind):
    suffix, write, right = KINDS[kind]
    room.write_colmap(tmp_path, room.write_photos(tmp_path / "images", write, suffix))
    if isinstance(right, str):
        with pytest.raises(ValueError, match=right) as caught:
            load_scene(tmp_path)
        assert "\n" not in str(caught.value) and f"images/0.{suffix}" in str(caught.value)
        return
    for background in (None, "black"):
        scene = load_scene(tmp_path, background=background)
        for view, photo in zip(sorted(views_of(scene), key=lambda v: v.name), room.photos(), strict=True):
            expected = right(photo.astype(float))
            if view.alpha is not None:
                expected = expected * (view.alpha.numpy()[..., None] / 255.0)
                assert np.abs(np.unique(view.alpha.numpy()) - 90).max() < 30 or "palette" in kind
            assert np.abs(view.image.numpy() - expected).mean() < 2 * room.RIGHT
        if right is same and background is None:
            assert room.color_error(scene) < 2 * room.RIGHT
