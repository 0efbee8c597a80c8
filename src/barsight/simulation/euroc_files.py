"""Write the files of a simulated recording in the EuRoC layout, one writer per sensor."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from barsight.calibration.geometry.camera import Camera
from barsight.core.arrays import Float64, Int64, UInt8
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S
from barsight.simulation.sensors import ImuRecord
from barsight.simulation.settings import SensorSettings


def write_yaml(path: Path, content: dict[str, Any]) -> None:
    """Write one YAML file, keys in the given order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def write_csv(path: Path, header: str, rows: Iterable[str]) -> None:
    """Write one CSV file with EuRoC's commented header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def write_png(path: Path, image: UInt8) -> None:
    """Write one image; OSError where it can't be written."""
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise OSError(f"{path}: the image can't be encoded")
    path.write_bytes(data.tobytes())


def write_body(folder: Path) -> None:
    """Write `mav0/body.yaml`, which says that nothing of this is real."""
    comment = "simulated bar yard: rendered images and computed sensors, not a real recording"
    write_yaml(folder / "body.yaml", {"comment": comment, "is_simulated": True})


def write_camera(
    folder: Path, camera: Camera, body_from_cam: Pose, stamp_ns: Int64, timeshift_s: float
) -> None:
    """Write `camN/sensor.yaml` and `camN/data.csv`; the images come one by one."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    span_s = max(float(stamp_ns[-1] - stamp_ns[0]) / NS_PER_S, 1e-9)
    content = {
        "sensor_type": "camera", "comment": folder.name, "T_BS": _matrix(body_from_cam),
        "rate_hz": round((len(stamp_ns) - 1) / span_s, 3), "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "distortion_model": "radial-tangential", "distortion_coefficients": list(camera.coefficients),
        "timeshift_cam_imu": timeshift_s,
    }  # fmt: skip
    write_yaml(folder / "sensor.yaml", content)
    write_csv(folder / "data.csv", "#timestamp [ns],filename", (f"{t},{t}.png" for t in stamp_ns))


def write_imu(folder: Path, imu: ImuRecord, settings: SensorSettings) -> None:
    """Write `imu0`."""
    content = {
        "sensor_type": "imu", "comment": "imu0", "T_BS": _matrix(Pose.identity("body", "imu")),
        "rate_hz": settings.imu_rate_hz,
        "gyroscope_noise_density": settings.gyro_noise_density,
        "gyroscope_random_walk": settings.gyro_random_walk,
        "accelerometer_noise_density": settings.accel_noise_density,
        "accelerometer_random_walk": settings.accel_random_walk,
    }  # fmt: skip
    write_yaml(folder / "sensor.yaml", content)
    header = "#timestamp [ns]," + ",".join(
        [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    )
    values = np.column_stack([imu.gyro_radps, imu.accel_mps2])
    write_csv(folder / "data.csv", header, _rows(imu.stamp_ns, values, 9))


def write_crane(
    folder: Path, stamp_ns: Int64, place_m: Float64, lever_m: Float64, nominal: Float64,
    settings: SensorSettings,
) -> None:  # fmt: skip
    """Write `crane0`."""
    std_m = float(np.hypot(settings.encoder_std_m, settings.encoder_step_m / 12**0.5))
    content = {
        "sensor_type": "crane",
        "comment": "absolute encoders of bridge, trolley and hoist: the crane point in the yard frame",
        "p_crane_body": lever_m.tolist(), "R_yard_body": nominal.ravel().tolist(),
        "rate_hz": settings.encoder_rate_hz,
        "position_std_m": round(std_m, 6),
    }  # fmt: skip
    write_yaml(folder / "sensor.yaml", content)
    header = "#timestamp [ns],bridge_x [m],trolley_y [m],hoist_z [m]"
    write_csv(folder / "data.csv", header, _rows(stamp_ns, place_m, 6))


def write_laser(folder: Path, x_m: Float64, y_m: Float64, z_m: Float64, std_m: float) -> None:
    """Write `laser0`: x_m (N,), y_m (K,), z_m (K, N) as measured."""
    content = {
        "sensor_type": "laser", "comment": "single points along X, yard frame; reference profiles",
        "spacing_m": round(float(x_m[1] - x_m[0]), 6), "range_std_m": std_m,
    }  # fmt: skip
    write_yaml(folder / "sensor.yaml", content)
    rows = (
        f"{k},{x:.3f},{y:.3f},{z:.4f}" for k, y in enumerate(y_m) for x, z in zip(x_m, z_m[k], strict=True)
    )
    write_csv(folder / "data.csv", "#profile,x [m],y [m],z [m]", rows)


def write_ground_truth(folder: Path, stamp_ns: Int64, place_m: Float64, quaternion_wxyz: Float64) -> None:
    """Write `state_groundtruth_estimate0`: stamps on the IMU's clock."""
    header = "#timestamp," + ",".join([f"p_RS_R_{a} [m]" for a in "xyz"] + [f"q_RS_{a} []" for a in "wxyz"])
    write_csv(folder / "data.csv", header, _rows(stamp_ns, np.column_stack([place_m, quaternion_wxyz]), 9))


def _rows(stamp_ns: Int64, values: Float64, decimals: int) -> Iterable[str]:
    for stamp, row in zip(stamp_ns, values + 0.0, strict=True):
        yield f"{stamp}," + ",".join(f"{v:.{decimals}f}" for v in row)


def _matrix(pose: Pose) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": pose.matrix.ravel().tolist()}
