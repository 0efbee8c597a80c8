"""Update the fixed-lag estimate frame by frame: new nodes, their factors, solution, marginalisation.

Sensors are read only as far as their readings would have arrived. A node's encoder position is added as soon
as the readings after the node are there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import seconds_to_ns
from barsight.features.guided_matching import PredictedMotion
from barsight.inertial.preintegration import Preintegrated
from barsight.motion.batch.fault_detection import freeze_sentences
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings, fit_position, reestimate_noise
from barsight.motion.fixed_lag.crane_ties import FIT_S, with_attitudes, with_encoder_positions
from barsight.motion.fixed_lag.delay_watch import DelayWatch
from barsight.motion.fixed_lag.encoder_watch import MAX_SEARCHED_S, EncoderWatch, with_jumps, with_sums
from barsight.motion.fixed_lag.known_later import (
    live_scale_sentences,
    way_of_delay,
    widened,
    widened_by_scales,
)
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer
from barsight.motion.fixed_lag.sliding_window import Window, add_frame, add_nodes
from barsight.motion.fixed_lag.window_update import marginalise, solve_window
from barsight.motion.frontend.chains import UNTIED, imu_bridges
from barsight.motion.frontend.motion_prediction import CranePredictor, predict_by_imu
from barsight.motion.frontend.seen_steps import known_motion
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.gravity import GravityAlignment
from barsight.motion.problem.encoder_factors import jump_sentences
from barsight.motion.problem.gauss_newton import GraphState
from barsight.motion.problem.gtsam_factors import initial_values
from barsight.motion.problem.nodes import (
    MAX_STILL_M,
    constrain_by_imu,
    initial_poses,
    is_imu_quiet,
    make_nodes,
    preintegrate_between,
    subdivide,
)
from barsight.motion.problem.problem import Problem

RECENT_FRAMES = 40
"""Number of the latest frames whose motions are compared with the encoders."""
LOOK_BACK_S = 6.0
"""Duration, s, of the IMU and encoder readings kept from before the first node held."""
MAX_BRIDGE_S = 15.0
"""Longest time, s, without frames after which the window goes on where encoders could begin a new one: the
IMU's place is off by metres after 40 s.
"""
AXES = (0, 1, 2)


class FixedLagEstimator:
    """Fixed-lag estimator that holds `held` frames; `window` is all that it knows, besides the `readings`."""

    def __init__(
        self, settings: FusionSettings, crane: CraneSettings, held: int, rectifier: Rectifier, shift_ns: int,
        readings: SensorBuffer, level: GravityAlignment | None,
    ) -> None:  # fmt: skip
        self._settings, self._crane, self._held = settings, crane, held
        self._rectifier, self._shift_ns = rectifier, shift_ns
        self.readings, self._level = readings, level
        self.window: Window | None = None
        self.motions: list[Sighting] = []
        self.watch = EncoderWatch()
        self.delay = DelayWatch()
        self._failed = False
        self._left: Window | None = None
        self._scaled_ns: int | None = None

    def predict(self, old_ns: int, new_ns: int) -> PredictedMotion | None:
        """Predict the motion as a `Predictor` does: by the IMU from the last estimate, else by encoders; None
        without either.
        """
        window, now = self.window, self._now(new_ns)
        if window is None or window.newest is None:
            return None
        at = np.flatnonzero(window.problem.stamp_ns == old_ns + self._shift_ns)
        if now.imu is not None and at.size:
            stamps = np.array([window.problem.stamp_ns[-1], new_ns + self._shift_ns])
            part = preintegrate_between(stamps, now.imu, now.noise, window.bias)[0]
            if part is not None:
                return predict_by_imu(
                    window.pose(int(at[0])), window.body, part, window.bias, window.newest.covariance,
                    self._rectifier.body_from_rect0,
                )  # fmt: skip
        if now.crane is None:
            return None
        bias = window.bias.gyro_radps
        return CranePredictor(now.crane, now.imu, bias, self._rectifier, self._shift_ns)(old_ns, new_ns)

    def take(self, seen: Sighting | RefusedFrame) -> PosedFrame | RefusedFrame:
        """Estimate the frame's pose, or return why it has none."""
        stamp = seen.stamp_ns + self._shift_ns
        sighting = seen if isinstance(seen, Sighting) else None
        if sighting is not None:
            # The points are dropped, so that memory doesn't grow with them.
            none = slice(0, 0)
            points = {name: getattr(sighting, name)[none] for name in ("track", "stereo", "sigma_px")}
            self.motions.append(replace(sighting, **points))
        self._check_encoders(seen.stamp_ns)
        now = self._now(seen.stamp_ns)
        covered = now.crane is not None and not isinstance(
            fit_position(now.crane, stamp, seconds_to_ns(self._crane.window_s)), Failed
        )
        if covered and self._is_long_past(stamp):
            self._leave_window()  # the IMU has gone too far astray for one step; encoders place a new one
        if sighting is None and not covered:
            assert isinstance(seen, RefusedFrame)
            return seen
        if sighting is not None and not covered and not self._is_tied(sighting, stamp, now):
            return RefusedFrame(seen.stamp_ns, UNTIED)
        window = (
            self._begun(stamp, sighting, now) if self.window is None else self._grown(stamp, sighting, now)
        )
        if isinstance(window, Failed):
            return RefusedFrame(seen.stamp_ns, window.reason)
        rectifier = self._rectifier
        window = add_frame(window, sighting, rectifier.camera, rectifier.body_from_rect0, self._held)
        window = with_encoder_positions(window, sighting, now, self._crane, stamp + self.readings.delay_ns)
        try:
            window, leaving = solve_window(window, self._held)
        except np.linalg.LinAlgError:
            if self._failed and now.crane is not None:
                self._leave_window()  # it may be the cause, and encoders can place a new one
            self._failed = True
            return RefusedFrame(seen.stamp_ns, "the sensors together have no solution here")
        self._failed = False
        pose = window.pose(len(window.problem.start) - 1)
        covariance = window.covariance
        self.window = marginalise(window, leaving) if leaving else window
        if self._scaled_ns is None and len(window.problem.held) < len(window.problem.scaled):
            self._scaled_ns = stamp
        return PosedFrame(seen.stamp_ns, pose, covariance)

    def _leave_window(self) -> None:
        """Leave the window; what it knows of the encoders' scales stays."""
        self._left, self.window = self.window or self._left, None

    def _is_long_past(self, stamp: int) -> bool:
        """Check whether the last node is too old for the IMU to lead from it to a stamp."""
        window = self.window
        return window is not None and stamp - int(window.problem.stamp_ns[-1]) > seconds_to_ns(MAX_BRIDGE_S)

    def _is_tied(self, sighting: Sighting, stamp: int, now: SensorBuffer) -> bool:
        """Check whether pictures or IMU tie a sighting to the window."""
        if self.window is None or self._old_node(sighting) is not None:
            return True
        return imu_bridges(now.imu, 0)(int(self.window.problem.stamp_ns[-1]), stamp)

    def _old_node(self, sighting: Sighting) -> tuple[int, PredictedMotion] | None:
        """Return the node to which pictures tie a sighting and the motion since then; None where there is
        no tie.
        """
        assert self.window is not None
        ties = [] if sighting.again is None else [(sighting.again.stamp_ns, sighting.again.motion)]
        if sighting.motion is not None and len(self.motions) > 1:
            ties.insert(0, (self.motions[-2].stamp_ns, sighting.motion))
        for stamp_ns, motion in ties:
            at = np.flatnonzero(self.window.problem.stamp_ns == stamp_ns + self._shift_ns)
            if at.size:
                return int(at[0]), motion
        return None

    def _check_encoders(self, stamp_ns: int) -> None:
        """Look for faults in the encoders' newest readings; positions taken beyond a new jump are removed."""
        now = self._come(stamp_ns)
        if self.delay.check(now):  # the window holds what late readings said
            self.window = self._left = self._scaled_ns = None
            self.watch, now = EncoderWatch(), self._come(stamp_ns, MAX_SEARCHED_S)
        if now.crane is None or not len(now.crane.stamp_ns):
            return
        sums = self.watch.put_together(int(now.crane.stamp_ns[0]))
        if sums and self.window is not None:
            self.window = with_sums(self.window, sums)
        reported = len(self.watch.told)
        recent = self.motions[-RECENT_FRAMES:]
        known = known_motion(recent, now.imu, self._rectifier, self._shift_ns)
        self.watch.check(reestimate_noise(now.crane), known)
        new, window = self.watch.told[reported:], self.window
        if not new or window is None:
            return
        window = with_jumps(window, self.watch.jumps)
        since = min(jump.stamp_ns for jump in new) - seconds_to_ns(FIT_S)
        problem = window.problem
        kept = tuple(place for place in problem.placed if problem.stamp_ns[place.node] < since)
        placed_ns = None if not kept else int(problem.stamp_ns[kept[-1].node])
        self.window = replace(window, problem=replace(problem, placed=kept), placed_ns=placed_ns)

    def encoder_faults(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Describe the encoders' faults: those that make everything doubtful, and those that are only
        possible.
        """
        crane = self.readings.crane
        if crane is None or not len(crane.stamp_ns):
            return (), ()
        begin_ns = int(crane.stamp_ns[0])
        sure, maybe = jump_sentences(sorted(self.watch.told, key=lambda jump: jump.stamp_ns), begin_ns, None)
        late, frozen = self.delay.sentences(begin_ns), freeze_sentences(self.watch.frozen, begin_ns)
        wrong, suspected = live_scale_sentences(self.window or self._left, self._scaled_ns, begin_ns)
        return (*late, *frozen, *wrong, *sure), (*suspected, *maybe)

    def told_later(self, frames: Sequence[PosedFrame]) -> tuple[PosedFrame, ...]:
        """Widen the poses from before a delay or a wrong scale of the encoders was known or suspected."""
        crane, window = self.readings.crane, self.window or self._left
        stamps = np.array([frame.stamp_ns for frame in frames], np.int64) + self._shift_ns
        if crane is None or not len(stamps):
            return tuple(frames)
        found = widened(frames, way_of_delay(crane, stamps, self.delay.late_ns, self.delay.found_ns))
        return widened_by_scales(found, stamps, window, self._scaled_ns)

    def _now(self, stamp_ns: int) -> SensorBuffer:
        """Select the readings that have arrived when the frame at a stamp is computed, from before the first
        node held on and without the encoders' faults.
        """
        now = self._come(stamp_ns)
        return now if now.crane is None else replace(now, crane=self.watch.usable(now.crane))

    def _come(self, stamp_ns: int, look_back_s: float = LOOK_BACK_S) -> SensorBuffer:
        last = stamp_ns + self._shift_ns + self.readings.delay_ns
        begin = last if self.window is None else int(self.window.problem.stamp_ns[0])
        return self.readings.between(begin - seconds_to_ns(look_back_s), last, self.delay.late_ns)

    def _begun(self, stamp: int, sighting: Sighting | None, now: SensorBuffer) -> Window | Failed:
        # Without encoders the first frame is the origin; a node before it would take that role.
        nodes = make_nodes(np.array([stamp]), None if now.crane is None else now.imu)
        if now.crane is None:
            assert sighting is not None
        else:
            fit = fit_position(now.crane, stamp, seconds_to_ns(0.35))
            if isinstance(fit, Failed):
                return Failed(fit.code, f"the encoders don't cover the first frame: {fit.reason}")
        sightings = () if sighting is None else (sighting,)
        start = initial_poses(nodes, now.crane, sightings, self._shift_ns, self._rectifier, self._level)
        known = (stamp, stamp) if now.crane is None else (int(now.crane.stamp_ns[0]), stamp)
        ties = constrain_by_imu(nodes, start, known, now.imu, now.noise)
        settings = self._settings
        self.watch.settle(stamp)
        problem = Problem(
            start, nodes.stamp_ns, now.crane is None, None, ties.preintegrated, (), (), ties.still, ties.bias,
            offset_prior_px=settings.offset_prior_px, scale_prior=settings.scale_sigma,
            has_latency=now.crane is not None, has_imu=now.imu is not None, jumps=self.watch.jumps,
            mounting_sigma_rad=self._crane.mounting_sigma_rad, scaled=AXES if now.crane else (),
            held=AXES if now.crane else (),
        )  # fmt: skip
        left, scales = self._left, None
        if left is not None and left.problem.has_latency and now.crane is not None:
            scales, old = left.scales, left.problem
            problem = replace(problem, held=old.held, known_scales=scales, travelled=old.travelled)
        state = GraphState(initial_values(problem), np.empty((0, 4)), np.zeros(2))
        window = Window(problem, state, np.empty(0, np.int64), scales=scales)
        return with_attitudes(window, 0, now.crane, self._crane)

    def _grown(self, stamp: int, sighting: Sighting | None, now: SensorBuffer) -> Window | Failed:
        window = self.window
        assert window is not None
        first = len(window.problem.start)
        last_ns = int(window.problem.stamp_ns[-1])
        stamps = subdivide(last_ns, stamp) if now.imu is not None else [stamp]
        parts: tuple[Preintegrated | None, ...] = (None,) * len(stamps)
        if now.imu is not None:
            parts = preintegrate_between(np.array([last_ns, *stamps]), now.imu, now.noise, window.bias)
            if any(part is None for part in parts):  # a node between that no IMU ties, nothing else may place
                stamps, parts = [stamp], (None,)
        poses, speeds = self._started(window, stamps, parts, sighting, now)
        grew = add_nodes(window, stamps, poses, speeds, parts)
        if now.imu is not None and self._stays(window, stamp, sighting, now):
            quiet = is_imu_quiet(grew.problem.stamp_ns[first:], now.imu, now.noise)
            still = (*grew.problem.still, *(first + int(k) for k in np.flatnonzero(quiet)))
            grew = replace(grew, problem=replace(grew.problem, still=still))
        return with_attitudes(grew, first, now.crane, self._crane)

    def _started(
        self, window: Window, stamps: list[int], parts: tuple[Preintegrated | None, ...],
        sighting: Sighting | None, now: SensorBuffer,
    ) -> tuple[list[Pose], list[Float64]]:  # fmt: skip
        """Initialise new nodes: by the IMU, else on a straight line to where pictures or encoders place
        the last.
        """
        old = window.pose(len(window.problem.start) - 1)
        if all(part is not None for part in parts):
            poses, speeds, state = [], [], window.body
            for part in parts:
                assert part is not None
                state = part.predict(state, window.bias)
                poses.append(Pose(old.target, "body", state.rotation, state.position_m))
                speeds.append(state.velocity_mps)
            return poses, speeds
        end = old
        tie = None if sighting is None else self._old_node(sighting)
        if tie is not None:
            mount, (node, motion) = self._rectifier.body_from_rect0, tie
            moved = Pose("rect0", "rect0", motion.rotation, motion.translation).inverse()
            end = window.pose(node) @ mount @ moved @ mount.inverse()
        elif now.crane is not None:
            fit = fit_position(now.crane, stamps[-1], seconds_to_ns(0.35))
            if not isinstance(fit, Failed):
                place = fit.position_m + now.crane.crane_to_body_m
                end = Pose(old.target, "body", old.rotation, place)
        seconds = (stamps[-1] - int(window.problem.stamp_ns[-1])) / 1e9
        way = end.translation - old.translation
        share = [(k + 1) / len(stamps) for k in range(len(stamps))]
        poses = [Pose(old.target, "body", end.rotation, old.translation + s * way) for s in share]
        return poses, [way / seconds] * len(stamps)

    def _stays(self, window: Window, stamp: int, sighting: Sighting | None, now: SensorBuffer) -> bool:
        """Check whether encoders, else pictures, show no travel since the last node. (An IMU shows none at
        any constant speed.)
        """
        last_ns = int(window.problem.stamp_ns[-1])
        if now.crane is not None:
            window_ns = seconds_to_ns(FIT_S)
            fits = [fit_position(now.crane, ns, window_ns) for ns in (last_ns, stamp)]
            places = [fit.position_m for fit in fits if not isinstance(fit, Failed)]
            return len(places) == 2 and float(np.linalg.norm(places[1] - places[0])) < MAX_STILL_M
        if sighting is None or sighting.motion is None or window.seen_ns != last_ns:
            return False
        return float(np.linalg.norm(sighting.motion.translation)) < MAX_STILL_M
