"""The viewer: shows a model in the browser, during or after training (extra `viewer`)."""

from nexwarp.viewer.gradual import GradualModel
from nexwarp.viewer.server import check_server
from nexwarp.viewer.viewer import Viewer

__all__ = ["GradualModel", "Viewer", "check_server"]
