"""Agreement with a laser profile, against a calculation by hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm
from scipy.stats import t as student

from barsight.core.errors import Failed
from barsight.core.records.heights import Agreement, AgreementIntervals, Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement import compute_agreement, profile_difference, smooth_places
from barsight.mapping.agreement_intervals import agreement_intervals
from barsight.report.files.tables import write_laser_csv
from barsight.result_folder import read_laser

X = np.round(5 + 0.01 * np.arange(8), 4)


def contour(z: list[float], source: list[int] | None = None, shift: float = 0.0) -> Contour:
    heights = np.array(z)
    codes = (
        np.where(np.isfinite(heights), HeightSource.VISION, HeightSource.UNKNOWN)
        if source is None
        else source
    )
    x = X[: heights.size] + shift
    return Contour(2, x, x * 0 + 0.7, heights, heights * 0 + 0.01, np.array(codes, dtype=np.uint8))


def laser(z: list[float], shift: float = 0.0) -> LaserProfile:
    heights = np.array(z)
    x = X[: heights.size] + shift
    return LaserProfile(2, x, x * 0 + 0.7, heights, 0.001)


def test_the_figures_by_hand() -> None:
    """Differences of 1, -2, 3 and 6 mm; two of six laser points have no vision (unknown, filled)."""
    seen = contour(
        [1.001, 0.998, np.nan, 1.003, 1.5, 1.106],
        [
            HeightSource.VISION,
            HeightSource.VISION,
            HeightSource.UNKNOWN,
            HeightSource.VISION,
            HeightSource.FILLED,
            HeightSource.VISION,
        ],
    )
    figures = compute_agreement(seen, laser([1.0, 1.0, 1.0, 1.0, 1.0, 1.1]))
    assert isinstance(figures, Agreement)
    assert (figures.profile, figures.y_m, figures.samples) == (2, 0.7, 4)
    assert figures.coverage_pct == pytest.approx(100 * 4 / 6)
    assert figures.bias_mm == pytest.approx(2.0)
    assert figures.mae_mm == pytest.approx(3.0)
    assert figures.median_mm == pytest.approx(2.5)
    assert figures.rmse_mm == pytest.approx(np.sqrt((1 + 4 + 9 + 36) / 4))
    assert figures.max_mm == pytest.approx(6.0)
    assert figures.p95_mm == pytest.approx(3 + 3 * 0.85)
    spread = np.sqrt((1 + 16 + 1 + 16) / 3)
    assert figures.loa_low_mm == pytest.approx(2 - 1.96 * spread)
    assert figures.loa_high_mm == pytest.approx(2 + 1.96 * spread)
    # The step to 1.1 m stands at the last laser point: the two before it and it itself aren't smooth.
    assert figures.smooth_mae_mm == pytest.approx(1.5)


def test_vision_is_interpolated_to_the_lasers_places() -> None:
    seen = contour([1.0, 1.1, 1.2, np.nan, 1.4, 1.5])
    between = profile_difference(seen, laser([1.0] * 6, shift=0.0025))
    np.testing.assert_allclose(between, [0.025, 0.125, np.nan, np.nan, 0.425, np.nan], atol=1e-9)
    before = profile_difference(seen, laser([1.0] * 6, shift=-0.0025))
    np.testing.assert_allclose(before, [np.nan, 0.075, 0.175, np.nan, np.nan, 0.475], atol=1e-9)


@pytest.mark.parametrize("shift", [1e-7, -1e-7])
def test_samples_on_the_lasers_grid_need_no_neighbours(shift: float) -> None:
    """Beside a gap a sample still counts where both grids agree but for rounding."""
    seen = contour([1.0, np.nan, 1.2, np.nan, 1.4], shift=shift)
    np.testing.assert_allclose(
        profile_difference(seen, laser([1.0] * 5)), [0, np.nan, 0.2, np.nan, 0.4], atol=1e-4
    )


def test_without_overlap_it_fails() -> None:
    one = contour([1.0, np.nan, np.nan])
    for seen in (
        one,
        contour([]),
        contour([1.0, 1.0, 1.0], shift=7.0),
        contour([1.0] * 3, [HeightSource.FILLED] * 3),
    ):
        failed = compute_agreement(seen, laser([1.0, 1.0, 1.0]))
        assert isinstance(failed, Failed)
        assert failed.code == "no-overlap"
        assert "profile 2" in failed.reason
        assert "of 3 laser points" in failed.reason


def test_smooth_places() -> None:
    step = np.array([0, 0, 0, 0, 0.031, 0.031, 0.031, 0.031])
    np.testing.assert_array_equal(smooth_places(step), [True, True, *[False] * 4, True, True])
    slope = smooth_places(np.array([0, 0.02, 0.04, 0.04, 0.04]))
    np.testing.assert_array_equal(slope, [False, True, False, True, True])
    assert smooth_places(np.array([0, 0.029, 0, 0.029])).all()


@pytest.mark.parametrize(("x_shift_m", "z_shift_m"), [(0.0, 0.0), (0.0132, -0.004), (-0.0408, 0.011)])
def test_a_shifted_laser_is_found(x_shift_m: float, z_shift_m: float) -> None:
    """Bars with a step; a tenth of the contour is far off."""
    rng = np.random.default_rng(1)
    x = 0.01 * np.arange(600)
    z = lambda at: 0.7 + 0.02 * np.abs(np.sin(at * 35)) + 0.3 * (at > 3)  # noqa: E731
    seen = z(x) + rng.normal(0, 0.001, 600) + np.where(rng.uniform(size=600) < 0.1, 0.4, 0)
    measured = Contour(0, x, x * 0, seen, x * 0 + 0.01, np.full(600, HeightSource.VISION, np.uint8))
    scanned = LaserProfile(0, x, x * 0, z(x - x_shift_m) + z_shift_m, 0.001)
    figures = compute_agreement(measured, scanned, speed_mps=0.5)
    assert isinstance(figures, Agreement)
    assert figures.x_shift_mm == pytest.approx(1e3 * x_shift_m, abs=1.0)
    assert figures.z_shift_mm == pytest.approx(1e3 * z_shift_m, abs=0.5)
    assert figures.time_shift_s == pytest.approx(figures.x_shift_mm / 500)


def compared(
    rng: np.random.Generator, phi: float, bias_mm: float, slope_mm_per_m: float = 0.0
) -> AgreementIntervals:
    """Bars of 0.3 and 0.9 m, differences of 2 mm of which each repeats the one before by `phi`."""
    noise = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(0, 2e-3, 800))[200:]
    z = 0.3 + 0.6 * (np.arange(600) // 50 % 2)
    difference = noise + 1e-3 * (bias_mm + slope_mm_per_m * z)
    difference[100:130] = np.nan
    return agreement_intervals(difference, z, np.full(600, 2e-3), 1e-3, smooth_places(z))


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_the_bias_lies_in_its_interval_though_neighbours_repeat_each_other(phi: float) -> None:
    drawn = [compared(np.random.default_rng((7, k)), phi, 1.0) for k in range(200)]
    held = np.mean([a.smooth_bias_low_mm <= 1.0 <= a.smooth_bias_high_mm for a in drawn])
    assert 0.90 <= held <= 0.985
    independent = drawn[0].smooth_samples * (1 - phi) / (1 + phi)
    assert np.median([a.effective_samples for a in drawn]) == pytest.approx(independent, rel=0.15)


def test_few_independent_samples_are_not_told_to_be_more() -> None:
    """About their own mean they look less alike: six passed for ten, and 85 % of the intervals held."""
    phi, rng = np.exp(-2 * 6 / 200), np.random.default_rng(11)
    rows = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(0, 2e-3, (600, 500)))[:, 300:]
    ones = np.ones(200)
    found = [agreement_intervals(row, ones, 2e-3 * ones, np.nan, ones > 0) for row in rows]
    assert np.median([one.effective_samples for one in found]) < 9
    assert np.mean([one.smooth_bias_low_mm < 0 < one.smooth_bias_high_mm for one in found]) > 0.86


def test_a_bias_that_grows_with_height_is_found() -> None:
    drawn = [compared(np.random.default_rng((8, k)), 0.8, 0.0, 5.0) for k in range(100)]
    assert np.mean([a.slope_mm_per_m for a in drawn]) == pytest.approx(5, abs=0.3)
    assert np.mean([a.slope_low_mm_per_m <= 5 <= a.slope_high_mm_per_m for a in drawn]) >= 0.9
    assert np.mean([a.slope_low_mm_per_m > 0 for a in drawn]) > 0.9


def test_means_are_called_equivalent_wrongly_in_one_case_of_twenty() -> None:
    """The bias lies on the margin: a test of 5 % calls that equivalent in 5 % of all cases."""
    drawn = [compared(np.random.default_rng((9, k)), 0.8, 1.5).equivalence_mm for k in range(300)]
    assert 0.02 <= np.mean(np.array(drawn) <= 1.5) <= 0.09
    assert np.mean(np.array(drawn) <= 3.0) > 0.99


def test_the_lasers_sigma_is_taken_off_and_counted_in() -> None:
    """Differences of 2 mm, a laser of 1 mm, vision stated to 2 mm."""
    drawn = [compared(np.random.default_rng((10, k)), 0.0, 0.0) for k in range(20)]
    assert np.mean([a.vision_sd_mm for a in drawn]) == pytest.approx(np.sqrt(3), rel=0.03)
    inside = 100 * (2 * norm.cdf(1.96 * np.sqrt(5) / 2) - 1)
    assert np.mean([a.within_95_pct for a in drawn]) == pytest.approx(inside, abs=0.7)


def test_a_profile_carries_its_intervals() -> None:
    """Every second difference is 3 mm, the others 1 mm: they take turns, so each counts as one."""
    x = 0.01 * np.arange(40)
    seen = 0.5 + np.where(np.arange(40) % 2, 3e-3, 1e-3)
    vision = Contour(0, x, 0 * x, seen, 0 * x + 1e-3, np.full(40, HeightSource.VISION, np.uint8))
    figures = compute_agreement(vision, LaserProfile(0, x, 0 * x, 0 * x + 0.5, 0.5e-3))
    assert isinstance(figures, Agreement)
    assert (figures.smooth_samples, figures.effective_samples) == (40, 40)
    standard = np.sqrt(40 / 39 / 40)
    assert figures.smooth_bias_high_mm - 2 == pytest.approx(student.ppf(0.975, 39) * standard)
    assert figures.equivalence_mm == pytest.approx(2 + student.ppf(0.95, 39) * standard)
    assert figures.vision_sd_mm == pytest.approx(np.sqrt(40 / 39 - 0.25))
    assert figures.within_95_pct == 50


def test_too_few_samples_say_nothing_of_their_bias() -> None:
    figures = compute_agreement(contour([1.0] * 6), laser([1.0] * 6))
    assert isinstance(figures, Agreement) and figures.smooth_samples == 6
    assert np.isnan(figures.equivalence_mm) and np.isnan(figures.smooth_bias_low_mm)


@pytest.mark.parametrize("sigma_m", [0.001, float("nan")])
def test_laser_csv_keeps_the_sigma(tmp_path: Path, sigma_m: float) -> None:
    profile = LaserProfile(3, X, X * 0 + 0.7, X * 0 + 1.25, sigma_m)
    write_laser_csv((profile,), tmp_path / "laser.csv")
    (read,) = read_laser(tmp_path)
    assert read.profile == 3 and np.array_equal(read.z_m, profile.z_m)
    assert np.array_equal(read.range_std_m, sigma_m, equal_nan=True)
