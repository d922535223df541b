"""Structure from motion with pycolmap on the CPU: from photos to a COLMAP scene."""

from nexwarp.sfm.options import SfmOptions
from nexwarp.sfm.pipeline import reconstruct
from nexwarp.sfm.process import ProcessReport, process
from nexwarp.sfm.report import SfmReport

__all__ = ["ProcessReport", "SfmOptions", "SfmReport", "process", "reconstruct"]
