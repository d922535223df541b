"""nexwarp: Nexels, neurally-textured surfels for real-time novel view synthesis, in NVIDIA Warp and PyTorch."""

import os

# Before torch is imported: its idle OpenMP threads would otherwise spin on the cores that the CPU kernels need.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Before cuBLAS is used: without it torch has no deterministic matrix products on CUDA. The size is that of its default.
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

from nexwarp.camera import Camera
from nexwarp.checkpoint import Model, load
from nexwarp.data import Scene, View, load_scene
from nexwarp.render import Rendering, render
from nexwarp.surfels import Surfels
from nexwarp.texture import NeuralTexture

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Model",
    "NeuralTexture",
    "Rendering",
    "Scene",
    "Surfels",
    "View",
    "load",
    "load_scene",
    "render",
]
