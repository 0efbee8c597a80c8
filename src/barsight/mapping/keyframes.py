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


class KeyframeSelection:
    """Selects keyframes by parallax: the first frame, and those whose picture has moved, since the last
    keyframe, by at least `keyframe_spacing_m` on a surface range_m away.
    """

    def __init__(self, rectifier: Rectifier, range_m: float, min_shift: float) -> None:
        self._rectifier, self._range_m, self._min_shift = rectifier, range_m, min_shift
        self._last: Float64 | None = None

    def is_due(self, frame: PosedFrame) -> bool:
        """Return True if the frame's picture has moved enough since the last keyframe."""
        if self._last is None:
            return True
        pose = frame.reference_from_body
        height_m = (pose @ self._rectifier.body_from_rect0).translation[2] if pose.target == "yard" else 0.0
        spacing_m = keyframe_spacing_m(self._rectifier.camera, self._range_m, self._min_shift, height_m)
        return bool(np.linalg.norm(self._seen(frame) - self._last) >= spacing_m)

    def take(self, frame: PosedFrame) -> None:
        """Make the frame the last keyframe. A frame that can't be matched mustn't be: the good ones after it
        would be passed over.
        """
        self._last = self._seen(frame)

    def _seen(self, frame: PosedFrame) -> Float64:
        camera = frame.reference_from_body @ self._rectifier.body_from_rect0
        return camera.apply(np.array([0.0, 0.0, self._range_m]))


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


def keyframe_spacing_m(
    camera: RectifiedCamera, range_m: float, min_shift: float, height_m: float = 0.0
) -> float:
    """Return the distance (m) that min_shift of a picture's shorter side spans on a surface range_m away, or
    MIN_WAY_PX on it or on the floor, height_m below the camera, if that is more.

    A picture that has moved by less repeats the errors of the last one, and what the crane carries can't be
    told from the yard in it, wherever above the floor it hangs: the first pair's range may be a pile's.
    """
    shift_m = min_shift * min(camera.width, camera.height) * range_m
    return max(shift_m, MIN_WAY_PX * max(range_m, height_m)) / camera.focal_px


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
