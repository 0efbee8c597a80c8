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
    ratios = [(f.off_m[-2:] / f.sigma_m[-2:, None]) ** 2 for f in found]
    assert 0.8 < np.mean(ratios) < 1.25


def judged(
    measured: np.ndarray, yard: np.ndarray, covariance: np.ndarray, checks: int = 0
) -> YardCalibration:
    names = tuple("abcdefgh"[: len(yard)])
    apart = np.arange(len(yard)) >= len(yard) - checks
    found = calibrate_yard(names, measured, yard, covariance, apart, "world")
    assert isinstance(found, YardCalibration)
    return found


def test_a_mistaken_target_is_named_and_doesnt_move_the_frame() -> None:
    for seed in range(12):
        measured, yard, covariance = targets(seed, 8)
        wrong = yard.copy()
        wrong[2] += (0.06, 0, 0)
        found = judged(measured, wrong, covariance)
        assert [told.split()[0] for told in found.contradictions] == ["c"]
        assert abs(found.off_m[2, 0] - 0.06) < 0.03
        wrong[5] += (0, 0, -0.2)
        both = judged(measured, wrong, covariance)
        assert [told.split()[0] for told in both.contradictions] == ["c", "f"]
        assert nees(both) < 6


def test_targets_that_nothing_reconciles_contradict_their_sigmas() -> None:
    measured, yard, covariance = targets(1, 8)
    rough = yard + np.random.default_rng(0).normal(0, 0.03, yard.shape)
    (told,) = judged(measured, rough, covariance).contradictions
    assert "times as much as their sigmas" in told
    honest = judged(measured, rough, np.broadcast_to(0.03**2 * np.eye(3), (8, 3, 3)))
    assert not honest.contradictions


def test_of_four_targets_both_that_may_be_mistaken_are_named() -> None:
    measured = np.array([[0, 0, -8.0], [12, 0, -8], [12, 5, -8], [0, 5, -8]])
    yard = TRUTH.apply(measured)
    yard[1] += TRUTH.rotation @ (0.0, 0.0, 0.05)  # a warped rectangle: any corner may be the wrong one
    (told,) = judged(measured, yard, np.broadcast_to(2.5e-5 * np.eye(3), (4, 3, 3))).contradictions
    assert all(f"{name} is" in told for name in "abcd")


def test_a_large_residual_within_its_sigma_is_a_doubt() -> None:
    measured = np.array([[0, 0, -8.0], [12, 0, -8], [12, 5, -8], [0, 5, -8], [6, 2, -7], [3, 4, -7]])
    yard = TRUTH.apply(measured)
    yard[4, 2] += 0.023
    found = judged(measured, yard, np.broadcast_to(2.5e-5 * np.eye(3), (6, 3, 3)))
    assert not found.contradictions
    assert "chance" in found.doubts[0] and "e most" in found.doubts[0]


def test_a_wrong_metre_and_a_check_that_is_off_are_said() -> None:
    measured, yard, covariance = targets(1)
    longer = judged(1.003 * measured, yard, covariance)
    assert "+0.3" in longer.contradictions[0] and "metre" in longer.contradictions[0]
    off = yard.copy()
    off[5, 2] += 0.1
    assert "f is" in judged(measured, off, covariance, checks=1).contradictions[0]


def test_many_honest_checks_whose_depth_is_less_sure_are_no_contradiction() -> None:
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        measured = rng.uniform((-2, -3, -8), (20, 3, -6.5), (28, 3))
        noise = rng.normal(0, (0.001, 0.001, 0.006), (28, 3))
        covariance = np.tile(np.diag([1e-6, 1e-6, 36e-6]), (28, 1, 1))
        yard = TRUTH.apply(measured) + noise
        apart = np.arange(28) >= 8
        found = calibrate_yard(tuple(map(str, range(28))), measured, yard, covariance, apart, "world")
        assert isinstance(found, YardCalibration)
        refused += bool(found.contradictions)
    assert refused <= 1


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
