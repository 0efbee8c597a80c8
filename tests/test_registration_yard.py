"""The yard from targets and from crane moves: errors as stated, doubtful or refused where due."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.motion.crane.crane_moves import MovedYard, yard_from_moves
from barsight.registration.yard import YardCalibration, calibrate_yard

TRUTH = Pose(
    "yard", "world", Rotation.from_rotvec([0.02, -0.01, 1.3]).as_matrix(), np.array([12.0, 3.0, 8.0])
)
LEVER = np.array([0.3, -0.2, -0.5])


def nees(found: YardCalibration) -> float:
    pose = found.alignment.target_from_source
    turn = Rotation.from_matrix(TRUTH.rotation @ pose.rotation.T).as_rotvec()
    error = np.concatenate([turn, TRUTH.translation - pose.translation])
    return float(error @ np.linalg.solve(found.alignment.covariance, error) / 6)


def targets(seed: int, count: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    measured = rng.uniform((-2, -3, -8), (20, 3, -6.5), (count, 3))
    sigma = rng.uniform(0.002, 0.006, count)
    noise = rng.normal(0, 1, (count, 3)) * sigma[:, None]
    return measured, TRUTH.apply(measured) + noise, sigma[:, None, None] ** 2 * np.eye(3)


def calibrated(seed: int, checks: int = 0) -> YardCalibration:
    measured, yard, covariance = targets(seed)
    apart = np.arange(6) >= 6 - checks
    found = calibrate_yard(tuple("abcdef"), measured, yard, covariance, apart, "world")
    assert isinstance(found, YardCalibration)
    return found


def test_targets_give_the_error_they_state() -> None:
    found = [calibrated(seed) for seed in range(60)]
    assert 0.8 < np.mean([nees(f) for f in found]) < 1.25
    assert sum(bool(f.doubts) for f in found) <= 2


def test_checks_lie_where_they_are_said_to() -> None:
    found = [calibrated(seed, checks=2) for seed in range(60)]
    ratios = [(f.off_m[f.checks] / f.sigma_m[f.checks, None]) ** 2 for f in found]
    assert 0.8 < np.mean(ratios) < 1.25


def test_a_mistaken_target_and_a_wrong_metre_are_said() -> None:
    measured, yard, covariance = targets(1)
    none = np.zeros(6, np.bool_)
    wrong = yard.copy()
    wrong[2, 0] += 0.05
    found = calibrate_yard(tuple("abcdef"), measured, wrong, covariance, none, "world")
    assert isinstance(found, YardCalibration)
    assert "a target is mistaken" in found.doubts[0]
    assert found.inflation > 4
    longer = calibrate_yard(tuple("abcdef"), 1.003 * measured, yard, covariance, none, "world")
    assert isinstance(longer, YardCalibration)
    assert any("+0.3" in doubt and "metre" in doubt for doubt in longer.doubts)
    off = yard.copy()
    off[5, 2] += 0.1
    apart = calibrate_yard(tuple("abcdef"), measured, off, covariance, np.arange(6) == 5, "world")
    assert isinstance(apart, YardCalibration)
    assert any("check f" in doubt for doubt in apart.doubts)


def moved(seed: int, trolley_m: float, walk_m: float = 0.0) -> MovedYard | Failed:
    """A bridge of 12 m, then a trolley; odometry with noise and, where asked, errors that go together."""
    rng = np.random.default_rng(seed)
    stamps = (np.arange(50) * 500_000_000 + 10**12).astype(np.int64)
    encoder_ns = np.arange(stamps[0] - 10**9, stamps[-1] + 10**9, 50_000_000)

    def place_at(stamp_ns: np.ndarray) -> np.ndarray:
        share = (stamp_ns - stamps[0]) / (stamps[-1] - stamps[0])
        bridge, trolley = np.clip(1.6 * share, 0, 1), np.clip(3 * share - 2, 0, 1)
        ways = [w * w * (3 - 2 * w) for w in (bridge, trolley)]
        return np.column_stack([4 + 12 * ways[0], 1 + trolley_m * ways[1], np.full(len(share), 9.0)])

    place = place_at(stamps)
    yard_from_body = Rotation.from_rotvec(rng.normal(0, 0.002, (50, 3))).as_matrix() @ np.diag([1.0, -1, -1])
    world_from_yard = TRUTH.inverse()
    smooth = np.zeros((50, 3))
    for k in range(1, 50):
        smooth[k] = 0.7 * smooth[k - 1] + rng.normal(0, walk_m, 3)
    seen = world_from_yard.apply(place + LEVER) + rng.normal(0, 0.003, (50, 3)) + smooth
    frames = tuple(
        PosedFrame(int(s), Pose("world", "body", world_from_yard.rotation @ r, p), np.eye(6))
        for s, r, p in zip(stamps, yard_from_body, seen, strict=True)
    )
    crane = CraneSamples(encoder_ns, place_at(encoder_ns), LEVER, np.diag([1.0, -1, -1]), 0.001)
    return yard_from_moves(Trajectory("world", frames, (), ("stereo",)), crane, 0)


@pytest.mark.parametrize("walk_m", [0.0, 0.002])
def test_moves_in_two_axes_give_the_error_they_state(walk_m: float) -> None:
    """Errors of the odometry that go together over seconds included."""
    found = [moved(seed, 4.0, walk_m) for seed in range(24)]
    values = [nees(f.calibration) for f in found if isinstance(f, MovedYard)]
    assert len(values) == 24
    assert 0.8 < np.mean(values) < 1.25
    first = found[0]
    assert isinstance(first, MovedYard)
    off = Rotation.from_matrix(first.yard_from_body @ np.diag([1.0, -1, -1])).magnitude()
    assert np.degrees(off) < 0.2


def test_bridge_travel_alone_is_refused() -> None:
    found = moved(0, 0.0)
    assert isinstance(found, Failed)
    assert "one axis only: the roll" in found.reason
