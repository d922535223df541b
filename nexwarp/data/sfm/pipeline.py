"""The stages of structure from motion, from photos to a scene."""

import dataclasses
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from nexwarp.data.lens import pycolmap_module
from nexwarp.data.sfm.options import EXHAUSTIVE_UP_TO, SfmOptions
from nexwarp.data.sfm.pairs import exhaustive_pairs, sequential_pairs
from nexwarp.data.sfm.photos import InputPhoto, camera_groups, camera_model, list_photos, read_photos
from nexwarp.data.sfm.report import EstimatedCamera, Overlaps, SfmReport, advise, left_out
from nexwarp.data.sfm.work import Count, open_database, quiet, run_stage
from nexwarp.io.files import make_folders, remove_empty
from nexwarp.io.json_files import Json, write_json

if TYPE_CHECKING:
    import pycolmap

REPORT_FILE = "sfm.json"
JPEG_QUALITY = 95  # of undistorted JPEG photos; other formats are lossless
MATCH_BLOCK = 16  # pairs between two checks for an interruption
MIN_MODEL = 3  # photos of a model

Observer = Callable[[str, int, int], None]


def reconstruct(
    photos: str | os.PathLike[str],
    scene: str | os.PathLike[str],
    options: SfmOptions | None = None,
    *,
    overwrite: bool = False,
    observe: Observer = lambda stage, done, total: None,
    notes: Mapping[str, Json] | None = None,
) -> SfmReport:
    """Estimate the cameras and points of photos, and write a COLMAP scene for `load_scene`.

    The scene holds images/ (undistorted, with the given names), sparse/0 (PINHOLE cameras) and sfm.json (the report and
    the options). It is written to a temporary folder beside `scene` and renamed at the end; a failure or interruption
    leaves no files.

    Args:
        photos: folder of the photos, searched with its subfolders; hidden files are ignored.
        scene: folder to write; must be empty or absent.
        options: settings; None is the defaults.
        overwrite: replace `scene` if this function wrote it.
        observe: called repeatedly with the stage's name, the number of finished items and their total.
        notes: further entries of sfm.json.

    Returns:
        The report.

    Raises:
        FileNotFoundError: no folder `photos`.
        FileExistsError: `scene` exists and may not be replaced.
        ValueError: an option out of range, fewer than 3 photos, a photo that cannot be decoded, photos of one camera
            that differ in size, or no model was found; then the message gives advice.
    """
    photos, scene, options = Path(photos), Path(scene), options or SfmOptions()
    options.check()
    names = list_photos(photos)
    check_target(photos, scene, overwrite)
    with (
        parents(scene),
        tempfile.TemporaryDirectory(
            dir=scene.parent, prefix=f".{scene.name}-", ignore_cleanup_errors=True
        ) as temporary,
        quiet(),
    ):
        work = _Work(photos, Path(temporary), options, observe)
        report = work.run(names)
        made = work.folder / "scene"
        entries = dataclasses.asdict(report) | {"options": dataclasses.asdict(options)}
        write_json(made / REPORT_FILE, entries | dict(notes or {}))
        _publish(made, scene, work.folder / "replaced")
    return report


@dataclass
class _Work:
    """The stages; they share COLMAP's database in a temporary folder."""

    photos: Path
    folder: Path
    options: SfmOptions
    observe: Observer
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    @property
    def threads(self) -> int:
        return self.options.threads or -1

    def run(self, names: Sequence[str]) -> SfmReport:
        with self._stage("reading", len(names)) as done:
            photos = read_photos(self.photos, names, done)
            groups = camera_groups(self.photos, photos, self.options.cameras)
        with self._stage("features", len(names)) as done:
            self._import(groups)
            self._extract(names, done)
        sequential = self.options.matching == "sequential" or (
            self.options.matching == "auto" and len(names) > EXHAUSTIVE_UP_TO
        )
        count = len(names)
        pairs = sequential_pairs(count, self.options.overlap) if sequential else exhaustive_pairs(count)
        with self._stage("matching", len(pairs)) as done:
            self._match(names, pairs, done)
            overlaps = self._overlaps(len(pairs), sequential)
        with self._stage("mapping", len(names)) as done:
            models = self._map(overlaps, done)
        registered = _names(models[0])
        with self._stage("undistorting", len(registered)) as done:
            sizes = self._undistort(models[0], done)
        return SfmReport(
            photos=len(names),
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
            seconds={stage: round(value, 2) for stage, value in self.seconds.items()},
            advice=advise(overlaps, len(registered)),
        )

    @contextmanager
    def _stage(self, title: str, total: int) -> Iterator[Callable[[int], None]]:
        start = time.perf_counter()
        self.observe(title, 0, total)
        yield lambda done: self.observe(title, min(done, total), total)
        self.observe(title, total, total)
        self.seconds[title] = time.perf_counter() - start

    def _import(self, groups: Sequence[Sequence[InputPhoto]]) -> None:
        """Enter photos and cameras in the database, in a fixed order, since the mapper's result depends on it."""
        with open_database(self.database):  # creates the file
            pass
        for group in groups:
            self._import_group([photo.name for photo in group], camera_model(group, self.options))
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

    def _import_group(self, names: list[str], model: str) -> None:
        pycolmap = pycolmap_module()
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = model
        single = pycolmap.CameraMode.SINGLE
        run_stage(
            "features",
            lambda _: pycolmap.import_images(self.database, self.photos, single, names, reader),
            lambda: None,
        )

    def _extract(self, names: Sequence[str], done: Callable[[int], None]) -> None:
        pycolmap = pycolmap_module()
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads = self.threads
        extraction.max_image_size = self.options.max_image_size
        extraction.sift.max_num_features = self.options.max_features
        with open_database(self.database) as database:
            images = {image.name: image.image_id for image in database.read_all_images()}
            count = Count((images[name] for name in names), database.exists_descriptors)
            run_stage(
                "features",
                lambda token: pycolmap.extract_features(
                    self.database,
                    self.photos,
                    list(names),
                    extraction_options=extraction,
                    device=pycolmap.Device.cpu,
                    cancellation_token=token,
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
                lambda token: pycolmap.match_image_pairs(
                    self.database, matching, pairing, verification, device=pycolmap.Device.cpu, cancellation_token=token
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

    def _map(self, overlaps: Overlaps, done: Callable[[int], None]) -> list["pycolmap.Reconstruction"]:
        """Return all models, largest first."""
        pycolmap = pycolmap_module()
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = self.threads
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self.options.seed
        options.min_model_size = MIN_MODEL
        registered = 0

        def first_pair() -> None:
            nonlocal registered
            registered = 2

        def next_photo() -> None:
            nonlocal registered
            registered += 1

        (self.folder / "models").mkdir()
        made = run_stage(
            "mapping",
            lambda token: pycolmap.incremental_mapping(
                self.database,
                self.photos,
                self.folder / "models",
                options,
                initial_image_pair_callback=first_pair,
                next_image_callback=next_photo,
                cancellation_token=token,
            ),
            lambda: done(registered),
        )
        models = sorted(made.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
        if not models or models[0].num_reg_images() < MIN_MODEL or not models[0].num_points3D():
            best = models[0].num_reg_images() if models else 0
            advice = "; ".join(advise(overlaps, 0))
            raise ValueError(
                f"{self.photos}: no scene could be made: {best} of {len(overlaps.features)} photos registered, "
                f"expected at least {MIN_MODEL}; {len(overlaps.inliers)} of {overlaps.pairs} pairs overlap; {advice}"
            )
        return models

    def _undistort(self, model: "pycolmap.Reconstruction", done: Callable[[int], None]) -> list[tuple[int, int]]:
        """Write the scene; return the distinct sizes of its photos."""
        pycolmap = pycolmap_module()
        chosen, output = self.folder / "model", self.folder / "undistorted"
        chosen.mkdir()
        model.write_binary(str(chosen))
        run_stage(
            "undistorting",
            lambda token: pycolmap.undistort_images(
                output,
                chosen,
                self.photos,
                jpeg_quality=JPEG_QUALITY,
                num_threads=self.threads,
                cancellation_token=token,
            ),
            lambda: done(sum(len(files) for _, _, files in os.walk(output / "images"))),
        )
        scene = self.folder / "scene"
        (scene / "sparse").mkdir(parents=True)
        (output / "images").rename(scene / "images")
        (output / "sparse").rename(scene / "sparse" / "0")
        cameras = pycolmap.Reconstruction(str(scene / "sparse" / "0")).cameras.values()
        return sorted({(camera.width, camera.height) for camera in cameras})


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


def check_target(photos: Path, scene: Path, overwrite: bool) -> None:
    """Raise FileExistsError or ValueError if `scene` may not be written, before any work."""
    source, target = photos.resolve(), scene.resolve()
    if source.is_relative_to(target) or target.is_relative_to(source):
        raise ValueError(f"{scene}: expected a scene folder apart from the photos in {photos}")
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return
    if not overwrite:
        raise FileExistsError(f"{scene}: expected a new folder, but it exists; give --overwrite or another one")
    if not (scene / REPORT_FILE).is_file():
        raise FileExistsError(
            f"{scene}: expected a scene of nexwarp sfm to overwrite, but it holds no {REPORT_FILE}; not touching it"
        )


@contextmanager
def parents(scene: Path) -> Iterator[None]:
    """Create the folders above `scene`; after an error, remove those of them that are empty."""
    created = make_folders(scene.absolute().parent)
    try:
        yield
    except BaseException:
        remove_empty(created)
        raise


def _publish(made: Path, scene: Path, aside: Path) -> None:
    """Rename `made` to `scene`. An existing scene is moved to `aside`, and moved back if that fails."""
    if not scene.exists():
        made.rename(scene)
        return
    scene.rename(aside)
    try:
        made.rename(scene)
    except BaseException:
        shutil.rmtree(scene, ignore_errors=True)
        aside.rename(scene)
        raise
