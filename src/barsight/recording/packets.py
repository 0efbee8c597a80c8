"""A recording as time-ordered packets: from one that lies on disk, and back into one that grows."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import InputError
from barsight.core.types import CraneSamples, ImuSamples, LaserProfile, RefusedFrame, StereoFrame
from barsight.recording.base import FrameIndex, Recording

Packet = StereoFrame | RefusedFrame | ImuSamples | CraneSamples | LaserProfile
"""A pair, or samples that came since the last packet of their kind, or a reference profile."""


def packets(recording: Recording) -> Iterator[Packet]:
    """Read a recording in time's order: before each pair the samples up to it, then what is left."""
    yield from recording.laser()
    imu, crane, shift_ns = recording.imu(), recording.crane(), recording.rig.timeshift_cam_imu_ns
    last_ns: int | None = None
    for frame in recording.frames():
        now_ns = frame.stamp_ns + shift_ns
        yield from _between(imu, crane, last_ns, now_ns)
        last_ns = now_ns
        yield frame
    yield from _between(imu, crane, last_ns, None)


class PacketRecording:
    """A `Recording` of the packets that came so far; `folder` takes the pictures' pixels.

    Raises InputError for a packet that is older than the last of its kind.
    """

    path, format = Path("session"), "packets"
    notes: tuple[str, ...] = ()

    def __init__(
        self, rig: StereoRig, folder: Path, noise: ImuNoise | None = None, *, is_simulated: bool = False
    ) -> None:
        self.rig, self._folder, self._noise, self.is_simulated = rig, folder, noise, is_simulated
        self._frames: dict[int, RefusedFrame | None] = {}
        self._imu: list[ImuSamples] = []
        self._crane: list[CraneSamples] = []
        self._laser: list[LaserProfile] = []

    def add(self, packet: Packet) -> None:
        """Take a packet."""
        if isinstance(packet, LaserProfile):
            self._laser.append(packet)
        elif isinstance(packet, ImuSamples):
            self._expect_later(packet.stamp_ns[:1], [part.stamp_ns[-1:] for part in self._imu[-1:]])
            self._imu.append(packet)
        elif isinstance(packet, CraneSamples):
            self._expect_later(packet.stamp_ns[:1], [part.stamp_ns[-1:] for part in self._crane[-1:]])
            self._crane.append(packet)
        else:
            self._expect_later([packet.stamp_ns], [list(self._frames)[-1:]])
            if isinstance(packet, StereoFrame):
                np.savez(self._file(packet.stamp_ns), left=packet.left, right=packet.right)
            self._frames[packet.stamp_ns] = packet if isinstance(packet, RefusedFrame) else None

    def _expect_later(self, first: object, last: list[object]) -> None:
        new = np.asarray(first, np.int64)
        old = np.asarray(last, np.int64)
        if new.size and old.size and new[0] <= old.max():
            raise InputError(self.path, f"a packet of {new[0]} ns comes late", "push packets in time's order")

    @property
    def index(self) -> FrameIndex:
        """Return the index; see `Recording.index`."""
        return FrameIndex(tuple(self._frames), ())

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield frames; see `Recording.frames`."""
        for stamp, refused in list(self._frames.items()):
            if wanted is None or stamp in wanted:
                yield self._read(stamp) if refused is None else refused

    def imu(self) -> ImuSamples | None:
        """Read the IMU; see `Recording.imu`."""
        if len(self._imu) > 1:
            self._imu = [ImuSamples(*(_joined(self._imu, name) for name in _IMU))]
        return self._imu[0] if self._imu else None

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise; see `Recording.imu_noise`."""
        return self._noise

    def crane(self) -> CraneSamples | None:
        """Read the encoders; see `Recording.crane`."""
        if len(self._crane) > 1:
            joined = {name: _joined(self._crane, name) for name in ("stamp_ns", "position_m")}
            self._crane = [replace(self._crane[0], **joined)]
        return self._crane[0] if self._crane else None

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read the laser; see `Recording.laser`."""
        return tuple(self._laser)

    def digests(self) -> dict[str, str]:
        """Nothing: no input is a file."""
        return {}

    def _read(self, stamp_ns: int) -> StereoFrame:
        with np.load(self._file(stamp_ns)) as pair:
            return StereoFrame(stamp_ns, pair["left"], pair["right"])

    def _file(self, stamp_ns: int) -> Path:
        return self._folder / f"pair_{stamp_ns}.npz"


_IMU = ("stamp_ns", "gyro_radps", "accel_mps2")


def _joined(parts: Sequence[ImuSamples | CraneSamples], name: str) -> Any:
    return np.concatenate([getattr(part, name) for part in parts])


def _between(
    imu: ImuSamples | None, crane: CraneSamples | None, after_ns: int | None, last_ns: int | None
) -> Iterator[ImuSamples | CraneSamples]:
    """Return the samples after one stamp up to another; None has no bound."""
    for samples, names in ((imu, _IMU), (crane, ("stamp_ns", "position_m"))):
        if samples is not None:
            stamps = samples.stamp_ns
            first = 0 if after_ns is None else int(np.searchsorted(stamps, after_ns, side="right"))
            end = stamps.size if last_ns is None else int(np.searchsorted(stamps, last_ns, side="right"))
            if end > first:
                yield replace(samples, **{name: getattr(samples, name)[first:end] for name in names})
