"""Check the values of the slow sensors in the same way for all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.calibration.files.yaml_document import Document
from barsight.core.arrays import Float64, Int64, rows_by_number
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.reading.bounded_reading import MAX_PROFILES
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.stamps import rows_not_later


def make_imu(path: Path, stamp_ns: Int64, gyro: Float64, accel: Float64, body_from_imu: Pose) -> ImuSamples:
    """Rotate samples into `body`.

    gyro (rad/s), accel (m/s^2): (N, 3) in the IMU's axes. If the IMU is away from the body's origin, the
    acceleration is not transferred (that needs the angular acceleration): lever arms are neglected.
    Raises `InputError` if the accelerations look like multiples of g.
    """
    rotation = body_from_imu.rotation
    if not np.array_equal(rotation, np.eye(3)):
        gyro, accel = gyro @ rotation.T, accel @ rotation.T
    expect_si(path, accel)
    return ImuSamples(stamp_ns, gyro, accel)


def expect_si(path: Path, accel: Float64) -> None:
    """Raise `InputError` if accelerations (N, 3) look like multiples of g."""
    median = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 < median < 1.25:
        raise InputError(
            path,
            f"the accelerations' median is {median:.2f} m/s^2, so they are probably in g",
            "multiply them by 9.80665 so that they are in m/s^2",
        )


def expect_usable(path: Path, crane: CraneSamples | None, imu: ImuSamples | None) -> None:
    """Raise `InputError` where readings that no file's reader has checked aren't in order of time or finite,
    or in g.

    Readings may be missing: there may be none at all.
    """
    given = [] if crane is None else [("the encoders'", crane.stamp_ns, crane.position_m)]
    if imu is not None:
        given.append(("the IMU's", imu.stamp_ns, np.hstack([imu.gyro_radps, imu.accel_mps2])))
    for whose, stamps, values in given:
        late = len(rows_not_later(stamps))
        if late:
            problem = f"{late} of {whose} {len(stamps)} stamps aren't later than the one before"
            raise InputError(path, problem, "sort the readings by time and drop doubled ones")
        wrong = int((~np.isfinite(values)).any(axis=1).sum())
        if wrong:
            raise InputError(path, f"{wrong} of {whose} {len(stamps)} readings aren't numbers", "drop them")
    if imu is not None and len(imu.stamp_ns):
        expect_si(path, imu.accel_mps2)


def make_crane(document: Document, stamp_ns: Int64, position_m: Float64) -> CraneSamples:
    """Build the encoder positions with the mounting from the crane's `sensor.yaml`.

    Raises `CalibrationError`.
    """
    rotation = np.array(document.numbers("R_yard_body", 9)).reshape(3, 3)
    try:
        nominal = Pose("yard", "body", rotation, np.zeros(3)).rotation
    except ValueError as error:
        raise document.error("R_yard_body", str(error), "give a rotation, row by row") from None
    std = document.number("position_std_m")
    if std <= 0:
        raise document.error(
            "position_std_m", f"{std} must be positive", "give the encoders' sigma in metres"
        )
    return CraneSamples(stamp_ns, position_m, np.array(document.numbers("p_crane_body", 3)), nominal, std)


def make_laser(path: Path, profile: Int64, xyz_m: Float64, range_std_m: float) -> tuple[LaserProfile, ...]:
    """Sort profiles by number and each by x. range_std_m: NaN if unknown.

    Raises InputError about `path` for more than MAX_PROFILES.
    """
    found = rows_by_number(profile)
    if len(found) > MAX_PROFILES:
        problem = f"the laser has {len(found)} profiles, at most {MAX_PROFILES} are read"
        raise InputError(path, problem, "leave profiles out")
    profiles = []
    for number, chosen in found.items():
        rows = xyz_m[chosen]
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        x, y, z = (np.ascontiguousarray(column) for column in rows.T)
        profiles.append(LaserProfile(number, x, y, z, range_std_m))
    return tuple(profiles)


def laser_std(document: Document | None) -> float:
    """Read the laser's range sigma (m) from its `sensor.yaml`; NaN if it isn't stated."""
    if document is None or document.values.get("range_std_m") is None:
        return float("nan")
    return document.number("range_std_m")
