"""Scenes from COLMAP, nerfstudio, Blender and the built-in demo; the initial points of a training."""

from nexwarp.data.points import InitialPoints, initial_points
from nexwarp.data.scene import Scene, SceneSource, demo_folder, load_scene
from nexwarp.data.views import View

__all__ = ["InitialPoints", "Scene", "SceneSource", "View", "demo_folder", "initial_points", "load_scene"]
