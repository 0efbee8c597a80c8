"""Describe the content of a recording: sensors, rates, gaps, pairs, calibration. Decodes at most one pair."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Int64
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples, LaserProfile
from barsight.core.stamps import NS_PER_S
from barsight.recording.plausibility import clock_faults, doubts
from barsight.recording.stored_images import NamedPictures, StoredPictures

GAP_FACTOR = 1.5


@dataclass(frozen=True)
class StreamInfo:
    """One sensor's samples. rate_hz: from the median interval, NaN for fewer than two samples.

    gaps: number of intervals over 1.5 times the median. longest_gap_s: the longest of them, 0 without gaps.
    """

    name: str
    count: int
    first_ns: int
    last_ns: int
    rate_hz: float
    gaps: int
    longest_gap_s: float

    @property
    def duration_s(self) -> float:
        """Return the time from the first sample to the last."""
        return (self.last_ns - self.first_ns) / NS_PER_S


@dataclass(frozen=True)
class CalibrationSummary:
    """Key figures of the rig. baseline_m: distance of the cameras. angle_deg: angle between them."""

    cam0: Camera
    cam1: Camera
    baseline_m: float
    angle_deg: float
    timeshift_cam_imu_ms: float


@dataclass(frozen=True)
class CraneInfo:
    """lowest_m, highest_m: the range of the encoders in `yard` (bridge x, trolley y, hoist z)."""

    lowest_m: tuple[float, float, float]
    highest_m: tuple[float, float, float]
    position_std_m: float


@dataclass(frozen=True)
class ProfileInfo:
    """One laser profile: its number, number of points, y, and extent along x (m, `yard`)."""

    profile: int
    count: int
    y_m: float
    x_first_m: float
    x_last_m: float


@dataclass(frozen=True)
class RecordingInfo:
    """Content of `barsight info`. dropped: pictures without partner, with the reason.

    first_refused: why the first pair can't be used, None if it can. notes: the reader's assumptions and any
    oddities.
    """

    path: Path
    format: str
    is_simulated: bool
    streams: tuple[StreamInfo, ...]
    pairs: int
    dropped: tuple[RefusedFrame, ...]
    first_refused: str | None
    calibration: CalibrationSummary
    crane: CraneInfo | None
    laser: tuple[ProfileInfo, ...]
    notes: tuple[str, ...]


def describe_recording(recording: StoredPictures) -> RecordingInfo:
    """Describe a recording. Raises `InputError` if a sensor's file is wrong, as measuring would."""
    stamps = recording.camera_stamps
    streams = [stream_info("cam0", stamps.left_ns), stream_info("cam1", stamps.right_ns)]
    imu, crane, laser = recording.imu(), recording.crane(), recording.laser()
    if imu is not None:
        streams.append(stream_info("imu0", imu.stamp_ns))
    if crane is not None:
        streams.append(stream_info("crane0", crane.stamp_ns))
    first = next(iter(recording.frames()), None)
    messages = (doubt.message for doubt in doubts(recording))
    notes = (
        *_absent(recording),
        *recording.notes,
        *clock_faults(recording),
        *messages,
        *_time_notes(streams),
    )
    return RecordingInfo(
        path=recording.path,
        format=recording.format,
        is_simulated=recording.is_simulated,
        streams=tuple(streams),
        pairs=len(recording.index.stamps_ns),
        dropped=recording.index.unpaired,
        first_refused=first.reason if isinstance(first, RefusedFrame) else None,
        calibration=_calibration(recording.rig),
        crane=_crane(crane) if crane is not None else None,
        laser=_laser(laser),
        notes=tuple(dict.fromkeys((*notes, *_time_notes(streams)))),
    )


def _absent(recording: StoredPictures) -> tuple[str, ...]:
    absent = recording.absent() if isinstance(recording, NamedPictures) else ()
    if not absent:
        return ()
    return (f"pictures that are not there, their pairs are refused: {len(absent)}, first {absent[0]}",)


def stream_info(name: str, stamp_ns: Int64) -> StreamInfo:
    """Count increasing stamps (N,), N >= 1, their rate and gaps."""
    steps = np.diff(stamp_ns)
    if steps.size == 0:
        return StreamInfo(name, stamp_ns.size, int(stamp_ns[0]), int(stamp_ns[-1]), float("nan"), 0, 0.0)
    median = float(np.median(steps))
    gaps = steps[steps > GAP_FACTOR * median]
    longest = float(gaps.max()) / NS_PER_S if gaps.size else 0.0
    return StreamInfo(
        name, stamp_ns.size, int(stamp_ns[0]), int(stamp_ns[-1]), NS_PER_S / median, gaps.size, longest
    )


def _calibration(rig: StereoRig) -> CalibrationSummary:
    place = rig.cam0_from_cam1
    cosine = (float(np.trace(place.rotation)) - 1) / 2
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return CalibrationSummary(rig.cam0, rig.cam1, rig.baseline_m, angle, rig.timeshift_cam_imu_ns / 1e6)


def _crane(crane: CraneSamples) -> CraneInfo:
    low, high = crane.position_m.min(axis=0).tolist(), crane.position_m.max(axis=0).tolist()
    return CraneInfo((low[0], low[1], low[2]), (high[0], high[1], high[2]), crane.position_std_m)


def _laser(profiles: Iterable[LaserProfile]) -> tuple[ProfileInfo, ...]:
    return tuple(
        ProfileInfo(p.profile, p.x_m.size, float(np.median(p.y_m)), float(p.x_m[0]), float(p.x_m[-1]))
        for p in profiles
    )


def _time_notes(streams: Iterable[StreamInfo]) -> Iterable[str]:
    """Note sensors whose samples don't cover the time of the pictures."""
    cam0, *others = streams
    for stream in others:
        before = (stream.first_ns - cam0.first_ns) / NS_PER_S
        after = (cam0.last_ns - stream.last_ns) / NS_PER_S
        apart = stream.first_ns > cam0.last_ns or stream.last_ns < cam0.first_ns
        if stream.name != "cam1" and not apart and max(before, after) > 0.1:
            yield (
                f"{stream.name} does not span the pictures: {max(before, 0):.2f} s missing at the start, "
                f"{max(after, 0):.2f} s at the end"
            )
