"""Keyframes: the frames of a recording that are matched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import barsight as bs
from barsight.core import parallel
from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.mapping import keyframes
from barsight.mapping.ego_mask import MIN_WAY_PX
from barsight.mapping.keyframes import (
    KeyframeSelection,
    keyframe_spacing_m,
    select_keyframes_by_encoders,
)
from barsight.mapping.settings import MapSettings
from barsight.mapping.view import Matcher
from barsight.measure_settings import MeasureSettings
from barsight.reconstruction import tracked_recording
from barsight.reconstruction.live_map import LiveMap
from barsight.reconstruction.pair_chain import PairChain
from barsight.stereo.image_pair import pair_from_images

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


NOISE = np.random.default_rng(1).integers(0, 255, (64, 160)).astype(np.uint8)
GOOD = pair_from_images(NOISE[:, :128], NOISE[:, 16:144])


def _picture(stamp: int) -> RectifiedPair:
    return replace(GOOD, stamp_ns=stamp)


def _strobed(stamp: int) -> RectifiedPair | RefusedFrame:
    """Every other picture is black, and a cable is loose now and then."""
    if stamp % 4 == 2:
        return RefusedFrame(stamp, "cut off")
    black = pair_from_images(*np.zeros((2, 64, 128), np.uint8))
    return _picture(stamp) if stamp % 2 else replace(black, stamp_ns=stamp)


def select_keyframes(frames: list[PosedFrame], rectifier: Any, range_m: float, share: float) -> set[int]:
    selection = KeyframeSelection(rectifier, range_m, share)
    return set(tracked_recording.select_keyframes(frames, _picture, selection, MeasureSettings().stereo)[0])


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


@pytest.mark.parametrize("range_m", [4.0, 5.33, 8.0])
def test_what_hangs_low_over_the_floor_is_told_from_it_beside_a_pile(range_m: float) -> None:
    """The first pair's range may be that of a pile, but a magnet can hang deeper: each has 24 px to move."""
    frames = _frames([0.03 * k for k in range(40)], [0.0] * 40)
    height = np.array([0.0, 0.0, RANGE_M])
    high = [replace(f, reference_from_body=Pose("yard", "body", np.eye(3),
            f.reference_from_body.translation + height)) for f in frames]  # fmt: skip
    taken = sorted(select_keyframes(high, _rectifier(), range_m, 0.0))[:-1]
    at_floor_px = 0.03 * np.diff(taken) * CAMERA.focal_px / RANGE_M
    assert len(taken) > 4 and at_floor_px.min() >= MIN_WAY_PX


def test_a_frame_without_a_picture_displaces_none_that_has_one(tmp_path: Path) -> None:
    """Strobes and faulty cables: encoders place what can't be matched. A live map selects the same frames."""
    frames = _frames([0.1 * k for k in range(23)], [0.0] * 23)
    selection = KeyframeSelection(_rectifier(), RANGE_M, 0.0)
    settings = MeasureSettings()
    taken, refused = tracked_recording.select_keyframes(frames, _strobed, selection, settings.stereo)
    assert list(taken) == list(range(1, 22, 2))
    assert [(one.frame.stamp_ns, one.stage) for one in refused[:2]] == [(0, "stereo"), (22, "recording")]

    fused = list[int]()
    builder = SimpleNamespace(add=lambda match, posed, after: fused.append(posed.stamp_ns), settle=int)
    builder.placed, builder.stamps_ns = [], fused
    pairs = SimpleNamespace(recording=SimpleNamespace(crane=lambda: None), rectifier=_rectifier())
    by_stamp = {frame.stamp_ns: frame for frame in frames}
    placer = SimpleNamespace(push=lambda pair: by_stamp[pair.stamp_ns], finish=lambda: 1)
    live = LiveMap(
        cast(Any, pairs), settings, tmp_path, None, cast(Any, placer), cast(Any, lambda pair: pair)
    )
    live._checkpoints = tmp_path
    live._map = cast(Any, (builder, None))
    live._selection = KeyframeSelection(_rectifier(), RANGE_M, 0.0)
    for frame in frames:
        live.add(_strobed(frame.stamp_ns))
    live.end()
    assert fused == list(taken)


def test_encoders_choose_as_the_trajectory_does() -> None:
    frames = _frames([0.0, 0.3, 0.65, 0.9, 1.2, 1.3, 1.4], [0.0] * 7)
    read = np.array([0.0, 0.65, 1.3, 1.4])
    places = np.column_stack([read, 0 * read + 2, 0 * read + 8])
    crane = CraneSamples(np.array([100, 102, 105, 106]), places, np.zeros(3), np.eye(3), 0.001)
    for share in (0.1, 0.15):
        chosen = select_keyframes_by_encoders(range(7), crane, 100, CAMERA, RANGE_M, share)
        assert set(chosen) == select_keyframes(frames, _rectifier(), RANGE_M, share)


def test_frames_that_are_passed_over_are_not_matched(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten minutes at rest are 6000 pairs, of which two are mapped."""
    matched, stamps = list[int](), bs.open_recording(whole).index.stamps_ns
    call = Matcher.__call__
    monkeypatch.setattr(
        Matcher,
        "__call__",
        lambda self, pair, *more: matched.append(pair.stamp_ns) or call(self, pair, *more),
    )
    monkeypatch.setattr(keyframes, "MIN_WAY_PX", 1e4)
    monkeypatch.setattr(parallel, "_is_alone", lambda: True)  # nothing is matched ahead of the trajectory
    bs.measure(whole, map={"cell_m": 0.05}, stereo={"method": "sgbm"})
    assert matched == [stamps[0], stamps[-1]]
    pairs = SimpleNamespace(recording=SimpleNamespace(index=SimpleNamespace(stamps_ns=list(range(9)))))
    assert PairChain(cast(Any, pairs), cast(Any, None), 4, None).with_predecessors([1, 6]) == {0, 1, 4, 5, 6}


def test_preset_fast_says_what_it_changes() -> None:
    best, fast = MeasureSettings().chosen(), MeasureSettings(preset="fast").chosen()
    assert (best.stereo.barsight.preset, best.map.min_shift) == ("best", 0.0)
    assert (fast.stereo.barsight.preset, fast.map.min_shift) == ("fast", 0.15)
    wider = MeasureSettings(preset="fast", map=MapSettings(min_shift=0.2)).chosen()
    assert wider.map.min_shift == 0.2
    with pytest.raises(ConfigError, match="min_shift"):
        MapSettings(min_shift=0.9)
