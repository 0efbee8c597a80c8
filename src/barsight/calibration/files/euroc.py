"""Read and write EuRoC's `sensor.yaml` files, which hold a rig and an IMU's noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from barsight.calibration.files.yaml_document import Document, read_document, write_document
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S, seconds_to_ns

DISTORTION_NAMES = {
    "radial-tangential": Distortion.RADTAN,
    "radtan": Distortion.RADTAN,
    "plumb_bob": Distortion.RADTAN,
    "rational_polynomial": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT,
    "equi": Distortion.EQUIDISTANT,
    "none": Distortion.NONE,
}


@dataclass(frozen=True, eq=False)
class MountedImu:
    """Mounting and noise of an IMU; noise is None where the file doesn't state it."""

    body_from_imu: Pose
    noise: ImuNoise | None


def read_rig(mav0: Path) -> StereoRig:
    """Read the rig from `cam0/sensor.yaml` and `cam1/sensor.yaml`. Raises `CalibrationError`."""
    documents = [read_document(mav0 / name / "sensor.yaml") for name in ("cam0", "cam1")]
    mounts = [
        document.pose("T_BS", "body", name)
        for document, name in zip(documents, ("cam0", "cam1"), strict=True)
    ]
    cameras = [read_camera(document, "distortion_coefficients") for document in documents]
    shift = seconds_to_ns(documents[0].number("timeshift_cam_imu", 0.0))
    return build_rig(documents[1].path, cameras[0], cameras[1], mounts[0], mounts[1], shift)


def read_camera(document: Document, coefficients_key: str) -> Camera:
    """Read a camera from EuRoC's or Kalibr's keys, which differ only in the name of the coefficients."""
    model = str(document.get("camera_model"))
    if model != "pinhole":
        raise document.error("camera_model", f"{model!r} is not supported", "calibrate as pinhole")
    name = str(document.values.get("distortion_model", "none")).lower()
    if name not in DISTORTION_NAMES:
        raise document.error(
            "distortion_model",
            f"{name!r} is not supported",
            "calibrate with radial-tangential or equidistant distortion",
        )
    distortion = DISTORTION_NAMES[name]
    coefficients = () if distortion is Distortion.NONE else document.numbers(coefficients_key)
    width, height = document.numbers("resolution", 2)
    fx, fy, cx, cy = document.numbers("intrinsics", 4)
    if width != int(width) or height != int(height):
        raise document.error("resolution", "is not a whole number of pixels", "give [width, height]")
    try:
        return Camera(int(width), int(height), fx, fy, cx, cy, distortion, coefficients)
    except ValueError as error:
        key = coefficients_key if "coefficients" in str(error) else "intrinsics"
        raise document.error(key, str(error), "take the calibration's original numbers") from None


def build_rig(
    path: Path, cam0: Camera, cam1: Camera, body_from_cam0: Pose, body_from_cam1: Pose, shift_ns: int
) -> StereoRig:
    """Build a `StereoRig`; invalid values raise `CalibrationError` about `path`."""
    try:
        return StereoRig(cam0, cam1, body_from_cam0, body_from_cam1, shift_ns)
    except ValueError as error:
        remedy = "exchange the cameras' folders or topics" if "swapped" in str(error) else "calibrate again"
        raise CalibrationError(path, str(error), remedy) from None


def read_imu(path: Path) -> MountedImu:
    """Read the IMU's `sensor.yaml`. Raises `CalibrationError`."""
    document = read_document(path)
    pose = document.pose("T_BS", "body", "imu") if "T_BS" in document.values else None
    keys = (
        "gyroscope_noise_density",
        "gyroscope_random_walk",
        "accelerometer_noise_density",
        "accelerometer_random_walk",
    )
    noise = None
    if all(key in document.values for key in keys):
        gyro, gyro_walk, accel, accel_walk = (document.number(key) for key in keys)
        noise = ImuNoise(gyro, gyro_walk, accel, accel_walk, document.number("rate_hz", 0.0))
    return MountedImu(pose or Pose.identity("body", "imu"), noise)


def write_rig(mav0: Path, rig: StereoRig, rate_hz: float) -> None:
    """Write `cam0/sensor.yaml` and `cam1/sensor.yaml`, which `read_rig` reads back bit for bit."""
    for name, camera, mount in (
        ("cam0", rig.cam0, rig.body_from_cam0),
        ("cam1", rig.cam1, rig.body_from_cam1),
    ):
        (mav0 / name).mkdir(parents=True, exist_ok=True)
        write_document(
            mav0 / name / "sensor.yaml",
            {
                "sensor_type": "camera",
                "comment": name,
                "T_BS": _matrix(mount),
                "rate_hz": round(rate_hz, 6),
                "resolution": [camera.width, camera.height],
                "camera_model": "pinhole",
                "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
                "distortion_model": str(camera.distortion),
                "distortion_coefficients": list(camera.coefficients),
                "timeshift_cam_imu": rig.timeshift_cam_imu_ns / NS_PER_S,
            },
        )


def write_imu_description(path: Path, noise: ImuNoise | None, rate_hz: float) -> None:
    """Write an IMU's `sensor.yaml` for samples that are already in the frame `body`."""
    values: dict[str, object] = {
        "sensor_type": "imu",
        "comment": "imu0",
        "T_BS": _matrix(Pose.identity("body", "imu")),
        "rate_hz": noise.rate_hz if noise else round(rate_hz, 6),
    }
    if noise:
        values |= {
            "gyroscope_noise_density": noise.gyro_density,
            "gyroscope_random_walk": noise.gyro_walk,
            "accelerometer_noise_density": noise.accel_density,
            "accelerometer_random_walk": noise.accel_walk,
        }
    write_document(path, values)


def _matrix(pose: Pose) -> dict[str, object]:
    return {"cols": 4, "rows": 4, "data": [float(v) for v in pose.matrix.ravel()]}
