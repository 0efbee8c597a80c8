"""Find implausible samples from the numbers alone: wrong units, clocks and mounting."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from barsight.core.arrays import Int64
from barsight.core.notices import Notice
from barsight.core.records.pairs import StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import NS_PER_S
from barsight.recording.base import Recording

GRAVITY_MPS2 = (8.0, 12.0)
MAX_TURN_RADPS = 5.0
MAX_TILT_DEG = 5.0
"""Largest angle in degrees between gravity and the vertical given by the attitude of the encoders."""
MAX_SPEED_MPS, SPEED_WINDOW_S = 5.0, 0.5
"""Largest plausible speed of a crane (m/s), as a median, and the time span (s) over which it is computed."""
LARGE_YARD_M, LARGE_HOIST_M = 3000.0, 100.0
LARGE_SHIFT_S = 0.5
MAX_RATE_HZ = 20_000.0
MAX_CELLS_RATIO = 0.05
"""Largest difference in brightness between even and odd rows and columns, of the mean brightness: for a
mosaic of gray it is that of the colours' sensitivities.
"""
MAX_MISSING_RATIO = 0.5
"""Largest share of the pictures' time that a sensor may be missing."""


def clock_faults(recording: Recording) -> tuple[str, ...]:
    """List the reasons why stamps can't be of one clock in ns; they rule out any measurement."""
    shift_s = recording.rig.timeshift_cam_imu_ns / NS_PER_S
    found, frames_ns = [], recording.index.stamps_ns
    if abs(shift_s) > LARGE_SHIFT_S:
        found.append(f"timeshift_cam_imu is {shift_s:g} s: state it in seconds")
    for name, stamp_ns in _streams(recording):
        step_ns = max(float(np.median(np.diff(stamp_ns))), 1.0) if stamp_ns.size > 1 else NS_PER_S
        if step_ns < NS_PER_S / MAX_RATE_HZ:
            found.append(f"{name} has {NS_PER_S / step_ns:.3g} samples a second: give its stamps in ns")
        if frames_ns and (stamp_ns[0] > frames_ns[-1] or stamp_ns[-1] < frames_ns[0]):
            found.append(f"{name} and cam0 have no time in common: put them on one clock, in ns")
    return tuple(found)


def doubts(recording: Recording) -> tuple[Notice, ...]:
    """List implausible properties of a recording's samples; each forbids every lift."""
    imu, crane, found = recording.imu(), recording.crane(), list[Notice]()
    if imu is not None and len(imu.stamp_ns):
        found += _imu_doubts(imu)
        if crane is not None:
            found += _tilt_doubts(imu, crane)
    if crane is not None and len(crane.stamp_ns):
        found += _crane_doubts(crane)
    for name, stamp_ns in _streams(recording):
        found += _span_doubts(name, stamp_ns, recording.index.stamps_ns)
    return tuple(found)


def mosaics(recording: Recording) -> Iterator[Notice]:
    """Yield a hint for each camera whose first picture is a Bayer mosaic taken as gray: its even and odd rows
    and columns differ in brightness.
    """
    first = next((one for one in recording.frames() if isinstance(one, StereoFrame)), None)
    if first is None:
        return
    for name, image in (("cam0", first.left), ("cam1", first.right)):
        height, width = (size // 2 * 2 for size in image.shape)
        cells = image[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(0, 2))
        if np.ptp(cells) > MAX_CELLS_RATIO * cells.mean():
            yield Notice(
                "assumed",
                f"the gray pictures of {name} look like a Bayer mosaic: record gray or colour, or name the "
                "Bayer encoding",
            )


def _streams(recording: Recording) -> Iterator[tuple[str, Int64]]:
    for name, samples in (("imu0", recording.imu()), ("crane0", recording.crane())):
        if samples is not None and samples.stamp_ns.size:
            yield name, samples.stamp_ns


def _imu_doubts(imu: ImuSamples) -> Iterator[Notice]:
    gravity = float(np.median(np.linalg.norm(imu.accel_mps2, axis=1)))
    if not GRAVITY_MPS2[0] < gravity < GRAVITY_MPS2[1]:
        yield Notice(
            "units-doubtful",
            f"the IMU's median acceleration is {gravity:.4g} m/s^2, gravity is 9.8: give it in m/s^2",
        )
    turn = float(np.percentile(np.linalg.norm(imu.gyro_radps, axis=1), 95))
    if turn > MAX_TURN_RADPS:
        yield Notice("units-doubtful", f"the IMU turns at {turn:.1f} rad/s: give it in rad/s, not degrees/s")


def _crane_doubts(crane: CraneSamples) -> Iterator[Notice]:
    place = np.abs(crane.position_m)
    if float(place.max()) > LARGE_YARD_M or float(np.median(place[:, 2])) > LARGE_HOIST_M:
        yield Notice("units-doubtful", f"the crane is up to {place.max():.0f} m away: give metres, not mm")
    time = (crane.stamp_ns - crane.stamp_ns[0]) / NS_PER_S
    ahead = np.searchsorted(time, time + SPEED_WINDOW_S)
    old = np.flatnonzero(ahead < len(time))
    if old.size:
        distance = np.linalg.norm(crane.position_m[ahead[old]] - crane.position_m[old], axis=1)
        speed = float(np.percentile(distance / (time[ahead[old]] - time[old]), 75))
        if speed > MAX_SPEED_MPS:
            yield Notice("units-doubtful", f"the crane travels at {speed:.3g} m/s: give metres, not mm")


def _span_doubts(name: str, stamp_ns: Int64, frames_ns: Sequence[int]) -> Iterator[Notice]:
    if not frames_ns:
        return
    first, last = frames_ns[0], frames_ns[-1]
    start_ns, end_ns = max(int(stamp_ns[0]) - first, 0), max(last - int(stamp_ns[-1]), 0)
    if start_ns + end_ns > MAX_MISSING_RATIO * (last - first):
        yield Notice(
            "trajectory-degraded",
            f"{name} does not span the pictures: {start_ns / NS_PER_S:.2f} s missing at the start, "
            f"{end_ns / NS_PER_S:.2f} s at the end",
        )


def _tilt_doubts(imu: ImuSamples, crane: CraneSamples) -> Iterator[Notice]:
    up = np.median(imu.accel_mps2, axis=0) @ crane.yard_from_body_nominal.T
    length = float(np.linalg.norm(up))
    tilt = float(np.degrees(np.arccos(np.clip(up[2] / length, -1, 1)))) if length else 0.0
    if tilt > MAX_TILT_DEG:
        yield Notice(
            "mounting-doubtful",
            f"gravity lies {tilt:.0f} degrees off the vertical that R_yard_body states: check it, the IMU's "
            "T_BS, and the accelerometer's axes and signs",
        )
