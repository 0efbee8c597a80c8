"""The estimate from all sensors: consistent over simulated seeds, and close to truth on recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.records.trajectory import Trajectory
from barsight.evaluation.trajectory_error import Drift, trajectory_drift
from barsight.features.guided_matching import project_stereo, triangulate_stereo
from barsight.motion.batch import fusion
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.problem.problem import ALIKE_M, FIRST_UNEVEN_M
from barsight.recording.base import Recording
from barsight.recording.formats.ground_truth import GroundTruth, read_ground_truth
from barsight.recording.open import open_recording
from barsight.simulation.sensors import EPOCH_NS, record_encoders, record_imu
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.trajectory import SimulatedTrajectory
from motion_recordings import MemoryRecording, ideal_rig, tell_sightings

SIGMA_PX = 0.1
LEVER = np.array([0.35, -0.2, -0.55])
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


class NoisyRecording(MemoryRecording):
    """With the simulated IMU's true noise."""

    def imu_noise(self) -> ImuNoise:
        s = SensorSettings()
        return ImuNoise(
            s.gyro_noise_density, s.gyro_random_walk, s.accel_noise_density, s.accel_random_walk, 200.0
        )


def unevenness(x_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw by how much rails move the body, unseen by encoders: (N, 3) m at (N,) places x of the bridge.

    On each axis the sigma is the prior's, and the integral of the correlation over the way is 2 `ALIKE_M`,
    the length within which the estimate counts neighbours.
    """
    stretches = np.subtract.outer(x_m, x_m) / (2 * ALIKE_M)
    alike = np.exp(-np.pi * stretches**2)
    return FIRST_UNEVEN_M * rng.multivariate_normal(np.zeros(len(x_m)), alike, 3, method="eigh").T


def simulated(seed: int) -> tuple[NoisyRecording, tuple[Sighting, ...], GroundTruth]:
    """A crane's way over points on a stack, without pictures: sightings with noise, IMU and encoders.

    The nominal attitude, the disparity and the encoders' places are off by as much as the estimate holds
    that they may be.
    """
    rng = np.random.default_rng(seed)
    way = SimulatedTrajectory.plan(6.0, CameraSettings(), TravelSettings(), DOWN, rng)
    rig = ideal_rig(1280, 1024)
    mount = Pose("body", "cam0", np.eye(3), np.array([0.06, -0.09, 0.04]))
    rig = replace(rig, body_from_cam0=mount, body_from_cam1=mount @ rig.cam0_from_cam1)
    camera = replace(rig.cam0, fx_px=1250, fy_px=1250)
    rig = replace(rig, cam0=camera, cam1=camera)
    imu = record_imu(way, SensorSettings(), rng)
    crane_ns, place = record_encoders(way, SensorSettings(), LEVER, rng)
    times = np.arange(0.6, way.duration_s - 0.5, 0.8)
    stamps = EPOCH_NS + (times * 1e9).round().astype(np.int64)
    motion = way.at(times)
    poses = [
        Pose("yard", "body", r, p) for r, p in zip(motion.yard_from_body, motion.position_m, strict=True)
    ]
    points = np.column_stack([rng.uniform(-4, 12, 1500), rng.uniform(-4, 4, 1500), rng.uniform(0, 1.5, 1500)])
    rectifier = Rectifier(rig)
    sightings = []
    offset_px = rng.normal(0, FusionSettings().offset_prior_px)
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        stereo = project_stereo((pose @ rectifier.body_from_rect0).inverse().apply(points), rectifier.camera)
        shown = (stereo[:, [0, 2]] > 0).all(1) & (stereo[:, [0, 2]] < 1280).all(1)
        shown &= (stereo[:, 1] > 0) & (stereo[:, 1] < 1024)
        seen = stereo[shown] + rng.normal(0, SIGMA_PX, (shown.sum(), 3))
        seen[:, 2] += offset_px
        sightings.append(Sighting(stamp, np.flatnonzero(shown), seen, np.full(len(seen), SIGMA_PX), None, 0))
    mounted_so = Rotation.from_rotvec(np.deg2rad(rng.normal(0, CraneSettings().sway_std_deg, 3))).as_matrix()
    place = place + unevenness(place[:, 0], rng)
    crane = CraneSamples(crane_ns, place, LEVER, mounted_so @ DOWN, 0.002)
    samples = ImuSamples(imu.stamp_ns, imu.gyro_radps, imu.accel_mps2)
    recording = NoisyRecording(
        rig, stamps_ns=tuple(stamps.tolist()), imu_samples=samples, crane_samples=crane
    )
    return recording, tuple(sightings), GroundTruth(stamps, tuple(poses))


def fused(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, sightings: tuple[Sighting, ...]
) -> Trajectory:
    tell_sightings(monkeypatch, fusion, sightings)
    return BatchFusion(FusionSettings(), CraneSettings())(recording, Rectifier(recording.rig), lambda: None)


def relative_nees(trajectory: Trajectory, truth: GroundTruth) -> np.ndarray:
    """(2,) squared errors of turn and way between neighbours over their covariance, per degree of freedom."""
    assert trajectory.detail is not None
    assert trajectory.detail.relative is not None
    found = [frame.reference_from_body for frame in trajectory.frames]
    sums = []
    for k, covariance in enumerate(trajectory.detail.relative.covariance):
        moved, truly = found[k].inverse() @ found[k + 1], truth.poses[k].inverse() @ truth.poses[k + 1]
        off = truly.inverse() @ moved
        error = np.concatenate([Rotation.from_matrix(off.rotation).as_rotvec(), off.translation])
        parts = ((error[:3], covariance[:3, :3]), (error[3:], covariance[3:, 3:]))
        sums.append([part @ np.linalg.solve(spread, part) / 3 for part, spread in parts])
    mean: np.ndarray = np.mean(sums, axis=0)
    return mean


@pytest.mark.slow
def test_the_covariance_is_right_over_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    drifts, relative = [], []
    for seed in range(20):
        recording, sightings, truth = simulated(seed)
        trajectory = fused(recording, monkeypatch, sightings)
        drift = trajectory_drift(trajectory, truth, 0)
        assert drift is not None
        drifts.append(drift)
        relative.append(relative_nees(trajectory, truth))
    neighbours = np.mean(relative, axis=0)
    assert (neighbours > 0.7).all()
    assert (neighbours < 1.4).all()
    mean = np.mean([[d.nees_position, d.nees_attitude, d.reference_rmse_mm] for d in drifts], axis=0)
    assert 0.7 < mean[0] < 1.4
    assert 0.7 < mean[1] < 1.4
    assert mean[2] < 1.0


def measured(path: Path, use: str) -> Drift:
    recording = open_recording(path)
    told: list[int] = []
    estimator = BatchFusion(FusionSettings(use=use), CraneSettings())
    trajectory = estimator(recording, Rectifier(recording.rig), lambda: told.append(1))
    stamps = np.array(recording.index.stamps_ns)
    assert len(told) == len(trajectory.frames) == len(stamps)
    drift = trajectory_drift(trajectory, read_ground_truth(path, stamps), recording.rig.timeshift_cam_imu_ns)
    assert drift is not None
    return drift


def test_a_car_drives(data: Path) -> None:
    drift = measured(data / "kitti_odometry_a", "stereo")
    assert drift.drift_percent < 0.7
    assert drift.aligned_rmse_mm < 70


def test_a_crane_over_bars(data: Path) -> None:
    drift = measured(data / "yard_dev", "stereo,imu,crane")
    assert drift.reference_rmse_mm < 1.0
    assert drift.reference_rmse_deg < 0.02
    assert drift.nees_position < 2


@pytest.mark.parametrize(("use", "max_depth_error_mm"), [("stereo", 1.2), ("stereo,imu", 1.0)])
def test_a_crane_without_encoders(data: Path, use: str, max_depth_error_mm: float) -> None:
    drift = measured(data / "yard_dev", use)
    assert drift.aligned_rmse_mm < max_depth_error_mm
    assert drift.aligned_rmse_deg < 0.03


def test_encoders_and_imu_without_pictures(data: Path) -> None:
    assert measured(data / "yard_dev", "crane,imu").reference_rmse_mm < 1.5


def test_what_cant_be() -> None:
    for use in ("imu", "", "stereo,radar"):
        with pytest.raises(ConfigError, match="use"):
            FusionSettings(use=use)
    recording = MemoryRecording(ideal_rig())
    with pytest.raises(MeasurementError, match="no crane encoders"):
        BatchFusion(FusionSettings(use="crane"), CraneSettings())(
            recording, Rectifier(recording.rig), lambda: None
        )


def test_encoders_too_sparse_for_any_frame_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, sightings, _ = simulated(0)
    crane = recording.crane()
    assert crane is not None
    sparse = replace(crane, stamp_ns=crane.stamp_ns[::20], position_m=crane.position_m[::20])
    with pytest.raises(MeasurementError, match=r"the encoders place no frame .*use: stereo,imu"):
        fused(replace(recording, crane_samples=sparse), monkeypatch, sightings)


def test_projection_and_triangulation_are_inverse() -> None:
    camera = Rectifier(ideal_rig()).camera
    points = np.array([[0.1, -0.2, 3.0], [1.0, 0.5, 7.0]])
    np.testing.assert_allclose(triangulate_stereo(project_stereo(points, camera), camera), points)
