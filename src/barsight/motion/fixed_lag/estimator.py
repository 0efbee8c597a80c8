"""Estimate while the crane travels (fixed lag): each frame's pose from what is known when it arrives.

The factors are those of the batch estimate, over the last few frames. What leaves the window stays as a
prior, so time and memory don't grow with the travel.
"""

from __future__ import annotations

from dataclasses import dataclass

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, MeasurementError
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.settings.values import expect_ranges
from barsight.core.stamps import seconds_to_ns
from barsight.inertial.model import ORDINARY_NOISE, saturation_sentences, without_saturation
from barsight.motion.batch.camera_offset import camera_doubts
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.batch.sensor_agreement import refuse_contradictions
from barsight.motion.crane.encoder_delay import shifted_back
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.estimator import FrameInput, ImmediatePoses, TrajectoryEstimator, pictures_of
from barsight.motion.fixed_lag.propagation import NavigationState
from barsight.motion.fixed_lag.sensor_buffer import SENSOR_DELAY_S, SensorBuffer
from barsight.motion.frontend.chains import UNTIED, untied_sentence
from barsight.motion.frontend.sightings import DisparityStep, Sighting, rig_moved
from barsight.motion.frontend.tracking import Tracker
from barsight.motion.gravity import align_with_gravity
from barsight.recording.base import Recording
from barsight.recording.sensor_samples import expect_usable


@dataclass(frozen=True)
class FixedLagSettings:
    """The estimate while travelling."""

    frames: int = 8
    """Number of frames held in the window at a time."""

    def __post_init__(self) -> None:
        expect_ranges(self, "live.", frames=(3, 100))


@dataclass(frozen=True)
class FixedLagFusion(TrajectoryEstimator):
    """Estimates without looking ahead; the reference is `yard` with encoders, else `world`, whose vertical is
    taken from the first second.
    """

    begins_early = True
    delay_ns = seconds_to_ns(SENSOR_DELAY_S)
    settings: FusionSettings
    live: FixedLagSettings
    crane: CraneSettings

    def begin(self, recording: Recording, rectifier: Rectifier) -> FixedLagPoses:
        """Begin; without encoders the IMU's first second must already be there. Raises MeasurementError where
        no sensor that places the body is left to use.
        """
        return FixedLagPoses(self, recording, rectifier)


class FixedLagPoses(ImmediatePoses):
    """`PoseEstimator` over a window of the last frames. untied: number of last frames whose pictures don't
    follow from those before.
    """

    def __init__(self, estimator: FixedLagFusion, recording: Recording, rectifier: Rectifier) -> None:
        from barsight.motion.fixed_lag.smoother import FixedLagEstimator

        super().__init__()
        settings = estimator.settings
        self._use, self._recording, self._rectifier = settings.sensors, recording, rectifier
        self._noise = recording.imu_noise() or ORDINARY_NOISE
        self.reads_pictures = "stereo" in self._use
        readings = self._readings()
        expect_usable(recording.path, readings.crane, readings.imu)
        self.delay_ns = readings.delay_ns
        if readings.crane is None and not self.reads_pictures:
            raise MeasurementError(f"{recording.path}: no crane encoders; estimate with use: stereo")
        self._level = None if readings.crane is not None else align_with_gravity(recording)
        self._estimator = FixedLagEstimator(
            settings, estimator.crane, estimator.live.frames, rectifier,
            recording.rig.timeshift_cam_imu_ns, readings, self._level,
        )  # fmt: skip
        self._tracker = Tracker(self._estimator.predict, settings.front_end)
        self.untied = self._apart = 0
        self._steps: list[DisparityStep] = []

    def place(self, seen: FrameInput) -> PosedFrame | RefusedFrame:
        """Track the frame and estimate its pose."""
        self._estimator.readings = readings = self._readings()
        self.delay_ns = readings.delay_ns + max(0, self._estimator.delay.late_ns)
        pair = pictures_of(seen)
        tracked: Sighting | RefusedFrame
        if isinstance(pair, Failed):
            tracked = RefusedFrame(seen.stamp_ns, pair.reason)
        else:
            tracked = self._tracker.push(pair)
        self._apart += isinstance(tracked, Sighting) and tracked.sides_apart
        is_tied = isinstance(tracked, Sighting) and (tracked.motion or tracked.again) is not None
        self.untied = 0 if is_tied else self.untied + 1
        if isinstance(tracked, RefusedFrame) and tracked.is_stale:
            return tracked
        if isinstance(tracked, Sighting) and tracked.step is not None:
            self._steps.append(tracked.step)
        return self._estimator.take(tracked)

    @property
    def navigation(self) -> NavigationState | None:
        """Return the latest estimated state; None before the first."""
        window = self._estimator.window
        return None if window is None or window.newest is None else window.navigation

    @property
    def encoders_off_m(self) -> Float64:
        """Return by how much each encoder is off by now, (3,)."""
        return self._estimator.watch.off_m

    def finish(self) -> Trajectory:
        """Return all poses. Raises InputError where the pictures contradict a sensor."""
        readings = self._estimator.readings
        imu, spoiled = (None, 0) if readings.imu is None else without_saturation(readings.imu)
        crane = readings.crane and shifted_back(readings.crane, self._estimator.delay.late_ns)
        refuse_contradictions(
            self._recording.path, self._estimator.motions, imu, crane, self._rectifier,
            self._recording.rig.timeshift_cam_imu_ns,
        )  # fmt: skip
        names = {"crane": readings.crane, "imu": readings.imu, "stereo": self.reads_pictures or None}
        sensors = tuple(name for name, used in names.items() if used is not None)
        doubts, warnings = self._estimator.encoder_faults()
        doubts += camera_doubts(
            self._estimator.motions, self._rectifier, self._recording.rig.timeshift_cam_imu_ns,
            crane and self._estimator.watch.usable(crane), self._estimator.delay.search,
        )  # fmt: skip
        if self._level is not None:
            warnings += self._level.warnings
        warnings += saturation_sentences(spoiled)
        if untied := sum(frame.reason == UNTIED for frame in self.refused):
            doubts += (untied_sentence(untied),)
        return Trajectory(
            "world" if readings.crane is None else "yard", self._estimator.told_later(self.placed),
            tuple(self.refused), sensors, warnings, doubts=doubts,
            rig_moved=rig_moved(self._steps, self._apart, self._recording.index.stamps_ns),
        )  # fmt: skip

    def _readings(self) -> SensorBuffer:
        """Read the sensors' readings so far."""
        recording, use = self._recording, self._use
        return SensorBuffer(
            recording.crane() if "crane" in use else None, recording.imu() if "imu" in use else None,
            self._noise,
        )  # fmt: skip
