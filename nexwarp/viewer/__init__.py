"""The viewer: a trained scene, or one in training, in the browser (extra `viewer`)."""

from nexwarp.viewer.server import check_server
from nexwarp.viewer.viewer import Viewer

__all__ = ["Viewer", "check_server"]
