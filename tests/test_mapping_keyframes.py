"""Keyframes: the frames of a recording that are matched."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.mapping.ego_mask import MIN_WAY_PX
from barsight.mapping.keyframes import keyframe_spacing_m, select_keyframes, select_keyframes_by_encoders
from barsight.mapping.settings import MapSettings
from barsight.measure_settings import MeasureSettings

CAMERA = RectifiedCamera(1000.0, 499.5, 399.5, 0.5, 0.0, 1000, 800)
RANGE_M = 8.0


def _frames(places_m: list[float], turns_rad: list[float]) -> list[PosedFrame]:
    frames = []
    for stamp, (x, turn) in enumerate(zip(places_m, turns_rad, strict=True)):
        sine, cosine = np.sin(turn), np.cos(turn)
        about_y = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        pose = Pose("yard", "body", about_y, np.array([x, 0.0, 0.0]))
        frames.append(PosedFrame(stamp, pose, np.eye(6)))
    return frames


def _rectifier() -> Any:
    return SimpleNamespace(camera=CAMERA, body_from_rect0=Pose("body", "rect0", np.eye(3), np.zeros(3)))


def test_frames_are_taken_once_the_picture_has_moved_far_enough() -> None:
    # A tenth of 800 px at 8 m and 1000 px is 0.64 m.
    frames = _frames([0.0, 0.3, 0.65, 0.9, 1.2, 1.3, 1.4], [0.0] * 7)
    assert select_keyframes(frames, _rectifier(), RANGE_M, 0.1) == {0, 2, 5, 6}
    assert select_keyframes(frames, _rectifier(), RANGE_M, 0.0) == {0, 1, 2, 3, 4, 6}
    turned = _frames([0.0] * 4, [0.0, 0.05, 0.1, 0.1])
    assert select_keyframes(turned, _rectifier(), RANGE_M, 0.1) == {0, 2, 3}


def test_a_crane_at_rest_or_slow_confirms_no_frame_by_itself() -> None:
    """Ten pictures a second at 0.6 m/s between rests of four seconds: those taken lie so far apart that what
    the crane carries is told from the yard, whatever the pictures' size; the last one is always taken.
    """
    places = [0.0] * 40 + [0.06 * k for k in range(1, 50)] + [0.06 * 49] * 40
    frames = _frames(places, [0.0] * len(places))
    taken = sorted(select_keyframes(frames, _rectifier(), RANGE_M, 0.0))
    apart_px = np.diff([places[k] for k in taken]) * CAMERA.focal_px / RANGE_M
    assert taken[0] == 0 and taken[-1] == len(places) - 1
    assert apart_px[:-1].min() >= MIN_WAY_PX and apart_px.max() < MIN_WAY_PX + 7.6
    assert keyframe_spacing_m(replace(CAMERA, width=320, height=256), RANGE_M, 0.01) == pytest.approx(
        MIN_WAY_PX * RANGE_M / CAMERA.focal_px
    )


def test_encoders_choose_as_the_trajectory_does() -> None:
    frames = _frames([0.0, 0.3, 0.65, 0.9, 1.2, 1.3, 1.4], [0.0] * 7)
    read = np.array([0.0, 0.65, 1.3, 1.4])
    places = np.column_stack([read, 0 * read + 2, 0 * read + 8])
    crane = CraneSamples(np.array([100, 102, 105, 106]), places, np.zeros(3), np.eye(3), 0.001)
    for share in (0.1, 0.15):
        chosen = select_keyframes_by_encoders(range(7), crane, 100, CAMERA, RANGE_M, share)
        assert set(chosen) == select_keyframes(frames, _rectifier(), RANGE_M, share)


def test_preset_fast_says_what_it_changes() -> None:
    best, fast = MeasureSettings().chosen(), MeasureSettings(preset="fast").chosen()
    assert (best.stereo.barsight.preset, best.map.min_shift) == ("best", 0.0)
    assert (fast.stereo.barsight.preset, fast.map.min_shift) == ("fast", 0.15)
    wider = MeasureSettings(preset="fast", map=MapSettings(min_shift=0.2)).chosen()
    assert wider.map.min_shift == 0.2
    with pytest.raises(ConfigError, match="min_shift"):
        MapSettings(min_shift=0.9)
