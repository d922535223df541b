"""The viewer: shows a model in the browser, during or after training (extra `viewer`)."""

from nexwarp.viewer.server import check_server
from nexwarp.viewer.viewer import Viewer

__all__ = ["Viewer", "check_server"]
