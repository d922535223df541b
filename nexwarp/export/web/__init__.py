"""Trained scenes in any browser and on any GPU: scene files, the web page, and the WGSL renderer.

`Renderer` runs the page's shaders from Python; it needs the extra `wgpu`.
"""

from nexwarp.export.web.export import export_web
from nexwarp.export.web.renderer import Renderer, WebRendering
from nexwarp.export.web.scene_file import encode_scene
from nexwarp.export.web.scene_reader import load_scene_file

__all__ = ["Renderer", "WebRendering", "encode_scene", "export_web", "load_scene_file"]
