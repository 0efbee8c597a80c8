"""The live estimate against batch and truth, in bounded memory; and what holds nothing to go by."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.evaluation.trajectory_error import trajectory_drift
from barsight.inertial.model import ORDINARY_NOISE
from barsight.motion.batch import fusion
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.fixed_lag import estimator as live
from barsight.motion.fixed_lag.estimator import FixedLagFusion, FixedLagSettings
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer
from barsight.motion.fixed_lag.smoother import FixedLagEstimator
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.recording.open import open_recording
from motion_recordings import MemoryRecording, ideal_rig, tell_sightings
from simulated_ways import steady
from test_motion_fusion import simulated

ESTIMATORS = {
    "fused": lambda use: BatchFusion(FusionSettings(use=use), CraneSettings()),
    "live": lambda use: FixedLagFusion(FusionSettings(use=use), FixedLagSettings(), CraneSettings()),
}


def off_in_sigmas(found: Trajectory, batch: Trajectory) -> float:
    """RMS of how far the places are apart, in the found ones' sigmas."""
    off = []
    for a, b in zip(found.frames, batch.frames, strict=True):
        way = a.reference_from_body.translation - b.reference_from_body.translation
        off.append(np.linalg.solve(np.linalg.cholesky(a.covariance[3:, 3:]), way))
    return float(np.sqrt(np.mean(np.square(off))))


def estimated(
    name: str, use: str, recording: Recording, seen: tuple, patch: pytest.MonkeyPatch
) -> Trajectory:
    tell_sightings(patch, {"fused": fusion, "live": live}[name], seen)
    return ESTIMATORS[name](use)(recording, Rectifier(recording.rig), lambda: None)


def test_live_agrees_with_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within its own covariance, and that is right against truth."""
    nees = []
    for seed in (0, 1, 2):
        recording, seen, truth = simulated(seed)
        batch, found = (estimated(n, "stereo,imu,crane", recording, seen, monkeypatch) for n in ESTIMATORS)
        assert off_in_sigmas(found, batch) < 1.3
        drift = trajectory_drift(found, truth, 0)
        assert drift is not None
        assert drift.reference_rmse_mm < 2.0
        nees.append([drift.nees_position, drift.nees_attitude])
    assert (np.mean(nees, axis=0) < 1.6).all()
    assert (np.mean(nees, axis=0) > 0.4).all()


@pytest.mark.slow
def test_a_crane_over_bars(data: Path) -> None:
    recording = open_recording(data / "yard_dev")
    batch, found = (
        make("stereo,imu,crane")(recording, Rectifier(recording.rig), lambda: None)
        for make in ESTIMATORS.values()
    )
    assert off_in_sigmas(found, batch) < 1.3
    truth = read_ground_truth(data / "yard_dev", np.array(recording.index.stamps_ns))
    drift = trajectory_drift(found, truth, recording.rig.timeshift_cam_imu_ns)
    assert drift is not None
    assert drift.reference_rmse_mm < 1.5
    assert drift.reference_rmse_deg < 0.05
    assert drift.nees_position < 2


def estimator_of(recording: Recording, use: str, held: int) -> FixedLagEstimator:
    crane = recording.crane() if "crane" in use else None
    readings = SensorBuffer(crane, recording.imu(), recording.imu_noise() or ORDINARY_NOISE)
    level = None if crane else live.align_with_gravity(recording)
    settings = FusionSettings(use=use)
    return FixedLagEstimator(settings, CraneSettings(), held, Rectifier(recording.rig), 0, readings, level)


def test_what_is_held_doesnt_grow() -> None:
    recording, seen, _ = steady(0.4, 0, frames=30)
    estimator = estimator_of(recording, "stereo,imu,crane", 4)
    held = []
    for sighting in seen:
        estimator.take(sighting)
        window = estimator.window
        assert window is not None
        assert window.problem.sightings is not None
        held.append((len(window.problem.start), len(window.problem.sightings.track)))
    assert max(nodes for nodes, _ in held[10:]) <= max(nodes for nodes, _ in held[:10]) <= 12
    most = max(len(s.track) for s in seen)
    assert max(count for _, count in held) <= 4 * most


def spoiled_encoders(recording: Recording, frozen_s: float = 0.0) -> Recording:
    """Each encoder jumps to and fro, every 2.5 s one of them, and freezes at 3 s."""
    crane = recording.crane()
    assert crane is not None
    place, since = crane.position_m.copy(), (crane.stamp_ns - crane.stamp_ns[0]) / 1e9
    for k, at in enumerate(np.arange(5.0, since[-1] - 4.0, 2.5)):
        place[since >= at, k % 3] += 0.3 * (-1) ** (k // 3)
    held = (since >= 3.0) & (since < 3.0 + frozen_s)
    place[held] = place[held][:1]
    return replace(recording, crane_samples=replace(crane, position_m=place))


def test_jumps_that_are_past_are_one_unknown_of_each_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """The poses are those that all of them kept apart give."""
    recording, seen, truth = steady(0.05, 2, frames=100)
    recording = spoiled_encoders(recording)
    found, unknowns, others = {}, {}, ("latency", *("scale", "mounting") * 3)
    for name in ("kept apart", "put together"):
        estimator = estimator_of(recording, "stereo,imu,crane", 4)
        if name == "kept apart":
            monkeypatch.setattr(estimator.watch, "put_together", lambda _: {})
        found[name] = [estimator.take(sighting) for sighting in seen]
        assert estimator.window is not None
        unknowns[name] = estimator.window.problem.encoder_unknowns
    assert unknowns["kept apart"] - len(others) == len(estimator.watch.told) >= 13
    assert unknowns["put together"] - len(others) <= 3 + 3
    for one, other in zip(*found.values(), strict=True):
        assert isinstance(one, PosedFrame) and isinstance(other, PosedFrame)
        off = one.reference_from_body.translation - other.reference_from_body.translation
        sigma = np.sqrt(np.diag(one.covariance))
        assert np.abs(off).max() < 0.01 * sigma[3:].min()
        np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), sigma, rtol=0.01)
    off = found["put together"][-1].reference_from_body.translation - truth.poses[-1].translation
    assert np.linalg.norm(off) < 0.05


def test_a_freeze_that_is_long_past_is_told_once() -> None:
    recording, seen, _ = steady(0.4, 2, frames=60)
    crane = recording.crane()
    assert crane is not None
    estimator = estimator_of(spoiled_encoders(recording, 1.0), "stereo,imu,crane", 4)
    for sighting in seen:
        estimator.take(sighting)
    told = [jump for jump in estimator.watch.told if jump.kind == "freeze"]
    assert len(told) == 3 and len(estimator.watch.frozen) == 1


def test_the_imu_alone_predicts_the_next_frame() -> None:
    """Without encoders: as near the true motion as it says, and near enough to guide the matching."""
    off = []
    for seed in range(6):
        recording, seen, truth = steady(0.4, seed)
        estimator = estimator_of(recording, "stereo,imu", 8)
        mount = Rectifier(recording.rig).body_from_rect0
        for k, sighting in enumerate(seen):
            if k > 2:
                predicted = estimator.predict(seen[k - 1].stamp_ns, sighting.stamp_ns)
                assert predicted is not None
                old, new = (truth.poses[j] @ mount for j in (k - 1, k))
                found = Pose("rect0", "rect0", predicted.rotation, predicted.translation)
                step = (new.inverse() @ old) @ found.inverse()
                error = np.r_[Rotation.from_matrix(step.rotation).as_rotvec(), step.translation]
                off.append(error @ np.linalg.solve(predicted.covariance, error) / 6)
                assert np.linalg.norm(step.translation) < 0.01
            estimator.take(sighting)
    assert np.mean(off) < 1.2


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("speed_mps", [0.0, 0.4])
@pytest.mark.parametrize(
    "use", ["stereo", "stereo,imu", "stereo,imu,crane", "stereo,crane", "crane,imu", "crane"]
)
def test_no_motion_and_even_motion(
    name: str, speed_mps: float, use: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An IMU sees nothing of the velocity: pictures and encoders must say it."""
    recording, seen, truth = steady(speed_mps, 3)
    drift = trajectory_drift(estimated(name, use, recording, seen, monkeypatch), truth, 0)
    assert drift is not None
    assert drift.frames == len(seen)
    # Live, `world` is upright only as far as the first seconds tell.
    assert drift.aligned_rmse_mm < {"fused": 2, "live": 20 if use == "stereo,imu" else 6}[name]
    if "crane" in use:
        assert drift.reference_rmse_mm < 10  # an unknown latency of 20 ms at 0.4 m/s
        assert drift.nees_position < 2


@pytest.mark.parametrize("name", ESTIMATORS)
def test_no_texture(name: str) -> None:
    """Encoders and IMU place frames that show nothing; without encoders each is refused, with a reason."""
    recording, _, truth = steady(0.4, 5)
    gray = np.full((1024, 1280), 90, np.uint8)
    blank = replace(recording, pictures=tuple(StereoFrame(s, gray, gray) for s in recording.stamps_ns))
    rectifier = Rectifier(blank.rig)
    drift = trajectory_drift(ESTIMATORS[name]("stereo,imu,crane")(blank, rectifier, lambda: None), truth, 0)
    assert drift is not None
    assert drift.frames == len(truth.poses)
    assert drift.reference_rmse_mm < 10
    alone = ESTIMATORS[name]("stereo,imu")(blank, rectifier, lambda: None)
    assert alone.frames == ()
    assert all("have a depth" in frame.reason for frame in alone.refused)


def test_frames_that_show_nothing_are_bridged(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, seen, truth = simulated(4)
    gone = tuple(RefusedFrame(s.stamp_ns, "dark") if 8 <= k < 11 else s for k, s in enumerate(seen))
    found = estimated("live", "stereo,imu,crane", recording, gone, monkeypatch)
    drift = trajectory_drift(found, truth, 0)
    assert drift is not None
    assert drift.frames == len(seen)
    assert drift.reference_rmse_mm < 3


def test_pictures_that_show_nothing_for_longer_than_the_window() -> None:
    recording, seen, truth = steady(0.1, 0, frames=20)
    estimator = estimator_of(recording, "stereo,imu,crane", 4)
    for k, sighting in enumerate(seen):
        frame = estimator.take(RefusedFrame(sighting.stamp_ns, "dark") if 6 <= k < 14 else sighting)
        assert isinstance(frame, PosedFrame)
    off = frame.reference_from_body.translation - truth.poses[-1].translation
    assert np.linalg.norm(off) < 0.01


@pytest.mark.parametrize("speed_mps", [0.0, 0.2])
@pytest.mark.parametrize("gap_s", [10, 60])
def test_no_pictures_for_a_minute(speed_mps: float, gap_s: int) -> None:
    """The first frame after it was metres off, up to 60 sigma: the IMU alone had led there."""
    recording, seen, truth = steady(speed_mps, 1, frames=20 + 2 * gap_s)
    estimator = estimator_of(recording, "stereo,imu,crane", 8)
    for k, sighting in enumerate(seen):
        if 10 <= k < 10 + 2 * gap_s:
            continue
        frame = estimator.take(replace(sighting, motion=None) if k == 10 + 2 * gap_s else sighting)
        assert isinstance(frame, PosedFrame)
        off = frame.reference_from_body.translation - truth.poses[k].translation
        assert off @ np.linalg.solve(frame.covariance[3:, 3:], off) < 25
    assert np.linalg.norm(off) < 0.02


def turned(seen: tuple, angle: float) -> tuple:
    """Every picture turned about the camera's axis, as points that slide alike look."""
    camera = Rectifier(ideal_rig(1280, 1024)).camera
    told = []
    for sighting in seen:
        stereo = sighting.stereo.copy()
        x, y = sighting.stereo[:, 0] - camera.cx_px, sighting.stereo[:, 1] - camera.cy_px
        stereo -= angle * np.column_stack([y, -x, y])
        told.append(replace(sighting, stereo=stereo))
    return tuple(told)


@pytest.mark.slow
def test_what_slides_alike_is_in_sigma(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slides of the size that ribbed bars show pass for a heading that is off: sigma counts them."""
    nees = []
    for seed in range(8):
        recording, seen, truth = simulated(seed)
        angle = np.random.default_rng(100 + seed).normal(0, 2.5e-4)
        found = estimated("live", "stereo,imu,crane", recording, turned(seen, angle), monkeypatch)
        drift = trajectory_drift(found, truth, 0)
        assert drift is not None
        nees.append([drift.nees_position, drift.nees_attitude])
    assert (np.mean(nees, axis=0) < 1.4).all()
    assert (np.mean(nees, axis=0) > 0.5).all()


def test_a_spoiled_window_is_left() -> None:
    """A frame that has no solution leaves nothing behind; after two the encoders say where to begin anew."""
    recording, seen, truth = steady(0.4, 0, frames=16)
    estimator = estimator_of(recording, "stereo,imu,crane", 4)
    for sighting in seen[:8]:
        estimator.take(sighting)
    window = estimator.window
    assert window is not None
    assert window.problem.prior is not None
    spoiled = replace(window.problem.prior, matrix=-1e12 * window.problem.prior.matrix)
    estimator.window = replace(window, problem=replace(window.problem, prior=spoiled))
    assert isinstance(estimator.take(seen[8]), RefusedFrame)
    assert estimator.window.placed_ns == window.placed_ns
    assert isinstance(estimator.take(seen[9]), RefusedFrame)
    for sighting, true in zip(seen[10:], truth.poses[10:], strict=True):
        frame = estimator.take(sighting)
        assert isinstance(frame, PosedFrame)
        assert np.linalg.norm(frame.reference_from_body.translation - true.translation) < 0.01


def test_settings() -> None:
    with pytest.raises(ConfigError, match="frames"):
        FixedLagSettings(frames=2)
    recording = MemoryRecording(ideal_rig())
    assert (
        FixedLagFusion(FusionSettings(), FixedLagSettings(), CraneSettings())(
            recording, Rectifier(recording.rig), lambda: None
        ).frames
        == ()
    )
