"""Barsight: measure a yard of steel bars from a travelling crane with two cameras and an IMU.

import barsight as bs
yard = bs.measure("recording", preset="fast")
yard.height_map, yard.bundles, yard.lifts
yard.save("out")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from barsight.api import calibrate_stereo, disparity, load, measure, open_recording, packets
    from barsight.calibration.geometry.rig import StereoRig
    from barsight.calibration.stereo.calibration import StereoCalibration
    from barsight.core.errors import BarsightError
    from barsight.core.records.disparity import Disparity
    from barsight.core.records.heights import Contour
    from barsight.core.records.pairs import StereoFrame
    from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
    from barsight.measure_settings import MeasureSettings
    from barsight.reconstruction.live_map import Snapshot
    from barsight.result import Lifts, LiftTarget, Yard
    from barsight.result_folder import CameraPath
    from barsight.session import Session
    from barsight.yard.types import Bundle, HeightMap

    __version__: str

__all__ = [
    "BarsightError", "Bundle", "CameraPath", "Contour", "CraneSamples", "Disparity", "HeightMap",
    "ImuSamples", "LaserProfile", "LiftTarget", "Lifts", "MeasureSettings", "Session", "Snapshot",
    "StereoCalibration", "StereoFrame", "StereoRig", "Yard", "__version__",
    "calibrate_stereo", "disparity", "load", "measure", "open_recording", "packets",
]  # fmt: skip

_HOMES = {
    "barsight.api": ("calibrate_stereo", "disparity", "load", "measure", "open_recording", "packets"),
    "barsight.calibration.geometry.rig": ("StereoRig",),
    "barsight.calibration.stereo.calibration": ("StereoCalibration",),
    "barsight.core.errors": ("BarsightError",),
    "barsight.core.records.disparity": ("Disparity",),
    "barsight.core.records.heights": ("Contour",),
    "barsight.core.records.pairs": ("StereoFrame",),
    "barsight.core.records.sensor_samples": ("CraneSamples", "ImuSamples", "LaserProfile"),
    "barsight.reconstruction.live_map": ("Snapshot",),
    "barsight.measure_settings": ("MeasureSettings",),
    "barsight.result": ("LiftTarget", "Lifts", "Yard"),
    "barsight.result_folder": ("CameraPath",),
    "barsight.session": ("Session",),
    "barsight.yard.types": ("Bundle", "HeightMap"),
}


def __getattr__(name: str) -> Any:
    """Load a name on its first use [PEP 562]."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("barsight")
    else:
        home = next((home for home, names in _HOMES.items() if name in names), None)
        if home is None:
            raise AttributeError(f"module 'barsight' has no attribute {name!r}")
        value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
