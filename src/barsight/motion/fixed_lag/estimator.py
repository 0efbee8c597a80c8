"""Estimate while the crane travels (fixed lag): each frame's pose from what is known when it comes.

The same factors as the batch estimate's, over the last few frames; what leaves stays as a prior, so time and
memory don't grow with the way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.types import PosedFrame, RefusedFrame, Trajectory
from barsight.inertial.model import ORDINARY_NOISE
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.batch.sensor_agreement import refuse_contradictions
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.fixed_lag.sensor_buffer import ReadingsSoFar
from barsight.motion.frontend.tracking import Sighting, track_incrementally
from barsight.motion.gravity import align_with_gravity
from barsight.recording.base import Recording

if TYPE_CHECKING:
    from barsight.motion.fixed_lag.smoother import FixedLagEstimator


@dataclass(frozen=True)
class FixedLagSettings:
    """The estimate while travelling."""

    frames: int = 8
    """Frames held at a time."""

    def __post_init__(self) -> None:
        if not 3 <= self.frames <= 100:
            raise ConfigError(f"live.frames must lie in 3...100, not {self.frames}")


@dataclass(frozen=True)
class FixedLagFusion:
    """`TrajectoryEstimator` that never looks ahead: `yard` with encoders, else `world`, whose upright is the
    first second's.
    """

    settings: FusionSettings
    live: FixedLagSettings
    crane: CraneSettings

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """Estimate; frames that neither pictures nor encoders place are refused."""
        from barsight.motion.fixed_lag.smoother import FixedLagEstimator

        use = self.settings.sensors
        crane, imu = recording.crane(), recording.imu()
        readings = ReadingsSoFar(
            crane if "crane" in use else None, imu if "imu" in use else None,
            recording.imu_noise() or ORDINARY_NOISE,
        )  # fmt: skip
        if readings.crane is None and "stereo" not in use:
            raise MeasurementError(f"{recording.path}: no crane encoders; estimate with --use stereo")
        shift = recording.rig.timeshift_cam_imu_ns
        level = None if readings.crane is not None else align_with_gravity(recording)
        estimator = FixedLagEstimator(
            self.settings, self.crane, self.live.frames, rectifier, shift, readings, level
        )
        placed: list[PosedFrame] = []
        refused: list[RefusedFrame] = []
        motions: list[Sighting] = []
        for seen in self._frames(recording, rectifier, estimator, advance):
            if isinstance(seen, Sighting):  # without its points: memory doesn't grow with them
                none = slice(0, 0)
                motions.append(replace(
                    seen, track=seen.track[none], stereo=seen.stereo[none], sigma_px=seen.sigma_px[none]
                ))  # fmt: skip
            frame = estimator.take(seen)
            if isinstance(frame, PosedFrame):
                placed.append(frame)
            else:
                refused.append(frame)
        refuse_contradictions(recording.path, motions, readings.imu, readings.crane, rectifier, shift)
        names = {"crane": readings.crane, "imu": readings.imu, "stereo": "stereo" in use or None}
        sensors = tuple(name for name, used in names.items() if used is not None)
        warnings = () if level is None else level.warnings
        return Trajectory(
            "world" if readings.crane is None else "yard", tuple(placed), tuple(refused), sensors, warnings
        )

    def _frames(
        self, recording: Recording, rectifier: Rectifier, estimator: FixedLagEstimator,
        advance: Callable[[], None],
    ) -> Iterator[Sighting | RefusedFrame]:  # fmt: skip
        if "stereo" in self.settings.sensors:
            yield from track_incrementally(
                recording, rectifier, estimator.predict, self.settings.front_end, advance
            )
            return
        for stamp in recording.index.stamps_ns:
            advance()
            yield RefusedFrame(stamp, "no sensor places it")
