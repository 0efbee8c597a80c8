"""Pairs started from the one before: prediction, alignment, what the pictures confirm, chains."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import barsight as bs
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.core.timing import Stopwatch
from barsight.mapping.view import MatchedFrame
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Refusal
from barsight.motion.frontend.direct_alignment import _add_equations, _compare, align_views
from barsight.reconstruction.tracked_recording import matching
from barsight.recording.base import Recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.stereo.direct.confirmation import confirmed_start
from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo
from barsight.stereo.direct.semiglobal.cost import describe_pixels, descriptor_cost, reverse_rows, row_costs
from barsight.stereo.prediction import _without_gaps, predict_disparity
from synthetic_scenes import Texture, quantised

WIDTH, HEIGHT, FOCAL, BASELINE = 480, 352, 500.0, 0.5
CAMERA = RectifiedCamera(FOCAL, WIDTH / 2 - 5, HEIGHT / 2 + 3, BASELINE, 0.0, WIDTH, HEIGHT)
FLOOR_M, TOP_M, BOX_M = 8.0, 6.8, (-1.2, 0.9, -0.8, 1.1)
METHOD = BarsightStereo(BarsightSettings(fill_occlusions=False, other_side_error_ratio=0.0))
RANGE = DisparityRange(24, 48)
MOVED = Pose(
    "now", "before", Rotation.from_euler("xyz", [0.3, -0.4, 0.2], degrees=True).as_matrix(),
    [0.31, -0.02, 0.01],
)  # fmt: skip


def seen_from(cam_from_world: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Gray values and true disparity (H, W) of a box on a floor; the world is the first left camera."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    rays = np.stack([(u - CAMERA.cx_px) / FOCAL, (v - CAMERA.cy_px) / FOCAL, np.ones_like(u)], axis=-1)
    world = cam_from_world.inverse()
    heading = rays @ world.rotation.T
    eye = world.translation
    far, near = ((z - eye[2]) / heading[..., 2] for z in (FLOOR_M, TOP_M))
    x, y = (eye[k] + near * heading[..., k] for k in (0, 1))
    low_x, high_x, low_y, high_y = BOX_M
    on_top = (x > low_x) & (x < high_x) & (y > low_y) & (y < high_y)
    depth = np.where(on_top, near, far)
    fine, coarse = Texture(5), Texture(6)
    x, y = (60 * (eye[k] + depth * heading[..., k]) for k in (0, 1))
    gray = 0.7 * fine(x + 300 * on_top, y) + 0.3 * coarse(x / 5, y / 5 + 40 * on_top)
    return quantised(gray), FOCAL * BASELINE / depth


@lru_cache
def pair_at(moved: bool) -> tuple[RectifiedPair, np.ndarray]:
    """The pair before or now, and the left picture's true disparity."""
    left_from_world = MOVED if moved else Pose("now", "before", np.eye(3), np.zeros(3))
    beside = Pose("right", "now", np.eye(3), [-BASELINE, 0, 0])
    left, truth = seen_from(left_from_world)
    right, _ = seen_from(beside @ left_from_world)
    valid = np.ones(left.shape, dtype=np.bool_)
    return RectifiedPair(int(moved), left, right, valid, valid, CAMERA), truth


def exact(disparity: np.ndarray) -> Disparity:
    return Disparity(disparity.astype(np.float32), np.full(disparity.shape, 0.05, dtype=np.float32))


def test_prediction_is_the_disparity_there() -> None:
    (_, before), (_, now) = pair_at(False), pair_at(True)
    predicted = predict_disparity(exact(before), CAMERA, MOVED)
    known = np.isfinite(predicted)
    error = np.abs(predicted - now)[known]
    assert known.mean() > 0.85
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.98) < 0.05
    unsure = Disparity(before.astype(np.float32), np.full(before.shape, 0.6, dtype=np.float32))
    assert not np.isfinite(predict_disparity(unsure, CAMERA, MOVED)).any()


def test_views_are_aligned_from_what_encoders_know() -> None:
    (before, disparity), (now, _) = pair_at(False), pair_at(True)
    guess = Pose("now", "before", np.eye(3), MOVED.translation + np.array([0.004, -0.003, 0.006]))
    found = align_views(before.left, exact(disparity), now.left, CAMERA, guess)
    assert isinstance(found, Pose)
    places = np.random.default_rng(1).uniform([-2, -2, 6.8], [2, 2, 8], (50, 3))
    true, seen = (FOCAL * p[:, :2] / p[:, 2:] for p in (MOVED.apply(places), found.apply(places)))
    assert np.linalg.norm(seen - true, axis=1).mean() < 0.3
    brighter = (now.left * 0.8 + 10).astype(np.uint8)
    again = align_views(before.left, exact(disparity), brighter, CAMERA, guess)
    assert isinstance(again, Pose)
    assert np.abs(again.translation - found.translation).max() < 0.005


def test_views_of_other_places_are_not_aligned() -> None:
    before, disparity = pair_at(False)
    other = np.ascontiguousarray(before.left[::-1, ::-1])
    assert isinstance(align_views(before.left, exact(disparity), other, CAMERA, MOVED), Failed)
    unknown = exact(np.full(disparity.shape, np.nan))
    assert isinstance(align_views(before.left, unknown, before.left, CAMERA, MOVED), Failed)


def test_places_are_compared_as_one_by_one() -> None:
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 255, (30, 40)).astype(np.float32)
    rays = np.column_stack([rng.uniform(-40, 40, 300), rng.uniform(-30, 30, 300), np.full(300, 50.0)])
    q, gray, tone = rng.uniform(5, 9, 300), rng.uniform(0, 255, 300), np.array([0.9, 4.0])
    principal, turn = np.array([19.0, 14.0]), Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix()
    shift = np.array([0.3, -0.2, 0.1])
    found = np.empty(300), np.empty((300, 8)), np.empty(300)
    seen = _compare((rays, q, gray), image, (turn, shift), tone, principal, *found)

    def shown(ray: np.ndarray, near: float, motion: np.ndarray) -> tuple[float, float, float]:
        """Gray value, column and row of a place, after a turn and a shift beside those above."""
        x, y, z = Rotation.from_rotvec(motion[:3]).apply(turn @ ray + near * shift) + near * motion[3:]
        u, v = 50 * x / z + principal[0], 50 * y / z + principal[1]
        if not (1 <= u < 38 and 1 <= v < 28):
            return np.nan, u, v
        a, b = int(u), int(v)
        row = [float(image[b + k, a] * (1 - u + a) + image[b + k, a + 1] * (u - a)) for k in (0, 1)]
        return row[0] * (1 - v + b) + row[1] * (v - b), u, v

    inside = [k for k in range(300) if np.isfinite(shown(rays[k], q[k], np.zeros(6))[0])]
    assert 40 < seen == len(inside) < 300
    for n, k in enumerate(inside):
        level, u, v = shown(rays[k], q[k], np.zeros(6))
        assert found[0][n] == pytest.approx(level - tone[0] * gray[k] - tone[1], abs=1e-4)
        assert (found[2][n], *found[1][n, 6:]) == (gray[k], -gray[k], -1)
        if min(u % 1, v % 1) < 0.01 or max(u % 1, v % 1) > 0.99:
            continue  # the slope changes here
        for j in range(6):
            way = 1e-6 * np.eye(6)[j]
            slope = (shown(rays[k], q[k], way)[0] - shown(rays[k], q[k], -way)[0]) / 2e-6
            assert found[1][n, j] == pytest.approx(slope, rel=1e-3, abs=0.05)


def test_equations_are_weighted_sums() -> None:
    rng = np.random.default_rng(4)
    residual, rows = rng.normal(0, 2, 50), rng.normal(0, 1, (50, 8))
    normal, pull = np.zeros((8, 8)), np.zeros(8)
    _add_equations(residual, rows, 3.0, normal, pull)
    weight = np.clip(1 - (residual / 3) ** 2, 0, None) ** 2
    assert 0 < np.count_nonzero(weight) < 50
    np.testing.assert_allclose(normal, rows.T @ (weight[:, None] * rows), rtol=1e-9)
    np.testing.assert_allclose(pull, rows.T @ (weight * residual), rtol=1e-9)


def errors_of(found: Disparity, truth: np.ndarray) -> np.ndarray:
    return np.abs(found.disparity_px - truth)[np.isfinite(found.disparity_px)]


def test_a_confirmed_pair_is_as_good_as_one_matched_from_nothing() -> None:
    (before, _), (now, truth) = pair_at(False), pair_at(True)
    predicted = predict_disparity(METHOD(before, RANGE), CAMERA, MOVED)
    confirmed, fresh = METHOD.confirm(now, RANGE, predicted), METHOD(now, RANGE)
    ours, theirs = errors_of(confirmed, truth), errors_of(fresh, truth)
    assert np.median(ours) < 1.1 * np.median(theirs)
    assert np.quantile(ours, 0.99) < np.quantile(theirs, 0.99)
    assert ours.size > 0.95 * theirs.size


@pytest.mark.parametrize("wrong_px", [-6.0, -3.0, -1.5, 1.5, 3.0, 6.0])
def test_a_wrong_prediction_dies(wrong_px: float) -> None:
    now, truth = pair_at(True)
    predicted = truth.astype(np.float32)
    patch = np.s_[60:200, 60:220]
    predicted[patch] += np.float32(wrong_px)
    found = METHOD.confirm(now, RANGE, predicted)
    off = np.abs(found.disparity_px - truth)[patch]
    seen = np.isfinite(off)
    assert np.median(off[seen]) < 0.1
    assert np.mean(off[seen] > abs(wrong_px) / 2) < 0.02


@pytest.mark.parametrize("shown", ["vanished", "appeared"])
def test_a_thing_that_vanished_or_appeared_since_is_seen_as_it_is(shown: str) -> None:
    now, truth = pair_at(True)
    top, floor = truth > 34, truth < 33
    predicted = truth.astype(np.float32)
    if shown == "vanished":
        # A box of the floor's right third was there before: 6 px nearer.
        changed = np.zeros_like(top)
        changed[40:300, 330:440] = True
        changed &= floor
        predicted[changed] += 6
    else:
        changed = top
        predicted[changed] = np.median(truth[floor])
    found = METHOD.confirm(now, RANGE, predicted)
    off = np.abs(found.disparity_px - truth)[changed]
    seen = np.isfinite(off)
    assert seen.mean() > 0.6
    assert np.median(off[seen]) < 0.1
    assert np.mean(off[seen] > 2) < 0.02


@pytest.mark.parametrize("bars", [-1, 1])
def test_a_prediction_one_bar_off_dies(bars: int) -> None:
    pitch_px, disparity_px = 9, 36
    rows, columns = np.mgrid[:HEIGHT, : WIDTH + disparity_px].astype(float)
    shading = 50 * np.sin(2 * np.pi * columns / pitch_px)
    gray = quantised(110 + shading + 0.25 * (Texture(7)(columns, rows) - 110))
    valid = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
    left, right = gray[:, :WIDTH], gray[:, disparity_px:]
    pair = RectifiedPair(0, np.ascontiguousarray(left), np.ascontiguousarray(right), valid, valid, CAMERA)
    predicted = np.full(valid.shape, disparity_px + bars * pitch_px, dtype=np.float32)
    found = METHOD.confirm(pair, DisparityRange(16, 64), predicted).disparity_px
    assert np.isfinite(found).mean() > 0.6
    assert np.nanquantile(np.abs(found - disparity_px), 0.98) < 0.5


@pytest.mark.parametrize("off_px", [-0.8, -0.3, 0.3, 0.8])
def test_a_prediction_that_is_off_everywhere_does_not_confirm_itself(off_px: float) -> None:
    now, truth = pair_at(True)
    found = METHOD.confirm(now, RANGE, (truth + off_px).astype(np.float32))
    bias = np.nanmedian(found.disparity_px - truth)
    assert abs(bias) < 0.1 * abs(off_px)


def test_without_a_prediction_only_sure_places_remain() -> None:
    now, truth = pair_at(True)
    found = METHOD.confirm(now, RANGE, np.full(truth.shape, np.nan, dtype=np.float32))
    error = errors_of(found, truth)
    assert error.size > 0.6 * truth.size
    assert np.quantile(error, 0.98) < 0.5


def test_what_the_pictures_like_better_stays() -> None:
    now, truth = pair_at(True)
    right, wrong = truth.astype(np.float32), (truth + 4).astype(np.float32)
    nothing = np.full(truth.shape, np.float32(-1e6))
    for predicted, matched in ((right, wrong), (wrong, right)):
        start = confirmed_start(now.left, now.right, predicted, matched, nothing)
        assert np.mean(np.abs(start - right)[8:-8, 60:-8] < 0.5) > 0.95


def test_start_is_the_prediction_where_nothing_speaks_against_it() -> None:
    rng, shape, gray = np.random.default_rng(5), (40, 70), np.full((40, 70), 90, dtype=np.uint8)
    matched = (30 + 0.2 * rng.standard_normal(shape)).astype(np.float32)
    predicted = (matched + rng.uniform(-0.9, 0.9, shape)).astype(np.float32)
    matched_right = (30 + 2 * rng.standard_normal(shape)).astype(np.float32)
    matched[:, 50:][rng.random((40, 20)) < 0.3] = np.nan
    predicted[rng.random(shape) < 0.2] = np.nan
    start = confirmed_start(gray, gray, predicted, matched, matched_right)
    for y, x in np.ndindex(shape):
        one, other = predicted[y, x], matched[y, x]
        around = matched[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5]
        wanted = other if np.ptp(around) <= 1 else np.nan  # a hole near by makes the span NaN
        if np.isfinite(one) and np.isfinite(other):
            wanted = one
        elif np.isfinite(one):
            column = round(float(np.float32(x) - one))
            seen = 0 <= column < shape[1] and abs(matched_right[y, column] - one) <= 2
            wanted = one if seen else np.nan
        np.testing.assert_equal(start[y, x], np.float32(wanted))


def test_gaps_between_moved_places_take_the_nearest_to_the_camera() -> None:
    rng = np.random.default_rng(6)
    first = (30 + rng.standard_normal((20, 30))).astype(np.float32)
    first[rng.random(first.shape) < 0.7] = np.nan
    framed, filled = np.pad(first, 1, constant_values=np.nan), _without_gaps(first)
    for y, x in np.ndindex(first.shape):
        around = framed[y : y + 3, x : x + 3]
        known = around[np.isfinite(around)]
        largest = known.max() if known.size else np.float32(np.nan)
        np.testing.assert_equal(filled[y, x], first[y, x] if np.isfinite(first[y, x]) else largest)


def test_a_pixel_costs_what_its_row_does() -> None:
    now, _ = pair_at(True)
    left, right = describe_pixels(now.left), describe_pixels(now.right)
    costs = np.empty((WIDTH, 16), dtype=np.uint8)
    row_costs(left, reverse_rows(right, 20, 16), 100, 20, 16, costs)
    for x, k in ((100, 0), (200, 5), (300, 15)):
        assert costs[x, k] == descriptor_cost(left, right, 100, x, x - 20 - k)


def match_all(
    recording: Recording, use: tuple[str, ...] = ("stereo", "imu", "crane"), kept: Path | None = None,
    backwards: bool = False,
) -> list[MatchedFrame | Refusal]:  # fmt: skip
    """Match all pairs of a recording by one chain, asked for in time's order or against it."""
    source = SelectedSensors(recording, use)
    pairs = RectifiedPairs(source, Rectifier(source.rig))
    chain = matching(pairs, MeasureSettings(), kept, Stopwatch())
    asked = list(pairs())
    found = [chain(pair) for pair in (reversed(asked) if backwards else asked)]
    return found[::-1] if backwards else found


def test_a_chain_gives_the_same_in_any_order(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    confirmed: list[int] = []
    plain = BarsightStereo.confirm

    def counted(self: BarsightStereo, pair: RectifiedPair, *rest: Any) -> Disparity:
        confirmed.append(pair.stamp_ns)
        return plain(self, pair, *rest)

    monkeypatch.setattr(BarsightStereo, "confirm", counted)
    recording = bs.open_recording(whole)
    stamps = recording.index.stamps_ns
    forth = match_all(recording, kept=tmp_path)
    assert confirmed == [stamp for place, stamp in enumerate(stamps) if place % 6]
    back = match_all(recording, backwards=True)
    for one, other in zip(forth, back, strict=True):
        assert isinstance(one, MatchedFrame) and isinstance(other, MatchedFrame)
        assert isinstance(one.disparity, Disparity) and isinstance(other.disparity, Disparity)
        np.testing.assert_array_equal(one.disparity.disparity_px, other.disparity.disparity_px)
        np.testing.assert_array_equal(one.disparity.sigma_px, other.disparity.sigma_px)
    confirmed.clear()
    kept = match_all(recording, kept=tmp_path)
    assert [frame.stamp_ns for frame in kept] == list(stamps) and not confirmed
    match_all(recording, ("stereo", "imu"))
    assert not confirmed
