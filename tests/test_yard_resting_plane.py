"""Heights under the poles, and the plane that rests on them, against plain NumPy and exact cases."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.footprint import Placement, overlap
from barsight.yard.magnet.resting_plane import (
    ALL,
    COLUMNS,
    CORRELATED_CELLS,
    POLE,
    SCATTER,
    SEEN,
    SEGMENT_M,
    SIGMA,
    STEP_M,
    STRAIGHT_M,
    U,
    V,
    Z,
    _likely,
    _straight,
    profiles,
    rest_faces,
    straighten_heights,
)
from barsight.yard.map_lookup import interpolate_height
from barsight.yard.types import HeightMap

POLES = np.array([[-0.3, 0.02, 0.9, 0.1], [0.7, -0.02, 0.5, 0.12]])


def some_map() -> HeightMap:
    rng = np.random.default_rng(2)
    z = rng.normal(0.5, 0.01, (150, 60)).astype(np.float32)
    source = rng.choice([0, 1, 1, 1, 1, 1, 2, 3], z.shape).astype(np.uint8)
    source[120:] = HeightSource.UNKNOWN
    z[source == HeightSource.UNKNOWN] = np.nan
    sigma = rng.uniform(0.003, 0.006, z.shape).astype(np.float32)
    return HeightMap(-0.3, -0.75, 0.01, z, sigma, np.ones_like(z), source)


def was_seen(heights: HeightMap) -> np.ndarray:
    return (heights.source != HeightSource.UNKNOWN) & (heights.source != HeightSource.FILLED)


def test_profiles_are_medians_of_what_was_seen() -> None:
    heights, place = some_map(), Placement(0.03, -0.05, 0.07)
    seen = was_seen(heights)

    def read(field: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        where = np.array([(y - heights.y0_m) / 0.01, (x - heights.x0_m) / 0.01])
        return map_coordinates(np.where(seen, field, 0.0), where, order=1, mode="grid-constant", cval=0.0)

    shape, points = profiles(heights, place, POLES)
    assert shape == [(10, 2), (12, 1)] and points.shape == (32, COLUMNS)
    c, s = math.cos(place.yaw_rad), math.sin(place.yaw_rad)
    first = 0
    for number, ((columns, parts), (along, across, length, width)) in enumerate(
        zip(shape, POLES, strict=True)
    ):
        assert parts == max(round(length / SEGMENT_M), 1)
        samples = int(length / parts / STEP_M)
        for i, k in np.ndindex(columns, parts):
            own = points[first + i * parts + k]
            u = across + width * ((i + 0.5) / columns - 0.5)
            v = along + length * ((k + (np.arange(samples) + 0.5) / samples) / parts - 0.5)
            x, y = place.x_m + c * u - s * v, place.y_m + s * u + c * v
            weight = read(np.ones(seen.shape), x, y)
            known = weight >= 0.5
            z = read(heights.z_m, x, y)[known] / weight[known]
            cells = np.array([(x - heights.x0_m) / 0.01, (y - heights.y0_m) / 0.01])[:, known]
            for column, row, height in zip(*cells, z, strict=True):
                alone = interpolate_height(heights.z_m, heights.source, column, row)
                assert alone == pytest.approx(height, abs=1e-6)
            assert (own[POLE], own[ALL]) == (number, samples)
            assert own[[U, V, SEEN]] == pytest.approx((u, v.mean(), weight.sum()))
            if 2 * known.sum() < samples:
                assert np.isnan(own[[Z, SCATTER]]).all()
                continue
            sigma = read(heights.sigma_m, x, y)[known] / weight[known]
            spread = 1.4826 * np.median(np.abs(z - np.median(z)))
            assert own[[Z, SCATTER, SIGMA]] == pytest.approx((np.median(z), spread, sigma.mean()), abs=1e-6)
        first += columns * parts
    assert 0 < np.isnan(points[:, Z]).sum() < 16


def test_a_departure_counts_by_how_far_it_is_from_straight() -> None:
    sigma = 0.003
    shrunk = STRAIGHT_M**2 / (STRAIGHT_M**2 + sigma**2)
    limit = 3 * math.hypot(STRAIGHT_M, sigma)
    assert _likely(0.5 * limit, sigma) == pytest.approx(0.5 * limit * shrunk)
    assert _likely(-1.5 * limit, sigma) == pytest.approx(-1.5 * limit)
    assert _likely(0.9 * limit, sigma) == pytest.approx(0.9 * limit * (0.5 + 0.5 * shrunk))


def test_a_straight_load_stays_and_what_departs_is_drawn_to_it() -> None:
    """A section of five columns that slopes and sags along; then poles and a point of it are raised."""
    rng = np.random.default_rng(4)
    pole, column, part = (a.ravel() for a in np.mgrid[:5, :5, :9])
    known = np.zeros((pole.size, COLUMNS))
    known[:, V] = v = 1.5 * (pole - 2) + 0.1 * (part - 4)
    section = rng.normal(0.4, 0.02, 5)
    known[:, SIGMA], known[:, POLE] = 0.003, pole
    for sag in (0.0, -0.001, 0.001):
        known[:, Z] = straight = section[column] + 0.01 * v + sag * v**2
        np.testing.assert_allclose(_straight(known, column, 0.001), straight, atol=2e-5)
    # Neither a slope nor a sag shares in these.
    raised, point = 0.002 * np.array([-1, 2, 0, -2, 1])[pole], 5 * 45 // 2
    known[:, Z] += raised
    known[point, Z] += 0.002
    wanted = straight + np.array([_likely(rise, 0.003) for rise in raised])
    wanted[point] += _likely(0.002, 0.001)
    np.testing.assert_allclose(_straight(known, column, 0.001), wanted, atol=1e-4)


def test_a_load_that_runs_askew_and_bends_under_the_beam_is_straight_all_the_same() -> None:
    """A round back of 0.1 m radius whose axis runs 12 mm aside and bends by 8 mm, with 2 mm of noise."""
    rng = np.random.default_rng(6)
    u, v = (a.ravel() for a in np.meshgrid(0.01 * np.arange(-4.5, 5), np.linspace(-2.4, 2.4, 12)))
    aside = 0.005 * v + 0.0014 * v**2 - 0.004
    back = np.sqrt(0.1**2 - (u - aside) ** 2) + 0.003 * v
    known = np.zeros((u.size, COLUMNS))
    known[:, U], known[:, V], known[:, SIGMA] = u, v, 0.01
    known[:, POLE] = np.repeat(np.arange(4), 30)
    known[:, Z] = back + rng.normal(0, 0.002, u.size)
    column = np.tile(np.arange(10), 12)
    off = _straight(known, column, 0.002) - back
    assert np.abs(off).max() < 0.005 and off.std() < 0.0018


def test_faces_rest_off_the_middle_only_where_the_suspension_holds_them() -> None:
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-0.05, 0.05, 11), np.linspace(-1, 1, 5)))
    noise = 0.001
    height, roll, pitch, off = rest_faces(u, v, 0.3 + 0.02 * u + 0.003 * v, noise, 0.1)
    assert (height, roll, pitch, off) == pytest.approx((0.3 - noise, 0.02, 0.003, 0.0), abs=1e-5)
    _, roll, _, off = rest_faces(u, v, 0.3 + 0.5 * u, noise, 0.1)
    assert roll == 0.1 and off == pytest.approx(0.05, abs=0.005)


def test_poles_and_bundles_overlap_where_their_rectangles_meet() -> None:
    rng, met = np.random.default_rng(5), []
    nothing, pole = np.zeros(5), np.array([0.0, 0.0, 0.9, 0.1])
    for _ in range(300):
        dx, dy = rng.uniform(-1, 1, 2)
        yaw, turn = rng.uniform(-1.5, 1.5, 2)
        half = rng.uniform((0.02, 0.2), (0.3, 0.8))
        along = np.array([-math.sin(turn), math.cos(turn)])
        depth, sigma, slack = overlap(
            dx, dy, math.cos(yaw), math.sin(yaw), pole, along, half, nothing, np.zeros(3), 0.0
        )
        one = ((dx, dy), (0.1, 0.9), math.degrees(yaw))
        other = ((0.0, 0.0), tuple(2 * half), math.degrees(turn))
        met.append(cv2.rotatedRectangleIntersection(one, other)[0] != cv2.INTERSECT_NONE)
        assert (depth > 0) == met[-1] or abs(depth) < 1e-6
        assert (sigma, slack) == (0.001, 0.0)
    assert 0.2 < np.mean(met) < 0.8
    # Pole along the bundle's side: across counts the place's sigma, the half width's, and the yaw's by 0.3 m.
    sides = overlap(
        0.1, 0.3, 1.0, 0.0, pole, np.array([0.0, 1.0]), np.array([0.1, 1.0]),
        np.array([0.003, 0.05, 0.01, 0.004, 0.05]), np.array([0.02, 0.5, 0.0]), 0.3,
    )  # fmt: skip
    assert sides == pytest.approx((0.05, math.sqrt(9e-6 + 9e-6 + 16e-6 + 1e-6), 0.02))


def test_a_noisy_straight_load_comes_nearer_to_straight() -> None:
    """Drawn errors of 2 mm on a straight section, known by cells that scatter 12 mm; some were not seen."""
    rng = np.random.default_rng(6)
    pole, column, part = (a.ravel() for a in np.mgrid[:3, :8, :9])
    points = np.zeros((pole.size, COLUMNS))
    points[:, U] = 0.01 * column + rng.uniform(-2e-7, 2e-7, pole.size)
    points[:, V] = 1.5 * (pole - 1) + 0.1 * (part - 4)
    truth = rng.normal(0.4, 0.02, 8)[column] + 0.01 * points[:, V]
    points[:, Z] = truth + rng.normal(0, 0.002, pole.size)
    points[:, SCATTER], points[:, SEEN] = 0.012, 36 * CORRELATED_CELLS
    points[:, SIGMA], points[:, POLE] = 0.003, pole
    unseen = rng.random(pole.size) < 0.2
    points[unseen, Z] = np.nan
    before = points.copy()
    noise = 1.25 * 0.012 / 6
    remains = straighten_heights(points)
    assert remains == pytest.approx(noise * STRAIGHT_M / math.hypot(STRAIGHT_M, noise))
    seen = before[~unseen]
    np.testing.assert_array_equal(np.isnan(points[:, Z]), unseen)
    np.testing.assert_allclose(points[~unseen, Z], _straight(seen, column[~unseen], noise), atol=1e-12)
    was, left = seen[:, Z] - truth[~unseen], points[~unseen, Z] - truth[~unseen]
    assert left.std() < 0.7 * was.std()
