"""A recording in memory, for estimators that need nothing but the Protocol."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.motion import estimator
from barsight.motion.frontend.sightings import Sighting
from barsight.recording.base import FrameIndex

BODY_FROM_CAM0 = Pose("body", "cam0", np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([0.2, -0.1, 0.3]))


def ideal_rig(width: int = 320, height: int = 240, shift_ns: int = 0) -> StereoRig:
    """A rectified pair, f 300 px, baseline 0.4 m, mounted away from the body's origin."""
    camera = Camera(width, height, 300, 300, width / 2, height / 2)
    place = Pose("cam0", "cam1", np.eye(3), np.array([0.4, 0, 0]))
    return StereoRig(camera, camera, BODY_FROM_CAM0, BODY_FROM_CAM0 @ place, shift_ns)


@dataclass
class MemoryRecording:
    """A `Recording` of what it is given."""

    rig: StereoRig
    pictures: tuple[StereoFrame | RefusedFrame, ...] = ()
    stamps_ns: tuple[int, ...] = ()
    imu_samples: ImuSamples | None = None
    crane_samples: CraneSamples | None = None
    path: Path = Path("memory")
    format: str = "memory"
    is_simulated: bool = True
    notes: tuple[str, ...] = ()

    @property
    def index(self) -> FrameIndex:
        return FrameIndex(self.stamps_ns or tuple(p.stamp_ns for p in self.pictures), ())

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        yield from (p for p in self.pictures if wanted is None or p.stamp_ns in wanted)

    def imu(self) -> ImuSamples | None:
        return self.imu_samples

    def imu_noise(self) -> ImuNoise | None:
        return None

    def crane(self) -> CraneSamples | None:
        return self.crane_samples

    def laser(self) -> tuple[LaserProfile, ...]:
        return ()

    def digests(self) -> dict[str, str]:
        return {}


def tell_sightings(patch: pytest.MonkeyPatch, room: Any, seen: Iterable[Sighting | RefusedFrame]) -> None:
    """Let the estimator of `room` track what is told, frame by frame, whatever the pictures show."""
    told = {one.stamp_ns: one for one in seen}
    dark, seen_of_all = np.zeros((1, 1), np.uint8), np.ones((1, 1), np.bool_)
    camera = RectifiedCamera(1, 0, 0, 1, 0, 1, 1)

    class Told:
        def __init__(self, *_: Any) -> None:
            pass

        def push(self, pair: RectifiedPair) -> Sighting | RefusedFrame:
            return told[pair.stamp_ns]

    patch.setattr(room, "Tracker", Told)
    pairs = [RectifiedPair(stamp, dark, dark, seen_of_all, seen_of_all, camera) for stamp in told]
    patch.setattr(estimator, "_frames", lambda *_: iter(pairs))
