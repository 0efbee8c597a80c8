"""Define the protocol of every trajectory estimator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.types import Trajectory
from barsight.recording.base import Recording


class TrajectoryEstimator(Protocol):
    """Protocol: estimate the body's pose at every frame of a recording."""

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """Estimate; `advance` is called once a frame.

        Frames that can't be placed are refused with a reason.
        """
        ...
