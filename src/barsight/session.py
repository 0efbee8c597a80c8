"""Measure packets as they arrive, with a snapshot at any time and the batch result at the end."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.records.pairs import RectifiedPair, RefusedFrame, StereoFrame
from barsight.core.settings.values import build_settings, checked_value
from barsight.core.stamps import NS_PER_S
from barsight.core.timing import Stopwatch
from barsight.measure_folder import ignore_progress, write_measured
from barsight.measure_settings import MeasureSettings
from barsight.motion.settings import make_early_estimator
from barsight.pipeline.lift_choice import LiftRequest
from barsight.reconstruction.checkpoint import checkpoint_folder, checkpoint_key
from barsight.reconstruction.live_map import LiveMap, PairPlacer, Snapshot, is_final
from barsight.reconstruction.tracked_recording import matching
from barsight.recording.packets import Packet, PacketRecording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.result import TemporaryFolder, Yard
from barsight.yard.magnet.description import load_magnet
from barsight.yard_frame import expect_fits, in_yard

GRACE_NS = NS_PER_S
"""Time in ns that a frame waits for a sensor's readings, and the first one for any sign of every sensor."""


class Session:
    """Measures packets as they arrive: `snapshot` at any time, `next_pass` between passes, `finish` once.

    Each picture is rectified once and each pair matched once, for the snapshots and the end; both are on disk
    (20 MB per pair of 1.3 megapixels), in a temporary folder that is deleted with the session and its yard.
    The estimator `live` also places each pair once; with the batch estimators the poses of snapshots are
    provisional.
    """

    def __init__(
        self, rig: StereoRig, settings: MeasureSettings | Mapping[str, Any] | None = None, *,
        magnet: Path | str | None = None, imu_noise: ImuNoise | None = None, is_simulated: bool = False,
        **fields: Any,
    ) -> None:  # fmt: skip
        """Open a session. settings: or their fields by name, as for `measure`. magnet: TOML file of the
        magnet that lifts are chosen for. is_simulated: stated in the result. Raises InputError or
        ConfigError.
        """
        if not isinstance(rig, StereoRig):
            raise ConfigError(f"rig is {rig!r}; give a StereoRig, like open_recording(PATH).rig")
        if settings is not None and fields:
            raise ConfigError(f"settings are given twice; add {', '.join(fields)} to them")
        self._asked = build_settings(fields if settings is None else settings, MeasureSettings)
        described = checked_value(magnet, Path | None, "magnet")
        self._magnet = None if described is None else load_magnet(described)
        if imu_noise is not None and not isinstance(imu_noise, ImuNoise):
            raise ConfigError(f"imu_noise is {imu_noise!r}; give an ImuNoise, like a recording's imu_noise()")
        compile_ahead(ignore_progress, "measure")  # a moving crane doesn't wait for kernels
        self._settings = self._asked.chosen()
        self._temporary = TemporaryFolder()
        self._folder = self._temporary.path
        self._yard = self._folder / "yard"
        self._rig, self._noise = rig, imu_noise
        self._is_simulated = checked_value(is_simulated, bool, "is_simulated")
        self._recordings: list[PacketRecording] = []
        self._begin_pass()

    def _begin_pass(self) -> None:
        name = f"pass_{len(self._recordings) + 1}"
        self._here = self._folder / name
        self._here.mkdir()
        self._recording = PacketRecording(
            self._rig, self._here, self._noise, is_simulated=self._is_simulated
        )  # fmt: skip
        self._recordings.append(self._recording)
        selected = SelectedSensors(self._recording, self._settings.use)
        self._source = in_yard(selected, self._settings.yard, is_awaited=True)
        key = checkpoint_key(self._recording, self._source, self._settings, {})
        self._checkpoints = checkpoint_folder(self._folder / "checkpoints" / name, key)
        self._pairs = RectifiedPairs(self._source, Rectifier(self._rig), self._checkpoints)
        # A rig that is corrected at the end then gives other disparities.
        checkpoints = self._checkpoints if self._settings.self_calibrate == "none" else None
        self._match = matching(self._pairs, self._settings, checkpoints, Stopwatch())
        self._waiting: deque[RectifiedPair | RefusedFrame] = deque()
        self._map: LiveMap | None = None

    def push(self, packet: Packet) -> None:
        """Add the next packet; a pair comes after all earlier readings, and enters the map once the readings
        that place it have arrived. Raises MeasurementError after `finish`, InputError if the yard file
        doesn't belong to this rig and crane.
        """
        self._expect_open()
        self._recording.add(packet)
        if isinstance(packet, StereoFrame):
            self._waiting.append(self._pairs.rectify(packet))
        elif isinstance(packet, RefusedFrame):
            self._waiting.append(packet)
        while self._waiting and self._is_due(self._waiting[0].stamp_ns):
            self._place(self._waiting.popleft())

    def next_pass(self) -> None:
        """Begin another pass over the same yard: further packets belong to its own recording, and a snapshot
        shows only that pass. Raises MeasurementError after `finish`.
        """
        self._expect_open()
        self._end_pass()
        self._begin_pass()

    def snapshot(self) -> Snapshot:
        """Return the map of this pass so far; the final result is not affected.

        The last view is missing until the crane has moved on: a crane that has stood since the beginning has
        no surface yet. Raises MeasurementError after `finish`, whose yard has the map.
        """
        self._expect_open()
        return Snapshot(None, 0) if self._map is None else self._map.snapshot(self)

    def finish(self) -> Yard:
        """Return the yard from all packets, as `measure` does for the same recording or passes.

        The matched pairs on disk are fused at the final poses, and bundles and lifts found. Raises
        MeasurementError if it was called before.
        """
        self._expect_open()
        self._end_pass()
        several = len(self._recordings) > 1
        kept = self._checkpoints.parent
        write_measured(
            self._recordings, self._yard, self._asked, LiftRequest(self._magnet),
            keep=kept.parent if several else kept, report=False,
        )  # fmt: skip
        return Yard(self._yard, self._temporary)

    def _end_pass(self) -> None:
        if is_final(self._settings):
            while self._waiting:
                self._place(self._waiting.popleft())
            if self._map is not None:
                self._map.end()

    def _expect_open(self) -> None:
        if self._yard.exists():
            raise MeasurementError("the session is finished: begin another one; finish returned its yard")

    def _is_due(self, stamp_ns: int) -> bool:
        """Check whether all readings that place a frame have arrived, or will not arrive any more."""
        shift_ns = self._source.rig.timeshift_cam_imu_ns
        last_ns = self._recording.last_frame_ns
        if last_ns is not None and last_ns >= stamp_ns + GRACE_NS:
            return True
        if self._map is None:
            return False
        due_ns = stamp_ns + shift_ns + self._map.delay_ns
        return all(last >= due_ns for last in self._recording.last_readings_ns(self._settings.use))

    def _place(self, pair: RectifiedPair | RefusedFrame) -> None:
        if self._map is None:
            expect_fits(self._source)
            has_crane = self._source.crane() is not None
            estimator = make_early_estimator(self._settings.motion, has_crane=has_crane)
            kept = self._checkpoints if is_final(self._settings) else None
            placer = PairPlacer(self._pairs, estimator, kept)
            self._map = LiveMap(self._pairs, self._settings, self._here, kept, placer, self._match)
        self._map.add(pair)
