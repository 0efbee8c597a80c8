"""Check a crane's sensors before a run: cameras present and as calibrated, readings plausible for a crane."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from barsight.core.errors import InputError
from barsight.live.settings import CraneConfig
from barsight.recording.awaited import AwaitedRecording
from barsight.recording.plausibility import doubts
from barsight.sensors.drivers import prove_cameras
from barsight.sensors.receiver import RawReading, ReadingReceiver
from barsight.sensors.settings import ReadingsSettings

LISTEN_S = 3.0
ENOUGH_S = 0.5
"""Time span in seconds of the readings that are judged."""


def prove_sensors(crane: CraneConfig, folder: AwaitedRecording) -> None:
    """Check that all sensors of crane.toml answer. Raises InputError naming the one that doesn't."""
    prove_cameras(crane.cameras, (folder.rig.cam0.width, folder.rig.cam0.height))
    for name in crane.sensors():
        folder = prove_sensor(crane, folder, name)
    expect_plausible(folder)


def prove_sensor(crane: CraneConfig, folder: AwaitedRecording, name: str) -> AwaitedRecording:
    """Receive `imu` or `crane` for a moment; return the recording with those readings.

    Raises InputError if none arrive, or if they aren't as crane.toml describes them.
    """
    sensor = crane.sensors()[name]
    found = _listen(name, sensor)
    stamps = np.array([one.device_ns for one in found], np.int64)
    if (np.diff(stamps) <= 0).any():
        raise InputError(name, "its stamps do not increase", "send the time of each measurement in ns")
    rate_hz = 1e9 / float(np.median(np.diff(stamps)))
    if not 0.5 < rate_hz / sensor.rate_hz < 2:
        raise InputError(
            name, f"its stamps give {rate_hz:.3g} readings a second, crane.toml says {sensor.rate_hz:g}",
            "send stamps in ns, and state the rate that is sent",
        )  # fmt: skip
    return held(folder, name, found)


def held(folder: AwaitedRecording, name: str, found: list[RawReading]) -> AwaitedRecording:
    """Return the recording with these readings of `imu` or `crane`."""
    stamps = np.array([one.device_ns for one in found], np.int64)
    values = np.array([one.values for one in found])
    if name == "imu" and folder.imu_samples is not None:
        heard = replace(
            folder.imu_samples, stamp_ns=stamps, gyro_radps=values[:, :3], accel_mps2=values[:, 3:]
        )
        return replace(folder, imu_samples=heard)
    assert folder.crane_samples is not None
    heard_crane = replace(folder.crane_samples, stamp_ns=stamps, position_m=values)
    return replace(folder, crane_samples=heard_crane)


def expect_plausible(folder: AwaitedRecording) -> None:
    """Raise InputError if the readings are implausible for a crane: units, gravity against the mounting."""
    for notice in doubts(folder):
        raise InputError("crane.toml", notice.message)


def _listen(name: str, sensor: ReadingsSettings) -> list[RawReading]:
    """Receive a few readings."""
    receiver = ReadingReceiver(name, sensor)
    wanted, give_up = max(round(ENOUGH_S * sensor.rate_hz), 5), time.monotonic() + LISTEN_S
    found: list[RawReading] = []
    try:
        for reading in receiver.readings(lambda: time.monotonic() < give_up, time.monotonic_ns):
            found.append(reading)
            if len(found) >= wanted:
                return found
    finally:
        receiver.close()
    remark = f", and {receiver.torn} of another form" if receiver.torn else ""
    remark += f" ({receiver.trouble})" if receiver.trouble else ""
    means = "the port and the firewall" if sensor.device is None else "the cable, the baud and the rights"
    raise InputError(
        name, f"{len(found)} readings came to {sensor.way} within {LISTEN_S:g} s{remark}",
        f"check the sender and its form (docs/how-to/run-a-crane.md), {means}",
    )  # fmt: skip
