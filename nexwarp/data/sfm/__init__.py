"""Structure from motion with pycolmap on the CPU: from photos to a COLMAP scene."""

from nexwarp.data.sfm.options import SfmOptions
from nexwarp.data.sfm.pipeline import reconstruct
from nexwarp.data.sfm.process import ProcessReport, process
from nexwarp.data.sfm.report import SfmReport

__all__ = ["ProcessReport", "SfmOptions", "SfmReport", "process", "reconstruct"]
