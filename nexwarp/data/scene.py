"""A scene: posed photos, split into training and test views, and the points that training starts from."""

import dataclasses
import math
import os
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from tyro.conf import Positional

from nexwarp.cameras.camera import Array, Camera
from nexwarp.data.capture import (
    Capture,
    Cloud,
    Photo,
    find_named,
    plain_name,
    report_missing,
    report_unused,
    safe_name,
    scene_errors,
    short,
)
from nexwarp.data.colmap import has_model, read_model
from nexwarp.data.depth_files import with_depths
from nexwarp.data.depth_fit import fit_depths
from nexwarp.data.images import EXR, Color, quiet_pillow, read_in_threads
from nexwarp.data.in_memory import as_bytes, make_cloud, near_origin, split_views
from nexwarp.data.option import Flag_, option
from nexwarp.data.ply import read_ply
from nexwarp.data.random_points import random_points
from nexwarp.data.transforms import BLENDER_FILES, EXTENSIONS, NERFSTUDIO_FILE, read_blender, read_nerfstudio
from nexwarp.data.views import PlannedView, View, ViewReader
from nexwarp.errors import MissingError
from nexwarp.io.pictures import save_png
from nexwarp.machine import available_memory

if TYPE_CHECKING:
    import pycolmap

DEMO = "demo"
TEST_EVERY = 8  # the field's split: of the views sorted by name, those with index % 8 == 0 are for testing
NEAR_FRACTION = 0.01  # near plane, in units of the scene scale
SCALE_MARGIN = 1.1
MAX_POINTS = 4_000_000  # to start from: more than any budget of surfels
READERS = {"colmap": "a COLMAP model", "nerfstudio": NERFSTUDIO_FILE, "blender": BLENDER_FILES["train"]}
JUDGED_PHOTOS, JUDGED_POINTS = 50, 5000  # of which some photo has to show some point
MASKS, ALPHA, NONE = "masks", "alpha", "none"
RANDOM = "random"
# Host memory that reading takes while it goes on, in bytes a pixel of the photo as it lies in its file.
READ_BYTES, UNDISTORT_BYTES = 24, 64
DEPTH_BYTES = 2  # a pixel of a depth map
MAX_READERS = 32
GIB = 2**30
SHARE = 0.9  # largest share of the free memory for photos
MAX_DOWNSCALE = 64  # that a message names
COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}

ProgressCallback = Callable[[int, int], None]


def demo_folder() -> Path:
    """Return the folder of the built-in scene `demo`, a COLMAP scene of 40 photos; its files are not to be changed.

    It is ours: traced by nexwarp/data/raytrace.py of commit 7f7bd6c, the points with the noise and outliers of
    structure from motion.
    """
    return Path(__file__).parent / "demo_scene"


@dataclass(frozen=True)
class SceneSource:
    """Where a scene lies, and how to read it: the options of `load_scene`."""

    path: Annotated[str, Positional, option("SCENE")]
    """Folder of a COLMAP, nerfstudio or Blender scene, `demo`, a video, or a folder of photos (docs/scenes.md)."""
    images: Annotated[str, option("FOLDER")] = "images"
    """Folder of the photos, in SCENE."""
    downscale: Annotated[int, option("N")] = 1
    """Factor by which photos are reduced."""
    masks: Annotated[str, option("FOLDER")] = MASKS
    """Folder of masks, `alpha` or `none`."""
    background: Annotated[str | None, option("COLOUR", "scene's")] = None
    """white, black, R,G,B or random."""
    points: Annotated[str | None, option("FILE.ply", "the scene's")] = None
    """Initial points."""
    format: Annotated[str | None, option("NAME", "detected")] = None
    """colmap, nerfstudio or blender."""
    follow_links: Flag_ = False
    """Follow symbolic links out of SCENE."""
    skip_missing: Flag_ = False
    """Go on without photos that do not exist."""
    linear: Annotated[float | None, option("WHITE", "")] = None
    """Photos are of linear light; this value is white."""
    exclude: Annotated[tuple[str, ...], option("NAME ...", "")] = ()
    """Leave photos out, by name or pattern (*.png)."""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "SceneSource":
        """Rebuild it from `dataclasses.asdict`; what a newer version added is passed over. TypeError names a field."""
        known = {field.name for field in dataclasses.fields(cls)}
        values = {name: value for name, value in data.items() if name in known}
        if isinstance(exclude := values.get("exclude"), list):  # of JSON
            values["exclude"] = tuple(exclude)
        source = cls(**values)
        if "downscale" not in data:  # of the first version, as all runs have it
            raise ValueError("scene: expected the key downscale, found none")
        _check_types(source)
        return source

    @property
    def folder(self) -> Path:
        """Folder of the scene's files."""
        return demo_folder() if self.path == DEMO else Path(self.path)

    @property
    def name(self) -> str:
        """Name of the scene, for folders and tables."""
        return DEMO if self.path == DEMO else Path(self.path).resolve().name

    def absolute(self) -> "SceneSource":
        """Return the same source with absolute paths."""
        path = self.path if self.path == DEMO else str(Path(self.path).resolve())
        points = None if self.points is None else str(Path(self.points).resolve())
        return dataclasses.replace(self, path=path, points=points)

    def load(self, progress: ProgressCallback | None = None) -> "Scene":
        """Read the scene; progress and errors are those of `load_scene`."""
        return _read_scene(self, progress or (lambda done, total: None))

    def photos(self) -> list[Photo]:
        """Read the photos' names, files and lenses, without pixels; errors are those of `load_scene`."""
        with quiet_pillow(), scene_errors():
            return _read_capture(self).photos


@dataclass(frozen=True)
class Scene:
    """What training sees and what it is judged by, in the units of the scene's files.

    Cameras and points are in the world frame of the files, moved by `origin` where single precision would lose more
    than a hundredth of a pixel in that frame, as with georeferenced coordinates.

    Attributes:
        train: views to learn from, sorted by name.
        test: views to judge by, never to learn from, sorted by name.
        points: (P, 3) float32 points to start from: sparse, of a PLY file, or random where there are none.
        colors: (P, 3) uint8 sRGB of the points.
        track_lengths: (P,) int32, how many photos a point was triangulated from; 0 when unknown.
        reprojection_errors: (P,) float32, mean over the track, in pixels of the photos as taken; -1 when
            unknown.
        scale: 1.1 times the largest distance of a training camera from their mean, in world units; with all
            of them in one place, the median distance of the points from there.
        path: the folder it was read from; `Path("memory")` where it was made of tensors.
        background: colour, three numbers in [0, 1], that transparent photos were put on, and that should lie
            behind a rendering to compare with; None where no photo's transparency was looked at, or none is
            transparent and no colour was asked for.
        origin: (3,) float64, world coordinates of the origin of the frame of cameras and points; zeros, except for
            scenes that are far from their world's origin. A position in the world is `origin` + the local one.
        white: linear light that is white in the photos, sRGB of the linear light of their files; None for others.
        random_background: whether training was asked to put each photo on a colour of its own instead, which
            `View.alpha` allows; `background` is white then, for comparisons.
    """

    train: list[View]
    test: list[View]
    points: torch.Tensor
    colors: torch.Tensor
    track_lengths: torch.Tensor
    reprojection_errors: torch.Tensor
    scale: float
    path: Path
    background: tuple[float, float, float] | None = None
    random_background: bool = False
    white: float | None = None
    origin: torch.Tensor = field(default_factory=partial(torch.zeros, 3, dtype=torch.float64))

    @property
    def cameras(self) -> dict[str, dict[str, Camera]]:
        """The cameras by set ("train", "test") and name of the photo."""
        return {name: {v.name: v.camera for v in views} for name, views in (("train", self.train), ("test", self.test))}

    @classmethod
    def from_tensors(
        cls,
        images: Sequence[Array],
        cameras: Sequence[Camera],
        points: Array | None = None,
        colors: Array | None = None,
        masks: Sequence[Array | None] | None = None,
        names: Sequence[str] | None = None,
        test_every: int = TEST_EVERY,
    ) -> "Scene":
        """Make a scene of photos and cameras in memory; no files are read or written.

        Args:
            images: (H, W, 3) sRGB photos, tensors or arrays, uint8, or floating in [0, 1], which are rounded to 8 bits.
            cameras: of the photos, of the same sizes and of one frame (`Camera.origin`); their near depths are kept.
                Viewmats far from the world's origin should be float64: they are moved to a frame nearby (`origin`).
            points: (P, 3) floating, world units, in the cameras' frame, to start from; None takes random points, as for
                scenes without any.
            colors: (P, 3) sRGB of the points, uint8 or floating in [0, 1]; None only where `points` is None.
            masks: for each photo (H, W) bool, True where it counts, or None where all of it does; None for no masks.
            names: of the photos, each once, as relative paths; None numbers them.
            test_every: of the views sorted by name, those with index % `test_every` == 0 are test views, which are
                never used for training; 0 keeps all views for training.

        Returns:
            The scene, copies of all tensors on the CPU.

        Raises:
            TypeError, ValueError: naming the argument, its index, what was expected and what came.
        """
        if points is None and colors is not None:
            raise ValueError("colors: expected None without points, got colours")
        cloud = None if points is None else make_cloud(points, colors)
        train, test = split_views(images, cameras, masks, names, test_every)
        train, test, cloud = near_origin(train, test, cloud)
        viewmats = [view.camera.viewmat.double().numpy() for view in train]
        scale = _scene_scale("cameras", viewmats, cloud)
        return _make_scene(train, test, cloud, scale, Path("memory"), None)

    @classmethod
    def from_pycolmap(
        cls,
        reconstruction: "pycolmap.Reconstruction",
        images: str | os.PathLike[str] | Mapping[str, Array],
        downscale: int = 1,
        **options: Any,
    ) -> "Scene":
        """Make a scene of a reconstruction of pycolmap, which goes through a temporary folder.

        Args:
            reconstruction: cameras, registered images and points. Points tell which photos see them, as in files.
            images: folder of the photos; or name of an image -> its photo (H, W, 3), uint8 or floating in [0, 1].
            downscale: as of `load_scene`.
            options: as of `load_scene`; `masks` is the path of a folder, None by default.

        Returns:
            The scene; its `path` is `Path("memory")`.

        Raises:
            TypeError: `reconstruction` is none. Otherwise as of `load_scene`.
        """
        if not hasattr(reconstruction, "write_binary"):
            kind = type(reconstruction).__name__
            raise TypeError(f"reconstruction: expected a pycolmap.Reconstruction, got {kind}")
        if not isinstance(images, Mapping) and not Path(images).is_dir():
            raise MissingError(f"images: expected the folder of the photos, found none at {images}")
        with tempfile.TemporaryDirectory() as folder:
            model = Path(folder) / "sparse" / "0"
            model.mkdir(parents=True)
            reconstruction.write_binary(str(model))
            if isinstance(images, Mapping):
                photos = Path(folder) / "images"
                for name, image in images.items():
                    file = photos / safe_name("images:", name, "images folder")
                    file.parent.mkdir(parents=True, exist_ok=True)
                    save_png(file, as_bytes(f"images[{name!r}]", image))
            else:
                photos = Path(images).resolve()
            scene = load_scene(folder, str(photos), downscale, **{"masks": None, **options})
        return dataclasses.replace(scene, path=Path("memory"))


def load_scene(
    path: str | os.PathLike[str],
    images: str = "images",
    downscale: int = 1,
    *,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> Scene:
    """Read a scene: a COLMAP folder, nerfstudio's transforms.json, or Blender's transforms_train.json.

    A COLMAP model lies in sparse/0, in sparse or in the folder itself, binary or text. Photos of another size than
    their cameras (images_2, images_4, ...) scale the intrinsics by the ratio of the sizes, an axis at a time.
    Photos of distorted cameras, of every model that COLMAP knows, are undistorted; a panorama becomes six views. Every
    camera's near depth is 0.01 of the scene scale. The test views are those that the files name, else every eighth by
    name. More in docs/scenes.md.

    Args:
        path: folder of the scene; "demo" is the built-in one.
        images: folder of the photos, inside `path`.
        downscale: average blocks of this many pixels squared; what fills no block is cropped.
        progress: called with the number of photos read and their total, from one thread at a time.
        options: the other fields of `SceneSource`. `masks`: a folder inside `path` with a mask for each photo that
            needs one, NAME.png beside NAME or of the same stem, white where the photo counts; "masks", the default,
            need not exist, and what transforms.json names as a frame's `mask_path` goes before it. "alpha": alpha of
            one half and more counts. None or "none": no masks. `background`: "white", "black", three numbers in
            [0, 1] or "random", which puts photos on white and marks the scene for training on random colours.
            `points`: in the scene's world frame. `follow_links`: a scene of others can then show any picture.
            `exclude`: names or patterns ("left/*") of photos to leave out; the others stay training or test views.

    Returns:
        The scene, all tensors on the CPU.

    Raises:
        NotADirectoryError: a file, not a folder.
        MissingError: no such folder, no scene in it, no images folder, or an absent photo, mask or file of points.
        TypeError, ValueError: an argument of the wrong type or out of range.
        SceneError: no such `format`, more than one kind of scene, damaged or malformed files, cameras that are not
            usable, a photo or mask whose shape is not its camera's, names that leave the folder, fewer than 2 photos,
            a COLMAP model without points, photos too many for the memory, an `exclude` that names no photo.
    """
    source = SceneSource(path, images, downscale, **options)  # type: ignore[arg-type]  # checked below
    _check_types(source)
    return source.load(progress)


def _check_types(source: SceneSource) -> None:
    """Raise TypeError naming a field of another type."""
    text, path, numbers = (str, type(None)), (str, os.PathLike), (int, float, type(None))
    kinds: dict[str, tuple[type, ...]] = {"path": path, "images": (str,), "masks": text, "format": text}
    kinds |= {"points": (*path, type(None)), "follow_links": (bool,), "skip_missing": (bool,), "downscale": (int,)}
    kinds |= {"linear": numbers, "exclude": (tuple, list)}
    values = [(name, getattr(source, name), kind) for name, kind in kinds.items()]
    if isinstance(source.exclude, (tuple, list)):
        values += [("exclude", name, (str,)) for name in source.exclude]
    for name, value, kind in values:
        if not isinstance(value, kind) or (isinstance(value, bool) and bool not in kind):
            expected = " or ".join(each.__name__ for each in kind)
            raise TypeError(f"{name}: expected {expected}, got {type(value).__name__}")


def _read_scene(source: SceneSource, progress: ProgressCallback) -> Scene:
    path = source.folder
    if source.downscale < 1:
        raise ValueError(f"downscale: expected at least 1, got {source.downscale}")
    if source.linear is not None and not 0 < source.linear < math.inf:
        raise ValueError(f"linear: expected a number above 0, got {source.linear}")
    random = isinstance(source.background, str) and source.background == RANDOM
    color = parse_color("white" if random else source.background)
    with quiet_pillow(), scene_errors():
        if path.is_file():
            raise NotADirectoryError(f"{path}: expected the folder of a scene, got a file; give {path.parent}")
        if not path.is_dir():
            raise FileNotFoundError(f"{path}: no such folder, expected a scene: COLMAP, nerfstudio or Blender")
        capture = _read_capture(source)
        if len(capture.photos) < 2:
            raise ValueError(f"{capture.source}: expected at least 2 registered images (1 to train, 1 to test), got 1")
        cloud = capture.cloud
        if source.points is not None:
            cloud = _given_points(Path(source.points), capture)
        viewmats = [photo.viewmat for photo in capture.photos if not photo.test]
        scale = _scene_scale(str(capture.source), viewmats, cloud)
        background = capture.background if color is None else color
        train, held_out = _read_views(source, capture, background, NEAR_FRACTION * scale, progress)
        train = fit_depths(train, cloud, path)
        if color is None and all(view.alpha is None for view in train + held_out):
            background = None  # behind opaque photos there is none to see
        scene = _make_scene(train, held_out, cloud, scale, path, background)
        linear = source.linear or any(photo.file.suffix.lower() == EXR for photo in capture.photos)
        white = float(source.linear or 1) if linear else None
    return dataclasses.replace(scene, random_background=random, white=white)


def parse_color(color: str | Sequence[float] | None) -> Color | None:
    """Three numbers in [0, 1] of a colour's name, of "R,G,B" or of three numbers; None stays None."""
    if color is None:
        return None
    if isinstance(color, str) and color in COLORS:
        return COLORS[color]
    try:
        values = tuple(float(x) for x in (color.split(",") if isinstance(color, str) else color))
    except (TypeError, ValueError):
        values = ()
    if len(values) != 3 or not all(0 <= x <= 1 for x in values):
        raise ValueError(f"background: expected white, black, random or three numbers in [0, 1], got {color!r}")
    return values


def scene_kinds(path: Path) -> list[str]:
    """Return which of `READERS` find a scene in a folder."""
    kinds = ["colmap"] if has_model(path) else []
    kinds += ["nerfstudio"] if (path / NERFSTUDIO_FILE).is_file() else []
    return kinds + (["blender"] if (path / BLENDER_FILES["train"]).is_file() else [])


def find_format(path: Path, format: str | None = None) -> str:
    """Tell which kind of scene a folder holds, exactly one of `READERS`, or check `format`."""
    if format is not None:
        if format not in READERS:
            raise ValueError(f"format: expected one of {', '.join(READERS)}, got {format!r}")
        return format
    kinds = scene_kinds(path)
    if len(kinds) > 1:
        raise ValueError(
            f"{path}: expected one kind of scene, got {' and '.join(READERS[kind] for kind in kinds)}; "
            f"choose with format: {' or '.join(kinds)}"
        )
    if not kinds:
        raise FileNotFoundError(
            f"{path}: no scene found, expected a COLMAP model (cameras, images and points3D, .bin or .txt, in "
            f"sparse/0, in sparse or in the folder itself), {NERFSTUDIO_FILE} of nerfstudio, or "
            f"{BLENDER_FILES['train']} of Blender; nexwarp process makes a scene of photos alone"
        )
    return kinds[0]


def _read_views(
    source: SceneSource, capture: Capture, background: Color | None, near: float, progress: ProgressCallback
) -> tuple[list[View], list[View]]:
    """Read all photos; return the training views and the test views."""
    alpha_mask = source.masks == ALPHA
    positions = None if capture.cloud is None else capture.cloud.positions.astype(np.float32)
    x, y, z = capture.origin.tolist()
    reader = ViewReader(source.downscale, background, alpha_mask, source.linear, positions, near, (x, y, z))
    photos = with_depths(source.folder, _with_masks(source, capture.photos))
    photos = [dataclasses.replace(photo, depth=None) if photo.test else photo for photo in photos]
    jobs = list(chain.from_iterable(read_in_threads(reader.plan, photos, MAX_READERS)))
    channels = 3 + (background is not None) + (alpha_mask or any(job.photo.mask for job in jobs))
    channels += DEPTH_BYTES * any(job.photo.depth for job in jobs)
    workers = _workers(source, channels, jobs)
    views = read_in_threads(reader.read, jobs, workers, lambda done: progress(done, len(jobs)))
    train = [view for job, view in zip(jobs, views, strict=True) if not job.photo.test]
    return train, [view for job, view in zip(jobs, views, strict=True) if job.photo.test]


def _make_scene(
    train: list[View], test: list[View], cloud: Cloud | None, scale: float, path: Path, background: Color | None
) -> Scene:
    """Make a scene of its parts; random points where there is no cloud."""
    cloud = _thinned(random_points(train, scale) if cloud is None else cloud)
    return Scene(
        train=train,
        test=test,
        points=torch.from_numpy(cloud.positions.astype(np.float32)),
        colors=torch.from_numpy(cloud.colors),
        track_lengths=torch.from_numpy(cloud.track_lengths),
        reprojection_errors=torch.from_numpy(cloud.reprojection_errors),
        scale=scale,
        path=path,
        background=background,
        origin=torch.tensor(train[0].camera.origin, dtype=torch.float64),
    )


def _given_points(file: Path, capture: Capture) -> Cloud:
    """Read the points of --points, in the capture's frame; warn if no photo shows any of them."""
    cloud = read_ply(file).moved(capture.origin)
    if not len(cloud.positions):
        raise ValueError(f"{file}: expected at least one vertex, got none")
    sample = cloud.positions[:: -(-len(cloud.positions) // JUDGED_POINTS)]
    judges = capture.photos[:: -(-len(capture.photos) // JUDGED_PHOTOS)]
    if not any(np.isfinite(photo.project(sample)).any() for photo in judges):
        warnings.warn(f"{file}: no photo shows any of its points; are they in the scene's world frame?", stacklevel=2)
    return cloud


def _read_capture(source: SceneSource) -> Capture:
    """Read a capture without the excluded photos. The test photos are chosen before these are left out."""
    capture = _read_files(source)
    photos = [
        dataclasses.replace(photo, test=index % TEST_EVERY == 0 if photo.test is None else photo.test)
        for index, photo in enumerate(capture.photos)
    ]
    excluded: set[str] = set()
    for pattern in source.exclude:
        matched = _matching([photo.name for photo in capture.photos], pattern)
        if capture.photos and not matched:
            example = capture.photos[0].name
            raise ValueError(f"exclude: no photo of {capture.source} is named {short(pattern)}, as {example} is")
        excluded |= matched
    photos = [photo for photo in photos if photo.name not in excluded]
    if excluded and all(photo.test for photo in photos):
        raise ValueError(f"exclude: expected to leave a training photo of {capture.source}, got none")
    return dataclasses.replace(capture, photos=photos)


def _matching(names: Sequence[str], pattern: str) -> set[str]:
    """Return the names that equal a pattern, else those that it matches, in any Unicode form."""
    plain, pattern = {name: plain_name(name) for name in names}, plain_name(pattern)
    equal = {name for name in names if plain[name] == pattern}
    return equal or {name for name in names if fnmatchcase(plain[name], pattern)}


def _read_files(source: SceneSource) -> Capture:
    path = source.folder
    kind = find_format(path, source.format)
    if kind == "colmap":
        capture = read_model(path, path / source.images, source.follow_links, source.points is None)
        _check_folder("images", path, source.images)
        photos = [photo for photo in capture.photos if photo.file.is_file()]
        missing = [photo.name for photo in capture.photos if not photo.file.is_file()]
        report_missing(capture.source, missing, len(capture.photos), source.skip_missing)
        report_unused(capture.source, path / source.images, capture.photos)
        return dataclasses.replace(capture, photos=photos)
    if source.images != "images":
        _check_folder("images", path, source.images)
    read = read_nerfstudio if kind == "nerfstudio" else read_blender
    return read(path, source.images, source.follow_links, source.skip_missing)


def _check_folder(argument: str, path: Path, name: str) -> None:
    if not (path / name).is_dir():
        folders = sorted(entry.name for entry in path.glob(f"{argument}*") if entry.is_dir())
        there = ", ".join(folders) or f"no folder {argument}*"
        raise FileNotFoundError(f"{argument}: no folder {name!r} in {path}, which has {there}")


def _with_masks(source: SceneSource, photos: list[Photo]) -> list[Photo]:
    """The photos with the mask that goes with each."""
    path, masks = source.folder, source.masks
    if masks in (None, NONE, ALPHA):
        return [dataclasses.replace(photo, mask=None) for photo in photos]
    if masks == MASKS and (any(photo.mask for photo in photos) or not (path / masks).is_dir()):
        return photos
    _check_folder("masks", path, masks)
    photos = [
        dataclasses.replace(photo, mask=find_named(path / masks, photo.name, (".png",), EXTENSIONS)) for photo in photos
    ]
    if not any(photo.mask for photo in photos):
        raise FileNotFoundError(
            f"masks: none in {path / masks} is named after a photo, expected {Path(photos[0].name).name}.png, say, "
            "or masks=None for none"
        )
    return photos


def _scene_scale(source: str, viewmats: Sequence[np.ndarray], cloud: Cloud | None) -> float:
    """Scale of a scene, from the (4, 4) float64 world to camera matrices of its training views; see `Scene.scale`."""
    centres = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in viewmats])
    mean = centres.mean(axis=0)
    radius = float(np.linalg.norm(centres - mean, axis=1).max())
    distance = 1.0 if cloud is None else float(np.median(np.linalg.norm(cloud.positions - mean, axis=1)))
    # A camera that only turns is at one place but for rounding: its centres are computed from its poses.
    scale = SCALE_MARGIN * radius if radius > 1e-6 * distance else distance
    if not 0 < scale < math.inf:
        raise ValueError(f"{source}: cannot tell the scene's scale: cameras and points give {scale}")
    return scale


def photos_bytes(sizes: Sequence[tuple[int, int]], downscale: int, channels: int) -> int:
    """Memory in bytes of photos of the given (width, height), reduced by `downscale`, with a byte a channel."""
    return sum((width // downscale) * (height // downscale) * channels for width, height in sizes)


def _workers(source: SceneSource, channels: int, jobs: list[PlannedView]) -> int:
    """How many photos to read at a time, so that what reading takes beside them fits as well.

    ValueError: the photos do not fit; the message suggests a downscale or a folder of smaller images.
    """
    sizes = [(job.target.width, job.target.height) for job in jobs]
    free = available_memory()
    limit = int(SHARE * free)
    need = photos_bytes(sizes, source.downscale, channels)
    if need > limit:
        factors = range(source.downscale + 1, min(MAX_DOWNSCALE, *map(min, sizes)) + 1)
        fit = next((k for k in factors if photos_bytes(sizes, k, channels) <= limit), None)
        advice = "use fewer photos"
        if fit is not None:
            advice = f"use downscale={fit} ({photos_bytes(sizes, fit, channels) / GIB:.1f} GiB)"
            folders = sorted(f.name for f in source.folder.glob("images_*") if f.is_dir() and f.name != source.images)
            advice += f" or a folder of smaller images ({', '.join(folders)})" if folders else ""
        width, height = max(sizes)
        raise ValueError(
            f"{source.folder}: {len(sizes)} photos of up to {width}x{height} at downscale={source.downscale} need "
            f"{need / GIB:.1f} GiB of host memory, of which {free / GIB:.1f} GiB are free; {advice}"
        )
    largest = max(
        READ_BYTES * job.size[0] * job.size[1]
        + (UNDISTORT_BYTES * job.target.width * job.target.height if job.photo.lens.distorted else 0)
        for job in jobs
    )
    return max(1, min(MAX_READERS, (os.cpu_count() or 1) + 4, (free - need) // (2 * largest)))


def _thinned(cloud: Cloud) -> Cloud:
    count = len(cloud.positions)
    if count <= MAX_POINTS:
        return cloud
    keep = np.sort(np.random.default_rng(0).choice(count, MAX_POINTS, replace=False))
    parts = (cloud.positions, cloud.colors, cloud.track_lengths, cloud.reprojection_errors)
    return Cloud(*(part[keep] for part in parts))
