"""Read and write Kalibr's `camchain-imucam.yaml` and `imu.yaml`.

Kalibr stores `T_cam_imu` = cam_from_body (the body is the IMU), `T_cn_cnm1` = cam1_from_cam0 and
`timeshift_cam_imu` with t_imu = t_cam + shift. Radial-tangential lenses with 5 or 8 coefficients, which
Kalibr itself does not produce, are written and read as longer lists.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.files.euroc import build_rig, read_camera
from barsight.calibration.files.yaml_document import Document, canonical_pose, read_document, write_document
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S, seconds_to_ns

MODEL_NAMES = {Distortion.NONE: "none", Distortion.RADTAN: "radtan", Distortion.EQUIDISTANT: "equi"}
AGREEMENT = 1e-3


@dataclass(frozen=True, eq=False)
class CamChain:
    """A camchain file. topics: the `rostopic` of cam0 and of cam1, None where it isn't stated.

    knows_imu: the file holds `T_cam_imu`. Without it, the rig's body is cam0 and an IMU can't be used.
    """

    rig: StereoRig
    topics: tuple[str | None, str | None]
    knows_imu: bool


@dataclass(frozen=True)
class ImuFile:
    """An `imu.yaml` file. topic: its `rostopic`, None where it isn't stated."""

    noise: ImuNoise
    topic: str | None


def read_camchain(path: Path) -> CamChain:
    """Read the rig formed by the first two cameras of a camchain. Raises `CalibrationError`."""
    document = read_document(path)
    cam0, cam1 = document.section("cam0"), document.section("cam1")
    cameras = read_camera(cam0, "distortion_coeffs"), read_camera(cam1, "distortion_coeffs")
    knows_imu = "T_cam_imu" in cam0.values and "T_cam_imu" in cam1.values
    if knows_imu:
        left = cam0.pose("T_cam_imu", "body", "cam0", inverted=True)
        right = cam1.pose("T_cam_imu", "body", "cam1", inverted=True)
        _expect_agreement(cam1, left, right)
    else:
        left = canonical_pose("body", "cam0", np.eye(4))
        right = cam1.pose("T_cn_cnm1", "body", "cam1", inverted=True)
    shift = seconds_to_ns(cam0.number("timeshift_cam_imu", 0.0))
    rig = build_rig(path, cameras[0], cameras[1], left, right, shift)
    return CamChain(rig, (_topic(cam0), _topic(cam1)), knows_imu)


def read_imu_file(path: Path) -> ImuFile:
    """Read the noise model from `imu.yaml`, whose keys Kalibr writes at the top level or below `imu0`.

    Raises `CalibrationError`.
    """
    document = read_document(path)
    if "imu0" in document.values:
        document = document.section("imu0")
    noise = ImuNoise(
        document.number("gyroscope_noise_density"),
        document.number("gyroscope_random_walk"),
        document.number("accelerometer_noise_density"),
        document.number("accelerometer_random_walk"),
        document.number("update_rate", 0.0),
    )
    return ImuFile(noise, _topic(document))


def write_camchain(path: Path, rig: StereoRig, topics: tuple[str, str]) -> None:
    """Write a camchain that `read_camchain` reads back bit for bit."""
    cam0_from_body = np.linalg.inv(rig.body_from_cam0.matrix).astype(np.float64)
    cam1_from_body = np.linalg.inv(rig.body_from_cam1.matrix).astype(np.float64)
    write_document(
        path,
        {
            "cam0": _section(rig.cam0, cam0_from_body, rig.timeshift_cam_imu_ns, topics[0], 1),
            "cam1": {
                "T_cn_cnm1": _rows(cam1_from_body @ rig.body_from_cam0.matrix),
                **_section(rig.cam1, cam1_from_body, rig.timeshift_cam_imu_ns, topics[1], 0),
            },
        },
    )


def write_imu_file(path: Path, noise: ImuNoise, topic: str) -> None:
    """Write an `imu.yaml` that `read_imu_file` reads back bit for bit."""
    write_document(
        path,
        {
            "accelerometer_noise_density": noise.accel_density,
            "accelerometer_random_walk": noise.accel_walk,
            "gyroscope_noise_density": noise.gyro_density,
            "gyroscope_random_walk": noise.gyro_walk,
            "rostopic": topic,
            "update_rate": noise.rate_hz,
        },
    )


def _section(camera: Camera, cam_from_body: Float64, shift_ns: int, topic: str, other: int) -> dict[str, Any]:
    return {
        "T_cam_imu": _rows(cam_from_body),
        "cam_overlaps": [other],
        "camera_model": "pinhole",
        "distortion_coeffs": list(camera.coefficients),
        "distortion_model": MODEL_NAMES[camera.distortion],
        "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
        "timeshift_cam_imu": shift_ns / NS_PER_S,
    }


def _rows(matrix: Float64) -> list[list[float]]:
    return [[float(value) for value in row] for row in matrix]


def _topic(document: Document) -> str | None:
    topic = document.values.get("rostopic")
    return str(topic) if topic else None


def _expect_agreement(cam1: Document, left: Pose, right: Pose) -> None:
    """Refuse a camchain that states the stereo extrinsics twice with different values, as after editing by
    hand.
    """
    if "T_cn_cnm1" not in cam1.values:
        return
    stated = cam1.pose("T_cn_cnm1", "cam0", "cam1", inverted=True)
    implied = left.inverse() @ right
    if implied.angle_to(stated) > AGREEMENT or implied.distance_to(stated) > AGREEMENT:
        raise cam1.error(
            "T_cn_cnm1",
            f"contradicts both T_cam_imu by {implied.distance_to(stated) * 1e3:.1f} mm and "
            f"{np.degrees(implied.angle_to(stated)):.2f} degrees",
            "take the file as Kalibr wrote it",
        )
