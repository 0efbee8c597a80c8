"""Estimate a recording's trajectory from those of cameras, IMU and encoders that it has, in one batch."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError, Failed, InputError, MeasurementError
from barsight.core.motion_detail import NormalisedResiduals
from barsight.core.records.pairs import NamedPoints, RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.settings.values import NOT_NEGATIVE, OVER_0, expect_ranges
from barsight.core.stamps import seconds_to_ns
from barsight.inertial.model import ORDINARY_NOISE, saturation_sentences, without_saturation
from barsight.motion.batch.camera_offset import camera_doubts
from barsight.motion.batch.detail import joint_sentences, jumps_alone, select_detail, untied_pictures
from barsight.motion.batch.fault_detection import check_crane, frames_off
from barsight.motion.batch.sensor_agreement import refuse_contradictions
from barsight.motion.crane.encoder_delay import find_delay, shifted_back
from barsight.motion.crane.encoder_trajectory import (
    CraneSettings,
    EncoderOdometry,
    fit_position,
    reestimate_noise,
)
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.crane.places import indices_apart, place_spacing_ns, placed_frames
from barsight.motion.estimator import FrameInput, TrajectoryEstimator
from barsight.motion.frame_to_frame.visual_odometry import StereoOdometry
from barsight.motion.frontend.board_corners import PointTracker, split_tracks
from barsight.motion.frontend.chains import (
    UNTIED,
    imu_bridges,
    tied_parts,
    untied_sentence,
)
from barsight.motion.frontend.motion_prediction import CranePredictor
from barsight.motion.frontend.seen_steps import known_motion
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.sightings import Sighting, rig_moved
from barsight.motion.frontend.tracking import Predictor, Tracker
from barsight.motion.gravity import GravityAlignment, align_with_gravity
from barsight.motion.problem.nodes import Nodes, constrain_by_imu, initial_poses, make_nodes
from barsight.recording.base import Recording
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.sensor_samples import expect_usable

if TYPE_CHECKING:
    from barsight.motion.batch.bundle_adjustment import Estimate
    from barsight.motion.problem.problem import AttitudePrior

SENSORS = ("stereo", "imu", "crane")


@dataclass(frozen=True)
class FusionSettings:
    """The estimate from all sensors together."""

    use: str = "stereo,imu,crane"
    """Sensors to use where the recording has them: any of stereo, imu, crane, separated by commas."""
    front_end: FrontEndSettings = field(default_factory=FrontEndSettings)
    offset_prior_px: float = 0.1
    """Standard deviation, in px of disparity, of a yaw between the cameras; the yaw is estimated too. 0 takes
    the calibration as exact.
    """
    scale_sigma: float = 5e-4
    """Standard deviation of the relative scale between baseline and encoders; the scale is estimated too."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.sensors if name not in SENSORS]
        if unknown or not ({"stereo", "crane"} & set(self.sensors)):
            raise ConfigError(f"use is {self.use!r}; name stereo or crane, and imu if wanted, with commas")
        expect_ranges(self, "fusion.", offset_prior_px=NOT_NEGATIVE, scale_sigma=(OVER_0, 0.1))

    @property
    def sensors(self) -> tuple[str, ...]:
        """Return the sensors named."""
        return tuple(name.strip() for name in self.use.split(",") if name.strip())


@dataclass(frozen=True)
class BatchFusion(TrajectoryEstimator):
    """Estimates any recording as a whole; the reference is `yard` with encoders, else `world`."""

    settings: FusionSettings
    crane: CraneSettings

    def begin(self, recording: Recording, rectifier: Rectifier) -> BatchPoses:
        """Begin; all of the recording's readings must be there. Raises MeasurementError where no sensor that
        places the body is left to use.
        """
        return BatchPoses(self.settings, self.crane, recording, rectifier)


@dataclass(frozen=True, eq=False)
class _Inputs:
    crane: CraneSamples | None
    imu: ImuSamples | None
    sightings: tuple[Sighting, ...]
    refused: tuple[RefusedFrame, ...]
    level: GravityAlignment | None
    warnings: tuple[str, ...]
    doubts: tuple[str, ...]


class BatchPoses:
    """`PoseEstimator` whose poses are final at the end: `push` tracks, `finish` solves for all frames."""

    delay_ns = None

    def __init__(
        self, settings: FusionSettings, crane: CraneSettings, recording: Recording, rectifier: Rectifier
    ) -> None:
        use = settings.sensors
        self._settings, self._crane_settings = settings, crane
        self._recording, self._rectifier = recording, rectifier
        self.reads_pictures = "stereo" in use
        self._stated = recording.crane() if "crane" in use else None
        self._imu, self._spoiled = recording.imu() if "imu" in use else None, 0
        expect_usable(recording.path, self._stated, self._imu)
        if self._imu is not None:
            self._imu, self._spoiled = without_saturation(self._imu)
        self._delay = find_delay(self._stated, self._imu)
        late_ns = seconds_to_ns(self._delay.late_s)
        self._crane, self._timed = None, self._stated and shifted_back(self._stated, late_ns)
        if self._timed is not None:
            self._crane = check_crane(reestimate_noise(self._timed), KnownMotion(None, self._imu)).samples
        if self._crane is None and not self.reads_pictures:
            raise MeasurementError(f"{recording.path}: no crane encoders; measure with use: stereo")
        self._tracker = Tracker(self._predictor(), settings.front_end)
        self._points = PointTracker(rectifier, settings.front_end.rough)
        self._sightings: list[Sighting] = []
        self._refused: list[RefusedFrame] = []

    def _predictor(self) -> Predictor:
        crane, imu, shift = self._crane, self._imu, self._recording.rig.timeshift_cam_imu_ns
        if crane is None:
            return lambda old_ns, new_ns: None
        bias = np.zeros(3) if imu is None else imu.gyro_radps.mean(axis=0)
        return CranePredictor(crane, imu, bias, self._rectifier, shift)

    def push(self, seen: FrameInput) -> None:
        """Track the next frame."""
        if not self.reads_pictures:
            return
        tracked: Sighting | RefusedFrame
        match seen:
            case RefusedFrame():
                tracked = seen
            case NamedPoints():
                tracked = self._points.push(seen)
            case _:
                tracked = self._tracker.push(seen)
        if isinstance(tracked, Sighting):
            self._sightings.append(tracked)
        else:
            self._refused.append(tracked)

    def finish(self) -> Trajectory:
        """Estimate; frames that neither pictures nor encoders place are refused."""
        recording, rectifier, inputs = self._recording, self._rectifier, self._inputs()
        shift = recording.rig.timeshift_cam_imu_ns
        frames = np.array([s.stamp_ns for s in inputs.sightings], np.int64)
        refused = list(inputs.refused)
        if inputs.crane is not None:
            frames, gone = placed_frames(recording, inputs.crane, frames, shift)
            frames = frames[~np.isin(frames, [r.stamp_ns for r in refused if r.is_stale])]
            left = set(frames.tolist())
            refused = gone + [r for r in refused if r.stamp_ns not in left]
            refused = list({r.stamp_ns: r for r in refused}.values())
        if len(frames) < 2:
            return replace(self._simple(inputs), doubts=inputs.doubts + jumps_alone(inputs.crane))
        nodes = make_nodes(frames + shift, inputs.imu)
        try:
            estimate, seen, doubts, encoders = self._solve(recording, rectifier, inputs, nodes, shift)
        except np.linalg.LinAlgError as error:  # the measurements leave an unknown open
            simple = self._simple(inputs)
            reason = f"the sensors together have no solution ({str(error).split('.')[0].strip()})"
            warnings = tuple(dict.fromkeys((*simple.warnings, *inputs.warnings)))
            doubts = inputs.doubts + jumps_alone(inputs.crane)
            doubts += (f"{reason}: estimated one by one",)
            return replace(simple, warnings=warnings, doubts=doubts, rig_moved=self._rig_moved())
        placed = tuple(
            PosedFrame(int(stamp), estimate.poses[k], covariance)
            for stamp, k, covariance in zip(frames, nodes.frame, estimate.covariance, strict=True)
        )
        if inputs.crane is None:
            seen += joint_sentences(inputs.sightings, estimate.relative)
        names = {"stereo": bool(inputs.sightings), "imu": inputs.imu is not None, "crane": inputs.crane}
        sensors = tuple(name for name in ("crane", "imu", "stereo") if names[name])
        return Trajectory(
            "world" if inputs.crane is None else "yard", placed, tuple(refused), sensors,
            inputs.warnings + seen, estimate.drift,
            select_detail(estimate, inputs.sightings, nodes, encoders, shift), inputs.doubts + doubts,
            self._rig_moved(),
        )  # fmt: skip

    def _rig_moved(self) -> tuple[str, ...]:
        steps = [one.step for one in self._sightings if one.step is not None]
        apart = sum(one.sides_apart for one in self._sightings)
        return rig_moved(steps, apart, self._recording.index.stamps_ns)

    def _simple(self, inputs: _Inputs) -> Trajectory:
        """Estimate without a graph: from the encoders alone or, without them, frame to frame."""
        simple: TrajectoryEstimator = StereoOdometry(self._settings.front_end.rough)
        if inputs.crane is not None:
            simple = EncoderOdometry(self._crane_settings)
        found = simple(self._recording, self._rectifier, lambda: None)
        stale = {one.stamp_ns: one for one in inputs.refused if one.is_stale}
        return replace(
            found, frames=tuple(frame for frame in found.frames if frame.stamp_ns not in stale),
            refused=(*(one for one in found.refused if one.stamp_ns not in stale), *stale.values()),
        )  # fmt: skip

    def _inputs(self) -> _Inputs:
        """Gather the tracked frames and the checked sensors. Raises InputError where they contradict."""
        recording, crane, doubts = self._recording, self._crane, tuple[str, ...]()
        sightings, refused = tuple(self._sightings), tuple(self._refused)
        if isinstance(recording, CornerRecording):
            sightings = split_tracks(sightings)
        self._refuse_wrong_sensors(sightings)
        level = None if crane else align_with_gravity(recording)
        warnings = level.warnings if level else ()
        if self._timed is not None:
            shift = recording.rig.timeshift_cam_imu_ns
            known = known_motion(sightings, self._imu, self._rectifier, shift)
            checked = check_crane(reestimate_noise(self._timed), known)
            crane, doubts = checked.samples, self._delay.doubts + checked.warnings
            doubts += camera_doubts(sightings, self._rectifier, shift, crane, self._delay)
        warnings += saturation_sentences(self._spoiled)
        if self.reads_pictures:
            few, most = untied_pictures(sightings, refused)
            warnings, doubts = warnings + few, doubts + most
            sightings, apart = self._joined(sightings, crane)
            refused += apart
            if apart:
                doubts += (untied_sentence(len(apart)),)
        return _Inputs(crane, self._imu, sightings, refused, level, warnings, doubts)

    def _joined(
        self, sightings: tuple[Sighting, ...], crane: CraneSamples | None
    ) -> tuple[tuple[Sighting, ...], tuple[RefusedFrame, ...]]:
        """Select the sightings that one estimate can contain: the parts that encoders place or, without
        encoders, the longest part. The others are refused.
        """
        shift = self._recording.rig.timeshift_cam_imu_ns
        part = tied_parts(sightings, imu_bridges(self._imu, shift))
        if not len(part) or (part == part[0]).all():
            return sightings, ()
        if crane is None:
            names, counts = np.unique(part, return_counts=True)
            good = names[[int(counts.argmax())]]
        else:
            fits = [fit_position(crane, s.stamp_ns + shift, seconds_to_ns(0.35)) for s in sightings]
            good = np.unique(part[[not isinstance(fit, Failed) for fit in fits]])
        kept = np.isin(part, good).tolist()
        apart = [RefusedFrame(s.stamp_ns, UNTIED) for s, k in zip(sightings, kept, strict=True) if not k]
        return tuple(s for s, k in zip(sightings, kept, strict=True) if k), tuple(apart)

    def _refuse_wrong_sensors(self, sightings: tuple[Sighting, ...]) -> None:
        """Raise InputError where the pictures show that a sensor or the cameras' stamps are wrong."""
        path, shift = self._recording.path, self._recording.rig.timeshift_cam_imu_ns
        late = frames_off(sightings, self._imu, self._crane, self._rectifier, shift)
        if late:
            raise InputError(
                path,
                f"the cameras' stamps are {abs(late)} frame(s) {'late' if late > 0 else 'early'} "
                "against gyro and encoders",
                "repair the stamps, or use the pictures alone (use: stereo)",
            )
        refuse_contradictions(path, sightings, self._imu, self._timed, self._rectifier, shift)

    def _solve(
        self, recording: Recording, rectifier: Rectifier, inputs: _Inputs, nodes: Nodes, shift: int
    ) -> tuple[Estimate, tuple[str, ...], tuple[str, ...], NormalisedResiduals | None]:
        # GTSAM is loaded where it is needed: its import takes a quarter of a second.
        from barsight.motion.batch.bundle_adjustment import solve_batch
        from barsight.motion.problem.encoder_factors import (
            encoder_positions,
            encoder_warnings,
            jump_sentences,
            scale_sentences,
        )
        from barsight.motion.problem.problem import EncoderPosition, Problem, StereoObservations
        from barsight.motion.problem.residuals import normalised_encoders

        start = initial_poses(nodes, inputs.crane, inputs.sightings, shift, rectifier, inputs.level)
        noise = recording.imu_noise() or ORDINARY_NOISE
        if inputs.crane is not None:
            known = int(inputs.crane.stamp_ns[0]), int(inputs.crane.stamp_ns[-1])
        else:
            known = inputs.sightings[0].stamp_ns + shift, inputs.sightings[-1].stamp_ns + shift
        ties = constrain_by_imu(nodes, start, known, inputs.imu, noise)
        placed: tuple[EncoderPosition, ...] = ()
        attitudes: list[AttitudePrior] = []
        if inputs.crane is not None:
            chosen = indices_apart(nodes.stamp_ns, place_spacing_ns(inputs.crane))
            placed = encoder_positions(inputs.crane, inputs.imu, nodes.stamp_ns, chosen)
            attitudes = self._attitudes(chosen, ties.still, inputs.crane.yard_from_body_nominal)
        jumps = inputs.crane.jumps if inputs.crane is not None and placed else ()
        seen = None
        if inputs.sightings:
            at = {int(nodes.stamp_ns[k]) - shift: int(k) for k in nodes.frame}
            seen = StereoObservations.of(
                inputs.sightings, [at[s.stamp_ns] for s in inputs.sightings], rectifier.camera,
                rectifier.body_from_rect0,
            )  # fmt: skip
        problem = Problem(
            start, nodes.stamp_ns, inputs.crane is None, seen, ties.preintegrated, placed,
            tuple(attitudes), ties.still, ties.bias,
            offset_prior_px=self._settings.offset_prior_px, scale_prior=self._settings.scale_sigma,
            crane=inputs.crane, imu=inputs.imu, has_latency=bool(placed), jumps=jumps,
            mounting_sigma_rad=self._crane_settings.mounting_sigma_rad,
            has_imu=any(part is not None for part in ties.preintegrated),
        )  # fmt: skip
        estimate = solve_batch(problem, nodes.frame)
        warnings = encoder_warnings(
            estimate.encoders, nodes.stamp_ns, estimate.placed, estimate.encoder_off_m, estimate.encoder_used
        )
        begin_ns = 0 if inputs.crane is None else int(inputs.crane.stamp_ns[0])
        sure, maybe = jump_sentences(jumps, begin_ns, estimate.encoders)
        wrong, doubtful = scale_sentences(
            estimate.scaled, estimate.encoders.excess if estimate.encoders else None
        )
        warnings += (*doubtful, *scale_sentences(*estimate.suspected)[1], *maybe)
        in_sigmas = estimate.encoder_off_m / estimate.encoder_sigma_m
        encoders = normalised_encoders(nodes.stamp_ns, estimate.placed, in_sigmas)
        return estimate, warnings, (*wrong, *sure), encoders

    def _attitudes(self, chosen: list[int], still: Container[int], nominal: Float64) -> list[AttitudePrior]:
        """Make the nominal attitude's priors at the chosen nodes: looser under way, since sway reverses
        within about a second and closer nodes aren't independent; at rest for one shared error.
        """
        from barsight.motion.problem.problem import AttitudePrior

        moving, standing = self._crane_settings.attitude_std_deg * 1.6, [k for k in chosen if k in still]
        at_rest = self._crane_settings.sway_std_deg * len(standing) ** 0.5
        sigma = {k: np.deg2rad(at_rest if k in standing else moving) for k in chosen}
        return [AttitudePrior(k, nominal, np.full(3, sigma[k]), k not in standing) for k in chosen]
