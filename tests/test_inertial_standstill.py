"""Standing still: found where the body rests, not where it moves; gravity and gyro bias from it."""

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.inertial.standstill import RestEstimate, estimate_at_rest, stands_still

NOISE = ImuNoise(2.4e-4, 2e-5, 1.9e-3, 4e-4, 200.0)
START = 1_700_000_000_000_000_000
UP = np.array([0.02, -0.01, -1.0]) / np.linalg.norm([0.02, -0.01, -1.0])
GYRO_BIAS = np.array([0.008, -0.001, 0.006])


def rest_then_travel(scale: float = 1.0) -> ImuSamples:
    """3 s at rest, 3 s under way with 0.3 m/s^2 and a little sway."""
    rng = np.random.default_rng(0)
    t = np.arange(1200) * 0.005
    moving = np.clip(t - 3, 0, 0.5)[:, None] * 2
    force = 9.80665 * UP + moving * [0.3, 0, 0] + moving * 0.05 * np.sin(9 * t)[:, None]
    rate = GYRO_BIAS + moving * 0.01 * np.cos(2.5 * t)[:, None]
    rate = rate + rng.normal(0, NOISE.gyro_density * 200**0.5, (1200, 3))
    force = force + rng.normal(0, NOISE.accel_density * 200**0.5, (1200, 3))
    return ImuSamples(START + np.arange(1200, dtype=np.int64) * 5_000_000, rate, force * scale)


def test_rest_is_found_and_motion_is_not() -> None:
    still = stands_still(rest_then_travel(), NOISE)
    assert still[20:560].mean() > 0.97
    assert still[720:].mean() < 0.02
    assert not stands_still(ImuSamples(*(a[:5] for a in vars(rest_then_travel()).values())), NOISE).any()


def test_gravity_and_gyro_bias_within_their_sigma() -> None:
    start = estimate_at_rest(rest_then_travel(), START, START + 2_500_000_000, NOISE)
    assert isinstance(start, RestEstimate)
    assert np.abs(start.bias.gyro_radps - GYRO_BIAS).max() < 4 * start.gyro_sigma_radps
    assert np.linalg.norm(np.cross(start.up_in_body, UP)) < 4 * start.tilt_sigma_rad
    assert np.linalg.norm(start.bias.accel_mps2) < 0.01


def test_what_is_no_start_is_refused() -> None:
    moving = estimate_at_rest(rest_then_travel(), START + 3_500_000_000, START + 5_000_000_000, NOISE)
    assert isinstance(moving, Failed)
    assert moving.code == "not-still"
    in_g = estimate_at_rest(rest_then_travel(1 / 9.80665), START, START + 2_000_000_000, NOISE)
    assert isinstance(in_g, Failed)
    assert "in g?" in in_g.reason
    none = estimate_at_rest(rest_then_travel(), START - 10**9, START - 1, NOISE)
    assert isinstance(none, Failed)
