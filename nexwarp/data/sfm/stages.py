"""The stages of structure from motion with pycolmap, from photos to a scene; they run in a process of their own."""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations, product
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Generic, TypeVar

from nexwarp.data.colmap import read_model
from nexwarp.data.images import read_image
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm.panoramas import cut_panoramas, find_panoramas, rig, view_groups
from nexwarp.data.sfm.photos import (
    InputPhoto,
    affordable_threads,
    camera_groups,
    camera_model,
    read_photos,
)
from nexwarp.data.sfm.report import EXHAUSTIVE_UP_TO, EstimatedCamera, Overlaps, SfmOptions, SfmReport, advise, left_out
from nexwarp.io.files import one_line

if TYPE_CHECKING:
    import pycolmap

JPEG_QUALITY = 95  # of undistorted JPEG photos; other formats are lossless
TILE = 16  # photos; the pairs of two tiles are matched together, so that their features stay in memory
MATCH_BLOCK = 16  # pairs that are matched together
MIN_MODEL = 3  # photos of a model
POLL_SECONDS = 0.2
ONLY_FATAL = 3  # glog level
PYCOLMAP = "pycolmap failed"  # in messages
# Exceptions of pycolmap 4.2; failed checks raise ValueError or RuntimeError.
ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError)

T = TypeVar("T")
Observer = Callable[[str, int, int], None]


@dataclass
class Stages:
    """The stages; they share COLMAP's database in a folder of their own, and leave the scene in its subfolder."""

    photos: Path
    folder: Path
    options: SfmOptions
    observe: Observer
    seconds: dict[str, float] = field(default_factory=dict)
    decoders: int = 1  # threads that may each hold a photo
    views: dict[str, str] = field(default_factory=dict)  # name of a panorama's view -> name of the panorama
    known: set[int] = field(default_factory=set)  # ids of the views' cameras

    @property
    def readable(self) -> Path:
        """Folder that pycolmap reads: links to the photos, and upright copies."""
        return self.folder / "photos"

    @property
    def threads(self) -> int:
        """Threads in pycolmap's notation: -1 is one a core."""
        return self.options.threads or -1

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return self.folder / "database.db"

    def run(self, names: Sequence[str]) -> SfmReport:
        """Reconstruct the photos of these names, and return the report."""
        pycolmap_module().logging.minloglevel = ONLY_FATAL
        names = self._cut(names)
        given = len(names)
        with self._stage("reading", given) as done:
            photos, skipped = self._read(names, done)
            plain = [photo for photo in photos if photo.name not in self.views]
            groups = camera_groups(self.photos, plain, self.options.cameras)
            groups += view_groups([photo for photo in photos if photo.name in self.views])
        names = [photo.name for photo in photos]
        with self._stage("features", len(names)) as done:
            self._import(groups)
            self._extract(names, done)
        sequential = self.options.matching == "sequential" or (
            self.options.matching == "auto" and len(names) > EXHAUSTIVE_UP_TO
        )
        pairs = self._pairs(names, sequential)
        with self._stage("matching", len(pairs)) as done:
            self._match(names, pairs, done)
            overlaps = self._overlaps(len(pairs), sequential)
        with self._stage("mapping", len(names)) as done:
            models, mapper = self._map(overlaps, done)
        registered = _names(models[0])
        with self._stage("undistorting", len(registered)) as done:
            sizes = self._undistort(models[0], done)
        with self._stage("checking", len(registered)) as done:
            self._check(done)
        return SfmReport(
            photos=given,
            registered=[name for name in names if name in set(registered)],
            left_out=left_out(overlaps, registered, [_names(model) for model in models]),
            points=models[0].num_points3D(),
            mean_track_length=models[0].compute_mean_track_length(),
            mean_reprojection_error=models[0].compute_mean_reprojection_error(),
            models=[model.num_reg_images() for model in models],
            cameras=_cameras(models[0], {photo.name: photo for photo in photos}),
            sizes=sizes,
            pairs=len(pairs),
            matched_pairs=len(overlaps.inliers),
            matching="sequential" if sequential else "exhaustive",
            mapper=mapper,
            seconds={stage: round(value, 2) for stage, value in self.seconds.items()},
            advice=advise(overlaps, len(registered)),
            skipped=skipped,
            panoramas=len(set(self.views.values())),
        )

    @contextmanager
    def _stage(self, title: str, total: int) -> Iterator[Callable[[int], None]]:
        start = time.perf_counter()
        self.observe(title, 0, total)
        yield lambda done: self.observe(title, min(done, total), total)
        self.observe(title, total, total)
        self.seconds[title] = time.perf_counter() - start

    def _cut(self, names: Sequence[str]) -> list[str]:
        """Replace panoramas by views of them; return the names of all photos."""
        panoramas = find_panoramas(self.photos, names)
        if not panoramas:
            return list(names)
        if self.options.mapper == "global":  # in what it makes of rigs, most pairs of photos contradict the cameras
            raise ValueError(f"{self.photos}: mapper: expected incremental for panoramas, got global")
        folder = self.folder / "views"
        with self._stage("cutting panoramas", len(panoramas)) as done:
            origins = cut_panoramas(self.photos, names, panoramas, folder, done)
        self.photos = folder
        self.views = {view: name for view, name in origins.items() if view != name}
        return list(origins)

    def _pairs(self, names: Sequence[str], sequential: bool) -> list[tuple[int, int]]:
        """Return the pairs of photos to compare, by index: of panoramas, all views of one with all of the other."""
        places: dict[str, list[int]] = {}  # a panorama is one, as any other photo is
        for index, name in enumerate(names):
            places.setdefault(self.views.get(name, name), []).append(index)
        members, count = list(places.values()), len(places)
        pairs = sequential_pairs(count, self.options.overlap) if sequential else exhaustive_pairs(count)
        return [pair for one, other in pairs for pair in product(members[one], members[other])]

    def _read(self, names: Sequence[str], done: Callable[[int], None]) -> tuple[list[InputPhoto], dict[str, str]]:
        """Decode the photos, and prepare them for pycolmap."""
        self.decoders = affordable_threads(self.photos, names, self.options)
        return read_photos(self.photos, names, self.decoders, done, self.readable, self.options.strict)

    def _import(self, groups: Sequence[Sequence[InputPhoto]]) -> None:
        """Enter photos and cameras in the database, in a fixed order, since the mapper's result depends on it."""
        with open_database(self.database):  # creates the file
            pass
        pycolmap = pycolmap_module()
        reader, single = pycolmap.ImageReaderOptions(), pycolmap.CameraMode.SINGLE
        for group in groups:
            names = [photo.name for photo in group]
            reader.camera_model = "PINHOLE" if names[0] in self.views else camera_model(group, self.options)
            run_stage("features", partial(pycolmap.import_images, self.database, self.readable, single, names, reader))
        by_name = {photo.name: group for group in groups for photo in group}
        with open_database(self.database) as database:
            camera_of = {image.camera_id: by_name[image.name] for image in database.read_all_images()}
            for camera in database.read_all_cameras():
                focals = [photo.focal for photo in camera_of[camera.camera_id] if photo.focal]
                if focals:  # COLMAP uses the first photo only
                    for index in camera.focal_length_idxs():
                        camera.params[index] = median(focals)
                camera.has_prior_focal_length = bool(focals)
                database.update_camera(camera)
            if self.views:
                self.known = {image.camera_id for image in database.read_all_images() if image.name in self.views}
                pycolmap.apply_rig_config([rig()], database)

    def _extract(self, names: Sequence[str], done: Callable[[int], None]) -> None:
        pycolmap = pycolmap_module()
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads = self.decoders
        extraction.max_image_size = self.options.max_image_size
        extraction.sift.max_num_features = self.options.max_features
        with open_database(self.database) as database:
            images = {image.name: image.image_id for image in database.read_all_images()}
            count = Count((images[name] for name in names), database.exists_descriptors)
            run_stage(
                "features",
                lambda: pycolmap.extract_features(
                    self.database, self.readable, list(names), extraction_options=extraction, device=pycolmap.Device.cpu
                ),
                lambda: done(count()),
            )

    def _match(self, names: Sequence[str], pairs: Sequence[tuple[int, int]], done: Callable[[int], None]) -> None:
        pycolmap = pycolmap_module()
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.num_threads = self.threads
        verification.ransac.random_seed = self.options.seed
        pairing = pycolmap.ImportedPairingOptions()
        pairing.block_size = MATCH_BLOCK
        pairing.match_list_path = self.folder / "pairs.txt"
        # COLMAP splits the lines of this file at spaces, so photos are renamed to numbers without spaces.
        Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in pairs))
        self._rename({name: str(index) for index, name in enumerate(names)})
        with open_database(self.database) as database:
            images = {int(image.name): image.image_id for image in database.read_all_images()}
            count = Count(
                ((images[i], images[j]) for i, j in pairs), lambda ids: database.exists_two_view_geometry(*ids)
            )
            run_stage(
                "matching",
                lambda: pycolmap.match_image_pairs(
                    self.database, matching, pairing, verification, device=pycolmap.Device.cpu
                ),
                lambda: done(count()),
            )
        self._rename({str(index): name for index, name in enumerate(names)})

    def _rename(self, new_names: dict[str, str]) -> None:
        with open_database(self.database) as database:
            for image in database.read_all_images():
                image.name = new_names[image.name]
                database.update_image(image)

    def _overlaps(self, pairs: int, sequential: bool) -> Overlaps:
        pycolmap = pycolmap_module()
        with open_database(self.database) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            features = {name: database.num_keypoints_for_image(index) for index, name in images.items()}
            inliers: dict[tuple[str, str], int] = {}
            for pair, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
                if count:
                    one, other = pycolmap.pair_id_to_image_pair(pair)
                    inliers[images[one], images[other]] = count
        return Overlaps(features, inliers, pairs, sequential)

    def _map(self, overlaps: Overlaps, done: Callable[[int], None]) -> tuple[list["pycolmap.Reconstruction"], str]:
        """Return all models, largest first, and the mapper that made them."""
        models: list[pycolmap.Reconstruction] = []
        chosen = self.options.mapper
        used = "global" if chosen == "global" else "incremental"
        if used == "incremental":
            models = _largest_first(self._incrementally(done))
        missed = not models or models[0].num_reg_images() < len(overlaps.features)
        if chosen == "global" or (chosen == "auto" and missed and not self.views):
            try:
                others = _largest_first(self._globally())
            except ValueError:
                if chosen == "global":
                    raise
                others = []  # what the first mapper made stays
            if others and (not models or others[0].num_reg_images() > models[0].num_reg_images()):
                models, used = others, "global"
        if not models or models[0].num_reg_images() < MIN_MODEL or not models[0].num_points3D():
            best = models[0].num_reg_images() if models else 0
            advice = "; ".join(advise(overlaps, 0))
            raise ValueError(
                f"{self.photos}: no scene could be made: {best} of {len(overlaps.features)} photos registered, "
                f"expected at least {MIN_MODEL}; {len(overlaps.inliers)} of {overlaps.pairs} pairs overlap; {advice}"
            )
        return models, used

    def _incrementally(self, done: Callable[[int], None]) -> dict[int, "pycolmap.Reconstruction"]:
        """Register one photo after another."""
        pycolmap, registered = pycolmap_module(), list[None]()
        options = pycolmap.IncrementalPipelineOptions()
        options.triangulation.random_seed = self.options.seed
        options.constant_cameras, options.ba_refine_sensor_from_rig = self.known, False
        run = partial(
            pycolmap.incremental_mapping,
            initial_image_pair_callback=lambda: registered.extend([None, None]),
            next_image_callback=lambda: registered.append(None),
        )
        return self._mapped(run, options, "models", lambda: done(len(registered)))

    def _globally(self) -> dict[int, "pycolmap.Reconstruction"]:
        """Estimate all rotations, then all positions, at once."""
        pycolmap = pycolmap_module()
        return self._mapped(pycolmap.global_mapping, pycolmap.GlobalPipelineOptions(), "global", lambda: None)

    def _mapped(
        self,
        run: Callable[..., dict[int, "pycolmap.Reconstruction"]],
        options: "pycolmap.IncrementalPipelineOptions | pycolmap.GlobalPipelineOptions",
        name: str,
        watch: Callable[[], None],
    ) -> dict[int, "pycolmap.Reconstruction"]:
        options.num_threads = options.mapper.num_threads = self.threads
        options.random_seed = options.mapper.random_seed = self.options.seed
        options.min_model_size = MIN_MODEL
        folder = self.folder / name
        folder.mkdir()
        return run_stage("mapping", lambda: run(self.database, self.readable, folder, options), watch)

    def _undistort(self, model: "pycolmap.Reconstruction", done: Callable[[int], None]) -> list[tuple[int, int]]:
        """Write the scene; return the distinct sizes of its photos."""
        pycolmap = pycolmap_module()
        chosen, output = self.folder / "model", self.folder / "undistorted"
        chosen.mkdir()
        model.write_binary(str(chosen))
        run_stage(
            "undistorting",
            lambda: pycolmap.undistort_images(
                output, chosen, self.readable, jpeg_quality=JPEG_QUALITY, num_threads=self.decoders
            ),
            lambda: done(sum(len(files) for _, _, files in os.walk(output / "images"))),
        )
        scene = self.folder / "scene"
        (scene / "sparse").mkdir(parents=True)
        (output / "images").rename(scene / "images")
        (output / "sparse").rename(scene / "sparse" / "0")
        cameras = pycolmap.Reconstruction(str(scene / "sparse" / "0")).cameras.values()
        return sorted({(camera.width, camera.height) for camera in cameras})

    def _check(self, done: Callable[[int], None]) -> None:
        """Read what was written: pycolmap tells no fault of the disk."""
        images = self.folder / "scene" / "images"
        photos = read_model(self.folder / "scene", images).photos
        with ThreadPoolExecutor(self.decoders) as pool:
            shapes = pool.map(lambda photo: tuple(read_image(images / photo.name).shape[:2]), photos)
            for count, (photo, shape) in enumerate(zip(photos, shapes, strict=True), start=1):
                if shape != (photo.lens.height, photo.lens.width):
                    raise ValueError(f"{photo.name}: {PYCOLMAP}: it wrote {shape[1]}x{shape[0]} pixels")
                done(count)


def exhaustive_pairs(count: int) -> list[tuple[int, int]]:
    """Return all pairs (i, j), i < j, of `count` photos, ordered by tiles."""
    return sorted(combinations(range(count), 2), key=lambda pair: (pair[0] // TILE, pair[1] // TILE, *pair))


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of `count` photos in sequence.

    Each photo is paired with its next `overlap` successors and with the successors at offsets 2, 4, 8, ...,
    2^(overlap - 1). The first `overlap` offsets wrap around from the last photo to the first, since a capture around an
    object ends where it began.
    """
    offsets = {*range(1, overlap + 1), *(2**k for k in range(overlap) if 2**k < count)}
    pairs = set()
    for i in range(count):
        for offset in offsets:
            # Only the first `overlap` offsets wrap around.
            if i + offset < count or offset <= overlap:
                j = (i + offset) % count
                if i != j:
                    pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _largest_first(models: dict[int, "pycolmap.Reconstruction"]) -> list["pycolmap.Reconstruction"]:
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _names(model: "pycolmap.Reconstruction") -> list[str]:
    return [model.image(index).name for index in model.reg_image_ids()]


def _cameras(model: "pycolmap.Reconstruction", photos: dict[str, InputPhoto]) -> list[EstimatedCamera]:
    """The cameras of a model before undistortion, by ascending id."""
    names: dict[int, list[str]] = {}
    for index in model.reg_image_ids():
        names.setdefault(model.image(index).camera_id, []).append(model.image(index).name)
    return [
        EstimatedCamera(
            model=model.camera(index).model.name,
            params=[float(value) for value in model.camera(index).params],
            width=model.camera(index).width,
            height=model.camera(index).height,
            photos=len(members),
            exif_focal=any(photos[name].focal for name in members),
        )
        for index, members in sorted(names.items())
    ]


def run_stage(title: str, work: Callable[[], T], watch: Callable[[], None] = lambda: None) -> T:
    """Return the result of `work`, done in a thread, while this one calls `watch` every 0.2 s and at the end.

    ValueError: pycolmap failed; the message names the stage.
    """
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(work)
        while wait([future], POLL_SECONDS).not_done:
            watch()
    try:
        result = future.result()
    except ERRORS as error:
        raise ValueError(f"{title}: {PYCOLMAP}: {one_line(error) or type(error).__name__}") from error
    watch()
    return result


@contextmanager
def open_database(path: Path) -> Iterator["pycolmap.Database"]:
    """Open COLMAP's database through pycolmap, and close it at the end of the block.

    Python's sqlite3 must not open it: it is a second copy of SQLite in the process, and closing its file releases the
    locks of the first copy, after which pycolmap crashes with a bus error.
    """
    with closing(pycolmap_module().Database.open(str(path))) as database:
        yield database


class Count(Generic[T]):
    """Counts finished items that finish roughly in order; each call checks only the first unfinished ones."""

    def __init__(self, items: Iterable[T], is_done: Callable[[T], bool]) -> None:
        self.items, self.is_done, self.done = list(items), is_done, 0

    def __call__(self) -> int:
        """Number of finished items before the first unfinished one."""
        while self.done < len(self.items) and self.is_done(self.items[self.done]):
            self.done += 1
        return self.done
