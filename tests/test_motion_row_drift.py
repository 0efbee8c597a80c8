"""Pitch, roll, focal ratio and yaw from rows: right on matches of a rig that has turned by known angles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedCamera
from barsight.motion.rig_check.drift_check import CheckSettings, DriftState, _row_lines
from barsight.motion.rig_check.epipolar_error import RowDrift, fit_rows

CAMERA = RectifiedCamera(1250.0, 640.0, 512.0, 0.5, 3.0, 1280, 1024)


def matches(drift: np.ndarray, rng: np.random.Generator, pattern_px: float = 0.0) -> np.ndarray:
    """Points seen by a left camera and a right one that has turned (pitch, yaw, roll) and zoomed."""
    pitch, roll, ratio, yaw = drift
    left = rng.uniform((120, 5), (1275, 1019), (6000, 2))
    depth = rng.uniform(6, 8, 6000)
    rays = np.column_stack([(left - (CAMERA.cx_px, CAMERA.cy_px)) / CAMERA.focal_px, np.ones(6000)])
    turned = Rotation.from_rotvec([pitch, yaw, roll]).inv()
    seen = turned.apply(rays * depth[:, None] - (CAMERA.baseline_m, 0, 0))
    right = CAMERA.focal_px * (1 + ratio) * seen[:, :2] / seen[:, 2:]
    right += (CAMERA.cx_px + CAMERA.doffs_px, CAMERA.cy_px)
    cell = (right // (160, 171)).astype(int).clip(0, 9)
    right[:, 1] += rng.normal(0, 0.1, 6000) + rng.normal(0, pattern_px, (10, 10))[cell[:, 0], cell[:, 1]]
    wild = rng.random(6000) < 0.03
    right[wild, 1] += rng.uniform(-3, 3, int(wild.sum()))
    return np.column_stack([right, right[:, 1] - left[:, 1]])


@pytest.mark.parametrize("pattern_px", [0.0, 0.05])
def test_errors_are_as_large_as_stated(pattern_px: float) -> None:
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = rng.normal(0, np.deg2rad([0.05, 0.05, 0.01, 0.02]))
        found = fit_rows(matches(truth, rng, pattern_px), CAMERA, 1)
        assert isinstance(found, RowDrift)
        squares.append(((found.values - truth) / found.sigmas)[1:] ** 2)
        assert abs(found.values[0] - truth[0]) < 2.5 * found.sigmas[0]
        assert found.sigmas[3] < np.deg2rad(0.012)
    assert 0.65 < np.mean(squares) < 1.3


def test_too_few_matches_are_said() -> None:
    good = matches(np.zeros(4), np.random.default_rng(0))
    few = fit_rows(good[:40], CAMERA, 1)
    corner = fit_rows(good[(good[:, :2] < 300).all(axis=1)], CAMERA, 1)
    assert isinstance(few, Failed)
    assert "corners match" in few.reason
    assert isinstance(corner, Failed)
    assert "parts of the picture" in corner.reason


@pytest.mark.parametrize("range_m", [7.5, np.nan])
def test_a_drift_that_matters_is_told_where_no_travel_tells_the_range(range_m: float) -> None:
    """A roll of 0.2 px on the rows turns the surface by 20 mm."""
    found = fit_rows(matches(np.array([0.0, 3e-4, 0.0, 0.0]), np.random.default_rng(3)), CAMERA, 1)
    assert isinstance(found, RowDrift)
    states = {
        line.name: line.state for line in _row_lines(found, found.sigmas, CAMERA, range_m, CheckSettings())
    }
    assert states["roll"] is DriftState.RECALIBRATE
