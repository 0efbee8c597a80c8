"""The solver: band matrices against dense ones, points taken out against GTSAM's own factor per sighting."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, L, X
from scipy.spatial.transform import Rotation

from barsight.core.linalg import skyline
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.sensor_samples import EncoderJump
from barsight.features.guided_matching import project_stereo
from barsight.inertial.model import ImuBias
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.linear.chain_elimination import (
    Chain,
    add_chain,
    add_products,
    back_substitute_nodes,
    eliminate_nodes,
)
from barsight.motion.linear.motion_only_kernel import frame_equations
from barsight.motion.linear.reprojection_kernels import (
    PLACE,
    POINT,
    POSE,
    SHARED,
    LinearisationPoint,
    Observations,
    PointTerms,
    Rig,
    disparity_offset,
    empty_rows,
    given_of,
    residuals,
    slide_offset,
    whitened_rows,
)
from barsight.motion.linear.schur_complement import (
    ReducedSystem,
    back_substitute,
    eliminate_points,
    scatter_reduced,
)
from barsight.motion.problem.encoder_factors import with_unevenness
from barsight.motion.problem.gauss_newton import (
    GraphState,
    cost_of,
    linearisation_point,
    observations_of,
    optimise_graph,
    retract,
    rig_of,
)
from barsight.motion.problem.gtsam_factors import build_graph, initial_values
from barsight.motion.problem.marginals import marginals, slide_variances
from barsight.motion.problem.problem import (
    AttitudePrior,
    EncoderPosition,
    Pieces,
    Problem,
    StereoObservations,
)
from barsight.motion.problem.rig_drift import HUBER_SIGMAS
from barsight.motion.problem.stereo_factors import initial_points, well_observed

CAMERA = RectifiedCamera(600.0, 320.0, 240.0, 0.3, 4.0, 640, 480)
MOUNT = Pose("body", "rect0", Rotation.from_rotvec([0.1, -0.3, 1.5]).as_matrix(), np.array([0.1, -0.2, 0.3]))

UNEVEN_M = np.array([0.0005, 0.001, 0.002])


def banded(rng: np.random.Generator, n: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    lower = np.tril(rng.normal(size=(n, n))) * (np.subtract.outer(np.arange(n), np.arange(n)) < width)
    matrix = lower @ lower.T + np.eye(n)
    matrix *= np.abs(np.subtract.outer(np.arange(n), np.arange(n))) < width
    matrix += np.diag(np.abs(matrix).sum(axis=1))
    rows = np.zeros((n, width))
    for i in range(n):
        for j in range(max(0, i - width + 1), i + 1):
            rows[i, width - 1 - (i - j)] = matrix[i, j]
    return matrix, rows


@pytest.mark.parametrize(("n", "width"), [(12, 3), (30, 12), (6, 6), (12, 12)])
def test_a_band_is_solved_like_a_dense_matrix(n: int, width: int) -> None:
    rng = np.random.default_rng(n)
    matrix, rows = banded(rng, n, width)
    right = rng.normal(size=(2, n))
    expected = np.linalg.solve(matrix, right.T).T
    factor = skyline.uniform_band(rows)
    assert skyline.factorise_skyline(factor)
    beside = right.T.copy()
    skyline.solve_forward(factor, beside)
    skyline.solve_back_dense(factor, beside)
    right = beside.T
    np.testing.assert_allclose(right, expected, rtol=1e-9, atol=1e-12)
    blocks = np.empty((n // 3, 3, 3))
    pairs = np.array([[k, k + 1] for k in range(n // 3 - 1)], np.int64).reshape(-1, 2)
    cross, diagonal = np.empty((len(pairs), 3, 3)), np.empty(n)
    skyline.inverse_blocks(factor, np.arange(0, n, 3), diagonal, blocks, pairs, cross)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(diagonal, np.diag(inverse), rtol=1e-8)
    for k, block in enumerate(cross):
        whole = inverse[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6]
        near = np.subtract.outer(np.arange(3), np.arange(3, 6)) > -width
        np.testing.assert_allclose(block[near], whole[near], rtol=1e-8, atol=1e-12)
        assert np.isnan(block[~near]).all()
    for k, block in enumerate(blocks):
        np.testing.assert_allclose(
            block, inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-8, atol=1e-12
        )


def test_an_undetermined_band_is_told() -> None:
    rows = np.array([[0.0, 1.0], [1.0, 1.0]])
    assert not skyline.factorise_skyline(skyline.uniform_band(rows))


def test_rows_that_begin_late_are_solved_like_a_dense_matrix() -> None:
    """Rows of all lengths; the inverse's diagonal too."""
    rng, n = np.random.default_rng(5), 40
    first = np.array([rng.integers(max(0, i - 17), i + 1) for i in range(n)])
    held = np.arange(n) >= first[:, None]
    matrix = np.where(held, np.tril(rng.normal(size=(n, n)), -1), 0)
    matrix = matrix + matrix.T
    matrix += np.diag(np.abs(matrix).sum(axis=1) + 0.5)
    factor = skyline.empty_skyline(first)
    for i in range(n):
        factor.values[factor.offset[i] + np.arange(first[i], i + 1)] = matrix[i, first[i] : i + 1]
    right = rng.normal(size=(n, 2))
    expected = np.linalg.solve(matrix, right)
    assert skyline.factorise_skyline(factor)
    skyline.solve_forward(factor, right)
    skyline.solve_back_dense(factor, right)
    np.testing.assert_allclose(right, expected, rtol=1e-9, atol=1e-12)
    diagonal, none = np.empty(n), np.empty((0, 1, 1))
    skyline.inverse_blocks(factor, np.empty(0, np.int64), diagonal, none, np.empty((0, 2), np.int64), none)
    np.testing.assert_allclose(diagonal, np.diag(np.linalg.inv(matrix)), rtol=1e-9)


def test_nodes_between_frames_are_taken_out() -> None:
    """A chain of seven nodes of which three are kept, against the whole one solved."""
    rng, size, count = np.random.default_rng(3), 3, 7
    matrix, _ = banded(rng, size * count, size + 1)
    blocks = matrix.reshape(count, size, count, size)
    own = np.array([blocks[k, :, k] for k in range(count)])
    link = np.array([blocks[k, :, max(k - 1, 0)] for k in range(count)])
    link[0] = 0
    gradient, side = rng.normal(size=size * count), rng.normal(size=(size * count, 2))
    kept, shared = np.array([1, 2, 5]), np.array([0.7, -0.2])
    corner, pull = np.array([[9.0, 1.0], [1.0, 7.0]]), np.array([0.5, -0.4])
    chain = Chain(own, link, gradient.reshape(count, size), side.reshape(count, size, 2), corner, pull)
    left, gaps = eliminate_nodes(chain, kept)
    band = skyline.full(np.zeros((9, 9)))
    add_chain(left, np.arange(0, 9, 3), band)
    small = np.tril(band.values.reshape(9, 9))
    small += np.tril(small, -1).T
    left_gradient, left_side = left.gradient.ravel(), left.side.reshape(-1, 2)
    step = -np.linalg.solve(small, left_gradient + left_side @ shared)
    found = back_substitute_nodes(step.reshape(3, 3), shared, kept, gaps, count)
    np.testing.assert_allclose(found.ravel(), -np.linalg.solve(matrix, gradient + side @ shared), atol=1e-12)
    whole = np.linalg.solve(matrix, np.column_stack([side, gradient]))
    rest = np.linalg.solve(small, np.column_stack([left_side, left_gradient]))
    np.testing.assert_allclose(left.corner - left_side.T @ rest[:, :2], corner - side.T @ whole[:, :2])
    np.testing.assert_allclose(left.corner_gradient - left_side.T @ rest[:, 2], pull - side.T @ whole[:, 2])


def test_sparse_rows_are_added_to_a_chain() -> None:
    """Four nodes of two unknowns; each row binds two neighbours and two of the encoders' unknowns."""
    rng = np.random.default_rng(8)
    dense = np.zeros((15, 10))
    for r, row in enumerate(dense):
        row[2 * (r % 3) : 2 * (r % 3) + 4], row[8:] = rng.normal(size=4), rng.normal(size=2)
    row, at = np.nonzero(dense)
    right = rng.normal(size=15)
    chain = Chain.empty(4, 2, 2)
    add_products(np.searchsorted(row, np.arange(16)), at, dense[row, at], right, chain)
    matrix, gradient = dense.T @ dense, -dense.T @ right
    for k in range(4):
        own = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(chain.own[k], matrix[own, own])
        np.testing.assert_allclose(chain.link[k], matrix[own, 2 * k - 2 : 2 * k] if k else np.zeros((2, 2)))
    np.testing.assert_allclose(chain.gradient.ravel(), gradient[:8])
    np.testing.assert_allclose(chain.side.reshape(8, 2), matrix[:8, 8:])
    np.testing.assert_allclose(chain.corner, matrix[8:, 8:])
    np.testing.assert_allclose(chain.corner_gradient, gradient[8:])


def seen_from(count: int, seed: int, with_crane: bool, wrong_px: float) -> tuple[Problem, np.ndarray]:
    """A camera that moves past points, some of them wrong, started a little off."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-3, 6, 120), rng.uniform(-2, 2, 120), rng.uniform(4, 7, 120)])
    sightings, poses, places = [], [], []
    for k in range(count):
        turn = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        rect0 = Pose("yard", "rect0", turn, np.array([0.4 * k, 0, 0]) + rng.normal(0, 0.05, 3))
        stereo = project_stereo(rect0.inverse().apply(points), CAMERA)
        shown = (stereo[:, [0, 2]] > 0).all(1) & (stereo[:, [0, 2]] < 640).all(1)
        shown &= (stereo[:, 1] > 0) & (stereo[:, 1] < 480)
        noisy = stereo[shown] + rng.normal(0, 0.2, (shown.sum(), 3))
        noisy[::15] += rng.normal(0, wrong_px, (len(noisy[::15]), 3))
        sigma = rng.uniform(0.1, 0.3, len(noisy))
        sightings.append(Sighting(k, np.flatnonzero(shown), noisy, sigma, None, 0))
        off = Pose(
            "body", "body", Rotation.from_rotvec(rng.normal(0, 2e-3, 3)).as_matrix(), rng.normal(0, 0.01, 3)
        )
        poses.append(rect0 @ MOUNT.inverse() @ off)
        places.append((rect0 @ MOUNT.inverse()).translation + rng.normal(0, 0.0005, 3))
    seen = StereoObservations.of(sightings, range(count), CAMERA, MOUNT)
    stamps = np.arange(count) * 500_000_000
    placed, attitudes, jumps = (), (), ()
    if with_crane:
        jumps = EncoderJump(stamps[5], 0, 0.0, 1.0), EncoderJump(stamps[3], 1, 0.0, 0.02)
        places = [place + np.array([0.03 * (k >= 5), 0.02 * (k >= 3), 0]) for k, place in enumerate(places)]
        v, a = np.array([0.8, 0, 0]), np.array([0.3, 0.1, 0])
        places[2] += 0.01 * (wrong_px > 0)  # beyond Huber's length
        placed = tuple(EncoderPosition(k, place, v * (k % 3 - 1), a, 0.002) for k, place in enumerate(places))
        attitudes = tuple(
            AttitudePrior(k, poses[k].rotation, np.full(3, 0.003), k % 2 == 0) for k in range(count)
        )
    problem = Problem(
        tuple(poses), stamps, not with_crane, seen, (None,) * (count - 1), placed, attitudes, (),
        ImuBias.none(), has_latency=with_crane, jumps=jumps, uneven_m=UNEVEN_M,
    )  # fmt: skip
    return problem, well_observed(seen, np.ones(len(seen.node), np.bool_))


def encoder_error(
    place: EncoderPosition, share: np.ndarray
) -> Callable[[Any, gtsam.Values, list[np.ndarray] | None], np.ndarray]:
    """The body's place minus the encoders' reading `latency` later without its jumps, of which bridge and
    trolley have a share (2,), and its derivatives."""

    def error(factor: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        pose, (latency, *jumped) = values.atPose3(factor.keys()[0]), values.atVector(factor.keys()[1])[:3]
        by_jumps = np.diag([*share, 1.0])[:, :2]
        if jacobians is not None:
            jacobians[0] = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
            speed = place.velocity_mps + place.acceleration_mps2 * latency
            jacobians[1] = np.column_stack([-speed, by_jumps, np.zeros((3, 3))])
        way = place.velocity_mps * latency + place.acceleration_mps2 * latency**2 / 2
        return pose.translation() - place.position_m - way + by_jumps @ jumped

    return error


def attitude_error(
    attitude: AttitudePrior,
) -> Callable[[Any, gtsam.Values, list[np.ndarray] | None], np.ndarray]:
    """The body's turn from its nominal attitude, under way less the mounting's error, and derivatives."""

    def error(factor: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        pose, mounting = values.atPose3(factor.keys()[0]), values.atVector(factor.keys()[1])[-3:]
        if jacobians is not None:
            jacobians[0] = np.eye(3, 6)
            jacobians[1] = np.hstack([np.zeros((3, 3)), -attitude.sways * np.eye(3)])
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(attitude.rotation).between(pose.rotation()))
        return np.asarray(turn - attitude.sways * mounting)

    return error


def by_gtsam(problem: Problem, used: np.ndarray) -> tuple[gtsam.Values, gtsam.Marginals]:
    """The slow way: a factor and its objects for every sighting and every place of the encoders."""
    seen, graph, values = problem.sightings, build_graph(problem), initial_values(problem)
    assert seen is not None
    lens = gtsam.Cal3_S2Stereo(
        CAMERA.focal_px, CAMERA.focal_px, 0.0, CAMERA.cx_px, CAMERA.cy_px, CAMERA.baseline_m
    )
    mounted = gtsam.Pose3(gtsam.Rot3(MOUNT.rotation), MOUNT.translation)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS)
    points = initial_points(problem)
    for place in problem.placed:
        near = [np.linalg.norm(place.position_m - other.position_m) < 0.5 for other in problem.placed]
        sigma = np.sqrt(place.sigma_m**2 + sum(near) * UNEVEN_M**2)
        model = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(sigma))
        share = np.array([float(place.node >= 5), float(place.node >= 3)])
        graph.add(gtsam.CustomFactor(model, [X(place.node), E(0)], encoder_error(place, share)))
    for attitude in problem.attitudes:
        model = gtsam.noiseModel.Diagonal.Sigmas(attitude.sigma_rad)
        graph.add(gtsam.CustomFactor(model, [X(attitude.node), E(0)], attitude_error(attitude)))
    for k in np.flatnonzero(used):
        model = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(3, seen.sigma_px[k]))
        u, v, right = seen.stereo[k]
        pixel = gtsam.StereoPoint2(u, right - CAMERA.doffs_px, v)
        node, track = X(int(seen.node[k])), L(int(seen.track[k]))
        graph.add(gtsam.GenericStereoFactor3D(pixel, model, node, track, lens, mounted))
        if not values.exists(track):
            values.insert(track, points[seen.track[k], :3])
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return values, gtsam.Marginals(graph, values)


@pytest.mark.parametrize("with_crane", [False, True])
def test_points_taken_out_give_what_gtsam_gives(with_crane: bool) -> None:
    problem, used = seen_from(8, 1, with_crane, 2.0)
    expected, covariance = by_gtsam(problem, used)
    graph = build_graph(problem)
    state = GraphState(initial_values(problem), initial_points(problem), np.zeros(2))
    for _ in range(10):
        state, system = optimise_graph(problem, graph, state, used)
    found = marginals(system)
    for k in range(8):
        off = expected.atPose3(X(k)).localCoordinates(state.values.atPose3(X(k)))
        sigma = np.sqrt(np.diag(covariance.marginalCovariance(X(k))))
        assert (np.abs(off) < 0.01 * sigma + 1e-9).all()
        np.testing.assert_allclose(np.sqrt(np.diag(found.poses[k])), sigma, rtol=0.01)
    if with_crane:
        sigma = np.sqrt(np.diag(covariance.marginalCovariance(E(0))))
        assert (np.abs(expected.atVector(E(0)) - state.values.atVector(E(0))) < 0.01 * sigma).all()
        np.testing.assert_allclose(found.encoder_sigmas, sigma, rtol=0.01)


def test_rails_that_wave_are_seen_in_the_places_and_noise_alone_is_not() -> None:
    problem, _ = seen_from(40, 1, True, 0.0)
    values, rng = initial_values(problem), np.random.default_rng(3)
    way = np.linspace(0, 12, 40)
    wave = 0.004 * np.sin(2 * np.pi * way / 4)
    off = rng.normal(0, 0.001, (40, 3)) + wave[:, None] * [0, 0, 1]
    start = np.column_stack([way, np.zeros((40, 2))])
    for k, place in enumerate(start):
        values.update(X(k), gtsam.Pose3(gtsam.Rot3(), place))
    still = np.zeros(3)
    placed = tuple(EncoderPosition(k, place, still, still, 0.001) for k, place in enumerate(start + off))
    uneven = with_unevenness(replace(problem, placed=placed, jumps=()), values).uneven_m
    assert (uneven[:2] < 0.0008).all()
    assert uneven[2] == pytest.approx(0.004 / 2**0.5, rel=0.2)
    leap = np.array([0, 0, 0.5])
    wild = tuple(replace(p, position_m=p.position_m + leap * (p.node % 2)) for p in placed)
    assert with_unevenness(replace(problem, placed=wild, jumps=()), values).uneven_m[2] < 0.006


def moved_by(step: np.ndarray) -> np.ndarray:
    """A small turn and shift as a matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    return matrix


def scattered(result: ReducedSystem, poses: int, pieces: int) -> tuple[np.ndarray, ...]:
    """Scatter a reduced system into dense arrays: matrix (lower), gradient, shared rows, corner, right."""
    n = poses + 2 * pieces
    dense = np.zeros((n, n)), np.zeros(n), np.zeros((2, n)), np.zeros((2, 2)), np.zeros(2)
    at = np.arange(0, poses, 6), poses + 2 * np.arange(pieces)
    scatter_reduced(result, *at, skyline.full(dense[0]), *dense[1:])
    return dense


@pytest.mark.parametrize("pieces", [0, 2])
def test_points_are_taken_out_of_the_dense_equations(pieces: int) -> None:
    """Central differences of all errors make the dense equations. One point is used nowhere; with pieces,
    points slide. What is shared is small: the derivatives by place and pose leave it out."""
    rng, nodes, count, size = np.random.default_rng(4), 4, 9, 4 if pieces else 3
    seen = [np.sort(rng.choice(nodes, rng.integers(2, nodes + 1), replace=False)) for _ in range(count)]
    first, node = np.cumsum([0] + [len(n) for n in seen]), np.concatenate(seen)
    used = np.ones(len(node), bool)
    used[first[3] : first[4]], used[first[5]] = False, False
    piece = np.arange(count) % max(pieces, 1)
    points = np.column_stack([rng.uniform(-1, 2, count), rng.uniform(-1, 1, count), rng.uniform(4, 7, count)])
    points = np.column_stack([points, rng.normal(0, 1e-5, count) * (pieces > 0)])
    shared = rng.normal(0, 1e-5, 2 * pieces + 2)
    cameras = np.array([moved_by(np.append(rng.normal(0, 0.05, 3), [-0.3 * k, 0, 0])) for k in range(nodes)])
    mount = moved_by(np.array([0.1, -0.3, 1.5, 0.1, -0.2, 0.3]))
    rig = Rig(np.array([600.0, 320, 240, 180, 4]), mount[:3].copy(), 1e9)
    weight, tight = rng.uniform(2, 5, len(node)), rng.uniform(300, 900, count)
    poses, places = 6 * nodes, 6 * nodes + size * count

    def errors(step: np.ndarray, stereo: np.ndarray) -> np.ndarray:
        turns = (np.linalg.inv(moved_by(s) @ mount) @ mount for s in step[:poses].reshape(nodes, 6))
        there, common = points.copy(), shared + step[places:]
        there[:, :size] += step[poses:places].reshape(count, size)
        camera = np.array([turn @ old for turn, old in zip(turns, cameras, strict=True)])[:, :3].copy()
        observations = Observations(first, node, used, stereo, weight, piece, tight, 1.0)
        off = np.zeros((len(node), 3))
        residuals(rig, observations, LinearisationPoint(camera, there, common), off)
        held = tight * (there[:, 3] - common[piece]) if pieces else np.zeros(count)
        held[3] = 0
        return np.append((-off * weight[:, None] * used[:, None]).ravel(), held)

    none = np.zeros(places + len(shared))
    blank = errors(none, np.zeros((len(node), 3)))[: 3 * len(node)].reshape(-1, 3) / weight[:, None]
    stereo = blank + rng.normal(0, 0.3, blank.shape)
    eye = 1e-6 * np.eye(len(none))
    jacobian = np.stack([(errors(e, stereo) - errors(-e, stereo)) / 2e-6 for e in eye], axis=1)
    normal, right = jacobian.T @ jacobian, jacobian.T @ errors(none, stereo)
    points_at = np.delete(np.arange(poses, places), np.arange(3 * size, 4 * size))
    # As scattered: poses, each piece's slide and disparity, then yaw and drift.
    mixed = places + np.append(np.arange(2 * pieces).reshape(2, pieces).T, [2 * pieces, 2 * pieces + 1])
    kept = np.append(np.arange(poses), mixed.astype(int))
    own, bound = normal[np.ix_(points_at, points_at)], normal[np.ix_(points_at, kept)]
    reduced = normal[np.ix_(kept, kept)] - bound.T @ np.linalg.solve(own, bound)
    slope = right[kept] - bound.T @ np.linalg.solve(own, right[points_at])

    observations = Observations(first, node, used, stereo, weight, piece, tight, 1.0)
    guess = LinearisationPoint(cameras[:, :3].copy(), points, shared)
    within = np.tile([0, nodes - 1], (pieces, 1))
    result = ReducedSystem.empty(nodes, nodes, within)
    eliminate_points(rig, observations, guess, result)
    whole, gradient, side, corner, pull = scattered(result, poses, pieces)
    scale = np.sqrt(np.diag(normal)[kept])
    found = np.block([[np.tril(whole) + np.tril(whole, -1).T, side.T], [side, corner]])
    np.testing.assert_allclose(found / np.outer(scale, scale), reduced / np.outer(scale, scale), atol=1e-5)
    np.testing.assert_allclose(np.append(gradient, pull) / scale, slope / scale, atol=5e-5)

    step = rng.normal(0, 1e-3, len(none))
    moved, variance = points.copy(), np.full(count, np.nan)
    back_substitute(rig, observations, guess, step[:poses].reshape(nodes, 6), step[places:], moved, variance)
    wanted = -np.linalg.solve(own, right[points_at] + bound @ step[kept])
    left = np.arange(count) != 3
    np.testing.assert_allclose((moved - points)[left, :size].ravel(), wanted, atol=5e-6)
    np.testing.assert_array_equal(moved[3], points[3])
    inverse = np.diag(np.linalg.inv(own))[size - 1 :: size]
    np.testing.assert_allclose(variance[left], inverse, rtol=1e-4)
    assert np.isnan(variance[3])


def test_one_frames_equations_are_its_costs_slope() -> None:
    """Points known, some sightings wrong: the slope against small changes; and steps lead to its end."""
    problem, used = seen_from(4, 6, False, 2.0)
    seen, values = problem.sightings, initial_values(problem)
    assert seen is not None
    rig, observations = rig_of(seen), observations_of(problem, used)
    state = GraphState(values, initial_points(problem), np.zeros(2))

    def moved(step: np.ndarray) -> GraphState:
        there = gtsam.Values(state.values)
        there.update(X(2), there.atPose3(X(2)).retract(step))
        return replace(state, values=there)

    for _ in range(20):
        normal, gradient = np.zeros((6, 6)), np.zeros(6)
        frame_equations(rig, observations, linearisation_point(problem, state), 2, normal, gradient)
        slope = np.empty(6)
        for axis, by in enumerate(1e-7 * np.eye(6)):
            ends = [linearisation_point(problem, moved(side * by)) for side in (1, -1)]
            high, low = (residuals(rig, observations, end, np.zeros((len(used), 3))) for end in ends)
            slope[axis] = (high - low) / 2e-7
        np.testing.assert_allclose(gradient, slope, atol=1e-5 * np.sqrt(np.diag(normal)).max())
        state = moved(-np.linalg.solve(normal, gradient))
    assert gradient @ np.linalg.solve(normal, gradient) < 1e-8


def test_what_is_shared_costs_what_the_system_says() -> None:
    """Slides, disparities and the drift pulled at a little, all else but the drift following: they move, and
    the cost rises, as their variances have it."""
    problem, used = seen_from(6, 3, True, 0.0)
    assert problem.sightings is not None
    rng = np.random.default_rng(3)
    wide = replace(problem.sightings, sigma_px=6 * problem.sightings.sigma_px)  # none beyond Huber's length
    pieces = Pieces(rng.integers(0, 3, len(wide.first) - 1), np.array([2e-3, 3e-3, 4e-3]), 0.7, 0.2)
    problem = replace(problem, sightings=wide, pieces=pieces)
    graph = build_graph(problem)
    state = GraphState(initial_values(problem), initial_points(problem), np.zeros(2), np.zeros(6))
    for _ in range(6):
        state, system = optimise_graph(problem, graph, state, used)
    at, weights = system.layout.pieces, np.array([1 / 2e-3, 1 / 3e-3, 1 / 4e-3, 0.5, -1.0, 2.0])
    variances, of_sum = slide_variances(system, weights)

    def check(pulls: np.ndarray, variance: float) -> None:
        gradient = np.zeros_like(system.gradient)
        gradient[at] = pulls / np.sqrt(variance)
        pulled = replace(system, gradient=gradient, corner_gradient=np.zeros(problem.border))
        step = pulled.step(problem.free)
        np.testing.assert_allclose(step[1] @ pulls, -np.sqrt(variance), rtol=1e-6)
        costs = []
        for side in (0.0, 0.3, -0.3):
            there = retract(problem, state, used, *(side * part for part in step))
            costs.append(cost_of(problem, graph, there, used))
        np.testing.assert_allclose((costs[1] + costs[2] - 2 * costs[0]) / 0.3**2, 1.0, rtol=0.02)

    for axis in range(6):
        check(np.eye(6)[axis], variances[axis])
    check(weights, of_sum)
    own, _ = system.schur(system.forward)
    for axis in (problem.border - 2, problem.border - 1):
        by = np.zeros(problem.border)
        by[axis] = 0.3 / np.sqrt(own[axis, axis])
        costs = [
            cost_of(
                problem, graph, retract(problem, state, used, *system.step(problem.free, fixed=s * by)), used
            )
            for s in (0.0, 1.0, -1.0)
        ]
        left = own[axis, axis] - own[axis, :-2] @ np.linalg.solve(own[:-2, :-2], own[:-2, axis])
        rise = (costs[1] + costs[2] - 2 * costs[0]) / by[axis] ** 2
        np.testing.assert_allclose(rise, left, rtol=0.02)


def test_the_drifts_share_is_right() -> None:
    """The share by which yaw and scale move the poses, against small changes of them."""
    problem, used = seen_from(6, 2, True, 0.0)
    assert problem.sightings is not None
    wide = replace(problem.sightings, sigma_px=6 * problem.sightings.sigma_px)  # none beyond Huber's length
    problem = replace(problem, sightings=wide)
    graph = build_graph(problem)
    state = GraphState(initial_values(problem), initial_points(problem), np.zeros(2))
    for _ in range(6):
        state, system = optimise_graph(problem, graph, state, used)
    drift_jacobian_of_pose = marginals(system).drift_jacobian_of_pose
    for axis, small in enumerate((1e-3, 1e-2)):
        drift = np.eye(2)[axis] * small
        other = replace(state, drift=drift)
        for _ in range(6):
            other, _ = optimise_graph(problem, graph, other, used)
        moved = [state.values.atPose3(X(k)).localCoordinates(other.values.atPose3(X(k))) for k in range(6)]
        np.testing.assert_allclose(
            np.array(moved) / small,
            drift_jacobian_of_pose[:, :, axis],
            rtol=0.1,
            atol=0.02 * np.abs(drift_jacobian_of_pose[:, :, axis]).max(),
        )


def test_a_sightings_rows_are_its_error_and_slopes() -> None:
    """Held against the projection as it is written down: focal 600 px, baseline 0.4 m, doffs 3 px."""
    lens, point, seen = np.array([600.0, 320, 240, 240, 3]), np.array([0.4, -0.3, 0.2]), [330.0, 250, 290]
    axes, lever = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.2, -0.1, 0.3])
    body, high = Rotation.from_rotvec([3.0, 0.1, 0.2]), np.array([0.5, 0.2, 6.0])

    def project(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x: turn, shift, place, slide, disparity offset, yaw, drift. Error px, and point in the camera."""
        turned = (body * Rotation.from_rotvec(x[:3])).as_matrix()
        in_body = turned.T @ (point + x[6:9] - high - body.as_matrix() @ x[3:6])
        u, v, w = in_camera = axes.T @ (in_body - lever)
        slide, off, yaw, drift = x[9:]
        left, row = 600 * (u - slide * v) / w + 320, 600 * (v + slide * u) / w + 240
        shift = -off - 600 * (1 + ((u - 0.4) / w) ** 2) * yaw - 240 / w * drift
        return np.array([left, row, left - 240 / w + 3 + shift]) - seen, in_camera

    def rows_of(x: np.ndarray, huber: float = 1e9, upside: float = 1.0) -> np.ndarray:
        from_reference = np.diag([1, 1, upside]) @ axes.T @ body.as_matrix().T
        shift = -from_reference @ high - np.diag([1, 1, upside]) @ axes.T @ lever
        rows, mount = empty_rows(), np.column_stack([axes, lever])
        assert rows.shape == (3, 13)
        camera = np.column_stack([from_reference, shift])[None]
        given = PointTerms(huber, 1.0, *x[10:])
        points = np.append(point, x[9])[None]
        whitened_rows(lens, mount, camera, points, np.array([seen]), 2.0, given, (0, 0, 0), rows)
        return rows

    moved = np.r_[np.zeros(9), 0.02, 0.3, 1e-3, 2e-3]
    error, in_camera = project(moved)
    rows = rows_of(moved)
    np.testing.assert_allclose(rows[:, 0], 2 * error, atol=1e-9)
    np.testing.assert_allclose(rows[:, POINT], in_camera, atol=1e-12)
    held = rows_of(moved, huber=5.0)
    others = [k for k in range(13) if k != POINT]
    np.testing.assert_allclose(
        held[:, others], rows[:, others] * np.sqrt(5 / np.linalg.norm(2 * error)), atol=1e-9
    )
    assert not rows_of(moved, upside=-1.0).any()
    rows, slopes = rows_of(np.zeros(13)), np.empty((3, 13))
    for k, step in enumerate(1e-5 * np.eye(13)):
        slopes[:, k] = 2 * (project(step)[0] - project(-step)[0]) / 2e-5
    np.testing.assert_allclose(rows[:, POSE : POSE + 6], slopes[:, :6], atol=1e-5)
    np.testing.assert_allclose(rows[:, PLACE : PLACE + 4], slopes[:, 6:10], atol=1e-5)
    np.testing.assert_allclose(rows[:, SHARED], slopes[2, 10:], atol=1e-5)


def test_what_a_points_sightings_share_is_its_pieces() -> None:
    points, piece = np.array([[0.0, 0, 0, 0.5], [1.0, 0, 0, 0.7]]), np.array([1, 0])
    shared = np.array([0.1, 0.2, 3.0, 4.0, 0.01, 0.02])
    none = np.empty(0)
    observations = Observations(none, none, none, none, none, piece, none, 0.0)
    rig = Rig(np.empty(5), np.empty((3, 4)), 2.5)
    assert [slide_offset(points, shared, piece, t) for t in (0, 1)] == pytest.approx([0.3, 0.6])
    assert [disparity_offset(shared, piece, t) for t in (0, 1)] == [4.0, 3.0]
    assert given_of(rig, observations, shared, 1) == PointTerms(2.5, 0.0, 3.0, 0.01, 0.02)
    assert slide_offset(points, shared[4:], piece, 1) == 0.7 and disparity_offset(shared[4:], piece, 1) == 0.0
