"""IMU noise against known noise, against an outside fit, and logs in other units."""

from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.camera_imu.allan_deviation import (
    ImuNoiseFit,
    fit_imu_noise,
    overlapping_allan_variance,
)
from barsight.calibration.files.kalibr import read_imu_file
from barsight.cli.main import run
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.recording.formats.imu_log import read_imu_log

RATE_HZ, DENSITY, WALK = 100.0, np.array([1.5e-3, 2e-2]), np.array([8e-4, 1e-2])


def still(seed: int, count: int) -> ImuSamples:
    """White noise and a random walk of known densities, gravity on z."""
    rng = np.random.default_rng(seed)
    values = []
    for density, walk in zip(DENSITY, WALK, strict=True):
        white = density * np.sqrt(RATE_HZ) * rng.normal(size=(count, 3))
        values.append(white + np.cumsum(walk / np.sqrt(RATE_HZ) * rng.normal(size=(count, 3)), axis=0) * 1e-2)
    stamps = (np.arange(count) * 1e9 / RATE_HZ + rng.normal(0, 1e5, count)).astype(np.int64)
    return ImuSamples(stamps, values[0], values[1] + np.array([0, 0, 9.81]))


def fitted(samples: ImuSamples) -> ImuNoiseFit:
    fit = fit_imu_noise(samples)
    assert isinstance(fit, ImuNoiseFit)
    return fit


def test_allan_deviation_of_published_data() -> None:
    """W. J. Riley, The Calculation of Time Domain Frequency Stability (the test suite of NIST SP 1065):
    NBS14's nine frequencies and 1000 of a congruential generator, with their overlapping Allan deviations.
    """
    nine = np.array([892.0, 809, 823, 798, 671, 644, 883, 903, 677])
    assert np.sqrt(overlapping_allan_variance(nine, np.array([1, 2]))) == pytest.approx(
        [91.22945, 85.95287], abs=5e-6
    )
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    thousand = np.array(numbers) / 2147483647
    assert np.sqrt(overlapping_allan_variance(thousand, np.array([1, 10, 100]))) == pytest.approx(
        [2.922319e-1, 9.159953e-2, 3.241343e-2], rel=2e-7
    )


def test_allan_variance_is_half_the_mean_square_of_neighbouring_averages_differences() -> None:
    values = np.random.default_rng(6).normal(3.0, 2.0, 60)
    for m in (1, 4, 12, 30):
        averages = [sum(values[i : i + m]) / m for i in range(len(values) - m + 1)]
        squares = [(averages[i + m] - averages[i]) ** 2 for i in range(len(averages) - m)]
        slow = sum(squares) / len(squares) / 2
        assert overlapping_allan_variance(values, np.array([m]))[0] == pytest.approx(slow, rel=1e-10)


def test_known_noise_is_found_within_five_percent() -> None:
    rng = np.random.default_rng(0)
    count = 400_000
    walk = 2e-3
    white = 1e-3 * np.sqrt(RATE_HZ) * rng.normal(size=(count, 3))
    gyro = white + np.cumsum(walk / np.sqrt(RATE_HZ) * rng.normal(size=(count, 3)), axis=0)
    gyro -= gyro.mean(axis=0)
    accel = 2e-2 * np.sqrt(RATE_HZ) * rng.normal(size=(count, 3)) + np.array([0, 0, 9.81])
    stamps = (np.arange(count) * 1e9 / RATE_HZ).astype(np.int64)
    clipped = fit_imu_noise(ImuSamples(stamps, gyro, accel))
    assert isinstance(clipped, Failed)
    assert clipped.code == "moving"
    fit = fitted(ImuSamples(stamps, gyro * 1e-2, accel))
    for axis in fit.axes[:3]:
        assert axis.density == pytest.approx(1e-5, rel=0.05)
        assert axis.walk == pytest.approx(walk * 1e-2, rel=0.05)
    for axis in fit.axes[3:]:
        assert axis.density == pytest.approx(2e-2, rel=0.05)
        assert axis.walk <= 3 * axis.walk_sigma


def test_gaps_and_jitter_change_little() -> None:
    whole = still(1, 60_000)
    keep = np.ones(60_000, np.bool_)
    keep[20_000:20_900] = keep[41_000:41_002] = False
    torn = ImuSamples(whole.stamp_ns[keep], whole.gyro_radps[keep], whole.accel_mps2[keep])
    fit = fitted(torn)
    assert fit.gaps == 2
    assert fit.rate_hz == pytest.approx(RATE_HZ, rel=1e-4)
    assert [a.density for a in fit.axes[:3]] == pytest.approx([DENSITY[0]] * 3, rel=0.03)


def test_densities_lie_within_their_sigmas() -> None:
    ratios = []
    for seed in range(8):
        fit = fitted(still(seed, 30_000))
        for k, axis in enumerate(fit.axes):
            ratios.append((axis.density - DENSITY[k // 3]) / axis.density_sigma)
    assert 0.5 <= np.mean(np.square(ratios)) <= 2.0


def test_an_imu_that_moves_or_a_short_log_is_refused() -> None:
    samples = still(2, 5000)
    moved = samples.gyro_radps.copy()
    moved[2000:3000] += 0.5
    result = fit_imu_noise(ImuSamples(samples.stamp_ns, moved, samples.accel_mps2))
    assert isinstance(result, Failed)
    assert result.code == "moving"
    short = fit_imu_noise(ImuSamples(*(a[:500] for a in (samples.stamp_ns, moved, samples.accel_mps2))))
    assert isinstance(short, Failed)
    assert short.code == "too-short"


def test_units_order_and_stamps_are_recognised(tmp_path: Path) -> None:
    samples = still(3, 3000)
    plain, other = tmp_path / "plain.csv", tmp_path / "other.txt"
    seconds = samples.stamp_ns[:, None] / 1e9 + 5
    stamps = samples.stamp_ns + 1_700_000_000_000_000_000
    rows = zip(stamps, samples.gyro_radps, samples.accel_mps2, strict=True)
    plain.write_text(
        "#t,gyro,accel\n" + "".join(f"{t},{','.join(map(repr, map(float, [*g, *a])))}\n" for t, g, a in rows)
    )
    swapped = np.column_stack([seconds, samples.accel_mps2 / 9.80665, np.degrees(samples.gyro_radps)])
    np.savetxt(other, swapped, header="time ax ay az [g] wx wy wz [deg/s]", fmt="%.12g")
    first, second = read_imu_log(plain), read_imu_log(other)
    assert np.array_equal(first.samples.stamp_ns, stamps)
    assert np.allclose(first.samples.gyro_radps, second.samples.gyro_radps, atol=1e-9)
    assert np.allclose(first.samples.accel_mps2, second.samples.accel_mps2, atol=1e-8)
    assert "read as deg/s and g" in second.notes


@pytest.mark.parametrize(
    ("rates", "others", "unit"),
    [
        ("gyro_{} [rad/s]", ["temp [degC]"], "rad/s"), ("gyro_{} [rad/s]", ["roll [deg]"], "rad/s"),
        ("gyro_{}", ["temp (deg C)"], "rad/s"), ("gyro_{}", ["temperature °C"], "rad/s"),
        ("w_{} (deg/s)", ["temp [degC]"], "deg/s"), ("gyr_{} [dps]", ["roll [rad]"], "deg/s"),
    ],
)  # fmt: skip
def test_a_temperature_in_degrees_says_nothing_of_the_gyro(
    tmp_path: Path, rates: str, others: list[str], unit: str
) -> None:
    names = ["time [s]", *(rates.format(a) for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz"), *others]
    rows = np.ones((9, 8)) * [0, 0.1, 0.1, 0.1, 0, 0, 9.81, 1]
    rows[:, 0] = np.arange(9) * 0.01
    log = tmp_path / "imu.csv"
    np.savetxt(log, rows, delimiter=",", header=",".join(names), comments="", encoding="utf-8")
    seen = read_imu_log(log).samples.gyro_radps
    assert np.allclose(seen, 0.1 if unit == "rad/s" else np.radians(0.1))


def test_hfi_log_agrees_with_the_outside_fit(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "imu.yaml"
    assert run(["calibrate", "imu-noise", str(data / "imu_static_hfi" / "imu.txt"), "-o", str(out)]) == 0
    noise = read_imu_file(out).noise
    assert noise.gyro_density == pytest.approx(0.0005624170823782376, rel=0.2)
    assert noise.accel_density == pytest.approx(0.0013751161376373432 * 9.80665, rel=0.2)
    assert noise.rate_hz == pytest.approx(10, rel=0.02)
    assert "Allan deviation" in out.with_suffix(".html").read_text()


def test_mistakes_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    for text, expected in (("1,2,3\n", "line 1: not 7 numbers"), ("", "holds no samples")):
        log.write_text(text)
        assert run(["calibrate", "imu-noise", str(log), "-o", str(tmp_path / "imu.yaml")]) == 3
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == [log]
