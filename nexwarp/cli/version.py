"""The version of nexwarp."""

__version__ = "0.2.0"
