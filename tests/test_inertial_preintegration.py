"""Preintegration against a slow integration of the equations, its covariance by Monte Carlo, EuRoC."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.inertial.model import GRAVITY_MPS2, BodyState, ImuBias
from barsight.inertial.preintegration import Preintegrated, Preintegrator
from barsight.recording.formats.ground_truth import read_ground_truth

NOISE = ImuNoise(2e-4, 2e-5, 2e-3, 1e-3, 200.0)
EUROC_NOISE = ImuNoise(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, 200.0)
START = 1_700_000_000_000_000_000
BIAS = ImuBias(np.array([0.01, -0.02, 0.005]), np.array([0.1, -0.05, 0.08]))
STATE = BodyState(
    Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([1.0, 2, 3]), np.array([0.5, -0.2, 0.1])
)


def lively(count: int = 401, bias: ImuBias = BIAS) -> ImuSamples:
    """2 s of turning and shaking, sampled at 200 Hz."""
    t = np.arange(count) * 0.005
    gyro = 0.6 * np.column_stack([np.sin(3 * t), np.cos(2 * t), np.sin(5 * t + 1)])
    force = np.column_stack([np.sin(7 * t), 2 * np.cos(4 * t), 9.8 + np.sin(2 * t)])
    stamps = START + np.arange(count, dtype=np.int64) * 5_000_000
    return ImuSamples(stamps, gyro + bias.gyro_radps, force + bias.accel_mps2)


def between(imu: ImuSamples, first: int, last: int, bias: ImuBias = BIAS) -> Preintegrated:
    result = Preintegrator(imu, NOISE).between(first, last, bias)
    assert isinstance(result, Preintegrated)
    return result


def integrate_slowly(imu: ImuSamples, start_ns: int, end_ns: int) -> BodyState:
    """STATE at end_ns by 2000 steps of [paper Eq. 11], the readings interpolated to each step's middle."""
    steps = 2000
    edges = np.linspace(0, end_ns - start_ns, steps + 1)
    middle = start_ns + ((edges[1:] + edges[:-1]) / 2).round().astype(np.int64)
    rate = interpolate_at(middle, imu.stamp_ns, imu.gyro_radps - BIAS.gyro_radps)
    force = interpolate_at(middle, imu.stamp_ns, imu.accel_mps2 - BIAS.accel_mps2)
    rotation, position, velocity = STATE.rotation, STATE.position_m, STATE.velocity_mps
    dt = (end_ns - start_ns) / NS_PER_S / steps
    for w, a in zip(rate, force, strict=True):
        half = rotation @ Rotation.from_rotvec(w * dt / 2).as_matrix()
        acceleration = half @ a - [0.0, 0.0, GRAVITY_MPS2]
        position = position + velocity * dt + acceleration * dt**2 / 2
        velocity = velocity + acceleration * dt
        rotation = rotation @ Rotation.from_rotvec(w * dt).as_matrix()
    return BodyState(rotation, position, velocity)


def error(found: BodyState, truth: BodyState) -> np.ndarray:
    """(9,) rotation, position, velocity in the true body's axes."""
    turn = Rotation.from_matrix(truth.rotation.T @ found.rotation).as_rotvec()
    move = truth.rotation.T @ (found.position_m - truth.position_m)
    return np.concatenate([turn, move, truth.rotation.T @ (found.velocity_mps - truth.velocity_mps)])


@pytest.mark.parametrize(("first", "last"), [(0, 1_000_000_000), (3_700_001, 1_501_200_007)])
def test_it_agrees_with_a_slow_integration(first: int, last: int) -> None:
    imu = lively()
    slow = integrate_slowly(imu, START + first, START + last)
    fast = between(imu, START + first, START + last).predict(STATE)
    np.testing.assert_allclose(error(fast, slow), 0, atol=8e-4)


def test_the_slow_one_is_exact_for_a_fall() -> None:
    stamps = START + np.arange(11, dtype=np.int64) * 100_000_000
    imu = ImuSamples(stamps, np.tile(BIAS.gyro_radps, (11, 1)), np.tile(BIAS.accel_mps2, (11, 1)))
    end = integrate_slowly(imu, START, START + 1_000_000_000)
    np.testing.assert_allclose(end.position_m, STATE.position_m + STATE.velocity_mps - [0, 0, 9.80665 / 2])
    np.testing.assert_allclose(end.rotation, STATE.rotation, atol=1e-12)


def test_another_bias_enters_to_first_order() -> None:
    imu, end = lively(), START + 1_000_000_000
    whole = between(imu, START, end)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-4
        other = ImuBias(BIAS.gyro_radps + step[3:], BIAS.accel_mps2 + step[:3])
        moved = error(between(imu, START, end, other).predict(STATE), whole.predict(STATE))
        first_order = error(whole.predict(STATE, other), whole.predict(STATE))
        np.testing.assert_allclose(first_order, moved, atol=2e-8)


def test_the_covariance_is_right() -> None:
    rng, imu, end = np.random.default_rng(3), lively(), START + 1_000_000_000
    truth = between(imu, START, end).predict(STATE)
    nees = []
    for _ in range(150):
        gyro = imu.gyro_radps + rng.normal(0, NOISE.gyro_density * 200**0.5, (401, 3))
        accel = imu.accel_mps2 + rng.normal(0, NOISE.accel_density * 200**0.5, (401, 3))
        noisy = between(ImuSamples(imu.stamp_ns, gyro, accel), START, end)
        off = error(noisy.predict(STATE), truth)
        nees.append(off @ np.linalg.solve(noisy.covariance, off) / 9)
    assert 0.85 < np.mean(nees) < 1.15


def test_a_gap_or_the_end_of_the_samples_fails() -> None:
    imu = lively()
    kept = np.r_[0:100, 140:401]
    holed = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    for samples, first, last in (
        (holed, 0, 1_000_000_000), (imu, -1, 1_000_000_000), (imu, 0, 2_000_000_001), (imu, 5, 5),
    ):  # fmt: skip
        result = Preintegrator(samples, NOISE).between(START + first, START + last, BIAS)
        assert isinstance(result, Failed)
        assert result.code == "imu-gap"


def euroc(data: Path, imu_name: str, truth_name: str) -> tuple[ImuSamples, np.ndarray, list[BodyState]]:
    """The IMU, the stamps of 1 s windows' edges, and the true states there."""
    folder = data / "euroc_imu_truth"
    lines = [line for line in (folder / imu_name).read_text().splitlines() if line[0] != "#"]
    table = np.array([[float(field) for field in line.split(",")] for line in lines])
    stamps = np.array([int(line.split(",")[0]) for line in lines])
    truth = read_ground_truth(folder / truth_name)
    time = (truth.stamp_ns - truth.stamp_ns[0]) / 1e9
    place = np.array([pose.translation for pose in truth.poses])
    turns = Rotation.from_matrix([pose.rotation for pose in truth.poses])
    edges, states = [], []
    for k in range(10, len(time) - 210, 200):
        near = slice(k - 6, k + 7)
        fit = np.polynomial.polynomial.polyfit(time[near] - time[k], place[near], 3)
        states.append(BodyState(turns[k].as_matrix(), place[k], fit[1]))
        edges.append(truth.stamp_ns[k])
    return ImuSamples(stamps, table[:, 1:4], table[:, 4:7]), np.array(edges), states


def by_bias(window: Preintegrated, state: BodyState) -> np.ndarray:
    """(9, 6): the predicted state by the accelerometer's and the gyroscope's bias."""
    steps = 1e-4 * np.eye(6)
    moved = [window.predict(state, ImuBias(step[3:], step[:3])) for step in steps]
    return np.column_stack([error(end, window.predict(state)) for end in moved]) / 1e-4


def euroc_sigmas(imu: ImuSamples, edges: np.ndarray, states: list[BodyState]) -> np.ndarray:
    """(W, 9) errors in sigmas; each window's bias is found from its neighbours, never from itself."""
    integrator = Preintegrator(imu, EUROC_NOISE, 9.81)
    windows, errors, jacobians = [], [], []
    for k, state in enumerate(states[:-1]):
        window = integrator.between(int(edges[k]), int(edges[k + 1]), ImuBias.none())
        assert isinstance(window, Preintegrated)
        windows.append(window)
        errors.append(error(window.predict(state), states[k + 1]))
        jacobians.append(by_bias(window, state))
    ratios = []
    for k, window in enumerate(windows):
        near = [j for j in range(max(0, k - 4), min(len(windows), k + 5)) if j != k]
        roots = [np.linalg.inv(np.linalg.cholesky(windows[j].covariance)) for j in near]
        design = np.vstack([-root @ jacobians[j] for root, j in zip(roots, near, strict=True)])
        target = np.concatenate([root @ errors[j] for root, j in zip(roots, near, strict=True)])
        bias = np.linalg.lstsq(design, target, rcond=None)[0]
        again = integrator.between(window.start_ns, window.end_ns, ImuBias(bias[3:], bias[:3]))
        assert isinstance(again, Preintegrated)
        off = error(again.predict(states[k]), states[k + 1])
        ratios.append(off / np.sqrt(np.diag(again.covariance)))
    return np.array(ratios)


def test_one_second_of_turning_agrees_with_euroc(data: Path) -> None:
    """MH_03's true attitude is smooth; its true place jumps by centimetres and says nothing of velocity."""
    ratios = euroc_sigmas(*euroc(data, "MH03.txt", "MH_03_medium.txt"))
    assert len(ratios) > 40
    assert (np.abs(ratios[:, :3]) < 3).all(axis=1).mean() >= 0.97


def test_what_vicon_disagrees_by_comes_back(data: Path) -> None:
    """V2_01's true attitude wanders by milliradians within seconds, eight times what the gyro's noise does
    in one. It is truth that wanders: a gyro's error would go on growing, by 1.8 and more from 5 s to 16 s.
    """
    imu, edges, states = euroc(data, "V201.txt", "V2_01_easy.txt")
    integrator = Preintegrator(imu, EUROC_NOISE, 9.81)
    turns = np.array([state.rotation for state in states])
    bias = np.zeros(3)
    for _ in range(3):  # all but the first time without the mean error in body axes over the whole flight
        parts = [
            integrator.between(int(first), int(last), ImuBias(bias, np.zeros(3)))
            for first, last in pairwise(edges)
        ]
        steps = np.array([part.rotation for part in parts if isinstance(part, Preintegrated)])
        off = Rotation.from_matrix((turns[:-1] @ steps).transpose(0, 2, 1) @ turns[1:]).as_rotvec()
        bias = bias - off.mean(axis=0)
    chain = Rotation.from_matrix(turns[:1])
    for step in steps:
        chain = Rotation.concatenate([chain, chain[-1] * Rotation.from_matrix(step)])
    wander = (Rotation.from_matrix(turns) * chain.inv()).as_rotvec() * 1e3
    after = {n: np.sqrt(((wander[n:] - wander[:-n]) ** 2).mean()) for n in (1, 5, 16)}
    assert 1.0 < after[1] < 2.0
    assert after[16] < 1.25 * after[5]
