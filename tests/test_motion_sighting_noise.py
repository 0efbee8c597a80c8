"""Residuals tell the sightings' noise: what a fit took up of it, and what neighbours share."""

from dataclasses import replace

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.motion.problem.problem import StereoObservations
from barsight.motion.problem.stereo_factors import dof_correction, spatial_inflation, temporal_inflation
from motion_recordings import ideal_rig

FRAMES, POINTS = 20, 800


def seen_once_each(rng: np.random.Generator) -> StereoObservations:
    """Points all over each picture, none of them seen again."""
    camera = Rectifier(ideal_rig(1280, 1024)).camera
    place = rng.uniform((0, 0), (camera.width, camera.height), (FRAMES * POINTS, 2))
    stereo = np.column_stack([place, place[:, 0] - 80])
    node = np.repeat(np.arange(FRAMES), POINTS)
    mount = Pose("body", "rect0", np.eye(3), np.zeros(3))
    return StereoObservations(
        node, np.arange(len(node)), stereo, np.full(len(node), 0.1), camera, mount
    )  # fmt: skip


def spread_of_means(residual: Float64) -> float:
    """Compute by how much frames' mean errors scatter more than independent ones would."""
    means = residual.reshape(FRAMES, POINTS, 3).mean(axis=1)
    return float(np.sqrt((means**2).mean() / ((residual**2).mean() / POINTS)))


def test_independent_errors_are_taken_as_such() -> None:
    rng = np.random.default_rng(1)
    seen = seen_once_each(rng)
    residual = rng.normal(0, 0.1, (len(seen.node), 3))
    assert spatial_inflation(residual, seen, np.ones(len(seen.node), np.bool_)) < 1.03


def test_what_neighbours_share_widens_sigma_by_what_their_mean_scatters_more() -> None:
    """Squares of 90 px whose points err alike, and which don't lie as the cells that are looked at do."""
    found, true = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        seen = seen_once_each(rng)
        square = ((seen.stereo[:, :2] + 37) // 90).astype(int)
        shared = rng.normal(0, 0.04, (FRAMES, 20, 20, 3))[seen.node, square[:, 0], square[:, 1]]
        residual = shared + rng.normal(0, 0.1, (len(seen.node), 3))
        found.append(spatial_inflation(residual, seen, np.ones(len(seen.node), np.bool_)))
        true.append(spread_of_means(residual))
    assert 1.2 < np.mean(true) < 2.0
    assert 0.85 * np.mean(true) < np.mean(found) < 1.05 * np.mean(true)


def test_what_a_fit_takes_up_is_given_back() -> None:
    """Each point's residuals without their mean, as a fit leaves them."""
    rng = np.random.default_rng(2)
    for often in (2, 4, 10):
        seen = seen_once_each(rng)
        track = np.arange(len(seen.node)) // often
        node = np.tile(np.arange(often), len(seen.node) // often)
        seen = StereoObservations(
            node, track, seen.stereo, seen.sigma_px, seen.camera, seen.body_from_rect0
        )  # fmt: skip
        error = rng.normal(0, 0.1, (len(node) // often, often, 3))
        residual = error - error.mean(axis=1, keepdims=True)
        used = np.ones(len(node), np.bool_)
        assert abs(residual.std() * dof_correction(seen, used) / 0.1 - 1) < 0.02


def slow_nearness(residual: Float64, seen: StereoObservations, used: np.ndarray) -> float:
    scaled = np.clip(residual[used] / seen.sigma_px[used, None], -4, 4)
    cell = (seen.stereo[used, :2] * (8 / seen.camera.width)).astype(np.int64)
    _, name = np.unique(np.column_stack([seen.node[used], cell]), axis=0, return_inverse=True)
    sums = np.array([np.bincount(name.ravel(), axis) for axis in scaled.T])
    return float(max(1.0, (sums**2).sum() / (scaled**2).sum()) ** 0.5)


def slow_persistence(residual: Float64, seen: StereoObservations, used: np.ndarray) -> float:
    order = np.flatnonzero(used)
    track = seen.track[order]
    length = np.bincount(track)[track[:-1]]
    pair = (track[:-1] == track[1:]) & (length >= 5)
    scaled = residual[order] / seen.sigma_px[order, None]
    first, second = scaled[:-1][pair], scaled[1:][pair]
    shared = 2 * (first * second).sum() / ((first**2).sum() + (second**2).sum())
    correlation = float(np.clip(shared + (1 / length[pair]).mean(), 0.0, 0.8))
    return float(((1 + correlation) / (1 - correlation)) ** 0.5)


def test_the_kernels_say_what_arrays_say() -> None:
    rng = np.random.default_rng(4)
    seen = seen_once_each(rng)
    track, node = np.sort(rng.integers(0, 2500, len(seen.node))), rng.permutation(seen.node)
    seen = replace(seen, track=track, node=node, sigma_px=rng.uniform(0.05, 0.3, len(track)))
    shared = rng.normal(0, 0.1, (2500, 3))[track] + rng.normal(0, 0.05, (FRAMES, 3))[node]
    residual, used = shared + rng.normal(0, 0.1, shared.shape), rng.random(len(track)) < 0.8
    assert temporal_inflation(residual, seen, used) == pytest.approx(slow_persistence(residual, seen, used))
    assert spatial_inflation(residual, seen, used) == pytest.approx(slow_nearness(residual, seen, used))
    assert (
        spatial_inflation(residual, seen, np.zeros_like(used))
        == temporal_inflation(residual, seen, used & False)
        == 1.0
    )
