"""A recording whose frames, stamps, encoders or IMU are spoiled in a known way, for robustness tests."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.recording.base import FrameIndex, Recording


@dataclass
class SpoiledRecording:
    """`recording` with frames left out (`kept` by index), shifted stamps and changed sensors."""

    recording: Recording
    kept: Callable[[int], bool] = lambda _: True
    stamps: Callable[[list[int]], list[int]] = lambda stamps: stamps
    spoil_crane: Callable[[CraneSamples], CraneSamples] = lambda crane: crane
    spoil_imu: Callable[[ImuSamples], ImuSamples] = lambda imu: imu
    spoil_pictures: Callable[[int, StereoFrame], StereoFrame] = lambda _, frame: frame
    _new: dict[int, int] = field(init=False)

    def __post_init__(self) -> None:
        old = list(self.recording.index.stamps_ns)
        self._new = {a: b for k, (a, b) in enumerate(zip(old, self.stamps(old), strict=True)) if self.kept(k)}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.recording, name)

    @property
    def index(self) -> FrameIndex:
        return FrameIndex(tuple(self._new.values()), ())

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        for k, frame in enumerate(self.recording.frames()):
            stamp = self._new.get(frame.stamp_ns)
            if stamp is not None and (wanted is None or stamp in wanted):
                frame = self.spoil_pictures(k, frame) if isinstance(frame, StereoFrame) else frame
                yield replace(frame, stamp_ns=stamp)

    def imu(self) -> ImuSamples | None:
        imu = self.recording.imu()
        return None if imu is None else self.spoil_imu(imu)

    def crane(self) -> CraneSamples | None:
        crane = self.recording.crane()
        return None if crane is None else self.spoil_crane(crane)


def with_outliers(crane: CraneSamples, share: float, size_m: float) -> CraneSamples:
    """A share of the readings off by `size_m` in a direction of chance."""
    rng = np.random.default_rng(1)
    off: Float64 = rng.normal(size=crane.position_m.shape)
    off *= size_m / np.linalg.norm(off, axis=1, keepdims=True)
    off[rng.random(len(off)) > share] = 0
    return replace(crane, position_m=crane.position_m + off)


def late(crane: CraneSamples, latency_s: float) -> CraneSamples:
    """Readings that say where the crane was `latency_s` before their stamp."""
    return replace(crane, stamp_ns=crane.stamp_ns + round(latency_s * 1e9))


def frozen_between(crane: CraneSamples, first_s: float, last_s: float) -> CraneSamples:
    """The readings stand still between two times after the first."""
    time = (crane.stamp_ns - crane.stamp_ns[0]) / 1e9
    place = crane.position_m.copy()
    held = (time > first_s) & (time < last_s)
    place[held] = place[np.flatnonzero(held)[0]]
    return replace(crane, position_m=place)
