"""View a recording through a calibration other than its own."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.calibration.geometry.rig import StereoRig
from barsight.recording.wrapper import RecordingProxy


@dataclass(frozen=True, eq=False)
class RecordingWithRig(RecordingProxy):
    """Recording `whole` with the calibration `own_rig`."""

    own_rig: StereoRig

    @property
    def rig(self) -> StereoRig:
        return self.own_rig
