"""Select keyframes: frames whose pictures have moved enough since the last keyframe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.mapping.ego_mask import MIN_WAY_PX


def select_keyframes(
    frames: Sequence[PosedFrame], rectifier: Rectifier, range_m: float, min_shift: float
) -> set[int]:
    """Select keyframes by parallax: stamps of frames whose picture has moved, since the last keyframe, by
    at least min_shift of its shorter side on a surface range_m away; the first and the last frame always.
    """
    ahead = np.array([0.0, 0.0, range_m])
    seen = [(frame.reference_from_body @ rectifier.body_from_rect0).apply(ahead) for frame in frames]
    stamps = [frame.stamp_ns for frame in frames]
    return set(_spread(stamps, np.array(seen), keyframe_spacing_m(rectifier.camera, range_m, min_shift)))


def select_keyframes_by_encoders(
    stamps_ns: Sequence[int], crane: CraneSamples, shift_ns: int, camera: RectifiedCamera, range_m: float,
    min_shift: float,
) -> list[int]:  # fmt: skip
    """Select keyframes from the encoders, before a trajectory is known, as if the camera moved with the crane
    without swaying.

    shift_ns: offset from the frames' clock to the encoders'.
    """
    start = int(crane.stamp_ns[0])
    at, known = (np.asarray(times) - start for times in (np.array(stamps_ns) + shift_ns, crane.stamp_ns))
    places = np.column_stack([np.interp(at, known, axis) for axis in crane.position_m.T])
    return _spread(stamps_ns, places, keyframe_spacing_m(camera, range_m, min_shift))


def keyframe_spacing_m(camera: RectifiedCamera, range_m: float, min_shift: float) -> float:
    """Return the distance (m) on a surface range_m away that min_shift of a picture's shorter side spans, or
    MIN_WAY_PX if that is more.

    A picture that has moved by less repeats the errors of the last one, and what the crane carries can't be
    told from the yard in it.
    """
    shift_px = max(min_shift * min(camera.width, camera.height), MIN_WAY_PX)
    return shift_px * range_m / camera.focal_px


def _spread(stamps_ns: Sequence[int], places_m: Float64, min_m: float) -> list[int]:
    """Select the stamps whose position (N, 3) is at least min_m from the last selected one; the first and
    the last always.
    """
    taken: list[int] = []
    last: Float64 | None = None
    for stamp, place in zip(stamps_ns, places_m, strict=True):
        if last is None or np.linalg.norm(place - last) >= min_m or stamp == stamps_ns[-1]:
            taken.append(stamp)
            last = place
    return taken
