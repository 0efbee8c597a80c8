"""Yaw and scale of the rig from known travel: errors as large as stated, and what follows from them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import RigDrift
from barsight.features.guided_matching import project_stereo
from barsight.motion.batch import fusion
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.problem.problem import Problem
from barsight.motion.problem.rig_drift import MATCHING_BIAS_PX, combine_with_prior, with_matching_bias
from barsight.motion.rig_check.self_calibration import (
    is_drifted,
    residual_sigma_px,
    self_calibrate,
    turn_right_camera,
)
from motion_recordings import MemoryRecording, ideal_rig, tell_sightings

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
RIG = ideal_rig(1280, 1024)
CAMERA = replace(RIG.cam0, fx_px=1250, fy_px=1250)
MOUNT = Pose("body", "cam0", np.eye(3), np.array([0.06, -0.09, 0.04]))
RIG = replace(
    RIG, cam0=CAMERA, cam1=CAMERA, body_from_cam0=MOUNT, body_from_cam1=MOUNT @ RIG.cam0_from_cam1
)  # fmt: skip


def travel(seed: int, yaw_rad: float, scale: float, bias_px: float) -> tuple[MemoryRecording, list[Sighting]]:
    """A crane over points on a stack and the floor: sightings and encoders, no pictures.

    The right camera has turned by `yaw_rad`, exactly; matching is off by up to `bias_px` as the floor says.
    """
    rng = np.random.default_rng(seed)
    stamps = (np.arange(8) * 800_000_000 + 10_000_000_000).astype(np.int64)
    encoder_ns = np.arange(9_000_000_000, 17_000_000_000, 50_000_000, dtype=np.int64)
    place = np.column_stack([(encoder_ns - encoder_ns[0]) / 1e9 * 0.6, *np.zeros((2, len(encoder_ns)))])
    place[:, 2] = 8.0
    poses = []
    for stamp in stamps:
        sway = np.deg2rad(rng.normal(0, 0.1, 3))
        x = (stamp - encoder_ns[0]) / 1e9 * 0.6
        cross = np.array([[0, -sway[2], sway[1]], [sway[2], 0, -sway[0]], [-sway[1], sway[0], 0]])
        poses.append(Pose("yard", "body", (np.eye(3) + cross) @ DOWN, np.array([x, 0, 8.0])))
    points = np.column_stack([rng.uniform(-4, 9, 900), rng.uniform(-4, 4, 900), rng.uniform(0, 1.5, 900)])
    rectifier = Rectifier(replace(RIG, body_from_cam1=RIG.body_from_cam1))
    camera = rectifier.camera
    bias, slope = rng.normal(0, bias_px, 2)
    sightings = []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        in_left = (pose @ rectifier.body_from_rect0).inverse().apply(points)
        stereo = project_stereo(in_left, camera)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        x, _, z = (in_left - [camera.baseline_m * (1 + scale), 0, 0]).T
        disparity = stereo[:, 0] - stereo[:, 2]
        stereo[:, 2] = camera.focal_px * (cos * x - sin * z) / (sin * x + cos * z) + camera.cx_px
        shown = (stereo[:, [0, 2]] > 0).all(1) & (stereo[:, [0, 2]] < 1280).all(1)
        shown &= (stereo[:, 1] > 0) & (stereo[:, 1] < 1024)
        stereo[:, 2] += bias + slope * (disparity - disparity.mean()) / disparity.std()
        seen = stereo[shown] + rng.normal(0, 0.1, (int(shown.sum()), 3))
        sightings.append(Sighting(stamp, np.flatnonzero(shown), seen, np.full(len(seen), 0.1), None, 0))
    encoders = place + rng.normal(0, 0.002, place.shape)
    crane = CraneSamples(encoder_ns, encoders, np.zeros(3), DOWN, 0.002)
    return MemoryRecording(RIG, stamps_ns=tuple(stamps.tolist()), crane_samples=crane), sightings


def drift_of(recording: MemoryRecording, sightings: list[Sighting], patch: pytest.MonkeyPatch) -> RigDrift:
    tell_sightings(patch, fusion, sightings)
    estimator = BatchFusion(FusionSettings(), CraneSettings())
    found = estimator(recording, Rectifier(RIG), lambda: None).drift
    assert found is not None
    assert found.by_encoders
    return found


@pytest.mark.slow
def test_errors_are_as_large_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Matching biases and scale drawn as the stated sigma has them; noise alone would be understated."""
    squares = []
    for seed in range(40):
        rng = np.random.default_rng((seed, 1))
        truth = rng.normal(0, [np.deg2rad(0.03), FusionSettings().scale_sigma])
        found = drift_of(*travel(seed, *truth, MATCHING_BIAS_PX), monkeypatch)
        error = np.array([found.yaw_rad, found.scale]) - truth
        squares.append(error @ np.linalg.solve(found.covariance, error) / 2)
    assert 0.75 < np.mean(squares) < 1.3


@pytest.mark.parametrize("degrees", [0.0, 0.01, -0.1])
def test_a_yaw_is_found(degrees: float, monkeypatch: pytest.MonkeyPatch) -> None:
    found = drift_of(*travel(3, np.deg2rad(degrees), 0.0, 0.0), monkeypatch)
    assert abs(np.rad2deg(found.yaw_rad) - degrees) < 0.003
    assert is_drifted(found) == (degrees != 0)


def test_without_encoders_nothing_is_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    drift = drift_of(*travel(3, np.deg2rad(0.05), 0.0, 0.0), monkeypatch)
    rectifier = Rectifier(RIG)
    blind = replace(drift, by_encoders=False)
    believed = self_calibrate(RIG, rectifier, blind, 0.05, correct=False)
    assert (believed.warnings, believed.sigma_px) == ((), 0.05)
    refused = self_calibrate(RIG, rectifier, blind, 0.05, correct=True)
    assert refused.rectifier is rectifier
    assert "only with encoders" in refused.warnings[0]
    warned = self_calibrate(RIG, rectifier, drift, 0.05, correct=False)
    assert warned.rectifier is rectifier
    assert "calibrate anew" in warned.warnings[0]


def test_the_turned_rig_takes_the_yaw_off() -> None:
    """A point's disparity in the corrected rectification is that of its true depth."""
    yaw = np.deg2rad(0.2)
    true = turn_right_camera(RIG, np.array([0.0, yaw, 0.0]))
    drift = RigDrift(yaw, 0.0, np.eye(2) * 1e-12, np.ones(2), 0.4, 7.0, True)
    corrected = self_calibrate(RIG, Rectifier(RIG), drift, 0.05, correct=True).rectifier
    assert corrected.camera == Rectifier(true).camera
    point = np.array([[0.3, -0.4, 7.0]])
    cam1_from_cam0 = true.cam0_from_cam1.inverse()
    raw = RIG.cam1.project(cam1_from_cam0.apply(point))[0, 0] - RIG.cam0.project(point)[0, 0]
    assert abs(raw + 1250 * 0.4 / 7 + 1250 * yaw) < 0.05


def test_the_drift_is_told_as_if_pieces_were_not_unknowns() -> None:
    """Errors of single pieces' disparities falsify heights whether or not the estimate knows it."""
    disparity = np.random.default_rng(4).uniform(60, 100, 500)
    stereo = np.column_stack([disparity, np.zeros(500), np.zeros(500)])
    seen = SimpleNamespace(stereo=stereo, camera=Rectifier(RIG).camera)
    without = SimpleNamespace(sightings=seen, has_latency=True, scale_prior=5e-4, pieces=None)
    with_pieces = SimpleNamespace(**{**vars(without), "pieces": ()})
    theta, covariance = np.array([1e-4, 2e-4]), np.array([[4e-10, 1e-9], [1e-9, 9e-8]])
    inside = combine_with_prior(theta, covariance, cast(Problem, with_pieces))
    told = with_matching_bias(inside, cast(Problem, with_pieces))
    expected = combine_with_prior(theta, covariance, cast(Problem, without))
    assert told.yaw_sigma_rad > 1.2 * inside.yaw_sigma_rad
    np.testing.assert_allclose(told.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose([told.yaw_rad, told.scale], [expected.yaw_rad, expected.scale], rtol=1e-6)


def shown(yaw_px: float, yaw_sigma_px: float, scale_sigma: float = 1e-9) -> RigDrift:
    """A yaw (px straight ahead) seen at 7 m by a rig of f 1250 px."""
    covariance = np.diag([(yaw_sigma_px / 1250) ** 2, scale_sigma**2])
    return RigDrift(yaw_px / 1250, 0.0, covariance, np.ones(2), 0.4, 7.0, True)


def test_what_the_rig_leaves_open() -> None:
    """Travel and calibration believed together where they agree; what contradicts counts as error until it is
    taken off; a baseline counts by the disparity."""
    left = residual_sigma_px(shown(0.02, 0.03), 1250, 0.04, False)
    assert left == pytest.approx(1 / np.hypot(1 / 0.03, 1 / 0.04), rel=1e-4)
    assert residual_sigma_px(shown(0.2, 50.0), 1250, 0.05, False) == pytest.approx(0.05, rel=1e-4)
    assert residual_sigma_px(shown(0.02, 0.03), 1250, 0.0, False) == pytest.approx(0, abs=1e-4)
    assert residual_sigma_px(shown(0.2, 0.02), 1250, 0.05, False) == pytest.approx(
        np.hypot(0.2, 0.02), rel=1e-4
    )
    assert residual_sigma_px(shown(0.2, 0.02), 1250, 0.05, True) == pytest.approx(0.02, rel=1e-4)
    baseline_px = 1e-3 * 1250 * 0.4 / 7
    wide = residual_sigma_px(shown(0.0, 1e-9, 1e-3), 1250, 0.05, False)
    assert wide == pytest.approx(baseline_px, rel=1e-4)


@pytest.mark.parametrize("rig_px", [0.02, 0.05])
def test_intervals_hold_over_rigs(rig_px: float) -> None:
    """Rigs as far off as their calibration admits or less, travel that shows it to 0.018 px, and 0.026 px
    (2 mm at 7 m) of other errors: 95 % of the errors lie inside. Far beyond what is admitted, all do."""
    rng = np.random.default_rng(2)
    off = rng.normal(0, rig_px, 3000)
    seen = off + rng.normal(0, 0.018, off.size)
    stated = np.array([residual_sigma_px(shown(yaw, 0.018), 1250, 0.05, False) for yaw in seen])
    error = off + rng.normal(0, 0.026, off.size)
    assert 0.94 < np.mean(np.abs(error) <= 1.96 * np.hypot(stated, 0.026)) < 0.97
    assert residual_sigma_px(shown(0.22, 0.018), 1250, 0.05, False) > 0.22
