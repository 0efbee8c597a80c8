"""Rows averaged in pairs where a picture is alike along its columns."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.stereo.direct.kernels.pyramid import halve, upsample_update
from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo
from barsight.stereo.direct.row_binning import are_rows_alike, bin_disparity, bin_rows, spread_rows

HEIGHT, WIDTH = 320, 400
RANGE = DisparityRange(24, 56)
FOR_MAP = BarsightSettings(fill_occlusions=False, other_side_error_ratio=0.0)
WHOLE, BINNED = BarsightStereo(FOR_MAP), BarsightStereo(FOR_MAP, binned_row_m=0.03)
"""A pixel is 0.5 m / 40 px = 12.5 mm on the surface."""


@lru_cache
def bars_pair(along: str) -> tuple[RectifiedPair, np.ndarray]:
    """Round bars of 24 px along the columns or the rows, painted, with noise, and their true disparity."""
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)

    def half_round(x: np.ndarray) -> np.ndarray:
        return np.sqrt(1 - (((x if along == "columns" else rows) % 24 - 12) / 13) ** 2)

    size = (4 * HEIGHT, 4 * (WIDTH + 80))
    stretch = (1.0, 8.0) if along == "columns" else (8.0, 1.0)
    paint = cv2.GaussianBlur(
        rng.standard_normal(size).astype(np.float32), (0, 0), 4 * stretch[0], None, 4 * stretch[1]
    )
    fine = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), 4.0)
    paint = 110 + 22 * paint / paint.std() + 8 * fine / fine.std()

    def read(x: np.ndarray) -> np.ndarray:
        shade = 0.6 + 0.4 * half_round(x)
        painted = cv2.remap(paint, (4 * x).astype(np.float32), (4 * rows).astype(np.float32), cv2.INTER_CUBIC)
        return painted * shade + 2 * rng.standard_normal(x.shape)

    seen = columns + 38.0
    for _ in range(40):
        seen = columns + 38 + 3 * half_round(seen)
    left, right = (np.rint(read(x)).clip(0, 255).astype(np.uint8) for x in (columns, seen))
    valid = np.ones(left.shape, dtype=np.bool_)
    camera = RectifiedCamera(900.0, WIDTH / 2, HEIGHT / 2, 0.5, 0.0, WIDTH, HEIGHT)
    return RectifiedPair(0, left, right, valid, valid, camera), 38 + 3 * half_round(columns)


def errors_of(found: Disparity, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inner = np.zeros(truth.shape, bool)
    inner[8:-8, 70:-8] = True
    known = inner & np.isfinite(found.disparity_px)
    return np.abs(found.disparity_px - truth)[known], found.sigma_px[known]


@pytest.mark.parametrize("predicted", [False, True])
def test_half_the_rows_tell_nearly_as_much(predicted: bool) -> None:
    pair, truth = bars_pair("columns")
    found = []
    for method in (WHOLE, BINNED):
        if predicted:
            off = truth + 0.2 * np.sin(np.arange(WIDTH) / 30)[None]
            found.append(method.confirm(pair, RANGE, off.astype(np.float32)))
        else:
            found.append(method(pair, RANGE))
    (whole, _), (binned, sigma) = (errors_of(one, truth) for one in found)
    assert not np.array_equal(found[0].disparity_px, found[1].disparity_px, equal_nan=True)
    assert binned.size > 0.98 * whole.size
    assert np.median(binned) < 1.1 * np.median(whole)
    assert np.quantile(binned, 0.95) < 1.1 * np.quantile(whole, 0.95)
    assert np.mean(binned < 1.96 * sigma) > 0.9


def test_pictures_that_rows_tell_apart_stay_whole() -> None:
    """Bars along the rows, and pixels that two of are wider than allowed."""
    across, _ = bars_pair("rows")
    assert not are_rows_alike(across, RANGE, 1.0)
    whole, same = WHOLE(across, RANGE), BINNED(across, RANGE)
    np.testing.assert_array_equal(whole.disparity_px, same.disparity_px)
    along, _ = bars_pair("columns")
    assert are_rows_alike(along, RANGE, 0.026) and not are_rows_alike(along, RANGE, 0.024)
    assert not are_rows_alike(along, DisparityRange(-60, -20), 1.0)


@pytest.mark.parametrize("height", [6, 7])
def test_rows_are_averaged_and_spread_as_written(height: int) -> None:
    rng = np.random.default_rng(height)
    fine = (20 + rng.normal(0, 0.4, (height, 9))).astype(np.float32)
    fine[2, 3:6] = np.nan
    even = np.concatenate([fine, fine[-1:]]) if height % 2 else fine
    binned = bin_disparity(fine)
    coarse = np.empty((len(even) // 2, 9), np.float32)
    for (row, x), _ in np.ndenumerate(coarse):
        upper, lower = even[2 * row, x], even[2 * row + 1, x]
        alike = abs(upper - lower) < 0.5
        coarse[row, x] = (upper + lower) / 2 if alike else lower if np.isnan(upper) else upper
    np.testing.assert_allclose(binned, coarse)
    spread = spread_rows(Disparity(binned, 0.1 * binned), height)
    for (y, x), value in np.ndenumerate(spread.disparity_px):
        own, beside = (
            binned[y // 2, x],
            binned[min(max(y // 2 + (1 if y % 2 else -1), 0), len(binned) - 1), x],
        )
        wanted = 0.75 * own + 0.25 * beside if abs(own - beside) < 0.5 else own
        np.testing.assert_allclose(value, wanted, rtol=1e-6)
        np.testing.assert_allclose(spread.sigma_px[y, x], 0.1 * wanted, rtol=1e-5)


def test_an_odd_row_stays_beside_itself() -> None:
    pair, _ = bars_pair("columns")
    cut = replace(
        pair, left=pair.left[:-1], right=pair.right[:-1], left_valid=pair.left_valid[:-1].copy(),
        right_valid=pair.right_valid[:-1], camera=replace(pair.camera, height=HEIGHT - 1),
    )  # fmt: skip
    cut.left_valid[5, 7] = False
    binned = bin_rows(cut)
    assert binned.left.shape == (HEIGHT // 2, WIDTH) == binned.left_valid.shape
    np.testing.assert_array_equal(binned.left[-1], cut.left[-1])
    assert np.abs(binned.left[3] - cut.left[6:8].mean(axis=0)).max() <= 0.5
    assert not binned.left_valid[2, 7] and binned.left_valid.sum() == binned.left.size - 1
    assert BINNED(cut, RANGE).disparity_px.shape == cut.left.shape


def test_half_the_columns_are_carried_up() -> None:
    start = np.where(np.arange(63) < 30, 20.0, 40.0).astype(np.float32) * np.ones((12, 1), np.float32)
    small = halve(start, rows=False)
    assert small.shape == (12, 32)
    moved = (0.01 * np.arange(12, dtype=np.float32))[:, None] * np.ones((1, 32), np.float32)
    carried = upsample_update(0.5 * small, moved, start, 1.0)
    np.testing.assert_allclose(carried - start, 2 * moved[:, :1] * np.ones((1, 63)), atol=1e-5)
