"""The one shape of every trajectory estimator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.types import Trajectory
from barsight.recording.base import Recording


class TrajectoryEstimator(Protocol):
    """From a recording to the body's pose at every frame."""

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """`advance` is called once a frame. Frames that can't be placed are refused with a reason."""
        ...
