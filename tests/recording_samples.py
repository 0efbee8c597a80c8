"""Tiny recordings built in a temporary folder, and the real ones where they are."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from barsight.recording.stored_images import StoredPictures

DATA = Path(os.environ.get("BARSIGHT_DATA", Path(__file__).parents[1] / "../shared/data")).resolve()
WIDTH, HEIGHT = 64, 48
START_NS = 1403715273262142977  # odd, and far beyond what a float64 holds exactly
STEP_NS = 50_000_000
NOISE = {
    "gyroscope_noise_density": 1.7e-4,
    "gyroscope_random_walk": 2e-05,
    "accelerometer_noise_density": 2e-3,
    "accelerometer_random_walk": 3e-3,
}


def real(name: str) -> Path:
    """A recording of the shared data; skips where the data is absent."""
    path = DATA / name
    if not path.is_dir():
        pytest.skip(f"{path} is absent: set BARSIGHT_DATA to the shared recordings")
    return path


def stamps(count: int) -> list[int]:
    return [START_NS + k * STEP_NS for k in range(count)]


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def mounts() -> tuple[np.ndarray, np.ndarray]:
    """body_from_cam0 and body_from_cam1 in general attitude, 0.12 m apart along cam0's x."""
    body_from_cam0 = np.eye(4)
    body_from_cam0[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix()
    body_from_cam0[:3, 3] = 0.1, -0.2, 0.05
    cam0_from_cam1 = np.eye(4)
    cam0_from_cam1[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix()
    cam0_from_cam1[:3, 3] = 0.12, 0.001, -0.002
    return body_from_cam0, body_from_cam0 @ cam0_from_cam1


def camera_yaml(matrix: np.ndarray, **changes: object) -> dict[str, object]:
    return {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": [float(v) for v in matrix.ravel()]},
        "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole",
        "intrinsics": [60.0, 61.0, 31.5, 23.5],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [-0.28, 0.07, 1.9e-4, 1.76e-05],
        "timeshift_cam_imu": -0.0035,
        **changes,
    }


def write_euroc(root: Path, count: int = 3, *, imu: bool = True, crane: bool = True) -> Path:
    """An EuRoC folder with `count` pairs; returns its root (which holds mav0)."""
    mav0 = root / "mav0"
    for camera, matrix in enumerate(mounts()):
        folder = mav0 / f"cam{camera}"
        (folder / "data").mkdir(parents=True)
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(camera_yaml(matrix)))
        rows = ["#timestamp [ns],filename"]
        for k, stamp in enumerate(stamps(count)):
            (folder / "data" / f"{stamp}.png").write_bytes(png(picture(10 * k + camera)))
            rows.append(f"{stamp},{stamp}.png")
        (folder / "data.csv").write_text("\n".join(rows) + "\n")
    if imu:
        write_imu(mav0, np.eye(4))
    if crane:
        write_crane_and_laser(mav0)
    return root


def write_imu(mav0: Path, body_from_imu: np.ndarray) -> None:
    folder = mav0 / "imu0"
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(1)
    rows = ["#timestamp [ns],wx,wy,wz,ax,ay,az"]
    for k in range(40):
        values = [*rng.normal(0, 0.1, 3), *rng.normal((0, 0, 9.81), 0.1)]
        rows.append(",".join([str(START_NS + k * 5_000_000), *(repr(float(v)) for v in values)]))
    (folder / "data.csv").write_text("\n".join(rows) + "\n")
    matrix = {"cols": 4, "rows": 4, "data": [float(v) for v in body_from_imu.ravel()]}
    (folder / "sensor.yaml").write_text(yaml.safe_dump({"T_BS": matrix, "rate_hz": 200, **NOISE}))


def write_crane_and_laser(mav0: Path) -> None:
    for name in ("crane0", "laser0"):
        (mav0 / name).mkdir()
    rows = [f"{START_NS + k * 50_000_000},{0.1 * k!r},{1 / 3!r},8.5" for k in range(4)]
    (mav0 / "crane0" / "data.csv").write_text("#timestamp [ns],bridge_x [m]\n" + "\n".join(rows) + "\n")
    attitude = Rotation.from_euler("xyz", [3.1, 0.02, -1.5]).as_matrix()
    crane = {
        "p_crane_body": [0.35, -0.2, -0.55],
        "R_yard_body": [float(v) for v in attitude.ravel()],
        "position_std_m": 0.002,
    }
    (mav0 / "crane0" / "sensor.yaml").write_text(yaml.safe_dump(crane))
    rows = [f"{p},{0.1 * k!r},{p * 0.7!r},{0.01 * k + p!r}" for p in (0, 3) for k in range(5)]
    (mav0 / "laser0" / "data.csv").write_text("#profile,x [m],y [m],z [m]\n" + "\n".join(rows) + "\n")
    (mav0 / "laser0" / "sensor.yaml").write_text(yaml.safe_dump({"range_std_m": 0.001}))


def assert_same(one: StoredPictures, other: StoredPictures) -> None:
    """Both recordings hold the same, bit for bit."""
    for name in ("body_from_cam0", "body_from_cam1"):
        np.testing.assert_array_equal(getattr(one.rig, name).matrix, getattr(other.rig, name).matrix)
    assert (one.rig.cam0, one.rig.cam1) == (other.rig.cam0, other.rig.cam1)
    assert one.rig.timeshift_cam_imu_ns == other.rig.timeshift_cam_imu_ns
    assert one.index == other.index
    assert one.is_simulated == other.is_simulated
    assert one.imu_noise() == other.imu_noise()
    for a, b in zip(one.frames(), other.frames(), strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.right, b.right)
    pairs = [(one.imu(), other.imu()), (one.crane(), other.crane())]
    pairs += list(zip(one.laser(), other.laser(), strict=True))
    for a, b in pairs:
        assert (a is None) == (b is None)
        for name in vars(a) if a is not None else ():
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
