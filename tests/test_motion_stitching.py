"""The paper's stitching on a textured wall that passes by: the way, its sigma, the frames it refuses."""

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.frame_to_frame.stitching import PaperStitching, StitchingSettings
from barsight.motion.frontend.stereo_features import OdometrySettings
from motion_recordings import MemoryRecording, ideal_rig
from test_motion_odometry import picture_pair


def test_the_chain_and_what_it_refuses() -> None:
    """Two steps, their errors within the stated sigma; a torn and a foreign picture are left out."""
    foreign = StereoFrame(4, *np.random.default_rng(0).integers(0, 256, (2, 240, 320), dtype=np.uint8))
    pictures = (picture_pair(1, 0.0), picture_pair(2, 3.3), RefusedFrame(3, "torn"), foreign)
    source = MemoryRecording(ideal_rig(), (*pictures, picture_pair(5, 7.8)))
    told: list[int] = []
    stitch = PaperStitching(StitchingSettings(), OdometrySettings(features=600), CraneSettings())
    trajectory = stitch(source, Rectifier(source.rig), lambda: told.append(1))
    assert len(told) == 5
    assert (trajectory.reference, trajectory.sensors) == ("world", ("stereo",))
    assert [f.stamp_ns for f in trajectory.frames] == [1, 2, 5]
    assert [f.stamp_ns for f in trajectory.refused] == [3, 4]
    # World's X is where cam0 looks; the rig moves along -Y.
    error = trajectory.positions_m - np.outer([0, -3.3, -7.8], [0, 1 / 60, 0])
    sigma = np.array([np.sqrt(np.diag(f.covariance)[3:]) for f in trajectory.frames])
    assert np.abs(error).max() < 0.01
    assert (np.abs(error[1:]) < 4 * sigma[1:]).all()
    assert (sigma[1] < sigma[2]).all()


def test_settings() -> None:
    for setting in ({"homography_px": 0.0}, {"trend_px": -1.0}, {"min_matches": 3}):
        with pytest.raises(ConfigError):
            StitchingSettings(**setting)
