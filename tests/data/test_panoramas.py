from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from nexwarp.data import load_scene
from nexwarp.data.colmap import read_model
from nexwarp.data.lens import FACES
from nexwarp.data.sfm import SfmOptions, process
from nexwarp.data.sfm.panoramas import cut_panoramas, find_panoramas, is_closed, rig

WIDTH, ROOM, TEXELS = 768, 2.0, 512


def rays(width: int) -> np.ndarray:
    """(H, W, 3) float64 unit directions of an equirectangular panorama, x right, y down, z forward (the middle)."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(width // 2) + 0.5)[:, None] / (width // 2) - 0.5) * np.pi
    x, y, z = np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)
    return np.stack([x, y + 0 * x, z], axis=-1)


def pinhole(side: int) -> np.ndarray:
    """(side, side, 3) float64 directions of a pinhole of 90 degrees."""
    x = (np.arange(side) + 0.5) / side * 2 - 1
    return np.stack([*np.meshgrid(x, x), np.ones((side, side))], axis=-1)


def smooth(directions: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 colours of directions, which change slowly."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return (127.5 + 100 * np.sin(unit * [2.0, 3.0, 4.0] + unit[..., [1, 2, 0]])).round().astype(np.uint8)


@pytest.fixture(scope="module")
def walls() -> np.ndarray:
    """(6, n, n) brightness of a room's walls: -x, x, -y, y, -z and z, along the next two axes."""
    noise = np.random.default_rng(3).random((6, TEXELS, TEXELS))
    fine = np.stack([gaussian_filter(wall, 3.0) + 2 * gaussian_filter(wall, 8.0) for wall in noise])
    return np.clip(127 + 500 * (fine - fine.mean()), 0, 255)


def room(walls: np.ndarray, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 of what rays from a place in a cubic room meet."""
    with np.errstate(divide="ignore"):
        distances = np.where(directions > 0, ROOM - position, -ROOM - position) / directions
    axis = np.abs(distances).argmin(axis=-1)
    hits = position + np.take_along_axis(distances, axis[..., None], -1) * directions
    side = 2 * axis + (np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0)
    place = [np.take_along_axis(hits, ((axis + k) % 3)[..., None], -1)[..., 0] for k in (1, 2)]
    grey = map_coordinates(walls, [side, *[(p / ROOM + 1) / 2 * (TEXELS - 1) for p in place]], order=1, mode="nearest")
    return np.repeat(grey.round().astype(np.uint8)[..., None], 3, axis=-1)


def turned(degrees: float) -> np.ndarray:
    """(3, 3) world to camera of a camera turned about the vertical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def test_views_show_what_their_place_in_the_rig_sees(tmp_path: Path) -> None:
    Image.fromarray(smooth(rays(512))).save(tmp_path / "a.png")
    origins = cut_panoramas(tmp_path, ["a.png"], ["a.png"], tmp_path / "views", lambda done: None)
    assert len(origins) == 6 and set(origins.values()) == {"a.png"}
    for camera in rig().cameras:
        view = np.array(Image.open(tmp_path / "views" / f"{camera.image_prefix}a.png")).astype(int)
        place = camera.cam_from_rig
        turn = np.eye(3) if place is None else place.rotation.matrix()
        expected = smooth(pinhole(len(view)) @ turn)
        assert len(view) == round(512 / np.pi) and np.abs(view - expected).max() <= 2
        assert camera.ref_sensor if place is None else not place.translation.any()


def test_panoramas_are_told_from_photos_of_their_shape(walls: np.ndarray, tmp_path: Path) -> None:
    panorama = room(walls, np.array([0.3, 0.1, -0.5]), rays(WIDTH))
    assert is_closed(panorama) and is_closed(smooth(rays(WIDTH)))
    photo = smooth(pinhole(WIDTH)[: WIDTH // 2])
    white = np.full_like(photo, 255)
    white[100:200, 300:400] = 0
    assert not is_closed(photo) and not is_closed(white)
    assert not is_closed(room(walls, np.zeros(3), pinhole(WIDTH)[: WIDTH // 2]))
    pictures = {"closed": panorama, "of their size": np.zeros_like(panorama), "square": panorama[:, : WIDTH // 2]}
    for name, pixels in (pictures | {"white": white[::2, ::2]}).items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.jpg")
    told = b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
    Image.fromarray(white[::4, ::4]).save(tmp_path / "told.jpg", xmp=told)
    (tmp_path / "damaged.jpg").write_bytes(b"none")
    names = [file.name for file in tmp_path.iterdir()]
    assert find_panoramas(tmp_path, names) == {"closed.jpg", "of their size.jpg", "told.jpg"}


def test_the_global_mapper_is_refused(tmp_path: Path) -> None:
    for name in "abc":
        Image.fromarray(smooth(rays(64))).save(tmp_path / f"{name}.png")
    with pytest.raises(ValueError, match="mapper: expected incremental for panoramas, got global"):
        process(tmp_path, tmp_path.with_suffix(".scene"), options=SfmOptions(mapper="global"))


@pytest.mark.slow
def test_cameras_of_panoramas_and_photos_come_back(walls: np.ndarray, tmp_path: Path) -> None:
    """Five panoramas and three photos of a room: a scene of 33 pinhole views, those of a panorama at one place."""
    places = {f"p{i}.jpg": np.array([0.4 * i - 0.8, 0.1 * (-1) ** i, 0.3 * (i % 3) - 0.4]) for i in range(5)}
    poses = {name: (turned(20.0 * i), place) for i, (name, place) in enumerate(places.items())}
    (tmp_path / "photos").mkdir()
    for name, (turn, place) in poses.items():
        Image.fromarray(room(walls, place, rays(WIDTH) @ turn)).save(tmp_path / "photos" / name, quality=95)
    for i in range(3):
        turn, place = turned(10.0 * i - 30.0), np.array([0.3 * i - 0.3, 0.0, -0.9])
        poses[f"x{i}.png"] = turn, place
        Image.fromarray(room(walls, place, pinhole(320)[40:280] @ turn)).save(tmp_path / "photos" / f"x{i}.png")
    report = process(tmp_path / "photos", tmp_path / "scene", options=SfmOptions(camera_model="simple_pinhole"))
    assert report.panoramas == 5 and len(report.registered) == report.photos == 33
    assert {camera.params[0] for camera in report.cameras if camera.model == "PINHOLE"} == {round(WIDTH / np.pi) / 2}
    photos = read_model(tmp_path / "scene", tmp_path / "scene" / "images").photos
    ours, theirs, turns = [], [], []
    for photo in photos:
        folder, _, name = photo.name.rpartition("/")
        turn, place = poses[name]
        face = np.array(FACES[folder.removeprefix("panorama_")]) if folder else np.eye(3)
        ours.append(-photo.viewmat[:3, :3].T @ photo.viewmat[:3, 3])
        theirs.append(place)
        turns.append(photo.viewmat[:3, :3].T @ face @ turn)
    assert np.abs(np.array(turns) - turns[0]).max() < 0.01  # one rotation takes the true world to ours
    x, y = (np.array(centres) - np.mean(centres, axis=0) for centres in (np.array(ours) @ turns[0], theirs))
    assert np.abs(x * (x * y).sum() / (x * x).sum() - y).max() < 0.01
    scene = load_scene(tmp_path / "scene")
    assert len(scene.train) + len(scene.test) == 33
