"""The pose spline and the arrow system against slow references: finite differences and dense algebra."""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from barsight.calibration.camera_imu.arrowhead_system import (
    LOCAL,
    ROWS,
    RandomWalks,
    Samples,
    apply_jacobian,
    assemble,
    eliminate,
    gradient_of,
    project_out_chain,
    step,
)
from barsight.calibration.camera_imu.pose_spline import STATE, PoseSpline, inverse_right_jacobian, locate
from barsight.calibration.camera_imu.problem import LOWER, tangent_basis
from barsight.calibration.camera_imu.residual_kernels import (
    InertialReadings,
    frame_rows,
    imu_rows,
    sum_corners,
)
from barsight.calibration.camera_imu.spline_kernels import (
    BLENDING,
    CUMULATIVE,
    DEGREE,
    ORDER,
    exp_so3,
    motion_at,
    place_at,
    rotation_at,
    weights,
)

STEP_S = 0.1


def some_spline(seed: int = 0, count: int = 9) -> PoseSpline:
    rng = np.random.default_rng(seed)
    rotations = [np.eye(3)]
    for turn in rng.normal(0, 0.4, (count - 1, 3)):
        rotations.append(rotations[-1] @ Rotation.from_rotvec(turn).as_matrix())
    biases = rng.normal(size=(2, count, 3))
    return PoseSpline(0, STEP_S, np.array(rotations), rng.normal(size=(count, 3)), biases[0], biases[1])


def test_places_are_a_uniform_b_spline() -> None:
    spline = some_spline()
    times = np.linspace(0, spline.segments * STEP_S, 23)[:-1]
    knots = (np.arange(len(spline.places_m) + ORDER) - DEGREE) * STEP_S
    reference = BSpline(knots, spline.places_m, DEGREE)
    motion = spline.at(times)
    np.testing.assert_allclose(motion.place_m, reference(times), atol=1e-12)
    np.testing.assert_allclose(motion.velocity_mps, reference(times, 1), atol=1e-10)
    np.testing.assert_allclose(motion.acceleration_mps2, reference(times, 2), atol=1e-9)


def test_rate_is_the_rotations_derivative() -> None:
    spline, times, e = some_spline(), np.array([0.13, 0.2, 0.333]), 1e-5
    before, after = spline.at(times - e).rotation, spline.at(times + e).rotation
    slope = Rotation.from_matrix(before.transpose(0, 2, 1) @ after).as_rotvec() / (2 * e)
    np.testing.assert_allclose(spline.at(times).rate_radps, slope, atol=1e-6)


def test_jacobians_match_finite_differences() -> None:
    spline, times, e = some_spline(), np.array([0.0, 0.13, 0.333]), 1e-6
    points = spline.control_points()
    for segment, u, time in zip(*locate(times, STEP_S, spline.segments), times, strict=True):
        turn_by, rate_by = np.empty((2, 3, 3 * ORDER))
        motion_at(
            points, segment, u, *np.empty((2, 3, ORDER)), np.empty((3, 3)), np.empty(3), turn_by, rate_by,
            np.empty((3, 3)),
        )  # fmt: skip
        for column in range(3 * ORDER):
            change = np.zeros((len(spline.places_m), STATE))
            change[segment + column // 3, column % 3] = e
            there, here = (spline.moved(sign * change).at(np.array([time])) for sign in (1, -1))
            turn = Rotation.from_matrix(here.rotation[0].T @ there.rotation[0]).as_rotvec() / (2 * e)
            np.testing.assert_allclose(turn_by[:, column], turn, atol=1e-8)
            slope = (there.rate_radps - here.rate_radps)[0] / (2 * e)
            np.testing.assert_allclose(rate_by[:, column], slope, atol=1e-7)


def differences(error: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """(..., size): central differences at zero."""
    return np.stack([(error(e) - error(-e)) / 2e-6 for e in 1e-6 * np.eye(size)], axis=-1)


def test_rows_of_imu_readings_are_their_errors_and_slopes() -> None:
    rng, times = np.random.default_rng(2), np.array([0.0, 0.13, 0.333])
    spline, gravity = some_spline(), np.array([0.3, -0.2, -9.8])
    gyro, accel, sigmas = *rng.normal(size=(2, 3, 3)), rng.uniform(0.5, 2, (2, 3))
    matrices = np.eye(3) + rng.normal(0, 0.1, (2, 3, 3))
    chain, width, at = spline.places_m.size // 3 * STATE, 20, 2

    def errors(step: np.ndarray) -> np.ndarray:
        motion, common = spline.moved(step[:chain].reshape(-1, STATE)).at(times), step[chain + at :]
        down = Rotation.from_rotvec(tangent_basis(gravity) @ common[:2]).as_matrix() @ gravity
        by_accel = matrices[1].copy()
        by_accel[tuple(np.transpose(LOWER))] += common[2:8]
        by_gyro = matrices[0] + common[8:17].reshape(3, 3)
        force = np.einsum("nji,nj->ni", motion.rotation, motion.acceleration_mps2 - down)
        rate = gyro - motion.rate_radps @ by_gyro.T - motion.gyro_bias_radps
        return np.hstack([
            rate / sigmas[0, :, None],
            (accel - force @ by_accel.T - motion.accel_bias_mps2) / sigmas[1, :, None],
        ])  # fmt: skip

    segment, u = locate(times, STEP_S, spline.segments)
    rows = imu_rows(
        segment, u, spline.control_points(),
        InertialReadings(gyro, spline.gyro_bias_radps, matrices[0], sigmas[0]),
        InertialReadings(accel, spline.accel_bias_mps2, matrices[1], sigmas[1]), gravity,
        tangent_basis(gravity), at, True, width,
    )  # fmt: skip
    first, residual, by_chain, by_common = rows
    np.testing.assert_array_equal(first, segment)
    np.testing.assert_allclose(residual, errors(np.zeros(chain + width)), rtol=1e-10)
    slopes = -differences(errors, chain + width)
    np.testing.assert_allclose(by_common, slopes[:, :, chain:], atol=1e-6)
    for k, begin in enumerate(STATE * segment):
        np.testing.assert_allclose(by_chain[k], slopes[k, :, begin : begin + LOCAL], atol=2e-5)


def test_rows_of_frames_hold_what_the_corners_say() -> None:
    """The rows' normal equations are the corners' own, by differences of points fixed in the world."""
    rng, times = np.random.default_rng(5), np.array([0.07, 0.333])
    spline, chain, lens, at, width = some_spline(), 9 * STATE, 2, 1, 11
    mount, place = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)
    frame, count = np.repeat([0, 1], 8), 16

    def corners(step: np.ndarray) -> np.ndarray:
        common = step[chain + at :]
        motion = spline.moved(step[:chain].reshape(-1, STATE)).at(times + common[6])
        there = Rotation.from_rotvec(common[:3]).as_matrix() @ mount
        body = np.einsum("nji,nj->ni", motion.rotation[frame], fixed - motion.place_m[frame])
        return (body - place - common[3:6]) @ there

    here = spline.at(times)
    start = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3))
    fixed = np.einsum("nij,nj->ni", here.rotation[frame], start @ mount.T + place) + here.place_m[frame]
    by_point, by_lens = rng.normal(size=(count, 2, 3)), rng.normal(size=(count, 2, lens))
    residual, weight = rng.normal(size=(count, 2)), rng.uniform(0.5, 2, count)
    whole, pull = sum_corners(frame, start, by_point, by_lens, residual, weight, 2)
    segment, u = locate(times, STEP_S, spline.segments)
    first, said, by_chain, by_common = frame_rows(
        segment, u, spline.control_points(), whole, pull, mount, place, at, 8 + at, width
    )
    moves = by_point @ differences(corners, chain + width)
    moves[:, :, chain + 8 + at : chain + 8 + at + lens] = by_lens
    for k, begin in enumerate(STATE * segment):
        own, mine = first == segment[k], frame == k
        found = np.dstack([by_chain[own], by_common[own]]).reshape(-1, LOCAL + width)
        columns = np.append(np.arange(begin, begin + LOCAL), np.arange(chain, chain + width))
        wanted = (np.sqrt(weight[mine, None, None]) * moves[mine]).reshape(-1, chain + width)
        np.testing.assert_allclose(wanted[:, : STATE * segment[k]], 0, atol=1e-7)
        wanted = wanted[:, columns]
        off = (np.sqrt(weight[mine, None]) * residual[mine]).ravel()
        scale = np.abs(wanted.T @ wanted).max()
        np.testing.assert_allclose(found.T @ found / scale, wanted.T @ wanted / scale, atol=1e-8)
        np.testing.assert_allclose(found.T @ said[own].ravel(), wanted.T @ off, atol=1e-5)


def test_the_inverse_jacobian_holds_for_tiny_and_large_turns() -> None:
    for size in (0.0, 1e-7, 1e-3, 1.0, 3.0):
        turn = np.array([0.6, -0.64, 0.48]) * size
        change = np.array([1e-6, 2e-6, -1e-6])
        moved = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(change)).as_rotvec()
        np.testing.assert_allclose(inverse_right_jacobian(turn[None])[0] @ change, moved - turn, atol=1e-11)


def test_the_arrow_system_is_the_dense_one() -> None:
    rng = np.random.default_rng(3)
    points, width, count = 12, 4, 60
    samples = Samples(
        rng.integers(0, points - DEGREE, count), rng.normal(size=(count, ROWS)),
        rng.normal(size=(count, ROWS, LOCAL)), rng.normal(size=(count, ROWS, width)),
    )  # fmt: skip
    walks = RandomWalks(rng.normal(size=(points - 1, 6)), np.full(6, 0.5))
    size = points * STATE
    rows = np.zeros((count, ROWS, size + width))
    for k, first in enumerate(samples.first):
        rows[k, :, first * STATE : first * STATE + LOCAL] = samples.by_chain[k]
    rows[:, :, size:] = samples.by_common
    dense = [rows.reshape(-1, size + width)]
    right = [samples.residual.ravel()]
    for m in range(points - 1):
        for axis in range(6):
            row = np.zeros(size + width)
            row[m * STATE + 6 + axis], row[(m + 1) * STATE + 6 + axis] = -2.0, 2.0
            dense.append(row[None])
            right.append(np.array([-2.0 * walks.difference[m, axis]]))
    a, b = np.vstack(dense), np.concatenate(right)
    system = assemble(samples, walks, points)
    eliminated = eliminate(system)
    chain, common = step(system, eliminated)
    best = np.linalg.solve(a.T @ a, a.T @ b)
    np.testing.assert_allclose(np.concatenate([chain, common]), best, atol=1e-7)
    covariance = np.linalg.inv(a.T @ a)[size:, size:]
    np.testing.assert_allclose(np.linalg.inv(eliminated.information), covariance, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(apply_jacobian(samples, chain, common), rows @ best, atol=1e-6)
    gradient = np.concatenate(gradient_of(samples, samples.residual, size))
    np.testing.assert_allclose(gradient, np.einsum("krc,kr->c", rows, samples.residual), atol=1e-9)
    through = rows[:, :, :size] @ eliminated.through
    np.testing.assert_allclose(
        project_out_chain(samples, eliminated.through), samples.by_common - through, atol=1e-9
    )


def test_weights_are_the_basis_and_its_slopes_by_time() -> None:
    basis = BSpline((np.arange(2 * ORDER) - DEGREE) * STEP_S, np.eye(ORDER), DEGREE)
    found, moved = np.empty((3, ORDER)), np.empty((3, 3))
    places = np.random.default_rng(4).normal(size=(ORDER, 3))
    for u in (0.0, 0.37, 0.99):
        weights(u, STEP_S, BLENDING, found)
        wanted = np.array([basis(u * STEP_S, order) for order in range(3)])
        np.testing.assert_allclose(found, wanted, atol=1e-9)
        place_at(places, found, moved)
        np.testing.assert_allclose(moved, wanted @ places, atol=1e-8)


def test_turns_and_their_jacobian_are_the_matrix_exponentials() -> None:
    rotation, right = np.empty((3, 3)), np.empty((3, 3))
    for size in (0.0, 1e-7, 2e-5, 0.3, 3.0):
        v = size / 0.7 * np.array([0.6, -0.64, 0.48])
        exp_so3(v, 0.7, rotation, right)
        cross = np.cross(np.eye(3), 0.7 * v)
        np.testing.assert_allclose(rotation, expm(cross), atol=1e-12)
        # The integral of Exp(-s w) over s in 0...1 stands beside the exponential of a block matrix.
        whole = expm(np.block([[-cross, np.eye(3)], [np.zeros((3, 6))]]))
        np.testing.assert_allclose(right, whole[:3, 3:], atol=1e-9)


def slow_rotation(rotations: np.ndarray, u: float) -> Rotation:
    """[Kim 1995] as it stands: R_0 Exp(l_1 d_1) ... Exp(l_5 d_5)."""
    basis = BSpline(np.arange(2 * ORDER) - DEGREE, np.eye(ORDER), DEGREE)(u)
    turned = Rotation.from_matrix(rotations[0])
    for j in range(1, ORDER):
        step = Rotation.from_matrix(rotations[j - 1].T @ rotations[j]).as_rotvec()
        turned = turned * Rotation.from_rotvec(basis[j:].sum() * step)
    return turned


def slow_rate(rotations: np.ndarray, u: float, e: float = 1e-4) -> np.ndarray:
    before, after = slow_rotation(rotations, u - e), slow_rotation(rotations, u + e)
    return (before.inv() * after).as_rotvec() / (2 * e * STEP_S)


def test_a_segments_rotation_and_its_slopes_are_those_of_its_definition() -> None:
    rotations, e = some_spline().rotations[:ORDER], 1e-5
    steps = Rotation.from_matrix(rotations[:-1].transpose(0, 2, 1) @ rotations[1:]).as_rotvec()
    inverse, unused = np.empty((DEGREE, 3, 3)), np.empty((3, 3))
    for turn, own in zip(steps, inverse, strict=True):
        exp_so3(turn, 1.0, unused, own)
        own[:] = np.linalg.inv(own)
    share, rotation, rate = np.empty((3, ORDER)), np.empty((3, 3)), np.empty(3)
    turn_by, rate_by = np.empty((3, 3 * ORDER)), np.empty((3, 3 * ORDER))
    for u in (0.2, 0.6):
        weights(u, STEP_S, CUMULATIVE, share)
        rotation_at(rotations[0], steps, inverse, share, rotation, rate, turn_by, rate_by)
        np.testing.assert_allclose(rotation, slow_rotation(rotations, u).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(rate, slow_rate(rotations, u), atol=1e-5)
        for k in range(3 * ORDER):
            moved = [rotations.copy(), rotations.copy()]
            for sign, own in zip((-1, 1), moved, strict=True):
                own[k // 3] = own[k // 3] @ Rotation.from_rotvec(sign * e * np.eye(3)[k % 3]).as_matrix()
            less, more = (slow_rotation(own, u) for own in moved)
            np.testing.assert_allclose(turn_by[:, k], (less.inv() * more).as_rotvec() / (2 * e), atol=1e-8)
            slope = (slow_rate(moved[1], u) - slow_rate(moved[0], u)) / (2 * e)
            np.testing.assert_allclose(rate_by[:, k], slope, atol=2e-5)
