"""The viewer: shows a model in the browser, during or after training (extra `viewer`)."""

from nexwarp.viewer.viewer import Viewer, ViewerOptions, listen

__all__ = ["Viewer", "ViewerOptions", "listen"]
