"""Scenes whose photos have different exposures."""

import dataclasses
from pathlib import Path

from nexwarp.data import Scene, View, load_scene
from nexwarp.io.pictures import save_png, to_uint8


def exposure_at(view: View) -> float:
    return 0.75 + 0.08 * view.camera.position[0].item()


def with_exposures(scene: Scene) -> Scene:
    """Return a scene whose photos grow brighter along the capture."""

    def exposed(views: list[View]) -> list[View]:
        return [dataclasses.replace(view, image=to_uint8(view.image / 255 * exposure_at(view))) for view in views]

    return dataclasses.replace(scene, train=exposed(scene.train), test=exposed(scene.test))


def expose_photos(folder: Path) -> None:
    """Make the photos of a scene grow brighter along the capture, in their PNG files."""
    scene = with_exposures(load_scene(folder))
    for view in (*scene.train, *scene.test):
        save_png(folder / "images" / view.name, view.image)
