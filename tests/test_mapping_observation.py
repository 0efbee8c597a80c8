"""A view's observations against a slow reference, and their variances by Monte Carlo."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.pose import Pose
from barsight.core.records.disparity import StereoPoints
from barsight.mapping.observation import sort_points

CELL_M = 0.02
SPACING_RAD = 1e-3
BODY = Pose(
    "yard", "body", Rotation.from_euler("xyz", [3.1, 0.05, 0.4]).as_matrix(), np.array([-3.0, 2.0, 8.0])
)
BODY_FROM_RECT0 = Pose("body", "rect0", Rotation.from_euler("z", 0.2).as_matrix(), np.array([0.1, 0.3, 0.05]))


def covariance() -> np.ndarray:
    """A pose's covariance whose rotation and translation go together."""
    root = np.random.default_rng(8).normal(0, 1, (6, 6)) * np.array([[2e-4] * 3 + [1e-3] * 3]).T
    return root @ root.T


def points(count: int = 4000, seed: int = 0) -> StereoPoints:
    """Points of a small patch 6 to 7 m below the camera, several of them in every cell."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)), rng.choice([6.0, 6.4, 7.0], count)])
    xyz[:, 2] += rng.normal(0, 0.02, count)
    return StereoPoints(
        1,
        xyz.astype(np.float32),
        rng.uniform(0.002, 0.03, count).astype(np.float32),
        rng.uniform(0.001, 0.01, count).astype(np.float32),
        rng.integers(0, 256, count, dtype=np.uint8),
    )


def observed_slowly(
    seen: StereoPoints, pose: Pose, origin: np.ndarray, cov: np.ndarray
) -> list[tuple[float, ...]]:
    """Cell by cell from the lowest y and x on, and within each cell from the top down."""
    cells: dict[tuple[int, int], list[tuple[float, ...]]] = {}
    xyz = seen.xyz_m.astype(np.float64)
    for ray, point, sigma, shared, gray in zip(
        xyz @ pose.rotation.T,
        pose.apply(xyz),
        seen.range_sigma_m,
        seen.shared_sigma_m,
        seen.intensity,
        strict=True,
    ):
        slope = ray[2] / np.linalg.norm(ray)
        arm = point - origin
        swing = np.array([arm[1], -arm[0], 0, 0, 0, 1])
        row, column = (int(np.floor(point[k] / CELL_M + 0.5)) for k in (1, 0))
        aside = max(abs(point[0] - column * CELL_M), abs(point[1] - row * CELL_M))
        depth = (point - pose.translation) @ pose.rotation[:, 2]
        middle = aside <= 0.5 * SPACING_RAD * depth
        height, noise = np.float32(point[2]), (sigma * slope) ** 2
        values = (height, noise, swing @ cov @ swing, abs(shared * slope), gray, middle)
        cells.setdefault((row, column), []).append(tuple(float(v) for v in values))
    result = []
    for (row, column), members in sorted(cells.items()):
        left = sorted(members, reverse=True)
        while left:
            floor = left[0][0] - max(4 * left[0][1] ** 0.5, 2 * CELL_M)
            group = np.array([member for member in left if member[0] >= floor])
            left = left[len(group) :]
            height = np.average(group[:, 0], weights=1 / group[:, 1])
            result.append((column, row, height, *group[:, 1:5].mean(axis=0), group[:, 5].max()))
    return result


def test_the_kernels_agree_with_the_slow_reference() -> None:
    seen, pose = points(), BODY @ BODY_FROM_RECT0
    found = sort_points(seen, pose, BODY.translation, covariance(), CELL_M, SPACING_RAD).merged()
    expected = np.array(observed_slowly(seen, pose, BODY.translation, covariance()))
    assert len(expected) > 1500
    np.testing.assert_array_equal(found.x, expected[:, 0])
    np.testing.assert_array_equal(found.y, expected[:, 1])
    np.testing.assert_allclose(found.z_m, expected[:, 2], atol=2e-6)
    np.testing.assert_allclose(found.variance_m2, expected[:, 3] + expected[:, 4], rtol=1e-4)
    np.testing.assert_allclose(found.shared_m, expected[:, 5], rtol=1e-4)
    np.testing.assert_allclose(found.intensity, expected[:, 6], rtol=1e-5)
    np.testing.assert_array_equal(found.central, expected[:, 7])
    assert 0.1 < found.central.mean() < 0.9


def test_many_points_of_one_view_say_it_once() -> None:
    """A hundred like points don't make the view surer than one."""
    one = StereoPoints(1, *(np.array(v) for v in _flat(1)))
    many = StereoPoints(1, *(np.array(v) for v in _flat(100)))
    nothing = np.zeros((6, 6))
    single = sort_points(one, BODY, BODY.translation, nothing, CELL_M, SPACING_RAD).merged()
    crowd = sort_points(many, BODY, BODY.translation, nothing, CELL_M, SPACING_RAD).merged()
    assert len(single.z_m) == len(crowd.z_m) == 1
    np.testing.assert_allclose(crowd.variance_m2, single.variance_m2)


def _flat(count: int) -> tuple[np.ndarray, ...]:
    xyz = np.tile(np.array([0, 0, 6], np.float32), (count, 1))
    return xyz, np.full(count, 0.01, np.float32), np.full(count, 0.002, np.float32), np.zeros(count, np.uint8)


def test_the_variance_is_that_of_noisy_rays_and_poses() -> None:
    rng = np.random.default_rng(3)
    seen, cov = points(1, seed=5), covariance()
    found = sort_points(seen, BODY @ BODY_FROM_RECT0, BODY.translation, cov, CELL_M, SPACING_RAD).merged()
    point = seen.xyz_m[0].astype(np.float64)
    heights = []
    for error in rng.multivariate_normal(np.zeros(6), cov, 4000):
        body = Pose(
            "yard",
            "body",
            Rotation.from_rotvec(error[:3]).as_matrix() @ BODY.rotation,
            BODY.translation + error[3:],
        )
        along = 1 + rng.normal(0, seen.range_sigma_m[0]) / np.linalg.norm(point)
        heights.append((body @ BODY_FROM_RECT0).apply(along * point)[2])
    assert np.var(heights) == pytest.approx(float(found.variance_m2[0]), rel=0.08)


def test_no_points() -> None:
    none = points(0)
    found = sort_points(none, BODY, BODY.translation, covariance(), CELL_M, SPACING_RAD).merged()
    assert found.x.shape == found.z_m.shape == (0,)
