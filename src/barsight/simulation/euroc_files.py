"""Write the files of a simulated recording in the EuRoC layout, with one writer per sensor."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from barsight.calibration.files.euroc import write_imu_description, write_rig
from barsight.calibration.files.yaml_document import write_document
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64, Int64, UInt8
from barsight.core.records.sensor_samples import CraneSamples, LaserProfile
from barsight.core.stamps import NS_PER_S
from barsight.recording.formats.ground_truth import EUROC_HEADER
from barsight.recording.writers import euroc
from barsight.simulation.sensors import ImuRecord
from barsight.simulation.settings.rig import SensorSettings


def write_png(path: Path, image: UInt8) -> None:
    """Write one image as PNG. Raises OSError if it can't be written."""
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise OSError(f"{path}: the image can't be encoded")
    path.write_bytes(data.tobytes())


def write_body(folder: Path) -> None:
    """Write `mav0/body.yaml`, which states that the recording is simulated."""
    comment = "simulated bar yard: rendered images and computed sensors, not a real recording"
    write_document(folder / "body.yaml", {"comment": comment, "is_simulated": True})


def write_cameras(mav0: Path, rig: StereoRig, stamp_ns: Int64) -> None:
    """Write `sensor.yaml` and `data.csv` of both cameras; the images are written one by one later."""
    span_s = max(float(stamp_ns[-1] - stamp_ns[0]) / NS_PER_S, 1e-9)
    write_rig(mav0, rig, round((len(stamp_ns) - 1) / span_s, 3))
    for name in ("cam0", "cam1"):
        (mav0 / name / "data").mkdir()
        euroc.write_table(mav0 / name / "data.csv", euroc.IMAGE_HEADER, (f"{t},{t}.png" for t in stamp_ns))


def write_imu(folder: Path, imu: ImuRecord, settings: SensorSettings) -> None:
    """Write the IMU's folder, `imu0`."""
    noise = ImuNoise(
        settings.gyro_noise_density, settings.gyro_random_walk, settings.accel_noise_density,
        settings.accel_random_walk, settings.imu_rate_hz,
    )  # fmt: skip
    values = np.column_stack([imu.gyro_radps, imu.accel_mps2])
    euroc.write_table(folder / "data.csv", euroc.IMU_HEADER, _rows(imu.stamp_ns, values, 9))
    write_imu_description(folder / "sensor.yaml", noise, noise.rate_hz)


def write_crane(folder: Path, crane: CraneSamples) -> None:
    """Write the encoders' folder, `crane0`."""
    euroc.write_table(folder / "data.csv", euroc.CRANE_HEADER, _rows(crane.stamp_ns, crane.position_m, 6))
    euroc.write_crane_description(folder / "sensor.yaml", crane)


def write_laser(folder: Path, laser: tuple[LaserProfile, ...]) -> None:
    """Write the laser's folder, `laser0`."""
    euroc.write_table(folder / "data.csv", euroc.LASER_HEADER, _rows(*euroc.laser_table(laser), 4))
    euroc.write_laser_description(folder / "sensor.yaml", laser)


def write_ground_truth(folder: Path, stamp_ns: Int64, place_m: Float64, quaternion_wxyz: Float64) -> None:
    """Write `state_groundtruth_estimate0`, stamped by the IMU's clock."""
    rows = _rows(stamp_ns, np.column_stack([place_m, quaternion_wxyz]), 9)
    euroc.write_table(folder / "data.csv", EUROC_HEADER, rows)


def _rows(stamp_ns: Int64, values: Float64, decimals: int) -> Iterator[str]:
    return euroc.table_rows(stamp_ns, values + 0.0, f"{{:.{decimals}f}}".format)
