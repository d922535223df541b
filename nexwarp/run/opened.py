"""What `nexwarp view`, `render`, `export`, `info` and `eval` open: a run, or a model that Python saved."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cameras.paths import surrounding
from nexwarp.data.scene import SceneSource
from nexwarp.errors import MissingError
from nexwarp.model.model import Model
from nexwarp.model.model_file import MODEL_FILE, SUFFIX, load
from nexwarp.run.folder import CONFIG_FILE, read_run
from nexwarp.train.recipe import Config


@dataclass(frozen=True)
class OpenedModel:
    """A run, or a model alone: its file, or a folder with `model.safetensors` and perhaps `cameras.json`."""

    path: Path  # as the user gave it
    folder: Path  # where results are written; never that of another model
    file: Path  # the model's; a run that has not finished has none yet
    source: SceneSource | None  # the run's scene
    config: Config | None  # the run's settings

    @property
    def title(self) -> str:
        """Name of the scene, or of the model's file or folder."""
        return self.folder.resolve().name if self.source is None else self.source.name

    @cached_property
    def model(self) -> Model:
        """The model, on the CPU."""
        return load(self.file)

    @cached_property
    def cameras(self) -> dict[str, dict[str, Camera]]:
        """Cameras by set and name; none for a model alone without `cameras.json`. MissingError for a run without it."""
        if self.source is None and not (self.folder / CAMERAS_FILE).is_file():
            return {}
        return load_cameras(self.folder / CAMERAS_FILE)

    def path_cameras(self) -> dict[str, dict[str, Camera]]:
        """Return the cameras that a path is made of; for a model without any, a ring around its surfels."""
        if self.source is not None or any(self.cameras.values()):
            return self.cameras
        ring = surrounding(self.model.surfels.means, near_depth(self.model))
        return {"train": {f"around_{index:02d}": camera for index, camera in enumerate(ring)}}


def near_depth(model: Model) -> float:
    """Return the near depth of a model's training cameras, world units; 0.01 if the model does not tell."""
    return near if isinstance(near := model.meta.get("near"), float) else 0.01


def open_model(path: Path) -> OpenedModel:
    """Open a run folder, a folder with a model, or a model's file; the model itself is read on first use."""
    folder = path
    file = path / MODEL_FILE
    if path.is_file() and path.suffix == SUFFIX:
        folder, file = (path.parent if path.name == MODEL_FILE else path.with_suffix("")), path
        if path.name != MODEL_FILE and ((folder / CONFIG_FILE).is_file() or (folder / MODEL_FILE).is_file()):
            folder = path.with_name(f"{path.name}.results")  # another model's folder is left alone
    if (folder / CONFIG_FILE).is_file() and file == folder / MODEL_FILE:
        record = read_run(folder)
        return OpenedModel(path, folder, file, record.source, record.config)
    if not file.is_file():
        raise MissingError(
            f"{path}: expected a run folder or a model, found no {CONFIG_FILE} and no {MODEL_FILE} there"
        )
    return OpenedModel(path, folder, file, None, None)
