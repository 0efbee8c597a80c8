"""ICP on bars: what they show is found within the stated sigma, along them the prediction stays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.errors import ConfigError, Failed
from barsight.core.pose import Pose
from barsight.registration.icp import IcpSettings, Refined, refine

NOISE_M = 0.002
SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.005, 0.005, 0.005])


def bars(rng: np.random.Generator, ends: bool) -> np.ndarray:
    """Round bars of 90 mm along y on a floor; with ends their faces show."""
    x, y = rng.uniform(-1, 1, 30_000), rng.uniform(-0.8, 0.8, 30_000)
    z = np.sqrt(np.maximum(0.045**2 - (np.mod(x, 0.09) - 0.045) ** 2, 0)) + 0.1 * (x > 0.2)
    points = np.column_stack([x, y, z])
    if ends:
        face = np.column_stack([rng.uniform(-1, 1, 6000), np.full(6000, 0.8), rng.uniform(-0.6, 0.0, 6000)])
        points = np.vstack([points, face])
    return points + rng.normal(0, NOISE_M, points.shape)


def case(seed: int, ends: bool) -> tuple[np.ndarray, np.ndarray, Pose, Pose]:
    """source, target, the truth and a prediction that is off by what SIGMA says."""
    rng = np.random.default_rng(seed)
    truth = Pose(
        "yard", "rect0", Rotation.from_euler("xyz", [3.1, 0.02, 0.1]).as_matrix(), np.array([20.0, 1, 8])
    )
    target, seen = bars(rng, ends) + np.array([20.0, 1, 0]), bars(rng, ends) + np.array([20.0, 1, 0])
    source = truth.inverse().apply(seen)
    off = rng.normal(0, 1, 6) * SIGMA
    # The prediction turns about the body, 8 m over the bars: 1 mrad is 8 mm there.
    prior = Pose(
        "yard",
        "rect0",
        Rotation.from_rotvec(off[:3]).as_matrix() @ truth.rotation,
        truth.translation + off[3:],
    )
    return source, target, truth, prior


def error_of(found: Refined, truth: Pose) -> np.ndarray:
    pose = found.target_from_source
    turn = Rotation.from_matrix(truth.rotation @ pose.rotation.T).as_rotvec()
    return np.r_[turn, truth.translation - pose.translation]


@pytest.mark.parametrize("ends", [False, True])
def test_errors_are_what_the_covariance_says(ends: bool) -> None:
    distances, along_bars = [], []
    for seed in range(8):
        source, target, truth, prior = case(seed, ends)
        found = refine(source, target, prior, np.diag(SIGMA**2), IcpSettings())
        assert isinstance(found, Refined)
        error = error_of(found, truth)
        distances.append(error @ np.linalg.solve(found.covariance, error))
        assert len(found.locked) == (2 if ends else 3)
        on_bars = np.array([0.0, 0.0, 8.0])
        off = found.target_from_source.apply(on_bars) - truth.apply(on_bars)
        assert np.abs(off[[0, 2]]).max() < 0.002
        along_bars.append(abs(off[1]))
    assert 2 < np.mean(distances) < 12  # chi-square of 6
    assert (max(along_bars) < 0.002) == ends


def test_a_wrong_prediction_is_told() -> None:
    source, target, truth, _ = case(0, ends=True)
    prior = Pose("yard", "rect0", truth.rotation, truth.translation + np.array([0, 0, 0.05]))
    sure = np.diag((0.1 * SIGMA) ** 2)
    found = refine(source, target, prior, sure, IcpSettings())
    assert isinstance(found, Refined)
    assert found.furthest_sigma > 3
    assert found.warning is not None and "sigma" in found.warning


def test_nothing_in_common() -> None:
    source, target, _, prior = case(0, ends=False)
    away = refine(source, target + 5, prior, np.diag(SIGMA**2), IcpSettings())
    assert isinstance(away, Failed) and away.code == "no-overlap"
    few = refine(source[:9], target, prior, np.diag(SIGMA**2), IcpSettings())
    assert isinstance(few, Failed) and few.code == "no-overlap"
    with pytest.raises(ConfigError):
        IcpSettings(reach_m=0)
