"""The way of the data from packets: what came so far can be looked at any time, the end is the batch's."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.checkpoint import checkpoint_folder
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, MeasurementError
from barsight.core.pose import Pose
from barsight.core.stamps import seconds_to_ns
from barsight.core.timing import Stopwatch
from barsight.core.types import CraneSamples, PosedFrame, StereoFrame
from barsight.map_building import checkpoint_key, matching
from barsight.mapping.fusion import fuse_view
from barsight.mapping.scene_extent import (
    RecordingProbe,
    choose_cell_size,
    least_way_m,
    points_per_pixel,
    probe_recording,
)
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.incremental import SurfaceElection
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore
from barsight.mapping.view import MatchedFrame, Matcher, PointBinner
from barsight.measure_folder import write_measured
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Refusal, to_json
from barsight.motion.crane.encoder_trajectory import EncoderOdometry
from barsight.recording.base import FrameIndex
from barsight.recording.packets import Packet, PacketRecording
from barsight.recording.wrapper import RecordingProxy
from barsight.result import Yard
from barsight.stereo.settings import make_method
from barsight.yard.sections import surface_map
from barsight.yard.types import HeightMap


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The map as it stands. surface: None while nothing is seen by two views, or no encoders say where.

    poses_from: `crane`, the encoders' poses, until `finish` estimates them from all sensors. frames: in the
    map. owner: the session, in whose folder the surface lies.
    """

    surface: Surface | None
    frames: int
    poses_from: str = "crane"
    owner: object = field(default=None, repr=False)

    @cached_property
    def height_map(self) -> HeightMap | None:
        """Return the whole map."""
        if self.surface is None:
            return None
        rows, columns = self.surface.shape
        return surface_map(self.surface).part(slice(0, rows), slice(0, columns))


@dataclass(frozen=True, eq=False)
class _Frames(RecordingProxy):
    stamps_ns: tuple[int, ...]

    @property
    def index(self) -> FrameIndex:
        return FrameIndex(self.stamps_ns, ())


class _Map:
    """The map by the encoders' poses, which `finish` doesn't use."""

    def __init__(self, first: RecordingProbe, settings: MeasureSettings, rectifier: Rectifier, folder: Path):
        self.cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=True)
        self.per_pixel = points_per_pixel(first, self.cell_m)
        self.placer = PointBinner(
            settings.stereo, rectifier.body_from_rect0, self.cell_m, self.per_pixel, settings.map.max_sigma_m,
            Stopwatch(),
        )  # fmt: skip
        self.store = TileStore(folder, settings.map.resident_tiles)
        self.election = SurfaceElection(self.store, folder, self.cell_m, settings.map)
        self.least_way_m = least_way_m(rectifier.camera, first.range_m, settings.map.min_shift)
        self.ahead = np.array([0.0, 0.0, first.range_m])
        self.last: Float64 | None = None
        self.placed: list[Pose] = []


class Session:
    """Measures packets as they come; `snapshot` any time, `finish` once.

    Each pair is matched once, for the snapshots and the end; both keep what they need on disk (20 MB a pair
    of 1.3 megapixels), in a temporary folder that goes with the session.
    """

    def __init__(
        self, rig: StereoRig, settings: MeasureSettings | None = None, *, magnet: Path | None = None,
        imu_noise: ImuNoise | None = None, is_simulated: bool = False,
    ) -> None:  # fmt: skip
        """magnet: TOML file of the magnet that lifts are chosen for. is_simulated: said in the result."""
        self._asked, self._magnet = settings or MeasureSettings(), magnet
        self._settings = self._asked.chosen()
        self._folder = Path(tempfile.mkdtemp(prefix="barsight."))
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._recording = PacketRecording(rig, self._folder, imu_noise, is_simulated=is_simulated)
        self._rectifier = Rectifier(rig)
        method = make_method(self._settings.stereo.for_map())
        key = checkpoint_key(self._recording, to_json(asdict(self._settings)), {})
        kept = checkpoint_folder(self._folder / "checkpoints", key)
        # A rig that is to be turned at the end gives other disparities then.
        kept_for_end = kept if self._settings.self_calibrate == "none" else None
        matcher = Matcher(self._settings.stereo, method, self._rectifier, Stopwatch())
        self._match = matching(matcher, kept_for_end)
        self._waiting: list[StereoFrame] = []
        self._map: _Map | None = None

    def push(self, packet: Packet) -> None:
        """Take the next packet; a pair enters the map once the encoders' readings after it are there, and
        never without encoders."""
        self._recording.add(packet)
        if isinstance(packet, StereoFrame):
            self._waiting.append(packet)
        if isinstance(packet, (StereoFrame, CraneSamples)):
            self._place_waiting()

    def snapshot(self) -> Snapshot:
        """Return the map of what came so far, by the encoders' poses; it changes nothing at the end."""
        held = self._map
        if held is None or len(held.placed) < 2:
            return Snapshot(None, 0 if held is None else len(held.placed))
        sights = ViewFrusta.of(held.placed, self._rectifier.camera, held.per_pixel)
        surface = held.election.snapshot(self._settings.map.min_views, sights)
        return Snapshot(surface, len(held.placed), owner=self)

    def finish(self) -> Yard:
        """Return the yard from all packets, as `measure` has it of the same recording."""
        out = self._folder / "yard"
        write_measured(
            self._recording, out, self._asked, keep=self._folder / "checkpoints", magnet=self._magnet,
            report=False,
        )  # fmt: skip
        yard = Yard(out)
        yard.keep(self)
        return yard

    def _place_waiting(self) -> None:
        crane = self._recording.crane() if "crane" in self._settings.use else None
        if crane is None:
            self._waiting.clear()
            return
        ahead_ns = self._recording.rig.timeshift_cam_imu_ns + seconds_to_ns(
            self._settings.motion.crane.window_s
        )
        ready = [frame for frame in self._waiting if frame.stamp_ns + ahead_ns <= crane.stamp_ns[-1]]
        if not ready:
            return
        self._waiting = self._waiting[len(ready) :]
        if self._map is None:
            try:
                first = probe_recording(self._recording, self._rectifier)
            except MeasurementError:
                return
            self._map = _Map(first, self._settings, self._rectifier, self._folder)
        stamps = tuple(frame.stamp_ns for frame in ready)
        poses = EncoderOdometry(self._settings.motion.crane)(
            _Frames(self._recording, stamps), self._rectifier, lambda: None
        )
        at = {frame.stamp_ns: frame for frame in ready}
        for posed in poses.frames:
            self._add(self._map, at[posed.stamp_ns], posed)

    def _add(self, held: _Map, frame: StereoFrame, posed: PosedFrame) -> None:
        """Match a pair and fuse it into the map, unless its picture has hardly moved."""
        pose = posed.reference_from_body @ self._rectifier.body_from_rect0
        seen = pose.apply(held.ahead)
        if held.last is not None and np.linalg.norm(seen - held.last) < held.least_way_m:
            return
        matched: MatchedFrame | Refusal = self._match(frame)
        view: Any = matched if isinstance(matched, Refusal) else held.placer(matched, posed)
        if isinstance(view, (Refusal, Failed)):
            return
        fuse_view(held.store, view.cells, self._settings.map)
        held.placed.append(pose)
        held.last = seen
