"""Up is found: from the accelerometer where it shows gravity, else from the picture's rows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.records.sensor_samples import ImuSamples
from barsight.motion.gravity import align_with_gravity
from motion_recordings import BODY_FROM_CAM0, MemoryRecording, ideal_rig

START_NS = 1_700_000_000_000_000_000


def at_rest(up_in_body: np.ndarray, strength: float = 9.81) -> ImuSamples:
    stamps = START_NS + np.arange(-100, 300) * 5_000_000
    noise = np.random.default_rng(0).normal(0, 0.05, (stamps.size, 3))
    return ImuSamples(stamps, np.zeros((stamps.size, 3)), strength * up_in_body + noise)


def level_of(imu: ImuSamples | None) -> tuple[np.ndarray, bool, tuple[str, ...]]:
    level = align_with_gravity(MemoryRecording(ideal_rig(), stamps_ns=(START_NS,), imu_samples=imu))
    pose = level.world_from_body
    assert (pose.target, pose.source) == ("world", "body")
    np.testing.assert_array_equal(pose.translation, 0)
    return pose.rotation, level.from_imu, level.warnings


@pytest.mark.parametrize("seed", range(5))
def test_up_is_where_the_accelerometer_points(seed: int) -> None:
    up = Rotation.random(rng=seed).apply([0, 0, 1.0])
    rotation, from_imu, warnings = level_of(at_rest(up))
    assert from_imu
    assert warnings == ()
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=2e-3)
    axis = BODY_FROM_CAM0.rotation[:, 2]
    if abs(axis @ up) > 0.9:
        axis = BODY_FROM_CAM0.rotation[:, 0]
    x, y, _ = rotation @ axis
    assert x > 0.4
    assert abs(y) < 2e-3


def test_a_camera_that_looks_down_has_x_along_its_rows() -> None:
    rotation, _, _ = level_of(at_rest(-BODY_FROM_CAM0.rotation[:, 2]))
    world_from_cam0 = rotation @ BODY_FROM_CAM0.rotation
    np.testing.assert_allclose(world_from_cam0, np.diag([1, -1, -1]), atol=3e-3)


def test_without_an_imu_the_rows_are_level() -> None:
    rotation, from_imu, warnings = level_of(None)
    assert not from_imu
    assert warnings == ("no gravity: the first picture's rows are taken as level",)
    world_from_cam0 = rotation @ BODY_FROM_CAM0.rotation
    np.testing.assert_allclose(world_from_cam0, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


def test_an_accelerometer_in_free_fall_is_not_believed() -> None:
    _, from_imu, warnings = level_of(at_rest(np.array([0, 0, 1.0]), strength=3.0))
    assert not from_imu
    assert "3.0 m/s^2" in warnings[0]
    assert "level" in warnings[1]
    late = at_rest(np.array([0, 0, 1.0]))
    _, from_imu, _ = level_of(ImuSamples(late.stamp_ns + 10**12, late.gyro_radps, late.accel_mps2))
    assert not from_imu
