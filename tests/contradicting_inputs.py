"""Recordings in EuRoC's layout whose files contradict each other: one table of what is spoiled, and how."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

Spoil = Callable[[Path], None]
SHIFT_S = -0.0035
"""The simulation's time shift."""


def columns(sensor: str, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change a sensor's numbers (N, 3 or 6), the stamps not among them."""

    def spoil(root: Path) -> None:
        path = root / sensor / "data.csv"
        head, *rows = path.read_text().splitlines()
        stamps = [row.split(",")[0] for row in rows]
        values = change(np.array([[float(x) for x in row.split(",")[1:]] for row in rows]))
        lines = [
            ",".join([stamp, *(f"{v:.9f}" for v in row)]) for stamp, row in zip(stamps, values, strict=True)
        ]
        path.write_text("\n".join([head, *lines]) + "\n")

    return spoil


def clock(change: Callable[[int], int], *sensors: str) -> Spoil:
    """Change the stamps of sensors."""

    def spoil(root: Path) -> None:
        for sensor in sensors:
            path = root / sensor / "data.csv"
            with path.open(newline="") as file:
                head, *rows = list(csv.reader(file))
            lines = [",".join([str(change(int(row[0]))), *row[1:]]) for row in rows]
            path.write_text("\n".join([",".join(head), *lines]) + "\n")

    return spoil


def stated(sensor: str, key: str, change: Callable[[object], object]) -> Spoil:
    """Change what a `sensor.yaml` states."""

    def spoil(root: Path) -> None:
        path = root / sensor / "sensor.yaml"
        content = yaml.safe_load(path.read_text())
        content[key] = change(content[key])
        path.write_text(yaml.safe_dump(content))

    return spoil


def both(*spoils: Spoil) -> Spoil:
    """Spoil in several ways."""

    def spoil(root: Path) -> None:
        for one in spoils:
            one(root)

    return spoil


def turned(axis: str, degrees: float, *sensors: str) -> Spoil:
    """Turn the stated mounting (`T_BS`) of sensors about an axis of the body."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()

    def change(matrix: object) -> object:
        data = np.array(matrix["data"]).reshape(4, 4)  # type: ignore[index]
        return {"cols": 4, "rows": 4, "data": (turn @ data).ravel().tolist()}

    return both(*(stated(sensor, "T_BS", change) for sensor in sensors))


def crane_turned(axis: str, degrees: float) -> Spoil:
    """Turn the stated attitude `R_yard_body` about an axis of the yard."""
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return stated(
        "crane0", "R_yard_body", lambda rows: (turn @ np.array(rows).reshape(3, 3)).ravel().tolist()
    )


def swapped_pictures(root: Path) -> None:
    """Exchange the pictures of the cameras, not their calibrations."""
    for name in ("data", "data.csv"):
        (root / "cam0" / name).rename(root / "cam0" / f"other_{name}")
        (root / "cam1" / name).rename(root / "cam0" / name)
        (root / "cam0" / f"other_{name}").rename(root / "cam1" / name)


def exchanged_calibrations(root: Path) -> None:
    """Exchange the calibrations of the cameras, not their pictures."""
    left, right = (root / cam / "sensor.yaml" for cam in ("cam0", "cam1"))
    texts = left.read_text(), right.read_text()
    right.write_text(texts[0])
    left.write_text(texts[1])


def shifted(seconds: float) -> Spoil:
    """State another time shift."""
    return both(*(stated(cam, "timeshift_cam_imu", lambda _: seconds) for cam in ("cam0", "cam1")))


def scaled(*factors: float) -> Callable[[np.ndarray], np.ndarray]:
    """Multiply the columns."""
    return lambda values: values * np.array(factors)


def late(seconds: float) -> Callable[[int], int]:
    """Shift stamps."""
    return lambda stamp: stamp + round(1e9 * seconds)


def gyro(factor: float) -> Spoil:
    """Multiply the gyro."""
    return columns("imu0", scaled(*[factor] * 3, 1, 1, 1))


def accel(factor: float) -> Spoil:
    """Multiply the accelerometer."""
    return columns("imu0", scaled(1, 1, 1, *[factor] * 3))


def without(*names: str) -> Spoil:
    """Remove files or folders."""

    def spoil(root: Path) -> None:
        for name in names:
            path = root / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil


def in_us(stamp: int) -> int:
    """Microseconds."""
    return stamp // 1000


SENSORS = ("cam0", "cam1", "imu0", "crane0")
CONTRADICTIONS: dict[str, tuple[Spoil, str]] = {
    "encoders in mm": (columns("crane0", scaled(1e3, 1e3, 1e3)), "not mm"),
    "encoders in km": (columns("crane0", scaled(1e-3, 1e-3, 1e-3)), "wrong unit"),
    "bridge in mm": (columns("crane0", scaled(1e3, 1, 1)), "not mm"),
    "bridge in km": (columns("crane0", scaled(1e-3, 1, 1)), "wrong unit"),
    "encoders in feet": (columns("crane0", scaled(3.2808, 3.2808, 3.2808)), "wrong unit"),
    "bridge and trolley exchanged": (columns("crane0", lambda v: v[:, [1, 0, 2]]), "wrong mounting"),
    "bridge and hoist exchanged": (columns("crane0", lambda v: v[:, [2, 1, 0]]), "wrong mounting"),
    "bridge negated": (columns("crane0", scaled(-1, 1, 1)), "wrong mounting"),
    "hoist negated": (columns("crane0", scaled(1, 1, -1)), "mounting-doubtful"),
    "gyro in degrees/s": (gyro(57.29578), "wrong unit"),
    "gyro divided by 57": (gyro(1 / 57.29578), "wrong unit"),
    "gyro in mrad/s": (gyro(1e3), "give it in rad/s"),
    "gyro axes exchanged": (columns("imu0", lambda v: v[:, [1, 0, 2, 3, 4, 5]]), "wrong mounting"),
    "gyro negated": (gyro(-1), "wrong mounting"),
    "accelerometer in g": (accel(1 / 9.80665), "probably in g"),
    "accelerometer in mg": (accel(1e3 / 9.80665), "units-doubtful"),
    "accelerometer negated": (accel(-1), "mounting-doubtful"),
    "time shift in ms": (shifted(1e3 * SHIFT_S), "timeshift_cam_imu"),
    "time shift in us": (shifted(1e6 * SHIFT_S), "timeshift_cam_imu"),
    "time shift 0.3 s off": (shifted(0.3), "wrong clock"),
    "time shift -0.3 s off": (shifted(-0.3), "wrong clock"),
    "all stamps in us": (clock(in_us, *SENSORS), "samples a second"),
    "IMU stamps in us": (clock(in_us, "imu0"), "no time in common"),
    "crane stamps in us": (clock(in_us, "crane0"), "no time in common"),
    "IMU clock 0.5 s late": (clock(late(0.5), "imu0"), "wrong clock"),
    "IMU clock 0.5 s early": (clock(late(-0.5), "imu0"), "wrong clock"),
    "crane clock 0.5 s late": (clock(late(0.5), "crane0"), "wrong clock"),
    "crane clock 0.5 s early": (clock(late(-0.5), "crane0"), "wrong clock"),
    "camera clock 0.5 s late": (clock(late(0.5), "cam0", "cam1"), "wrong clock"),
    "cam1 clock 0.8 s late": (clock(late(0.8), "cam1"), "clocks"),
    "cameras turned 90 about x": (turned("x", 90, "cam0", "cam1"), "wrong mounting"),
    "cameras turned 90 about y": (turned("y", 90, "cam0", "cam1"), "wrong mounting"),
    "cameras turned 90 about z": (turned("z", 90, "cam0", "cam1"), "wrong mounting"),
    "cameras turned 180 about z": (turned("z", 180, "cam0", "cam1"), "wrong mounting"),
    "cameras turned 180 about x": (turned("x", 180, "cam0", "cam1"), "wrong mounting"),
    "IMU turned 90 about x": (turned("x", 90, "imu0"), "gravity lies 90 degrees off"),
    "IMU turned 90 about z": (turned("z", 90, "imu0"), "wrong mounting"),
    "IMU turned 180 about z": (turned("z", 180, "imu0"), "wrong mounting"),
    "rig's attitude turned 90 about yard x": (crane_turned("x", 90), "mounting-doubtful"),
    "rig's attitude turned 10 about yard x": (crane_turned("x", 10), "mounting-doubtful"),
    "rig's attitude turned 90 about yard z": (crane_turned("z", 90), "wrong mounting"),
    "rig's attitude turned 180 about yard z": (crane_turned("z", 180), "wrong mounting"),
    "rig's attitude turned 10 about yard z": (crane_turned("z", 10), "wrong mounting"),
    "pictures of the cameras exchanged": (swapped_pictures, "cam0 (left) and cam1 (right)"),
    "calibrations of the cameras exchanged": (exchanged_calibrations, "left and right are swapped"),
    "calibration of a rig knocked in pitch": (turned("y", 0.5, "cam1"), "calibration-drift"),
    "calibration of a rig knocked in yaw": (turned("x", 0.3, "cam1"), "calibration-drift"),
    "no cam1 calibration": (without("cam1/sensor.yaml"), "cam1"),
    "no crane": (without("crane0"), "no-yard-frame"),
}
"""What is spoiled -> how, and the code (or words) that must name it."""

YEARS_S = 20 * 365.25 * 86_400
AGES: dict[str, tuple[Spoil, bool, str]] = {
    "recorded years ago": (both(), True, "map-too-old"),
    "recorded in the future": (clock(late(YEARS_S), *SENSORS), True, "map-from-the-future"),
    "no magnet": (both(), False, "no-magnet"),
}
"""Stale, future or missing, judged now -> how, whether a magnet is given, the code that must name it."""
