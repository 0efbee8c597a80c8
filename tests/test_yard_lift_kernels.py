"""The look-ups under a magnet against slow ones that take one array after the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import _sum_pull
from barsight.yard.map_lookup import interpolate_height
from barsight.yard.placement.checks import _stray_shares
from barsight.yard.placement.clearance import (
    BEAM_CLEAR_M,
    MAX_NARROW_RISE_M,
    MAX_RISE_M,
    MAX_THIN_RISE_M,
    FacePlane,
    find_obstacle,
)
from barsight.yard.types import HeightMap
from barsight.yard.unseen import wide_parts
from lift_yards import MAGNET, Laid, laid, map_of, record

FACES = FacePlane(0.2, 0.01, -0.02, 0.002)
EIGHT = np.ones((3, 3))


def rough_yard(seed: int) -> HeightMap:
    """Ground below the faces with bumps, narrow ridges, unseen places and bounds by lines of sight."""
    rng = np.random.default_rng(seed)
    heights = map_of([], x_m=(-3.0, 3.0))
    bumps = ndimage.gaussian_filter(rng.normal(size=heights.shape), 9)
    heights.z_m[:] = 0.13 + 0.9 * bumps + rng.normal(0, 0.002, heights.shape)
    heights.z_m[rng.random(heights.shape) < 2e-5] += 0.5
    heights.z_m[200 + 40 * (seed % 10), rng.integers(0, 600, 40)] += 0.2
    hidden = ndimage.gaussian_filter(rng.normal(size=heights.shape), 4) > (0.12, 0.4)[seed % 2]
    heights.source[hidden], heights.z_m[hidden] = HeightSource.UNKNOWN, np.nan
    free = 0.1 + 6 * ndimage.gaussian_filter(rng.normal(size=heights.shape), 9)
    free[rng.random(heights.shape) < 0.3] = np.inf
    return replace(heights, free_m=free.astype(np.float32))


def plain_obstacle(heights: HeightMap, place: Placement, load: Laid) -> tuple[str, float, np.ndarray] | None:
    """Code, mm and places."""
    margin = 120
    around = {"pad_width": margin, "mode": "constant"}
    z = np.pad(heights.z_m, constant_values=np.nan, **around)
    free = np.pad(heights.free_m, constant_values=np.inf, **around)
    first = np.array([heights.x0_m, heights.y0_m]) - margin * heights.cell_m
    xy = first + 0.01 * np.stack(np.meshgrid(*(np.arange(n) for n in z.shape[::-1])), axis=-1)
    v, u = (np.asarray((xy - (place.x_m, place.y_m)) @ axis) for axis in (place.along, place.across))
    level = FACES.centre_z_m + v * math.tan(FACES.pitch_rad) + u * math.tan(FACES.roll_rad) - FACES.sigma_m
    slack, turned = (MAGNET.tolerance.x_m, MAGNET.tolerance.y_m), math.radians(MAGNET.tolerance.yaw_deg)
    sizes = [(p.along_m, p.across_m, p.length_m, p.width_m) for p in MAGNET.poles]
    sizes.append((0.0, 0.0, MAGNET.beam.length_m, MAGNET.beam.width_m))
    long, wide = (max(abs(size[k]) + size[2 + k] / 2 for size in sizes) for k in (0, 1))
    more_v = 0.033 + abs(place.along) @ slack + turned * wide
    more_u = 0.033 + abs(place.across) @ slack + turned * long
    *faces, beam = (
        (abs(v - a) <= n / 2 + more_v) & (abs(u - b) <= w / 2 + more_u) for a, b, n, w in sizes
    )  # fmt: skip
    over_faces = np.any(faces, axis=0)
    under = over_faces | beam
    near = tuple(slice(at.min() - 20, at.max() + 21) for at in np.nonzero(under))
    cut = z, free, xy, level, over_faces, under
    z, free, xy, level, over_faces, under = (a[near] for a in cut)
    half = np.array([load.width_m, load.length_m]) / 2
    off_load = abs(xy - (load.x_m, 0.0)) - half
    over_load, at_load = ((off_load <= margin).all(axis=-1) for margin in (0.0, 0.03))
    rise, most = (z - level).astype(np.float32), (free - level).astype(np.float32)
    above_m = MAGNET.beam.above_faces_m - BEAM_CLEAR_M
    allowed = np.where(over_faces, MAX_RISE_M, above_m)
    blocked = np.where(np.isnan(rise), ~(free - level <= allowed), z - level > allowed)
    seen = np.where(np.isnan(rise), -1, np.maximum(rise, -1))
    filled = np.where(np.isnan(rise), np.fmin(ndimage.maximum_filter(seen, 5), most), seen)
    spare = np.where(over_faces | over_load, 0.0, above_m - MAX_RISE_M)
    filled = filled - spare
    for side, limit, least in ((5, MAX_RISE_M, 4), (3, MAX_NARROW_RISE_M, 4), (1, MAX_THIN_RISE_M, 8)):
        smooth = ndimage.median_filter(filled, side)
        label, _ = ndimage.label(under & (smooth > limit), EIGHT)
        large = (np.bincount(label.ravel()) >= least)[label] & (label > 0)
        if large.any():
            highest = np.argmax(np.where(large, smooth, -np.inf))
            return "obstructed", 1e3 * (smooth + spare).ravel()[highest], xy[large]
    label, _ = ndimage.label(~blocked)
    unproven = blocked | (np.bincount(label.ravel()) < 4)[label]
    over, beside = (ndimage.binary_opening(unproven, np.ones((side, side))) for side in (6, 4))
    hidden = (over | beside & ~at_load) & under
    if hidden.any():
        patch, _ = ndimage.label(hidden, EIGHT)
        largest = patch == 1 + np.argmax(np.bincount(patch.ravel())[1:])
        bound_m = 0.06 if at_load[largest].any() else 0.04
        width_m = max(bound_m, 0.01 * math.sqrt(largest.sum()))
        return "unknown-under-footprint", 1e3 * width_m, xy[hidden]
    return None


def test_an_obstacle_is_the_one_that_array_after_array_finds() -> None:
    found = set()
    for seed in range(8):
        rng, heights = np.random.default_rng(seed), rough_yard(seed)
        place = Placement(*rng.uniform(-0.5, 1.5, 2), float(rng.uniform(-0.5, 0.5)))
        load = laid(place.x_m + 0.2)
        obstacle = find_obstacle(place, heights, MAGNET, FACES, (record(load),))
        plain = plain_obstacle(heights, place, load)
        found.add(obstacle.code if obstacle else "none")
        assert (obstacle is None) == (plain is None)
        if obstacle is not None and plain is not None:
            assert obstacle.code == plain[0]
            assert obstacle.value_mm == pytest.approx(plain[1], abs=1e-3)
            np.testing.assert_allclose(obstacle.places_m, plain[2], atol=1e-9)
    assert found == {"none", "obstructed", "unknown-under-footprint"}


@pytest.mark.parametrize("cells", [2, 4, 5, 8])
def test_a_wide_part_stays_where_it_is(cells: int) -> None:
    unseen = np.random.default_rng(cells).random((60, 40)) < 1 - 0.5 / cells**2
    opened = ndimage.binary_opening(unseen, np.ones((cells, cells)))
    inner = np.s_[cells:-cells, cells:-cells]
    assert opened[inner].any() and not opened[inner].all()
    np.testing.assert_array_equal(wide_parts(unseen, cells)[inner], opened[inner])


def test_heights_between_cells_are_weighed_where_half_is_seen() -> None:
    heights, rng = rough_yard(3), np.random.default_rng(0)
    x, y = rng.uniform(-3.1, 3.1, 200), rng.uniform(-4.1, 4.1, 200)
    plain = np.full(200, np.nan)
    for k in range(200):
        down, across = (
            np.maximum(1 - abs(axis - place[k]) / 0.01, 0)
            for axis, place in ((heights.y_m, y), (heights.x_m, x))
        )
        near = np.ix_(down > 0, across > 0)
        weight = np.outer(down[down > 0], across[across > 0]) * (heights.source[near] == HeightSource.VISION)
        if weight.sum() >= 0.5:
            plain[k] = (weight * np.nan_to_num(heights.z_m[near])).sum() / weight.sum()
    assert 10 < np.isnan(plain).sum() < 100
    cells = (x - heights.x0_m) / heights.cell_m, (y - heights.y0_m) / heights.cell_m
    found = [interpolate_height(heights.z_m, heights.source, *at) for at in zip(*cells, strict=True)]
    np.testing.assert_allclose(found, plain, atol=1e-6)


def test_what_lies_outside_all_outlines_is_the_share_that_arrays_give() -> None:
    heights, rng = rough_yard(1), np.random.default_rng(4)
    place = Placement(0.2, -0.3, 0.3)
    grid = np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(-0.5, 0.5, 300), rng.integers(0, 2, 300)])
    turn = rng.uniform(-3, 3, 4)
    outlines = np.column_stack(
        [rng.uniform(-1, 1, (4, 2)), -np.sin(turn), np.cos(turn), rng.uniform(0.1, 0.8, (4, 4))]
    )
    reach_z = np.array([0.12, 0.14])
    frame = place.frame
    points = frame[0] + grid[:, :2] @ frame[1:]
    at = np.array([heights.x0_m, heights.y0_m, heights.cell_m])
    columns, rows = ((points - at[:2]) / at[2]).T
    z = np.array(
        [interpolate_height(heights.z_m, heights.source, c, r) for c, r in zip(columns, rows, strict=True)]
    )
    reached = np.nan_to_num(np.clip((z - reach_z[grid[:, 2].astype(int)]) / 0.01 + 0.5, 0, 1))
    away = points[:, None] - outlines[:, :2]
    along, across = outlines[:, 2:4], np.column_stack([outlines[:, 3], -outlines[:, 2]])
    to = np.stack([abs((away * across).sum(axis=2)), abs((away * along).sum(axis=2))], axis=2)
    plain = [
        (reached * np.clip((to - outlines[:, k : k + 2]).max(axis=2).min(axis=1) / 0.01 + 0.5, 0, 1)).mean()
        for k in (4, 6)
    ]  # fmt: skip
    assert min(plain) > 0.05 and max(plain) < 0.95 * reached.mean()
    found = _stray_shares(heights.z_m, heights.source, at, frame, grid, reach_z, outlines)
    np.testing.assert_allclose(found, plain, atol=1e-9)


def test_a_faces_pull_is_the_sum_over_its_cells() -> None:
    rng = np.random.default_rng(2)
    gaps = rng.uniform(0, 0.05, (10, 3))
    gaps[4] = np.nan
    gap_m = np.array([0.0, 0.002, 0.01, 0.04])
    likely, low = np.array([800.0, 700, 300, 0]), np.array([600.0, 500, 200, 0])
    held = np.interp(np.nan_to_num(gaps, nan=np.inf) + 0.003, gap_m, low, right=0.0)
    total = np.interp(np.nan_to_num(gaps, nan=np.inf) + 0.001, gap_m, likely, right=0.0).sum()
    across = ((np.arange(10) + 0.5) / 10 - 0.5) @ held.sum(axis=1)
    along = held.sum(axis=0) @ ((np.arange(3) + 0.5) / 3 - 0.5)
    found = _sum_pull(gaps, gap_m, likely, low, 0.001, 0.003)
    np.testing.assert_allclose(found, (total, held.sum(), across, along), rtol=1e-12)
