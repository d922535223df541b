"""The stages of structure from motion with pycolmap, from photos to a scene; they run in a process of their own."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, TypeVar

from nexwarp.data.capture import Photo
from nexwarp.data.colmap import read_model
from nexwarp.data.images import read_image, read_in_threads
from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm.panoramas import cut_panoramas, find_panoramas, rig, view_groups
from nexwarp.data.sfm.photos import InputPhoto, affordable_threads, camera_groups, camera_model, read_photos
from nexwarp.data.sfm.report import (
    EXHAUSTIVE_UP_TO,
    PYCOLMAP,
    EstimatedCamera,
    Observer,
    Overlaps,
    SfmOptions,
    SfmReport,
    advise,
    left_out,
)
from nexwarp.io.files import one_line

if TYPE_CHECKING:
    import pycolmap
else:
    pycolmap = pycolmap_module()

JPEG_QUALITY = 95  # of undistorted JPEG photos; other formats are lossless
TILE = 16  # photos; the pairs of two tiles are matched together, so that their features stay in memory
MATCH_BLOCK = 16  # pairs that are matched together
MIN_MODEL = 3  # photos of a model
POLL_SECONDS = 0.5
ONLY_FATAL = 3  # glog level
# Exceptions of pycolmap 4.2; failed checks raise ValueError or RuntimeError.
ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError)

T = TypeVar("T")


@dataclass(frozen=True)
class Stage:
    """A stage: its title, the number of its items, and who is told how many of them are done."""

    title: str
    total: int
    observe: Observer

    def done(self, count: int) -> None:
        """Tell how many items are done."""
        self.observe(self.title, min(count, self.total), self.total)

    def run(self, work: Callable[[], T], count: Callable[[], int] = lambda: 0) -> T:
        """Return the result of `work`, done in a thread, while this one tells what `count` returns.

        ValueError: pycolmap failed; the message names the stage.
        """
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(work)
            while wait([future], POLL_SECONDS).not_done:
                self.done(count())
        try:
            return future.result()
        except ERRORS as error:
            raise ValueError(f"{self.title}: {PYCOLMAP}: {one_line(error) or type(error).__name__}") from error


class Stages:
    """The stages; they share COLMAP's database in a folder of their own, and leave the scene in its subfolder."""

    def __init__(self, photos: Path, folder: Path, options: SfmOptions, observe: Observer) -> None:
        self.photos, self.folder, self.options, self.observe = photos, folder, options, observe
        self.readable = folder / "photos"  # what pycolmap reads: links to the photos, and upright copies
        self.database = folder / "database.db"
        self.threads = options.threads or -1  # in pycolmap's notation: -1 is one a core
        self.decoders = 1  # threads that may each hold a photo
        self.views: dict[str, str] = {}  # name of a panorama's view -> name of the panorama
        self.known: set[int] = set()  # ids of the views' cameras
        self.seconds: dict[str, float] = {}

    def run(self, names: Sequence[str]) -> SfmReport:
        """Reconstruct the photos of these names, and return the report."""
        pycolmap.logging.minloglevel = ONLY_FATAL
        names = self._cut(names)
        given = len(names)
        with self._stage("reading", given) as stage:
            self.decoders = affordable_threads(self.photos, names, self.options)
            strict = self.options.strict
            photos, skipped = read_photos(self.photos, names, self.decoders, stage.done, self.readable, strict)
            plain = [photo for photo in photos if photo.name not in self.views]
            groups = camera_groups(self.photos, plain, self.options.cameras)
            groups += view_groups([photo for photo in photos if photo.name in self.views])
        names = [photo.name for photo in photos]
        with self._stage("features", len(names)) as stage:
            self._import(groups, stage)
            self._extract(names, stage)
        sequential = self.options.matching == "sequential" or (
            self.options.matching == "auto" and len(names) > EXHAUSTIVE_UP_TO
        )
        pairs = self._pairs(names, sequential)
        with self._stage("matching", len(pairs)) as stage:
            self._match(names, pairs, stage)
            overlaps = self._overlaps(len(pairs), sequential)
        with self._stage("mapping", len(names)) as stage:
            models, mapper = self._map(overlaps, stage)
        registered = _names(models[0])
        with self._stage("undistorting", len(registered)) as stage:
            self._undistort(models[0], stage)
        with self._stage("checking", len(registered)) as stage:
            sizes = self._check(stage)
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
    def _stage(self, title: str, total: int) -> Iterator[Stage]:
        start, stage = time.perf_counter(), Stage(title, total, self.observe)
        stage.done(0)
        yield stage
        stage.done(total)
        self.seconds[title] = time.perf_counter() - start

    def _cut(self, names: Sequence[str]) -> list[str]:
        """Replace panoramas by views of them; return the names of all photos."""
        panoramas = find_panoramas(self.photos, names)
        if not panoramas:
            return list(names)
        if self.options.mapper == "global":  # in what it makes of rigs, most pairs of photos contradict the cameras
            raise ValueError(f"{self.photos}: mapper: expected incremental for panoramas, got global")
        folder = self.folder / "views"
        with self._stage("cutting panoramas", len(panoramas)) as stage:
            origins = cut_panoramas(self.photos, names, panoramas, folder, stage.done)
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

    def _open_database(self) -> pycolmap.Database:
        """Open COLMAP's database through pycolmap, which closes it at the end of a `with` block.

        Python's sqlite3 must not open it: it is a second copy of SQLite in the process, and closing its file releases
        the locks of the first copy, after which pycolmap crashes with a bus error.
        """
        return pycolmap.Database.open(str(self.database))

    def _import(self, groups: Sequence[Sequence[InputPhoto]], stage: Stage) -> None:
        """Enter photos and cameras in the database, in a fixed order, since the mapper's result depends on it."""
        self._open_database().close()  # creates the file
        reader, single = pycolmap.ImageReaderOptions(), pycolmap.CameraMode.SINGLE
        for group in groups:
            names = [photo.name for photo in group]
            reader.camera_model = "PINHOLE" if names[0] in self.views else camera_model(group, self.options)
            stage.run(partial(pycolmap.import_images, self.database, self.readable, single, names, reader))
        by_name = {photo.name: group for group in groups for photo in group}
        with self._open_database() as database:
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

    def _extract(self, names: Sequence[str], stage: Stage) -> None:
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads = self.decoders
        extraction.max_image_size = self.options.max_image_size
        extraction.sift.max_num_features = self.options.max_features
        device = pycolmap.Device.cpu
        with self._open_database() as database:
            images = [image.image_id for image in database.read_all_images()]
            stage.run(
                lambda: pycolmap.extract_features(
                    self.database, self.readable, list(names), extraction_options=extraction, device=device
                ),
                lambda: sum(map(database.exists_descriptors, images)),
            )

    def _match(self, names: Sequence[str], pairs: Sequence[tuple[int, int]], stage: Stage) -> None:
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.num_threads = self.threads
        verification.ransac.random_seed = self.options.seed
        pairing = pycolmap.ImportedPairingOptions()
        pairing.block_size = MATCH_BLOCK
        pairing.match_list_path = self.folder / "pairs.txt"
        # COLMAP splits the lines of this file at spaces, so photos are renamed to numbers without spaces.
        Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in pairs))
        self._rename({name: str(index) for index, name in enumerate(names)})
        device = pycolmap.Device.cpu
        with self._open_database() as database:
            stage.run(
                lambda: pycolmap.match_image_pairs(self.database, matching, pairing, verification, device=device),
                database.num_verified_image_pairs,  # of pairs without a match, too
            )
        self._rename({str(index): name for index, name in enumerate(names)})

    def _rename(self, new_names: dict[str, str]) -> None:
        with self._open_database() as database:
            for image in database.read_all_images():
                image.name = new_names[image.name]
                database.update_image(image)

    def _overlaps(self, pairs: int, sequential: bool) -> Overlaps:
        with self._open_database() as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            features = {name: database.num_keypoints_for_image(index) for index, name in images.items()}
            inliers: dict[tuple[str, str], int] = {}
            for pair, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
                if count:
                    one, other = pycolmap.pair_id_to_image_pair(pair)
                    inliers[images[one], images[other]] = count
        return Overlaps(features, inliers, pairs, sequential)

    def _map(self, overlaps: Overlaps, stage: Stage) -> tuple[list[pycolmap.Reconstruction], str]:
        """Return all models, largest first, and the mapper that made them."""
        chosen, used, models = self.options.mapper, "incremental", list[pycolmap.Reconstruction]()
        if chosen != "global":
            models = _largest_first(self._incrementally(stage))
        missed = _most_photos(models) < len(overlaps.features)
        if chosen == "global" or (chosen == "auto" and missed and not self.views):
            try:
                others = _largest_first(self._globally(stage))
            except ValueError:
                if chosen == "global":
                    raise
                others = []  # what the first mapper made stays
            if _most_photos(others) > _most_photos(models):
                models, used = others, "global"
        best = _most_photos(models)
        if best < MIN_MODEL or not models[0].num_points3D():
            advice = "; ".join(advise(overlaps, 0))
            raise ValueError(
                f"{self.photos}: no scene could be made: {best} of {len(overlaps.features)} photos registered, "
                f"expected at least {MIN_MODEL}; {len(overlaps.inliers)} of {overlaps.pairs} pairs overlap; {advice}"
            )
        return models, used

    def _incrementally(self, stage: Stage) -> dict[int, pycolmap.Reconstruction]:
        """Register one photo after another."""
        registered = list[None]()
        options = pycolmap.IncrementalPipelineOptions()
        options.triangulation.random_seed = self.options.seed
        options.constant_cameras, options.ba_refine_sensor_from_rig = self.known, False
        run = partial(
            pycolmap.incremental_mapping,
            initial_image_pair_callback=lambda: registered.extend([None, None]),
            next_image_callback=lambda: registered.append(None),
        )
        work = self._mapping(run, options, "models")
        return stage.run(work, lambda: len(registered))

    def _globally(self, stage: Stage) -> dict[int, pycolmap.Reconstruction]:
        """Estimate all rotations, then all positions, at once."""
        return stage.run(self._mapping(pycolmap.global_mapping, pycolmap.GlobalPipelineOptions(), "global"))

    def _mapping(
        self,
        run: Callable[..., dict[int, pycolmap.Reconstruction]],
        options: pycolmap.IncrementalPipelineOptions | pycolmap.GlobalPipelineOptions,
        name: str,
    ) -> Callable[[], dict[int, pycolmap.Reconstruction]]:
        """Return the work of a mapper, in a folder of that name, with the options that both mappers have."""
        options.num_threads = options.mapper.num_threads = self.threads
        options.random_seed = options.mapper.random_seed = self.options.seed
        options.min_model_size = MIN_MODEL
        folder = self.folder / name
        folder.mkdir()
        return lambda: run(self.database, self.readable, folder, options)

    def _undistort(self, model: pycolmap.Reconstruction, stage: Stage) -> None:
        """Write the scene."""
        chosen, output = self.folder / "model", self.folder / "undistorted"
        chosen.mkdir()
        model.write_binary(str(chosen))
        stage.run(
            lambda: pycolmap.undistort_images(
                output, chosen, self.readable, jpeg_quality=JPEG_QUALITY, num_threads=self.decoders
            ),
            lambda: sum(len(files) for _, _, files in os.walk(output / "images")),
        )
        scene = self.folder / "scene"
        (scene / "sparse").mkdir(parents=True)
        (output / "images").rename(scene / "images")
        (output / "sparse").rename(scene / "sparse" / "0")

    def _check(self, stage: Stage) -> list[tuple[int, int]]:
        """Read what was written, as pycolmap tells no fault of the disk; return the distinct sizes of the photos."""
        images = self.folder / "scene" / "images"
        photos = read_model(self.folder / "scene", images).photos

        def check(photo: Photo) -> tuple[int, int]:
            height, width, _ = read_image(photo.file).shape
            if (width, height) != (photo.lens.width, photo.lens.height):
                raise ValueError(f"{photo.name}: {PYCOLMAP}: it wrote {width}x{height} pixels")
            return width, height

        return sorted(set(read_in_threads(check, photos, self.decoders, stage.done)))


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
    ends = ((i, i + offset) for i in range(count) for offset in offsets if i + offset < count or offset <= overlap)
    pairs = {(min(i, j % count), max(i, j % count)) for i, j in ends}
    return sorted((i, j) for i, j in pairs if i != j)


def _largest_first(models: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _most_photos(models: Sequence[pycolmap.Reconstruction]) -> int:
    """Number of photos of the first and largest model; 0 without any."""
    return models[0].num_reg_images() if models else 0


def _names(model: pycolmap.Reconstruction) -> list[str]:
    return [model.image(index).name for index in model.reg_image_ids()]


def _cameras(model: pycolmap.Reconstruction, photos: dict[str, InputPhoto]) -> list[EstimatedCamera]:
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
