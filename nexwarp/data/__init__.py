"""Scenes from COLMAP, nerfstudio, Blender and the built-in demo; the initial points of a training."""

from nexwarp.data.demo import demo_folder
from nexwarp.data.points import InitialPoints, initial_points
from nexwarp.data.scene import Scene, SceneSource, load_scene
from nexwarp.data.views import View

__all__ = ["InitialPoints", "Scene", "SceneSource", "View", "demo_folder", "initial_points", "load_scene"]
