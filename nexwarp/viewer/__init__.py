"""The viewer: shows a model in the browser, during or after training (extra `viewer`)."""

from nexwarp.viewer.viewer import Viewer, ViewerOptions, check_server

__all__ = ["Viewer", "ViewerOptions", "check_server"]
