"""Judge what the run can currently do: the mode, the reasons for it, and whether lifts are valid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.stamps import BEFORE_ALL_NS, NS_PER_S, seconds_to_ns
from barsight.live.settings import LiveSettings
from barsight.motion.batch.fault_detection import frozen_now

ModeName = Literal["full", "no-imu", "no-encoders", "encoders-only", "blind"]
MODES: dict[ModeName, str] = {
    "full": "Pictures, IMU and encoders: poses, a map, lifts.",
    "no-imu": "Pictures and encoders: poses, a map, lifts.",
    "no-encoders": "Pictures without encoders: poses and a map that drift in the yard, no lift.",
    "encoders-only": "Encoders without pairs of pictures: no new map, no lift.",
    "blind": "Neither pictures nor encoders: nothing is known, no lift.",
}
SENSORS = ("cam0", "cam1", "imu", "crane")
TROUBLES = ("cam0", "cam1", "pictures", *(f"{name}_clock" for name in SENSORS))
"""Names of troubles: why a camera isn't connected, why the last pictures show nothing or nothing new, and why
a sensor's clock can't be followed.
"""
FOR_LIFTS = ("full", "no-imu")
MIN_CAMERA_SILENCE_S = 0.3
PAIR_SILENCES = 2
"""Time without a pair after which the cameras are out, in terms of a camera's own bound: a counter that began
anew costs two pairs.
"""
MAX_CLOCK_STEP_S = 1.0
MAX_SKEW_NS = 1_000_000
"""Largest difference (ns) between the two exposures of a pair. At 0.6 m/s along a baseline of 0.5 m it moves
heights by 10 mm at 8 m.
"""
JUMP_SIGMAS, MIN_JUMP_M, MAX_CHANGE_MPS2 = 8.0, 0.03, 1.0
"""Thresholds of a jump: sigmas of a reading, least distance (m), and largest acceleration (m/s²) assumed when
a reading is predicted from the crane's speed.
"""
SPEED_READINGS = 6
MAX_OFF_M = 0.05
"""Threshold (m) of encoders that are off by cameras and IMU: a jump there and back leaves up to this."""
JUMP_HELD_S = 1.0
"""Time in seconds for which encoders stay excluded after they came back from a jump."""
AFTER_FREEZE_S = 0.3
STAMP_SIGMA_S = 0.02
"""Standard deviation (s) of stamps while a device's clock is being estimated anew."""
HELD_NS, HELD_READINGS = 5 * NS_PER_S, 100
"""Window in which faults are searched: its length in ns, and its minimum number of readings."""
LOOK_NS = NS_PER_S // 10
"""Interval in ns between searches for faults, by the readings' stamps."""


@dataclass(frozen=True)
class SensorActivity:
    """Last activity of each sensor: stamps on the cameras' clock, 0 for never.

    cameras_ns: of cam0 and cam1. pair_ns: of the last pair that their pictures formed. interval_ns: longest
    interval between pictures. readings_ns: of `imu` and `crane`, if the recording has them. frozen: whether
    the encoders repeat one reading although the crane must be moving. jumped_m: by how much (m) they have
    jumped, otherwise 0. off_m: by how much each is off by cameras and IMU, which also see a jump that came
    while they were silent. restarted: whether their sender has restarted during the run. clock_step_s: of the
    system's clock. skew_ns: by how much cam1 is exposed after cam0, 0 unless the cameras share one clock.
    troubles: by name, "" or missing if there is none (see TROUBLES).
    """

    cameras_ns: tuple[int, int]
    pair_ns: int
    interval_ns: int
    readings_ns: dict[str, int]
    frozen: bool = False
    jumped_m: float = 0.0
    off_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    restarted: bool = False
    clock_step_s: float = 0.0
    skew_ns: int = 0
    troubles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Mode:
    """Mode of a run, and whether its lifts may be valid.

    name: of MODES. reasons: why it isn't `full`, or which process is down.
    """

    name: ModeName
    reasons: tuple[str, ...]
    lifts: bool


def judge_mode(
    heard: SensorActivity, now_ns: int, settings: LiveSettings, down: Mapping[str, str] = MappingProxyType({})
) -> Mode:
    """Judge the mode at a stamp of the cameras' clock. down: processes that aren't running, with reasons."""
    reasons = [f"{process} is down: {why}" for process, why in down.items()]
    silent = _silent_cameras(heard, now_ns, settings)
    imu = _silent_sensor("imu", "the IMU", heard, now_ns, settings.imu_silence_s)
    crane = _silent_sensor("crane", "the encoders", heard, now_ns, settings.encoder_silence_s)
    if heard.frozen:
        crane = "the encoders are frozen: they repeat one reading while the crane must be moving"
    elif heard.jumped_m:
        crane = f"the encoders jumped by {1e3 * heard.jumped_m:.0f} mm"
    if "capture" in down:
        name: ModeName = "blind"
    elif silent or "track" in down:
        name = "blind" if crane else "encoders-only"
    elif crane:
        name = "no-encoders"
    else:
        name = "no-imu" if imu else "full"
    reasons += [*silent, *(why for why in (imu, crane) if why)]
    doubts = _doubts(heard)
    return Mode(name, (*reasons, *doubts), name in FOR_LIFTS and not down and not doubts)


def _doubts(heard: SensorActivity) -> list[str]:
    """List what revokes lifts whatever the mode: ages, stamps or the encoders' zero can't be told."""
    doubts = []
    if abs(heard.clock_step_s) > MAX_CLOCK_STEP_S:
        doubts.append(f"the system's clock was stepped by {heard.clock_step_s:.1f} s: ages aren't known")
    if (off_m := float(np.linalg.norm(heard.off_m))) > MAX_OFF_M:
        doubts.append(f"the encoders are {1e3 * off_m:.0f} mm off by cameras and IMU, survey again")
    if heard.restarted:
        doubts.append("the encoders' sender began anew, their zero may have changed: survey again")
    if abs(heard.skew_ns) > MAX_SKEW_NS:
        order = "after" if heard.skew_ns > 0 else "before"
        skew = f"cam1 is exposed {abs(heard.skew_ns) / 1e6:.1f} ms {order} cam0, by their common clock"
        doubts.append(f"{skew}: trigger both by one signal")
    doubts += [f"{name}: {why}" for name in SENSORS if (why := heard.troubles.get(f"{name}_clock", ""))]
    return doubts


def _silent_cameras(heard: SensorActivity, now_ns: int, settings: LiveSettings) -> list[str]:
    """List the cameras that have provided no picture for too long, or both if theirs form no pairs or show
    nothing new.
    """
    silences = []
    bound_s = max(MIN_CAMERA_SILENCE_S, settings.camera_silence_intervals * heard.interval_ns / NS_PER_S)
    for camera, last_ns in enumerate(heard.cameras_ns):
        why = heard.troubles.get(f"cam{camera}", "")
        if not last_ns:
            silences.append(f"cam{camera}: no picture yet" + (why and f": {why}"))
        elif now_ns - last_ns > seconds_to_ns(bound_s):
            silences.append(_silence(f"cam{camera}", now_ns - last_ns, bound_s) + (why and f": {why}"))
    if why := heard.troubles.get("pictures", ""):
        silences.append(f"cam0 and cam1: {why}")
    elif not silences and now_ns - heard.pair_ns > seconds_to_ns(PAIR_SILENCES * bound_s):
        since = f"for {(now_ns - heard.pair_ns) / NS_PER_S:.2f} s" if heard.pair_ns else "yet"
        silences.append(f"cam0 and cam1: no pair {since}, their stamps or exposure counters contradict")
    return silences


def _silent_sensor(sensor: str, name: str, heard: SensorActivity, now_ns: int, bound_s: float) -> str | None:
    """Return why a sensor is out, None if it isn't."""
    if sensor not in heard.readings_ns:
        return f"{name}: none in use"
    last_ns = heard.readings_ns[sensor]
    if not last_ns:
        return f"{name}: no reading yet"
    return _silence(name, now_ns - last_ns, bound_s) if now_ns - last_ns > seconds_to_ns(bound_s) else None


def _silence(name: str, silent_ns: int, bound_s: float) -> str:
    return f"{name}: silent for {silent_ns / NS_PER_S:.2f} s (bound {bound_s:.2f} s)"


class FreezeWatch:
    """Detects that some or all encoders are frozen. mounted: provides everything but the readings."""

    def __init__(self, mounted: CraneSamples) -> None:
        self._mounted = mounted
        self._since, self._axes = np.zeros(3), np.zeros(3, np.bool_)

    def check(self, stamp_ns: Int64, position_m: Float64) -> bool:
        """Examine the newest readings, (N,) and (N, 3), of the last few seconds."""
        if len(stamp_ns) == 0:
            return False
        if self._axes.any() and (position_m[-1] == self._since)[self._axes].all():
            return True
        crane = replace(self._mounted, stamp_ns=stamp_ns, position_m=position_m)
        self._since, self._axes = position_m[-1], frozen_now(crane)
        return bool(self._axes.any())


class JumpWatch:
    """Detects a jump of the encoders and measures it until they come back.

    sigma_m: standard deviation of a reading. after_ns: readings up to this stamp aren't judged.
    """

    def __init__(self, sigma_m: float, after_ns: int = BEFORE_ALL_NS) -> None:
        self._min_jump_m = max(MIN_JUMP_M, JUMP_SIGMAS * sigma_m)
        self._off_m: Float64 = np.zeros(3)
        self._last_ns, self._jump_ns, self._from_ns = after_ns, BEFORE_ALL_NS, BEFORE_ALL_NS
        self._jump_m: Float64 = np.zeros(3)
        self._bound_m = 0.0

    def check(self, stamp_ns: Int64, position_m: Float64) -> float:
        """Examine the newest readings, (N,) and (N, 3), of the last few seconds; return the jump (m) or 0."""
        for k in range(int(np.searchsorted(stamp_ns, self._last_ns, side="right")), len(stamp_ns)):
            if k >= SPEED_READINGS and stamp_ns[k - SPEED_READINGS] > self._from_ns:
                self._take(stamp_ns[k - SPEED_READINGS : k + 1], position_m[k - SPEED_READINGS : k + 1])
        self._last_ns = int(stamp_ns[-1]) if len(stamp_ns) else self._last_ns
        away = float(np.linalg.norm(self._off_m))
        if away > self._bound_m:
            return away
        is_recent = self._last_ns - self._jump_ns < seconds_to_ns(JUMP_HELD_S)
        return float(np.linalg.norm(self._jump_m)) if is_recent else 0.0

    def begin_anew(self) -> None:
        """Discard the readings so far and those of the next moment, as they are frozen."""
        self._from_ns = self._last_ns + seconds_to_ns(AFTER_FREEZE_S)

    def _take(self, stamp_ns: Int64, position_m: Float64) -> None:
        """Compare the last reading with the one predicted from the speed before it."""
        t = (stamp_ns - stamp_ns[-2]) / NS_PER_S
        place = position_m + (stamp_ns < self._jump_ns)[:, None] * self._jump_m
        off = place[-1] - place[-2] - (place[-2] - place[0]) / -t[0] * t[-1]
        speed = float(np.linalg.norm(place[-2] - place[0])) / -t[0]
        bound_m = self._min_jump_m + STAMP_SIGMA_S * speed + MAX_CHANGE_MPS2 * t[-1] * (t[-1] - t[0])
        if np.linalg.norm(off) > bound_m:
            # Coming back means within the sum of the bounds of both jumps, there and back.
            is_away = np.linalg.norm(self._off_m) > self._bound_m
            self._off_m, self._bound_m = (
                (self._off_m + off, self._bound_m + bound_m) if is_away else (off, bound_m)
            )
            self._jump_ns, self._jump_m = int(stamp_ns[-1]), off


class EncoderFaults:
    """Detects freezes and jumps of the encoders, whatever their rate and however late they are examined.

    mounted: provides everything but the readings.
    """

    def __init__(self, mounted: CraneSamples) -> None:
        self._freeze, self._jump = FreezeWatch(mounted), JumpWatch(mounted.position_std_m)
        self._stamp_ns, self._position_m = mounted.stamp_ns[:0], mounted.position_m[:0]
        self._frozen, self._jumped_m = False, 0.0

    def take(self, stamp_ns: Int64, position_m: Float64) -> tuple[bool, float]:
        """Process the readings received since the last call, (N,) and (N, 3).

        Returns whether the encoders are frozen, and by how much (m) they have jumped.
        """
        if not len(stamp_ns):
            return self._frozen, self._jumped_m
        stamps = self._stamp_ns = np.concatenate([self._stamp_ns, stamp_ns])
        places = self._position_m = np.concatenate([self._position_m, position_m])
        steps = 1 + np.flatnonzero(np.diff(stamps // LOOK_NS))
        begin = 0
        for end in (*steps[steps > len(stamps) - len(stamp_ns)].tolist(), len(stamps)):
            oldest = int(np.searchsorted(stamps, stamps[end - 1] - HELD_NS))
            begin = max(min(oldest, end - HELD_READINGS), 0)
            now = stamps[begin:end], places[begin:end]
            self._frozen, self._jumped_m = self._freeze.check(*now), self._jump.check(*now)
            if self._frozen:
                self._jump.begin_anew()
        self._stamp_ns, self._position_m = stamps[begin:].copy(), places[begin:].copy()
        return self._frozen, self._jumped_m
