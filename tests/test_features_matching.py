"""Detectors behind one Protocol, and every step of matching against what is known."""

from pathlib import Path

import numpy as np
import pytest

from barsight.benchmarks.motion.matching import bench_features, bench_matching
from barsight.core.arrays import UInt8
from barsight.core.errors import InputError
from barsight.core.records.pairs import RectifiedCamera
from barsight.features.detectors import DETECTORS, DetectorName, make_detector
from barsight.features.guided_matching import project_stereo
from barsight.features.matching import (
    homography_inliers,
    is_mutual,
    motion_inliers,
    nearest_neighbours,
    ratio_test,
)
from synthetic_scenes import Texture, quantised

CAMERA = RectifiedCamera(300.0, 160.0, 120.0, 0.4, 0.0, 320, 240)


def moved(dx: float, dy: float, seed: int = 0) -> UInt8:
    u, v = np.meshgrid(np.arange(320.0) - dx, np.arange(240.0) - dy)
    return quantised(Texture(3)(u, v) + np.random.default_rng(seed).normal(0, 1.0, u.shape))


@pytest.mark.parametrize("name", DETECTORS)
def test_features_are_found_again_within_their_sigma(name: DetectorName) -> None:
    detector, scaled = make_detector(name), []
    for k, shift in enumerate([(0.3, -0.6), (2.45, 1.2), (-1.7, 3.35)]):
        first, second = detector(moved(0, 0, 2 * k), 480), detector(moved(*shift, seed=2 * k + 1), 480)
        assert 50 < len(first) <= 480
        assert (first.descriptors.dtype == np.uint8) == (name == "orb")
        forward, backward = (
            nearest_neighbours(first.descriptors, second.descriptors),
            nearest_neighbours(second.descriptors, first.descriptors),
        )
        kept = is_mutual(forward, backward) & ratio_test(forward)
        error = second.pixels[forward.index[kept]] - first.pixels[kept] - shift
        sigma = np.hypot(first.sigma_px[kept], second.sigma_px[forward.index[kept]])
        true = np.linalg.norm(error, axis=1) < 2
        assert true.mean() > (0.7 if name == "surf" else 0.95)
        scaled.append(error[true] / sigma[true, None])
    spread = 1.4826 * float(np.median(np.abs(np.concatenate(scaled))))
    assert 0.4 < spread < 1.6


@pytest.mark.parametrize("name", DETECTORS)
def test_an_empty_picture_has_none(name: DetectorName) -> None:
    found = make_detector(name)(np.full((240, 320), 90, np.uint8), 480)
    assert len(found) == 0
    assert len(nearest_neighbours(found.descriptors, found.descriptors).index) == 0


def test_nearest_is_brute_force_for_both_distances() -> None:
    rng = np.random.default_rng(0)
    bits, reals = rng.integers(0, 256, (30, 32), dtype=np.uint8), rng.normal(size=(30, 8)).astype(np.float32)
    hamming = np.unpackbits(bits[:20, None] ^ bits[None, 5:], axis=2).sum(axis=2)
    euclid = np.linalg.norm(reals[:20, None] - reals[None, 5:], axis=2)
    for table, first, second in ((hamming, bits[:20], bits[5:]), (euclid, reals[:20], reals[5:])):
        found = nearest_neighbours(first, second)
        np.testing.assert_array_equal(found.index, table.argmin(axis=1))
        np.testing.assert_allclose(found.distance, np.sort(table, axis=1)[:, 0], atol=1e-5)
        np.testing.assert_allclose(found.next_distance, np.sort(table, axis=1)[:, 1], atol=1e-5)


def test_a_homography_loses_what_is_off_its_plane_and_the_trend_does_not() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (200, 2)), np.full(200, 6.0)])
    points[:60, 2] = 4.0
    move = np.array([0.3, 0.0, 0.0])
    first, second = (project_stereo(p, CAMERA)[:, :2] for p in (points, points + move))
    second[150:] += rng.uniform(12, 30, (50, 2))
    plane = homography_inliers(first, second)
    trend = motion_inliers(points, second, np.eye(3), move, CAMERA, 2.0)
    assert plane[60:150].mean() > 0.98
    assert plane[:60].mean() < 0.1
    assert trend[:150].all()
    assert not trend[150:].any()
    assert not homography_inliers(first[:3], second[:3]).any()


def test_ours_is_precise_and_keeps_the_true_ones(data: Path) -> None:
    bench = bench_matching((data / "yard_dev",), ("sift", "orb"))
    for row in bench.matches:
        if row.step == "ours":
            assert row.precision >= 0.99
            assert row.kept >= 0.95
    rows = {row.step: row for row in bench.matches if row.detector == "orb"}
    assert rows["homography"].precision < 0.97
    assert rows["homography"].kept < 0.8
    assert rows["ours"].pairs > 3 * rows["homography, trend"].pairs


@pytest.mark.slow
def test_features_are_counted_and_timed(data: Path) -> None:
    rows = bench_features((data / "yard_dev",), ("orb",), repeats=1).features
    assert [row.detector for row in rows] == ["orb"]
    assert rows[0].features > 500
    assert rows[0].time.median_ms > 0
    with pytest.raises(InputError, match="no view with true depth"):
        bench_features((data / "kitti_odometry_a",), ("orb",))
