"""Scores against a fabricated truth: zero for an exact map, the right figures for known errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.stamps import NS_PER_S
from barsight.evaluation.score import score_folder
from barsight.evaluation.trajectory_error import frame_errors, trajectory_drift
from barsight.mapping.settings import MapSettings
from barsight.recording.formats.ground_truth import GroundTruth
from barsight.report.files.height_rasters import write_height
from barsight.report.files.tables import write_contours
from mapping_views import block, fused, view

X = np.round(1 + 0.01 * np.arange(120), 4)
Y = np.round(-0.4 + 0.02 * np.arange(40), 4)


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A floor, a stack with a round top, a step along x at 1.6 m and one along y at 0 m."""
    stack = 0.8 + 0.1 * np.sin(9 * x) + 0.02 * y
    return np.where(x < 1.6, stack, np.where(y < 0, 0.02, 0.5 + 0.05 * y))


TRUTH = heights(X[:, None], Y[None, :])


def smooth(z: np.ndarray, axis: int) -> np.ndarray:
    """No step over 30 mm to a neighbour at most two samples away: point by point, along one axis."""
    z = np.moveaxis(z, axis, -1)
    result = np.ones(z.shape, dtype=np.bool_)
    for i in range(z.shape[-1]):
        for j in range(max(i - 2, 0), min(i + 3, z.shape[-1])):
            result[..., i] &= np.abs(z[..., i] - z[..., j]) <= 0.03
    return np.moveaxis(result, -1, axis)


SMOOTH = smooth(TRUTH, 0) & smooth(TRUTH, 1)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Cells of the last 20 columns and the profile's first 10 places are seen by one frame only."""
    visible = np.where(np.arange(120)[:, None] < 100, 3, 1) * np.ones(40, dtype=int)
    (tmp_path / "truth").mkdir()
    np.savez(
        tmp_path / "truth" / "height.npz",
        x=X,
        y=Y,
        z=TRUTH.astype(np.float32),
        visible=visible,
        profile_x=X,
        profile_ys=np.array([0.1]),
        profile_y0=heights(X, np.array(0.1)),
        profile_visible0=np.where(np.arange(120) < 10, 1, 2),
    )
    return tmp_path


def written(out: Path, error_mm: float = 0.0, sigma_m: float = 0.005, hole: slice | None = None) -> Path:
    """A measured folder off by error_mm everywhere; hole: profile samples and columns left unknown."""
    out.mkdir(parents=True)
    x, y = block(140, 90, 90, -45)
    z = heights(x * 0.01, y * 0.01) + error_mm / 1e3
    kept = np.ones(x.shape, dtype=np.bool_)
    profile = heights(X, np.array(0.1)) + error_mm / 1e3
    if hole is not None:
        kept &= ~np.isin(x, np.round(X[hole] * 100).astype(int))
        profile[hole] = np.nan
    surface = fused([view(x[kept], y[kept], z[kept], sigma_m)], out / "s", MapSettings(min_views=1, fill_m=0))
    write_height(surface, out / "height.tif", "yard:f00d")
    source = np.where(np.isfinite(profile), HeightSource.VISION, HeightSource.UNKNOWN).astype(np.uint8)
    contour = Contour(0, X, X * 0 + 0.1, profile, profile * 0 + sigma_m, source)
    write_contours((contour,), out / "contour.csv")
    return out


def test_a_contour_at_another_y_is_not_held_against_a_profile_of_its_number(
    recording: Path, tmp_path: Path
) -> None:
    out = written(tmp_path / "out")
    z = heights(X, np.array(-0.2))
    vision = np.full(X.size, HeightSource.VISION, np.uint8)
    other = Contour(0, X, X * 0 - 0.2, z, z * 0 + 0.005, vision)
    write_contours((other,), out / "contour.csv")
    assert "contour, everywhere" not in score_folder(recording, out)
    profile = heights(X, np.array(0.1))
    write_contours((other, replace(other, profile=1, y_m=X * 0 + 0.1, z_m=profile)), out / "contour.csv")
    assert score_folder(recording, out)["contour, everywhere"]["max_mm"] < 0.1


def test_an_exact_map_has_no_error(recording: Path, tmp_path: Path) -> None:
    figures = score_folder(recording, written(tmp_path / "out"))
    assert set(figures) == {
        "contour, smooth places",
        "contour, everywhere",
        "height, smooth stack",
        "height, seen by two",
    }
    for name, group in figures.items():
        # contour.csv has hundredths of a millimetre.
        assert group["max_mm"] <= 0.006, name
        assert group["within_95_pct"] == 100, name
        assert group.get("coverage_pct", 100) == 100, name
    assert figures["height, smooth stack"]["samples"] == (SMOOTH & (TRUTH > 0.2)).sum()
    assert figures["height, seen by two"]["samples"] == 100 * 40
    profile = heights(X, np.array(0.1))
    assert figures["contour, smooth places"]["samples"] == smooth(profile, 0).sum()
    assert figures["contour, everywhere"]["samples"] == 120


@pytest.mark.parametrize(("error_mm", "within"), [(4.0, 100.0), (-12.0, 0.0)])
def test_a_shifted_map(recording: Path, tmp_path: Path, error_mm: float, within: float) -> None:
    """The stated sigma of 5 mm covers 9.8 mm."""
    for group in score_folder(recording, written(tmp_path / "out", error_mm)).values():
        assert group["bias_mm"] == pytest.approx(error_mm, abs=0.01)
        for name in ("median_mm", "mae_mm", "p95_mm", "max_mm"):
            assert group[name] == pytest.approx(abs(error_mm), abs=0.01)
        assert group["within_95_pct"] == within


def test_coverage_counts_what_two_frames_see(recording: Path, tmp_path: Path) -> None:
    """The hole's 40 samples: all are counted in the height map; the profile's first 10 are not."""
    figures = score_folder(recording, written(tmp_path / "out", hole=slice(0, 40)))
    assert figures["height, seen by two"]["coverage_pct"] == pytest.approx(60, abs=1e-3)
    profile = smooth(heights(X, np.array(0.1)), 0) & (np.arange(120) >= 10)
    expected = 100 * profile[40:].sum() / profile.sum()
    assert figures["contour, smooth places"]["coverage_pct"] == pytest.approx(expected, abs=1e-3)
    stack = SMOOTH & (TRUTH > 0.2)
    expected = 100 * stack[40:100].sum() / stack[:100].sum()
    assert figures["height, smooth stack"]["coverage_pct"] == pytest.approx(expected, abs=1e-3)
    assert figures["contour, everywhere"]["samples"] == 80


def test_missing_files_are_named(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"contour.csv: no such file"):
        score_folder(recording, tmp_path / "nowhere")
    out = written(tmp_path / "out")
    with pytest.raises(InputError, match=r"height.npz: no such file; give a simulated recording"):
        score_folder(out, out)


def around_a_circle(stamp_ns: int, reference: str) -> Pose:
    angle = 0.5 * stamp_ns / NS_PER_S
    return Pose(reference, "body", np.eye(3), 3 * np.array([np.cos(angle), np.sin(angle), 0]))


def test_frames_in_a_gap_of_the_truth_are_not_compared() -> None:
    """A motion capture that sees nothing for four seconds made an exact odometry half a metre wrong."""
    tracked = [k * NS_PER_S // 100 for k in range(1001) if not 300 < k < 700]
    truth = GroundTruth(np.array(tracked), tuple(around_a_circle(stamp, "world") for stamp in tracked))
    stamps = [k * NS_PER_S // 10 + 1000 for k in range(100)]
    frames = tuple(PosedFrame(s, around_a_circle(s, "world"), 1e-6 * np.eye(6)) for s in stamps)
    trajectory = Trajectory("world", frames, (), ("stereo",))
    drift, errors = trajectory_drift(trajectory, truth, 0), frame_errors(trajectory, truth, 0)
    assert drift is not None and errors is not None
    assert drift.frames == errors.stamp_ns.size == 60
    assert drift.aligned_rmse_mm < 0.1
    sparse = replace(truth, stamp_ns=truth.stamp_ns[::100], poses=truth.poses[::100])
    every = trajectory_drift(trajectory, sparse, 0)
    assert every is not None and every.frames == 50
