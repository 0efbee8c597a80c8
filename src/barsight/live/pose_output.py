"""Run the pose process: write the body's pose at a steady rate, between pairs from IMU and encoders."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.json_values import DIGITS, write_json
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.inertial.model import ORDINARY_NOISE
from barsight.live.link import Link
from barsight.live.modes import FreezeWatch, JumpWatch
from barsight.live.shared.logs import ReadingLog
from barsight.live.source import ReplayClock
from barsight.motion.fixed_lag.propagation import REFERENCE_S, NavigationState, Propagator
from barsight.recording.sensor_selection import SelectedSensors
from barsight.yard_frame import crane_in_yard, frame_of, in_yard, shared_covariance

WAIT_S = 0.01
"""Longest time in seconds that a pose waits for the readings at its stamp; missing ones are extrapolated."""
POLL_S = 0.001
BEAT_S = 0.2
"""Longest interval in seconds between the process's heartbeats while no pose is due."""
BEFORE_STATE_S = 5.0
"""Time in seconds before the oldest state in use from which readings are kept, to estimate the encoder
noise.
"""


def output_poses(link: Link) -> None:
    """Write poses until the supervisor stops this."""
    board = link.open_counters()
    output = PoseOutput(link)
    board["pose", "ready"] = 1
    while not board["supervisor", "began_ns"] and not board["supervisor", "stop"]:
        board.beat("pose")
        time.sleep(POLL_S)
    began_ns, crane = board["supervisor", "began_ns"], link.source.crane
    first_ns = board["capture", "first_ns"] if crane is None else began_ns + link.source.epoch_ns
    clock, due_s = ReplayClock(began_ns, first_ns, link.source.speed), time.monotonic()
    while not board["supervisor", "stop"]:
        due_s = max(due_s + 1 / link.live.pose_rate_hz, time.monotonic())
        board.beat("pose")
        while (left_s := due_s - time.monotonic()) > 0 and not board["supervisor", "stop"]:
            time.sleep(min(left_s, BEAT_S))
            board.beat("pose")
        board.add("pose", "written", output.write(clock.stamp_now_ns()))


class PoseOutput:
    """Writes pose.json and logs in `link.outputs()` how late each pose was."""

    def __init__(self, link: Link) -> None:
        self._link, whole = link, link.open_recording()
        source = in_yard(SelectedSensors(whole, link.settings.use), link.settings.yard)
        self._frame, self._noise = frame_of(source), whole.imu_noise() or ORDINARY_NOISE
        self._sensors, self._mounted = link.sensors(whole), whole.crane()
        placed = source.crane()
        self._lever_m = None if placed is None else placed.crane_to_body_m
        self._freeze: FreezeWatch | None = None
        self._jump: JumpWatch | None = None
        if self._mounted is not None and "crane" in self._sensors:
            self._freeze = FreezeWatch(self._mounted)
        self._shift_ns = whole.rig.timeshift_cam_imu_ns
        held_s = BEFORE_STATE_S + link.live.max_predicted_s
        self._imu, self._crane = (HeldReadings(link.readings(name), held_s) for name in ("imu", "crane"))
        self._state_ns, self._has_encoders = 0, False
        self._propagator: Propagator | None = None
        self._states, self._outputs = link.states(), link.outputs()

    def write(self, now_ns: int | None) -> bool:
        """Write the pose at a stamp (cameras' clock); at full speed, that of a new state.

        Returns True if there is a pose that isn't older than `live.max_predicted_s`.
        """
        began = time.monotonic_ns()
        is_new = self._begin_anew()
        if self._propagator is None or (now_ns is None and not is_new):
            return False
        if now_ns is None:
            self._publish(self._propagator.at(self._state_ns))
            return True
        stamp_ns = now_ns + self._shift_ns
        if stamp_ns - self._state_ns > seconds_to_ns(self._link.live.max_predicted_s):
            return False
        self._await(stamp_ns, began + int(WAIT_S * NS_PER_S))
        if self._has_encoders and self._trusted_encoders() is None:
            self._begin()  # they have frozen or jumped, and must not tie the pose to a wrong place
        self._take(stamp_ns)
        self._publish(self._propagator.at(stamp_ns))
        self._outputs.append((now_ns, time.monotonic_ns() - began))
        return True

    def _begin_anew(self) -> bool:
        """Start from the newest state of `track`, if there is a new one."""
        stamps, rows = self._states.last(1)
        if not len(stamps) or int(stamps[0]) == self._state_ns:
            return False
        self._state_ns = int(stamps[0])
        self._state = NavigationState.of(self._state_ns, rows[0])
        for buffer in (self._imu, self._crane):
            buffer.grow()
        if self._mounted is not None:
            about_ns = self._state_ns - seconds_to_ns(REFERENCE_S)
            self._jump = JumpWatch(self._mounted.position_std_m, about_ns)
        self._begin()
        return True

    def _begin(self) -> None:
        """Start from the last state, with the encoders if they can be trusted now."""
        for buffer in (self._imu, self._crane):
            buffer.taken_ns = self._state_ns
        has_imu, known = "imu" in self._sensors, self._trusted_encoders()
        self._has_encoders = known is not None
        self._propagator = Propagator(self._state, self._noise, known, has_imu=has_imu)

    def _trusted_encoders(self) -> CraneSamples | None:
        """Return the encoder readings held; None if none are in use, or they are frozen, or they have jumped
        since the last state or around it.
        """
        readings = self._crane.since(0)
        if self._freeze is None or self._freeze.check(*readings):
            return None
        if self._jump is None or self._jump.check(*readings):
            return None
        return self._placed(*readings)

    def _await(self, stamp_ns: int, give_up_ns: int) -> None:
        """Wait a limited time for the IMU reading at a stamp."""
        self._imu.grow()
        while "imu" in self._sensors and self._imu.last_ns < stamp_ns and time.monotonic_ns() < give_up_ns:
            time.sleep(POLL_S)
            self._imu.grow()
        self._crane.grow()

    def _take(self, stamp_ns: int) -> None:
        """Pass the propagator each sensor's readings since the last call, up to a stamp."""
        assert self._propagator is not None
        imu, crane = (
            buffer.take(stamp_ns) if name in self._sensors else buffer.since(0, 0)
            for name, buffer in (("imu", self._imu), ("crane", self._crane))
        )
        places = self._placed(*crane)
        self._propagator.take(*imu, crane[0], np.empty((0, 3)) if places is None else places.position_m)

    def _placed(self, stamps_ns: Int64, places_m: Float64) -> CraneSamples | None:
        """Return encoder readings in the surveyed yard; None if there are none."""
        if self._mounted is None or not len(stamps_ns):
            return None
        crane = replace(self._mounted, stamp_ns=stamps_ns, position_m=places_m)
        return crane if self._frame is None else crane_in_yard(crane, self._frame)

    def _publish(self, posed: PosedFrame) -> None:
        """Write the pose for readers, atomically. predicted_s: time since the last pair."""
        pose = posed.reference_from_body
        lever_m, covariance = None, posed.covariance
        if pose.target == "yard":
            lever_m = self._lever_m
            covariance = (
                covariance if self._frame is None else covariance + shared_covariance(pose, self._frame)
            )
        content = {
            "stamp_ns": posed.stamp_ns - self._shift_ns,
            "frame": pose.target,
            "position_m": pose.translation,
            "crane_m": None if lever_m is None else pose.translation - lever_m,
            "quaternion_xyzw": pose.quaternion_xyzw,
            "sigma_m": np.sqrt(np.diag(covariance)[3:]),
            "predicted_s": (posed.stamp_ns - self._state_ns) / NS_PER_S,
        }
        write_json(self._link.folder.parent / "pose.json", content, DIGITS)


class HeldReadings:
    """The readings of a log over the last `held_s`. taken_ns: stamp of the last one taken."""

    def __init__(self, log: ReadingLog, held_s: float) -> None:
        self._log, self._held_ns, self.taken_ns = log, seconds_to_ns(held_s), 0
        self._stamps_ns, self._values = log.last(0)

    @property
    def last_ns(self) -> int:
        """Return the stamp of the last reading, 0 if there is none."""
        return int(self._stamps_ns[-1]) if len(self._stamps_ns) else 0

    def grow(self) -> None:
        """Add the readings received since the last call."""
        stamps, values = self._log.read()
        if len(stamps):
            first = int(np.searchsorted(self._stamps_ns, stamps[-1] - self._held_ns))
            self._stamps_ns = np.concatenate([self._stamps_ns[first:], stamps])
            self._values = np.concatenate([self._values[first:], values])

    def take(self, until_ns: int) -> tuple[Int64, Float64]:
        """Take the readings after the last one taken, up to a stamp."""
        found = self.since(self.taken_ns, until_ns)
        self.taken_ns = max([self.taken_ns, *found[0][-1:].tolist()])
        return found

    def since(self, after_ns: int, until_ns: int | None = None) -> tuple[Int64, Float64]:
        """Return the readings after one stamp, up to another: (N,) stamps, (N, width) values."""
        begin = int(np.searchsorted(self._stamps_ns, after_ns, side="right"))
        end = None if until_ns is None else int(np.searchsorted(self._stamps_ns, until_ns, side="right"))
        return self._stamps_ns[begin:end], self._values[begin:end]
