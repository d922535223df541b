"""Scene files of the web page, for `tests.robustness.fuzz_targets`."""

from pathlib import Path

from nexwarp.export.web.scene_file import SCENE_FILE, encode_scene
from nexwarp.export.web.scene_reader import load_scene_file
from tests.robustness.fuzz_inputs import Files
from tests.robustness.fuzz_models import some_cameras, some_model


def make_scene_files(folder: Path) -> list[Files]:
    folder.mkdir(parents=True, exist_ok=True)
    cameras = {f"{i}.png": camera for i, camera in enumerate(some_cameras())}
    return [
        {SCENE_FILE: encode_scene(some_model(), cameras, quality="full", poster=b"picture")},
        {SCENE_FILE: encode_scene(some_model(), cameras)},
    ]


def read_scene_files(folder: Path) -> None:
    load_scene_file(folder / SCENE_FILE)
