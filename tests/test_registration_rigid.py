"""The rigid alignment: exact without noise, consistent with it, and refused where it can't be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.registration.rigid import Alignment, align_rigid

FRAMES = ("yard", "world")
TRUTH = Pose(*FRAMES, Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix(), np.array([20.0, -3.0, 8.0]))


def found(source: np.ndarray, target: np.ndarray, covariance: np.ndarray | None = None) -> Alignment:
    result = align_rigid(source, target, FRAMES, covariance)
    assert isinstance(result, Alignment)
    return result


def error(result: Alignment, truth: Pose) -> np.ndarray:
    """(6,) the small rotation and translation from the found pose to the true one."""
    pose = result.target_from_source
    turn = Rotation.from_matrix(truth.rotation @ pose.rotation.T).as_rotvec()
    return np.concatenate([turn, truth.translation - pose.translation])


@pytest.mark.parametrize("flat", [False, True])
def test_exact_points_give_the_exact_motion(flat: bool) -> None:
    source = np.random.default_rng(1).uniform(-5, 5, (7, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    result = found(source, TRUTH.apply(source))
    assert np.abs(error(result, TRUTH)).max() < 1e-12
    assert abs(result.scale - 1) < 1e-12


def test_a_mirrored_set_gives_a_rotation() -> None:
    source = np.random.default_rng(2).uniform(-5, 5, (9, 3))
    assert np.linalg.det(found(source, source * [1, 1, -1]).target_from_source.rotation) > 0.999


@pytest.mark.parametrize("stated", [False, True])
def test_the_covariance_is_right(stated: bool) -> None:
    squares, scales = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        source = rng.uniform(-3, 9, (25, 3)) * [1, 1, 0.2]
        shape = rng.normal(0, 1e-3, (25, 3, 3)) if stated else np.broadcast_to(2e-3 * np.eye(3), (25, 3, 3))
        covariance = shape @ shape.transpose(0, 2, 1) + 1e-7 * np.eye(3) * stated
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(0, 1, (25, 3)))
        result = found(source, TRUTH.apply(source) + noise, covariance if stated else None)
        e = error(result, TRUTH)
        squares.append(e @ np.linalg.solve(result.covariance, e) / 6)
        scales.append((result.scale - 1) / result.scale_sigma)
    assert 0.87 < np.mean(squares) < 1.15
    assert 0.75 < np.mean(np.square(scales)) < 1.3


def test_sigmas_that_differ_by_direction_are_believed() -> None:
    squares = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        source = rng.uniform((-20, -6, 0), (20, 6, 2.5), (12, 3))
        ray = np.column_stack([rng.normal(0, 0.3, (12, 2)), np.ones(12)])
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        covariance = 1e-6 * np.eye(3) + 99e-6 * ray[:, :, None] * ray[:, None, :]
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(0, 1, (12, 3)))
        result = found(source, TRUTH.apply(source) + noise, covariance)
        squares.append(result.chi2 / result.degrees_of_freedom)
    assert 0.9 < np.mean(squares) < 1.1


def test_mistaken_points_are_fitted_no_worse_than_by_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(100):
        rng = np.random.default_rng((4, seed))
        source = rng.uniform((-20, -6, 0), (20, 6, 2.5), (4, 3))
        target = source + rng.normal(0, 5, 3) * [[1], [0], [0], [0]]
        ray = np.column_stack([rng.normal(0, 0.3, (4, 2)), np.ones(4)])
        covariance = 1e-6 * np.eye(3) + 99e-6 * ray[:, :, None] * ray[:, None, :]
        refined = found(source, target, covariance)
        with monkeypatch.context() as patch:
            patch.setattr("barsight.registration.rigid.ROUNDS", 0)
            assert refined.chi2 <= found(source, target, covariance).chi2


def test_what_cant_be_aligned_is_refused_with_the_reason() -> None:
    line = np.column_stack([np.linspace(0, 7, 20), np.zeros(20), np.zeros(20)])
    for source, code in ((line, "collinear"), (np.zeros((5, 3)), "collinear"), (line[:2], "few-points")):
        result = align_rigid(source, TRUTH.apply(source), FRAMES)
        assert isinstance(result, Failed)
        assert result.code == code


@pytest.mark.parametrize("count", [3, 4, 6])
def test_few_points_without_sigmas_are_no_surer_than_they_may_be(count: int) -> None:
    beyond = []
    for seed in range(600):
        rng = np.random.default_rng((5, seed))
        corners = [[-5, -3, 0], [5, -2, 0.5], [-1, 3, 0], [6, 4, 1], [0, 0, 1], [-6, 2, 0.5]]
        source = np.array(corners[:count], float)
        result = found(source, TRUTH.apply(source) + rng.normal(0, 5e-3, (count, 3)))
        beyond.append(np.abs(error(result, TRUTH)) > 1.96 * np.sqrt(np.diag(result.covariance)))
    assert np.mean(beyond) < 0.06
