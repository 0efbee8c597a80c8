"""Pictures that are lost begin anew: long steps, chains that are joined, and places that look alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bar_pictures import bar_view
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.evaluation.trajectory_error import trajectory_drift
from barsight.features.guided_matching import PredictedMotion
from barsight.motion.frontend.chains import UNTIED, chained_poses, tied_parts
from barsight.motion.frontend.motion_consensus import wide_consensus
from barsight.motion.frontend.relative_pose import RelativePose
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.sightings import SeenAgain, Sighting
from barsight.motion.frontend.tracking import Tracker
from barsight.motion.frontend.wide_steps import (
    BARS_OFF,
    DescribedMotion,
    Repeats,
    check_next_bars,
    check_overlap,
    wide_motion,
    wide_view,
)
from barsight.recording.formats.ground_truth import GroundTruth, read_ground_truth
from barsight.recording.open import open_recording
from motion_recordings import MemoryRecording, ideal_rig
from simulated_ways import with_motion
from spoiled_recording import SpoiledRecording
from test_motion_fusion import simulated
from test_motion_live import ESTIMATORS, estimated
from test_motion_pitch import WAY_M, followed

SETTINGS = FrontEndSettings()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_drive_of_long_steps(data: Path, name: str) -> None:
    """2.3 m between pairs, no other sensor: all are placed, no worse than all pairs are."""
    whole = open_recording(data / "kitti_odometry_a")
    recording = SpoiledRecording(whole, kept=lambda k: k % 2 == 0)
    found = ESTIMATORS[name]("stereo")(recording, Rectifier(recording.rig), lambda: None)
    truth = read_ground_truth(data / "kitti_odometry_a", np.array(whole.index.stamps_ns))
    drift = trajectory_drift(found, truth, 0)
    assert drift is not None and drift.frames == 21 and not found.doubts
    assert drift.drift_percent < 0.8


@pytest.mark.parametrize("contrast", [12.0, 6.0])
@pytest.mark.parametrize("pitch_m", [0.04, 0.09])
def test_bars_alike_arent_mistaken(pitch_m: float, contrast: float) -> None:
    """The true motion stands; the same by bars more or less is refused, whatever the features said."""
    old, new = bar_view(pitch_m, 0.0, contrast), bar_view(pitch_m, WAY_M, contrast, seed=9)
    tracks = followed(old)
    views = [wide_view(one, SETTINGS.rough) for one in (old, new)]
    wide = wide_motion(views[0], views[1], SETTINGS.rough)
    assert not isinstance(wide, Failed)
    found = wide_consensus(tracks, new, wide, SETTINGS)
    assert not isinstance(found, Failed)
    assert abs(found[2].translation[0] + WAY_M) < 2e-3
    repeats = Repeats.of(tracks)
    assert repeats.share > 0.9 and abs(repeats.pitches_m[0, 0] - pitch_m) < 0.05 * pitch_m
    sure = np.diag([3e-4] * 3 + [0.002] * 3) ** 2
    for bars in BARS_OFF:
        way = np.array([-WAY_M - bars * pitch_m, 0, 0])
        off = DescribedMotion(PredictedMotion(np.eye(3), way, sure), 1.0)
        assert isinstance(wide_consensus(tracks, new, off, SETTINGS), Failed)


def test_a_next_bar_that_fits_as_well_is_refused() -> None:
    """A dull bar off, a third of the points still agree: that the true place explains twice as many tells."""
    old, new = bar_view(0.09, 0.0, 6.0), bar_view(0.09, WAY_M, 6.0, seed=9)
    tracks, sure = followed(old), np.diag([3e-4] * 3 + [0.002] * 3) ** 2
    repeats = Repeats.of(tracks)
    found = len(tracks.track) // 3
    wrong = PredictedMotion(np.eye(3), np.array([-WAY_M - 0.09, 0, 0]), sure)
    refused = check_next_bars(tracks, new, wrong, repeats, found, SETTINGS.tracks)
    assert refused is not None and "another bar may be" in refused.reason
    right = replace(wrong, translation=np.array([-WAY_M, 0, 0]))
    assert check_next_bars(tracks, new, right, repeats, 2 * found, SETTINGS.tracks) is None


def test_what_is_seen_at_the_edge_only_ties_nothing() -> None:
    """Half the view may lie elsewhere alike, unless all features agree."""
    old, new = bar_view(0.09, 0.0), bar_view(0.09, 1.8, seed=9)
    tracks = followed(old)
    step = RelativePose(np.eye(3), np.array([-1.8, 0, 0]), np.eye(6) * 1e-6, 0.0, np.arange(100) < 70)
    told = check_overlap(tracks, new, DescribedMotion.of(step), SETTINGS.tracks)
    assert told is not None and "elsewhere may be alike" in told.reason
    agreed = DescribedMotion.of(replace(step, kept=np.ones(100, np.bool_)))
    assert check_overlap(tracks, new, agreed, SETTINGS.tracks) is None


def test_a_chain_is_joined_where_its_place_is_seen_again() -> None:
    """Somewhere else first, which ties to nothing; then back beside the place before the loss."""
    tracker = Tracker(lambda *_: None, SETTINGS)
    views = [bar_view(0.09, x, seed=k).pair for k, x in enumerate((0.0, 0.3, 40.0, 40.3, 0.5, 0.8))]
    told = [tracker.push(replace(pair, stamp_ns=k)) for k, pair in enumerate(views)]
    assert all(isinstance(one, Sighting) for one in told)
    assert [one.motion is None for one in told] == [True, False, True, False, True, False]
    assert [None if one.again is None else one.again.stamp_ns for one in told] == [None] * 4 + [1, None]
    again = told[4].again.motion
    assert abs(again.translation[0] + 0.2) < 2e-3
    assert np.isin(told[4].track, told[1].track).sum() > 100
    parts = tied_parts(told, lambda *_: False)
    assert (parts[[0, 1, 4, 5]] == parts[0]).all() and (parts[2:4] != parts[0]).all() and parts[2] == parts[3]


def test_poses_of_chains_that_are_joined_later() -> None:
    """Forwards and backwards through the ties; what nothing ties goes on as it went."""
    way, none = np.array([0.0, 0.0, -0.5]), np.empty(0)
    move = PredictedMotion(Rotation.from_rotvec([0, 0.02, 0]).as_matrix(), way, np.eye(6))
    still = PredictedMotion(np.eye(3), np.zeros(3), np.eye(6))
    plain = Sighting(0, none.astype(np.int64), np.empty((0, 3)), none, None, 0)
    seen = [replace(plain, stamp_ns=k, motion=move if k in (1, 3) else None) for k in range(4)]
    mount, start = ideal_rig().body_from_cam0, Pose("world", "body", np.eye(3), np.zeros(3))
    mount = Pose("body", "rect0", mount.rotation, mount.translation)
    step = (mount @ Pose("rect0", "rect0", move.rotation, move.translation) @ mount.inverse()).inverse()
    poses = chained_poses(seen, start, mount)
    np.testing.assert_allclose(poses[1].matrix, (start @ step).matrix, atol=1e-12)
    np.testing.assert_allclose(poses[2].translation, 2 * poses[1].translation, atol=1e-12)
    np.testing.assert_allclose(poses[3].matrix, (poses[2] @ step).matrix, atol=1e-12)
    seen[3] = replace(seen[3], again=SeenAgain(1, still))
    poses = chained_poses(seen, start, mount)
    np.testing.assert_allclose(poses[3].matrix, poses[1].matrix, atol=1e-12)
    np.testing.assert_allclose((poses[2] @ step).matrix, poses[3].matrix, atol=1e-12)


def chained() -> tuple[MemoryRecording, tuple[Sighting, ...], GroundTruth]:
    """A simulated way whose sightings tell the motion since the one before."""
    recording, seen, truth = simulated(4)
    return recording, with_motion(list(seen), list(truth.poses), Rectifier(recording.rig)), truth


def lost(seen: tuple, first: int, end: int) -> tuple:
    """Frames first...end - 1 are dark; what follows is a new chain of points with new names."""
    most = max(int(one.track.max()) for one in seen) + 1
    told = [
        RefusedFrame(one.stamp_ns, "dark") if first <= k < end
        else one if k < first
        else replace(one, track=one.track + most, motion=one.motion if k > end else None)
        for k, one in enumerate(seen)
    ]  # fmt: skip
    return tuple(told)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_imu_joins_both_parts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, seen, truth = chained()
    found = estimated(name, "stereo,imu", recording, lost(seen, 8, 11), monkeypatch)
    assert len(found.frames) == len(seen) - 3 and not found.doubts
    drift = trajectory_drift(found, truth, 0)
    whole = trajectory_drift(estimated(name, "stereo,imu", recording, seen, monkeypatch), truth, 0)
    assert drift is not None and whole is not None
    assert drift.aligned_rmse_mm < whole.aligned_rmse_mm + 30
    if name == "fused":
        (told,) = [one for one in found.warnings if "begin anew" in one]
        assert "the IMU joins both parts" in told


@pytest.mark.parametrize("name", ESTIMATORS)
def test_what_nothing_joins_is_told(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, seen, _ = chained()
    found = estimated(name, "stereo", recording, lost(seen, 8, 11), monkeypatch)
    left = [frame for frame in found.refused if frame.reason == UNTIED]
    assert len(found.frames) + len(left) == len(seen) - 3 and len(left) in (8, len(seen) - 11)
    assert any(f"nothing joins the parts: {len(left)} frames" in doubt for doubt in found.doubts)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_points_seen_again_join_both_parts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, seen, truth = chained()
    told = list(lost(seen, 8, 9))
    rectifier = Rectifier(recording.rig)
    old, new = (truth.poses[k] @ rectifier.body_from_rect0 for k in (7, 9))
    step = new.inverse() @ old
    motion = PredictedMotion(step.rotation, step.translation, np.eye(6) * 1e-6)
    extra = np.isin(seen[9].track, seen[7].track)
    told[9] = replace(
        told[9], track=np.append(told[9].track, seen[9].track[extra]),
        stereo=np.vstack([told[9].stereo, seen[9].stereo[extra]]),
        sigma_px=np.append(told[9].sigma_px, seen[9].sigma_px[extra]),
        again=SeenAgain(seen[7].stamp_ns, motion),
    )  # fmt: skip
    found = estimated(name, "stereo", recording, tuple(told), monkeypatch)
    assert len(found.frames) == len(seen) - 1 and not found.doubts
    drift = trajectory_drift(found, truth, 0)
    assert drift is not None and drift.aligned_rmse_mm < 10
