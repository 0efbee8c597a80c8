"""Ribs and highlights that slide along their bars, and gloss that lies deeper than the bars: found, and what
they leave open is in the covariance.
"""

from dataclasses import replace

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.evaluation.trajectory_error import trajectory_drift
from barsight.features.guided_matching import triangulate_stereo
from barsight.motion.batch import apparent_motion as slides
from barsight.motion.frontend.sightings import Sighting
from barsight.recording.formats.ground_truth import GroundTruth
from test_motion_fusion import NoisyRecording, fused, simulated

COMMON_RAD, OWN_RAD = 2.5e-4, 3e-4
GLOSS_PX, STRIP_M = 0.06, 1.4
FLOOR_M = 0.4


def sliding(seed: int) -> tuple[NoisyRecording, tuple[Sighting, ...], GroundTruth]:
    """Points over 0.4 m turn about the camera's axis by some share each and by another in common."""
    recording, sightings, truth = simulated(seed)
    rng = np.random.default_rng(100 + seed)
    rectifier = Rectifier(recording.rig)
    own = rng.normal(rng.choice([-1, 1]) * COMMON_RAD, OWN_RAD, 2000)
    slid = []
    for sighting, pose in zip(sightings, truth.poses, strict=True):
        place = (pose @ rectifier.body_from_rect0).apply(
            triangulate_stereo(sighting.stereo, rectifier.camera)
        )
        turn = np.where(place[:, 2] > FLOOR_M, own[sighting.track], 0.0)
        u, v = sighting.stereo[:, 0] - rectifier.camera.cx_px, sighting.stereo[:, 1] - rectifier.camera.cy_px
        stereo = sighting.stereo + np.column_stack([-turn * v, turn * u, -turn * v])
        slid.append(replace(sighting, stereo=stereo))
    return recording, tuple(slid), truth


def glossy(seed: int) -> tuple[NoisyRecording, tuple[Sighting, ...], GroundTruth]:
    """Strips of points over 0.4 m have disparities that are off, each by its own."""
    recording, sightings, truth = simulated(seed)
    rng = np.random.default_rng(200 + seed)
    rectifier = Rectifier(recording.rig)
    strips = rng.normal(0, GLOSS_PX, 20)
    off = []
    for sighting, pose in zip(sightings, truth.poses, strict=True):
        place = (pose @ rectifier.body_from_rect0).apply(
            triangulate_stereo(sighting.stereo, rectifier.camera)
        )
        strip = np.floor(place[:, 0] / STRIP_M).astype(int) + 5
        more = np.where(place[:, 2] > FLOOR_M, strips[strip], 0.0)
        off.append(replace(sighting, stereo=sighting.stereo - more[:, None] * [0, 0, 1]))
    return recording, tuple(off), truth


def test_gloss_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the pieces' disparities as unknowns, and held at nothing: then the attitude is worse."""

    def attitude() -> tuple[float, float]:
        found = []
        for seed in range(2):
            recording, sightings, truth = glossy(seed)
            drift = trajectory_drift(fused(recording, monkeypatch, sightings), truth, 0)
            assert drift is not None
            found.append((drift.reference_rmse_deg, drift.nees_attitude))
        rmse, nees = np.mean(found, axis=0)
        return float(rmse), float(nees)

    counted = attitude()
    monkeypatch.setattr(slides, "FIRST_SIGMA_PX", 1e-6)
    monkeypatch.setattr(slides, "PRIOR_PIECES", 1e9)
    without = attitude()
    assert counted[1] < 1.4
    assert counted[0] < without[0]


def test_slides_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the slides as unknowns, and without: then attitude is surer than it may be."""

    def nees() -> float:
        found = []
        for seed in range(2):
            recording, sightings, truth = sliding(seed)
            drift = trajectory_drift(fused(recording, monkeypatch, sightings), truth, 0)
            assert drift is not None
            found.append(drift.nees_attitude)
        return float(np.mean(found))

    counted = nees()
    monkeypatch.setattr(slides, "partition_points", lambda *_: None)
    assert counted < 1.5
    assert nees() > 2 * counted
