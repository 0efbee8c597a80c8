"""Convert a recording to time-ordered packets, and build a growing recording from packets."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Int64
from barsight.core.errors import ConfigError, InputError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.settings.values import checked_value
from barsight.core.stamps import rows_not_later
from barsight.recording.base import FrameIndex, Recording
from barsight.recording.sensor_samples import expect_si

Samples = TypeVar("Samples", ImuSamples, CraneSamples)
Checked = TypeVar("Checked", ImuSamples, CraneSamples, LaserProfile)
Packet = StereoFrame | RefusedFrame | ImuSamples | CraneSamples | LaserProfile
"""A pair, or samples received since the last packet of their kind, or a reference profile."""
MIN_JUDGED = 10
"""Minimum number of samples whose median shows the unit of accelerations; a few may be a shock's."""


def packets(recording: Recording) -> Iterator[Packet]:
    """Read a recording in time order: before each pair the samples up to it, then the rest. Raises
    ConfigError for what is no recording.
    """
    if not hasattr(recording, "frames"):
        raise ConfigError(f"recording is {recording!r}; give what open_recording(PATH) returns")
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
    """A `Recording` of the packets received so far; `folder` stores the pictures' pixels.

    Raises InputError for a packet that is older than the last of its kind, whose arrays aren't finite,
    complete and in time order, or whose mounting differs from that before; ConfigError for what is no packet.
    A packet without samples has no effect.
    """

    path, format = Path("session"), "packets"
    notes: tuple[str, ...] = ()

    def __init__(
        self, rig: StereoRig, folder: Path, noise: ImuNoise | None = None, *, is_simulated: bool = False
    ) -> None:
        self.rig, self._folder, self._noise, self.is_simulated = rig, folder, noise, is_simulated
        self._stamps_ns: list[int] = []
        self._refused: dict[int, RefusedFrame] = {}
        self._imu: _Grown[ImuSamples] = _Grown()
        self._crane: _Grown[CraneSamples] = _Grown()
        self._laser: list[LaserProfile] = []
        self.last_frame_ns: int | None = None

    def add(self, packet: Packet) -> None:
        """Add a packet."""
        kinds: tuple[type, ...] = get_args(Packet)
        if not isinstance(packet, kinds):
            names = ", ".join(kind.__name__ for kind in kinds)
            raise ConfigError(f"a {type(packet).__name__} is no packet; give one of {names}")
        if isinstance(packet, LaserProfile):
            if checked_value(packet.range_std_m, float, "range_std_m of LaserProfile") < 0:
                raise InputError(
                    self.path, f"range_std_m is {packet.range_std_m}", "give the laser's sigma, m"
                )
            self._laser.append(self._checked(packet))
        elif isinstance(packet, ImuSamples):
            self._add_samples(packet, self._imu)
        elif isinstance(packet, CraneSamples):
            self._add_samples(packet, self._crane)
        else:
            self._expect_later([packet.stamp_ns], self.last_frame_ns)
            self.last_frame_ns = packet.stamp_ns
            if isinstance(packet, StereoFrame):
                np.savez(self._file(packet.stamp_ns), left=packet.left, right=packet.right)
            else:
                self._refused[packet.stamp_ns] = packet
            self._stamps_ns.append(packet.stamp_ns)

    def _add_samples(self, packet: Samples, series: _Grown[Samples]) -> None:
        if not np.size(packet.stamp_ns):
            return
        packet = self._checked(packet)
        self._expect_later(packet.stamp_ns, series.last_ns)
        if isinstance(packet, CraneSamples):
            self._expect_mounting(packet)
        elif len(packet.stamp_ns) >= MIN_JUDGED:
            expect_si(self.path, packet.accel_mps2)
        series.add(packet)

    def _checked(self, packet: Checked) -> Checked:
        """Return a packet with its arrays as NumPy's: stamps int64, the others float64. Raises InputError
        unless they are complete.
        """
        kind: type = type(packet)
        arrays = dict[str, Any]()
        count: int | None = None
        columns: tuple[int, ...]
        for name, columns in _COLUMNS[kind].items():
            values = np.asarray(getattr(packet, name))
            count = len(values) if count is None and values.ndim else count
            if values.shape != (count, *columns):
                problem = f"{name} of {kind.__name__} has the shape {values.shape}"
                raise InputError(self.path, problem, f"give {(count, *columns)}, a row per sample")
            if name == "stamp_ns" and values.dtype.kind not in "iu":
                raise InputError(
                    self.path, f"stamps of {kind.__name__} are {values.dtype}", "give ns, integers"
                )
            if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                problem = f"{name} of {kind.__name__} holds NaN, infinite values or no numbers"
                raise InputError(self.path, problem, "leave such samples out")
            # Later packets are written into an array of the first one's type.
            arrays[name] = values.astype(np.int64 if name == "stamp_ns" else np.float64, copy=False)
        return replace(packet, **arrays)

    def _expect_mounting(self, packet: CraneSamples) -> None:
        """Raise InputError for a mounting that can't be, or isn't that of the packets before."""
        mounting = [np.asarray(getattr(packet, name), np.float64) for name in _MOUNTING]
        first = self._crane.first
        if first is not None and not all(
            np.array_equal(one, getattr(first, name)) for one, name in zip(mounting, _MOUNTING, strict=True)
        ):
            problem = "CraneSamples have another mounting or sigma than those before"
            raise InputError(self.path, problem, "begin another session after the rig was moved")
        body_m, turn, std_m = mounting
        try:
            Pose("yard", "body", turn, body_m)
        except ValueError as error:
            raise InputError(self.path, f"the crane's mounting can't be: {error}") from None
        if not (np.isfinite(body_m).all() and 0 < std_m < np.inf):
            raise InputError(
                self.path, "crane_to_body_m and position_std_m must be finite, the latter positive"
            )

    def _expect_later(self, stamps_ns: Sequence[int] | Int64, last_ns: int | None) -> None:
        late = last_ns is not None and stamps_ns[0] <= last_ns
        if late or rows_not_later(np.asarray(stamps_ns)).size:
            raise InputError(
                self.path, f"a packet of {stamps_ns[0]} ns comes late", "push packets in time's order"
            )

    def last_readings_ns(self, use: Container[str]) -> tuple[int, ...]:
        """Return the stamp of the last reading of each sensor in `use` (`imu`, `crane`) that has any."""
        last = (
            series.last_ns for name, series in (("imu", self._imu), ("crane", self._crane)) if name in use
        )
        return tuple(stamp for stamp in last if stamp is not None)

    @property
    def index(self) -> FrameIndex:
        """Return the index; see `Recording.index`."""
        return FrameIndex(self._stamps_ns, ())

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield frames; see `Recording.frames`."""
        for stamp in self._stamps_ns[:]:
            if wanted is None or stamp in wanted:
                yield self._refused.get(stamp) or self._read(stamp)

    def imu(self) -> ImuSamples | None:
        """Read the IMU; see `Recording.imu`."""
        return self._imu.samples

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise; see `Recording.imu_noise`."""
        return self._noise

    def crane(self) -> CraneSamples | None:
        """Read the encoders; see `Recording.crane`."""
        return self._crane.samples

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read the laser; see `Recording.laser`."""
        return tuple(self._laser)

    def digests(self) -> dict[str, str]:
        """Return an empty result: no input is a file."""
        return {}

    def _read(self, stamp_ns: int) -> StereoFrame:
        with np.load(self._file(stamp_ns)) as pair:
            return StereoFrame(stamp_ns, pair["left"], pair["right"])

    def _file(self, stamp_ns: int) -> Path:
        return self._folder / f"pair_{stamp_ns}.npz"


_COLUMNS: dict[type, dict[str, tuple[int, ...]]] = {
    ImuSamples: {"stamp_ns": (), "gyro_radps": (3,), "accel_mps2": (3,)},
    CraneSamples: {"stamp_ns": (), "position_m": (3,)},
    LaserProfile: {"x_m": (), "y_m": (), "z_m": ()},
}
"""Arrays of a packet, and the shape of a sample in each."""
_MOUNTING = ("crane_to_body_m", "yard_from_body_nominal", "position_std_m")


class _Grown(Generic[Samples]):
    """Growing samples; the cost of adding does not depend on their number."""

    def __init__(self) -> None:
        self.first: Samples | None = None
        self._arrays: dict[str, Any] = {}
        self._count = 0

    def add(self, part: Samples) -> None:
        if self.first is None:
            self.first = part
            self._arrays = {name: getattr(part, name).copy() for name in _COLUMNS[type(part)]}
            self._count = len(part.stamp_ns)
            return
        end = self._count + len(part.stamp_ns)
        array: Any
        for name, array in self._arrays.items():
            if end > len(array):
                self._arrays[name] = np.resize(array, (2 * end, *array.shape[1:]))
            self._arrays[name][self._count : end] = getattr(part, name)
        self._count = end

    @property
    def last_ns(self) -> int | None:
        return int(self._arrays["stamp_ns"][self._count - 1]) if self._count else None

    @property
    def samples(self) -> Samples | None:
        count = self._count  # read once: another thread may be adding
        if self.first is None:
            return None
        return replace(self.first, **{name: array[:count] for name, array in self._arrays.items()})


def _between(
    imu: ImuSamples | None, crane: CraneSamples | None, after_ns: int | None, last_ns: int | None
) -> Iterator[ImuSamples | CraneSamples]:
    """Return the samples after one stamp up to another; None for no bound."""
    for samples in (imu, crane):
        if samples is not None:
            stamps = samples.stamp_ns
            first = 0 if after_ns is None else int(np.searchsorted(stamps, after_ns, side="right"))
            end = stamps.size if last_ns is None else int(np.searchsorted(stamps, last_ns, side="right"))
            if end > first:
                names = _COLUMNS[type(samples)]
                yield replace(samples, **{name: getattr(samples, name)[first:end] for name in names})
