"""Structure from motion with pycolmap on the CPU: from photos or a video to a COLMAP scene."""

from nexwarp.data.sfm.process import process
from nexwarp.data.sfm.report import SfmOptions, SfmReport

__all__ = ["SfmOptions", "SfmReport", "process"]
