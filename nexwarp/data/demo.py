"""The built-in scene `demo`: 40 photos of a courtyard with cameras and points, a COLMAP scene in the package.

It is ours: traced by nexwarp/data/raytrace.py of commit 7f7bd6c, the points with the noise and outliers of structure
from motion.
"""

from pathlib import Path


def demo_folder() -> Path:
    """Return the folder of the built-in scene; its files are not to be changed."""
    return Path(__file__).parent / "demo_scene"
