"""The crane's encoders: exact where the truth is a parabola, honest about noise, deaf to wild readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError, Failed, MeasurementError
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.inertial.model import GRAVITY_MPS2, ImuBias
from barsight.motion.crane.encoder_trajectory import (
    CraneSettings,
    EncoderOdometry,
    fit_position,
    reestimate_noise,
)
from barsight.motion.crane.known_motion import ImuWay, way_around
from barsight.motion.crane.robust_parabola import ROUNDS, fit_parabola
from barsight.motion.crane.sway import sway_at
from motion_recordings import MemoryRecording, ideal_rig

START_NS = 1_700_000_000_603_500_001
STD_M = 0.002
WINDOW_NS = 350_000_000
NOMINAL = np.diag([1.0, -1, -1])
MOUNT = np.array([0.35, -0.2, -0.55])


def place(time_s: np.ndarray) -> np.ndarray:
    """A parabola in each axis, by time since START_NS."""
    t = np.asarray(time_s)[..., None]
    return np.array([1.0, 2, 8]) + t * [0.5, -0.1, 0.02] + t**2 * [-0.2, 0.1, 0.05]


def readings(count: int = 40, noise: float = 0.0, rng: np.random.Generator | None = None) -> CraneSamples:
    """Readings every 50 ms, with some jitter of the stamps."""
    rng = rng or np.random.default_rng(0)
    stamps = START_NS + np.arange(count) * 50_000_000 + rng.integers(-5_000_000, 5_000_000, count)
    position = place((stamps - START_NS) / 1e9) + rng.normal(0, noise, (count, 3))
    return CraneSamples(stamps, position, MOUNT, NOMINAL, STD_M)


def test_a_parabola_is_met_exactly() -> None:
    crane = readings()
    for stamp in (START_NS + 500_000_007, START_NS + 1_234_567_891):
        fit = fit_position(crane, stamp, WINDOW_NS)
        position, covariance = fit.position_m, fit.covariance
        np.testing.assert_allclose(position, place((stamp - START_NS) / 1e9), atol=1e-10)
        assert 0 < covariance[0, 0] < STD_M**2


@pytest.mark.parametrize("rate_hz", [20, 1000])
def test_rounding_of_a_standing_crane_doesnt_average_out(rate_hz: int) -> None:
    truth, step_m = np.array([3.1234, 1.2345, 5.0003]), 0.005
    stamps = START_NS + np.arange(10 * rate_hz, dtype=np.int64) * (10**9 // rate_hz)
    read = np.tile(np.round(truth / step_m) * step_m, (len(stamps), 1))
    crane = CraneSamples(stamps, read, MOUNT, NOMINAL, step_m / 12**0.5)
    fit = fit_position(reestimate_noise(crane), START_NS + 5 * 10**9, WINDOW_NS)
    assert (np.abs(fit.position_m - truth) < 1.8 * np.sqrt(np.diag(fit.covariance))).all()


@pytest.mark.parametrize("count", [5, 8, 15])
def test_the_covariance_is_right(count: int) -> None:
    rng = np.random.default_rng(1)
    truth = place(np.array(0.025 * count))
    nees = []
    for _ in range(400):
        crane = readings(count, STD_M, rng)
        fit = fit_position(crane, START_NS + 25_000_000 * count, WINDOW_NS)
        position, covariance = fit.position_m, fit.covariance
        nees.append((position - truth) @ np.linalg.solve(covariance, position - truth) / 3)
    # For five readings the line's bias (0.2 m/s^2 over 0.1 s) adds to the noise.
    assert 0.8 < np.mean(nees) < (1.5 if count == 5 else 1.2)


def oscillating(hz: float, late_s: float = 0.0) -> tuple[CraneSamples, ImuSamples, np.ndarray]:
    """A crane that travels and oscillates by 0.6 m/s2, readings late; the place read at START_NS + 1 s."""
    turn = 2 * np.pi * hz
    wave = np.array([0.6, -0.3, 0.0]) / turn**2

    def at(time: np.ndarray) -> np.ndarray:
        return place(time) + np.sin(turn * time)[..., None] * wave

    read, felt = np.arange(0.0, 2.0, 0.05), np.arange(0.0, 2.0, 0.005)
    acceleration = 2 * np.array([-0.2, 0.1, 0.05]) - np.sin(turn * felt)[:, None] * wave * turn**2
    force = (acceleration + np.array([0, 0, GRAVITY_MPS2])) @ NOMINAL
    imu = ImuSamples(START_NS + np.round(1e9 * felt).astype(np.int64), np.zeros_like(force), force)
    crane = CraneSamples(
        START_NS + np.round(1e9 * read).astype(np.int64), at(read - late_s), MOUNT, NOMINAL, STD_M
    )
    return crane, imu, at(np.array(1.0 - late_s))


@pytest.mark.parametrize("hz", [0.5, 1.5, 3.0])
def test_an_oscillation_that_the_imu_tells_isnt_smeared(hz: float) -> None:
    """A parabola alone would be off by millimetres; where attitude and bias are open, the way is one more
    than the IMU tells.
    """
    crane, imu, truth = oscillating(hz)
    askew, none = NOMINAL @ Rotation.from_rotvec([2e-3, -1e-3, 0]).as_matrix(), ImuBias.none()
    for rotation, degree in ((NOMINAL, 1), (askew, 2)):
        way = way_around(imu, START_NS + 1_000_000_000, WINDOW_NS, rotation, none, degree)
        fit = fit_position(crane, START_NS + 1_000_000_000, WINDOW_NS, way)
        np.testing.assert_allclose(fit.position_m, truth, atol=2e-5)
    assert way_around(imu, START_NS + 1_800_000_000, WINDOW_NS, NOMINAL, none, 1) is None


def test_late_readings_of_an_oscillation_give_its_place_then() -> None:
    crane, imu, truth = oscillating(2.0, late_s=0.04)
    way = way_around(imu, START_NS + 1_000_000_000, WINDOW_NS + 40_000_000, NOMINAL, ImuBias.none(), 1)
    fit = fit_position(crane, START_NS + 1_000_000_000, WINDOW_NS, way, 40_000_000)
    np.testing.assert_allclose(fit.position_m, truth, atol=2e-5)


def test_what_the_imu_tells_leaves_less_to_find() -> None:
    """A line's middle has 4/9 of a parabola's variance, and scatters so."""
    rng, count = np.random.default_rng(1), 14
    stamp, truth = START_NS + 350_000_000, place(np.array(0.35))
    time = np.arange(-0.01, 0.72, 0.005)
    bend = np.tile(2 * np.array([-0.2, 0.1, 0.05]), (len(time), 1))
    way = ImuWay.integrate(START_NS + np.round(1e9 * time).astype(np.int64), bend, 1)
    off, stated = [], []
    for _ in range(400):
        fits = [fit_position(readings(count, STD_M, rng), stamp, WINDOW_NS, known) for known in (None, way)]
        off.append([fit.position_m - truth for fit in fits])
        stated.append([fit.covariance[0, 0] for fit in fits])
        np.testing.assert_allclose(fits[1].acceleration_mps2, bend[0])
    seen, stated = np.square(off).mean(axis=(0, 2)), np.mean(stated, axis=0)
    np.testing.assert_allclose(seen / stated, 1, atol=0.15)
    assert abs(seen[1] / seen[0] - 4 / 9) < 0.08


def test_without_an_imu_sigma_holds_what_a_parabola_smears() -> None:
    crane, _, _ = oscillating(3.0)
    crane = replace(crane, position_std_m=2e-4)
    fit = fit_position(crane, START_NS + 1_040_000_000, WINDOW_NS)
    even = (crane.stamp_ns - START_NS)[:, None] / 1e9 * [0.3, 0.1, 0.05]
    steady = fit_position(replace(crane, position_m=even), START_NS + 1_040_000_000, WINDOW_NS)
    assert fit.covariance[0, 0] ** 0.5 > 5 * steady.covariance[0, 0] ** 0.5
    assert 1e-3 > fit.covariance[0, 0] ** 0.5 > 4e-4


@pytest.mark.parametrize("size_m", [0.05, 1.0, 100.0])
@pytest.mark.parametrize("wild", [[5], [4, 9]])
def test_wild_readings_dont_pull(size_m: float, wild: list[int]) -> None:
    rng = np.random.default_rng(2)
    truth = place(np.array(0.35))
    errors, sigmas = [], []
    for _ in range(100):
        crane = readings(15, STD_M, rng)
        crane.position_m[wild, 0] += size_m
        fit = fit_position(crane, START_NS + 350_000_000, WINDOW_NS)
        position, covariance = fit.position_m, fit.covariance
        errors.append(position - truth)
        sigmas.append(np.sqrt(covariance[0, 0]))
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * np.mean(sigmas)
    assert np.mean(sigmas) < 0.6 * STD_M


def test_without_readings_around_it_a_frame_is_refused() -> None:
    crane = readings(40)
    stamps = crane.stamp_ns
    gap = np.r_[0:10, 30:40]
    holed = CraneSamples(stamps[gap], crane.position_m[gap], MOUNT, NOMINAL, STD_M)
    none = CraneSamples(stamps[:0], crane.position_m[:0], MOUNT, NOMINAL, STD_M)
    for samples, stamp in (
        (crane, int(stamps[0]) - 1),
        (crane, int(stamps[-1]) + 1),
        (holed, START_NS + 1_000_000_000),
        (none, START_NS),
    ):
        failed = fit_position(samples, stamp, WINDOW_NS)
        assert isinstance(failed, Failed)
        assert failed.code == "no-encoder"


def recording(shift_ns: int = 0, **sensors: object) -> MemoryRecording:
    return MemoryRecording(ideal_rig(shift_ns=shift_ns), **sensors)


def test_the_trajectory_is_the_crane_points_plus_the_mount() -> None:
    """Stamps are the cameras'; the encoders' clock is the IMU's, t_imu = t_cam + shift."""
    stamps = tuple(START_NS + k * 400_000_000 for k in range(6))
    crane = readings()
    source = recording(30_000_000, stamps_ns=stamps, crane_samples=crane)
    told = []
    settings = CraneSettings(attitude_std_deg=0.2)
    trajectory = EncoderOdometry(settings)(source, Rectifier(source.rig), lambda: told.append(1))
    assert trajectory.reference == "yard"
    assert trajectory.sensors == ("crane",)
    assert [f.stamp_ns for f in trajectory.frames] == list(stamps[:5])
    assert [f.stamp_ns for f in trajectory.refused] == [stamps[5]]
    assert len(told) == 6
    for frame in trajectory.frames:
        pose = frame.reference_from_body
        assert (pose.target, pose.source) == ("yard", "body")
        expected = place((frame.stamp_ns + 30_000_000 - START_NS) / 1e9) + MOUNT
        np.testing.assert_allclose(pose.translation, expected, atol=1e-9)
        np.testing.assert_array_equal(pose.rotation, NOMINAL)
        np.testing.assert_allclose(np.diag(frame.covariance)[:3], np.deg2rad(0.2) ** 2)


def test_without_encoders_it_says_so() -> None:
    with pytest.raises(MeasurementError, match="memory: no crane encoders; measure without them"):
        EncoderOdometry(CraneSettings())(recording(), Rectifier(ideal_rig()), lambda: None)


def swaying(bias: float) -> tuple[ImuSamples, np.ndarray]:
    """20 s of a body that swings 0.3 degrees about its own axes, its gyro biased."""
    time = np.arange(0, 20, 0.005)
    angle = np.deg2rad(0.3) * np.column_stack([np.sin(2.4 * time), np.cos(1.7 * time), np.sin(3.1 * time)])
    rate = np.gradient(angle, time, axis=0) + bias
    stamps = START_NS + (time * 1e9).round().astype(np.int64)
    return ImuSamples(stamps, rate, np.tile([0, 0, 9.81], (time.size, 1))), angle


def test_the_gyro_measures_the_sway() -> None:
    imu, truth = swaying(bias=0.002)
    for index in (1600, 2000, 2400):
        sway = sway_at(imu, int(imu.stamp_ns[index]), 8.0)
        np.testing.assert_allclose(sway, truth[index], atol=np.deg2rad(0.06))


def test_the_sway_turns_the_attitude() -> None:
    imu, truth = swaying(bias=0.001)
    stamp = int(imu.stamp_ns[2000])
    crane = readings(400)
    source = recording(stamps_ns=(stamp,), crane_samples=crane, imu_samples=imu)
    trajectory = EncoderOdometry(CraneSettings())(source, Rectifier(source.rig), lambda: None)
    assert trajectory.sensors == ("crane", "imu")
    expected = NOMINAL @ Rotation.from_rotvec(truth[2000]).as_matrix()
    found = trajectory.frames[0].reference_from_body.rotation
    assert Rotation.from_matrix(found.T @ expected).magnitude() < np.deg2rad(0.08)
    assert Rotation.from_matrix(NOMINAL.T @ expected).magnitude() > np.deg2rad(0.2)


def test_an_imu_that_doesnt_cover_the_frame() -> None:
    imu, _ = swaying(bias=0.0)
    late = int(imu.stamp_ns[-1]) + 1
    failed = sway_at(imu, late, 8.0)
    assert isinstance(failed, Failed)
    kept = np.abs(imu.stamp_ns - imu.stamp_ns[2000]) > 150_000_000
    holed = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    failed = sway_at(holed, int(imu.stamp_ns[2000]), 8.0)
    assert isinstance(failed, Failed)
    assert "gap" in failed.reason
    crane = readings(40)
    source = recording(stamps_ns=(START_NS + 900_000_000,), crane_samples=crane, imu_samples=holed)
    source.imu_samples = ImuSamples(imu.stamp_ns + 10**12, imu.gyro_radps, imu.accel_mps2)
    trajectory = EncoderOdometry(CraneSettings())(source, Rectifier(source.rig), lambda: None)
    assert trajectory.sensors == ("crane",)
    assert trajectory.warnings == ("the IMU doesn't cover 1 frames: nominal attitude",)


def test_settings() -> None:
    for setting in ({"window_s": 0.0}, {"attitude_std_deg": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(setting))):
            CraneSettings(**setting)


@pytest.mark.parametrize("degree", [1, 2])
def test_the_kernels_parabola_is_the_slow_one(degree: int) -> None:
    rng = np.random.default_rng(degree)
    time = np.sort(rng.uniform(-1, 1, 14))
    design = np.vander(time, degree + 1, increasing=True)
    values = design @ rng.normal(size=(degree + 1, 3)) + rng.normal(0, 0.01, (14, 3))
    values[4] += 1.0
    fitted = np.empty((degree + 1, 4))
    fit_parabola(time, values, 0.02, fitted)
    weights = np.ones(14)
    for _ in range(ROUNDS):
        expected, *_ = np.linalg.lstsq(design * weights[:, None], values * weights[:, None])
        used = weights
        weights = 1 / np.sqrt(1 + (np.linalg.norm(values - design @ expected, axis=1) / 0.02) ** 2)
    np.testing.assert_allclose(fitted[:, :3], expected, atol=1e-10)
    inverse = np.linalg.inv((design * used[:, None] ** 2).T @ design)
    less = (weights**4).sum() / (weights**2).sum()
    np.testing.assert_allclose(fitted[:, 3], less * inverse[:, 0], atol=1e-10)
