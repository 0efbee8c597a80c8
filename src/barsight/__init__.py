"""Barsight: measure a yard of steel bars from a travelling crane with two cameras and an IMU."""

from importlib.metadata import version

__version__ = version("barsight")
