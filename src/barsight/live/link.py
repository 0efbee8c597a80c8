"""Hand a process of the run what it needs: settings, files and shared memory."""

from __future__ import annotations

import contextlib
from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from barsight.core.errors import OutputError
from barsight.core.files import atomic_path
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.live.settings import CraneConfig, LiveSettings
from barsight.live.shared.counters import Counters
from barsight.live.shared.logs import NumberLog, ReadingLog
from barsight.live.shared.ring import PairRing
from barsight.measure_settings import MeasureSettings
from barsight.motion.fixed_lag.propagation import ROW_NUMBERS
from barsight.recording.base import FrameIndex, Recording
from barsight.recording.open import open_recording
from barsight.recording.packets import PacketRecording
from barsight.recording.sensor_selection import SelectedSensors
from barsight.recording.stored_images import StoredPictures
from barsight.recording.wrapper import RecordingProxy
from barsight.yard_frame import in_yard


@dataclass(frozen=True)
class LiveInput:
    """A recording to replay, or a crane's own sensors.

    speed: recorded seconds per second; 0: as fast as possible. crane: the sensors of crane.toml; `recording`
    is then the folder that the run records into. epoch_ns: offset of the stamps from the monotonic clock
    there. surveys: the run ends when the crane stops.
    """

    recording: Path
    speed: float = 1.0
    crane: CraneConfig | None = None
    epoch_ns: int = 0
    surveys: bool = False


@dataclass(frozen=True)
class Link:
    """Settings, files and memory of a run that its processes share.

    checkpoints: the folder in `folder` for pictures and disparities. ring, counters: names of the shared
    memory. keyframes: stamps of the only pairs to keep, None if the run chooses them.
    """

    source: LiveInput
    settings: MeasureSettings
    live: LiveSettings
    folder: Path
    checkpoints: Path
    ring: str
    counters: str
    keyframes: tuple[int, ...] | None

    def open_recording(self) -> Recording:
        """Open the recording that is replayed; at a crane, what is known about it beforehand."""
        crane = self.source.crane
        return self.open_replayed() if crane is None else crane.awaited(self.source.recording)

    def open_replayed(self) -> StoredPictures:
        """Open the recording that is replayed."""
        return open_recording(self.source.recording, self.settings.recording)

    def sensors(self, recording: Recording) -> set[str]:
        """Name those of `imu` and `crane` that the recording has and that may be used."""
        have = {"imu": recording.imu, "crane": recording.crane}
        return {sensor for sensor, read in have.items() if sensor in self.settings.use and read() is not None}

    def open_ring(self) -> PairRing:
        """Attach to the ring of pairs."""
        camera = self.open_recording().rig.cam0
        return PairRing(self.live.ring_pairs, camera.height, camera.width, self.ring)

    def open_counters(self) -> Counters:
        """Attach to the counters."""
        return Counters(self.counters)

    def readings(self, sensor: str) -> ReadingLog:
        """Open the log of `imu` or `crane`."""
        return ReadingLog(self.folder / f"{sensor}.log", {"imu": 6, "crane": 3}[sensor])

    def tell(self, name: str, why: str) -> None:
        """Write why a process ended, or one of `modes.TROUBLES`; "" once it is over. The disk may be full, of
        which the command tells. A reader never finds a trouble that lasts to be over.
        """
        if " ".join(why.split()) != self.told(name):
            with contextlib.suppress(OSError, OutputError), atomic_path(self._reason(name)) as path:
                path.write_text(why, encoding="utf-8")

    def told(self, name: str) -> str:
        """Read what was told last, on one line; "" if nothing was."""
        try:
            return " ".join(self._reason(name).read_text(encoding="utf-8").split())
        except OSError:
            return ""

    def _reason(self, name: str) -> Path:
        return self.folder / f"{name}.reason"

    def states(self) -> ReadingLog:
        """Open the log of the states from which poses are propagated (IMU clock)."""
        return ReadingLog(self.folder / "states.log", ROW_NUMBERS)

    def outputs(self) -> NumberLog:
        """Open the log of the poses written: stamp, and delay after it (ns)."""
        return NumberLog(self.folder / "outputs.log")

    def frames(self) -> NumberLog:
        """Open the log of tracked frames: stamp, exposure and end (ns, monotonic), is kept, has a pose."""
        return NumberLog(self.folder / "frames.log")

    def tiles(self) -> NumberLog:
        """Open the log of mapped frames: stamp, exposure and completion (ns, monotonic)."""
        return NumberLog(self.folder / "tiles.log")

    def raw_file(self, stamp_ns: int) -> Path:
        """Return the file of a kept pair's raw pictures, which exists until they are recorded."""
        return self.folder / f"raw_{stamp_ns}.npy"


@dataclass(frozen=True, eq=False)
class KeptRecording(RecordingProxy):
    """View of `whole` with only the pairs of `stamps_ns`, which may grow."""

    stamps_ns: list[int]

    @property
    def index(self) -> FrameIndex:
        return FrameIndex(self.stamps_ns, self.whole.index.unpaired)

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        kept = set(self.stamps_ns)
        yield from self.whole.frames({s for s in kept if wanted is None or s in wanted})


@dataclass(frozen=True, eq=False)
class GrowingRecording(KeptRecording):
    """A `KeptRecording` with only the readings received so far; `grow` adds those received since."""

    link: Link

    def imu(self) -> ImuSamples | None:
        return self._held.imu()

    def crane(self) -> CraneSamples | None:
        return self._held.crane()

    def grow(self) -> None:
        """Add the readings received since the last call."""
        stamps, values = self._logs["imu"].read()
        self._held.add(ImuSamples(stamps, values[:, :3], values[:, 3:]))
        stamps, values = self._logs["crane"].read()
        if self._mounted is not None:
            self._held.add(replace(self._mounted, stamp_ns=stamps, position_m=values))

    def in_use(self) -> Recording:
        """Return a view with the sensors in use, in the yard frame."""
        use, yard = self.link.settings.use, self.link.settings.yard
        return in_yard(SelectedSensors(self, use), yard, SelectedSensors(self.whole, use))

    def last_readings_ns(self) -> dict[str, int]:
        """Return the stamp of the last reading of each sensor that has provided any."""
        use = self.link.settings.use
        return {sensor: last for sensor in use for last in self._held.last_readings_ns((sensor,))}

    @cached_property
    def _held(self) -> PacketRecording:
        return PacketRecording(self.rig, self.link.folder)

    @cached_property
    def _mounted(self) -> CraneSamples | None:
        return self.whole.crane()

    @cached_property
    def _logs(self) -> dict[str, ReadingLog]:
        return {sensor: self.link.readings(sensor) for sensor in ("imu", "crane")}
