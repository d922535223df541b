"""The scene of most trainings here."""

import pytest

from nexwarp.data import Scene


@pytest.fixture(scope="session")
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene
