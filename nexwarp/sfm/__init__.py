"""Structure from motion: bare photos to a COLMAP scene, with pycolmap, on the CPU."""

from nexwarp.sfm.options import SfmOptions
from nexwarp.sfm.pipeline import reconstruct
from nexwarp.sfm.report import SfmReport

__all__ = ["SfmOptions", "SfmReport", "reconstruct"]
