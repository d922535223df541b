"""nexwarp: Nexels, neurally-textured surfels for real-time novel view synthesis, in NVIDIA Warp and PyTorch."""

import os
import signal
import sys
from typing import NoReturn


def _interrupted(*_: object) -> NoReturn:
    """End the command, of which nothing has begun; of several ranks, one says so."""
    if os.environ.get("RANK", "0") == "0":
        os.write(2, b"nexwarp: interrupted\n")
    os._exit(130)


# While the command `nexwarp` loads its libraries, for seconds, Ctrl-C would print a traceback.
_program = os.path.basename(sys.argv[0]) if sys.argv else ""
_is_command = _program in ("nexwarp", "nexwarp.exe") or (_program == "-m" and "nexwarp" in sys.orig_argv)
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _interrupted)

# Before torch is imported: its idle OpenMP threads would otherwise spin on the cores that the CPU kernels need.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Before cuBLAS is used: without it torch has no deterministic matrix products on CUDA. The size is that of its default.
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

if "RANK" in os.environ:
    # Of several ranks: torch's warnings of closed connections would bury the line that says which rank has ended.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.cameras_file import load_cameras
from nexwarp.cameras.paths import ellipse
from nexwarp.cameras.ray_camera import RayCamera
from nexwarp.cli import __version__ as __version__
from nexwarp.data import Scene, View, load_scene
from nexwarp.export.baked_scene import BakedScene, load_baked
from nexwarp.model.exposures import Exposures
from nexwarp.model.model import Model
from nexwarp.model.model_file import load
from nexwarp.model.options import RenderOptions
from nexwarp.model.rasterize import compose, rasterize
from nexwarp.model.render import Rendering, render
from nexwarp.model.surfels import Surfels
from nexwarp.model.texture import DetailLimits, Hits, NeuralTexture, Texture, register_texture
from nexwarp.ops import tape as tape
from nexwarp.train.api import train
from nexwarp.train.densify import DensityControl
from nexwarp.train.recipe import Config, preset
from nexwarp.train.report import StepReport
from nexwarp.train.target import Target
from nexwarp.train.trainer import Trainer

__all__ = [
    "BakedScene",
    "Camera",
    "Config",
    "DensityControl",
    "DetailLimits",
    "Exposures",
    "Hits",
    "Model",
    "NeuralTexture",
    "RayCamera",
    "RenderOptions",
    "Rendering",
    "Scene",
    "StepReport",
    "Surfels",
    "Target",
    "Texture",
    "Trainer",
    "View",
    "compose",
    "ellipse",
    "load",
    "load_baked",
    "load_cameras",
    "load_scene",
    "preset",
    "rasterize",
    "register_texture",
    "render",
    "train",
]
