"""The viewer: shows a model in the browser, during or after training (extra `viewer`)."""

from nexwarp.viewer.server import check_server
from nexwarp.viewer.viewer import Viewer, ViewerOptions

__all__ = ["Viewer", "ViewerOptions", "check_server"]
