"""Build the map while packets still arrive: each pair is located, and is fused once the next one is
located.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from barsight.core.errors import Failed, MeasurementError
from barsight.core.records.pairs import RectifiedPair, RefusedFrame
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.timing import Stopwatch, unwatched
from barsight.mapping.keyframes import KeyframeSelection
from barsight.mapping.recording_probe import points_per_pixel
from barsight.mapping.surface.surface import Surface
from barsight.mapping.view import PointBinner, check_pair
from barsight.measure_settings import MeasureSettings
from barsight.motion.estimator import PoseEstimator, TrajectoryEstimator
from barsight.motion.settings import make_estimator
from barsight.reconstruction.checkpoint import checkpointed, sensor_readings, trajectory_name
from barsight.reconstruction.map_building import MapBuilder, map_name
from barsight.reconstruction.pair_chain import MatchedAhead, PairChain
from barsight.reconstruction.probed_recording import look_at
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.search_range import find_disparity_range
from barsight.yard.sections import surface_map
from barsight.yard.types import HeightMap
from barsight.yard_frame import frame_of, placed_in_yard


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The current map. surface: None until two views have been fused.

    frames: number of frames in the map. owner: the session whose folder holds the surface.
    """

    surface: Surface | None
    frames: int
    owner: object = field(default=None, repr=False)

    @cached_property
    def height_map(self) -> HeightMap | None:
        """Return the whole map."""
        return None if self.surface is None else surface_map(self.surface).whole()


class PairPlacer:
    """Locates pairs with an estimator whose poses are final at once.

    A pose is stored in `checkpoints` under the frames and readings that it depends on. A stored pose needs no
    pictures, unless `reads` is False or a later pose is missing: then the pairs before it are tracked again.
    poses: the estimator, in its current state. beat: called for each pair that is tracked.

    Raises MeasurementError if no sensor determines the body's pose.
    """

    def __init__(
        self, pairs: RectifiedPairs, estimator: TrajectoryEstimator, checkpoints: Path | None, *,
        reads: bool = True, beat: Callable[[], None] = unwatched,
    ) -> None:  # fmt: skip
        self._pairs, self._checkpoints, self._reads = pairs, checkpoints, reads
        self._beat = beat
        self.poses: PoseEstimator = estimator.begin(pairs.recording, pairs.rectifier)
        self._known: list[tuple[int, tuple[int, ...]]] = []
        self._unfollowed: list[int | RefusedFrame] = []
        self._key = hashlib.sha256()

    def push(self, pair: RectifiedPair | RefusedFrame) -> PosedFrame | RefusedFrame | None:
        """Return the next pair's pose, or why it has none; None if it can be determined only at the end."""
        before = self._known[-1][1] if self._known else None
        now = self._counts(pair.stamp_ns)
        self._known.append((pair.stamp_ns, now))
        if self._checkpoints is None:
            return self.poses.push(pair)
        self._key.update(f"{pair.stamp_ns} {isinstance(pair, RefusedFrame)} {now}".encode())
        readings = sensor_readings(self._pairs.recording)
        for number, (values, count) in enumerate(zip(readings, now, strict=True)):
            first = 0 if before is None or len(before) != len(now) else before[number]
            for one in values:
                self._key.update(np.ascontiguousarray(one[first:count]).tobytes())
        name = f"placed_{pair.stamp_ns}_{self._key.hexdigest()[:32]}"
        if not self._reads:
            posed = self.poses.push(pair)
            return checkpointed(self._checkpoints, name, lambda: posed)
        self._unfollowed.append(pair if isinstance(pair, RefusedFrame) else pair.stamp_ns)
        return checkpointed(self._checkpoints, name, self._follow)

    def finish(self) -> Trajectory | None:
        """Return all poses and store them in the checkpoints; None if measuring the recording now would use
        other frames or readings than those that arrived in time.

        Raises InputError where the pictures contradict a sensor.
        """
        recording = self._pairs.recording
        stamps = [stamp_ns for stamp_ns, _ in self._known]
        if stamps != list(recording.index.stamps_ns):
            return None
        if any(self._counts(stamp_ns) != known for stamp_ns, known in self._known):
            return None

        def finish() -> Trajectory:
            self._follow()
            return self.poses.finish()

        return checkpointed(self._checkpoints, trajectory_name(recording, self.poses.delay_ns), finish)

    def _follow(self) -> PosedFrame | RefusedFrame | None:
        """Estimate the poses of the pairs not yet tracked; return the last one."""
        posed = None
        for seen in self._unfollowed:
            (pair,) = (seen,) if isinstance(seen, RefusedFrame) else self._pairs(frozenset((seen,)))
            posed = self.poses.push(pair)
            self._beat()
        self._unfollowed.clear()
        return posed

    def _counts(self, stamp_ns: int) -> tuple[int, ...]:
        """Count, for each sensor, the readings that a frame needs and that have arrived."""
        due_ns = stamp_ns + self._pairs.recording.rig.timeshift_cam_imu_ns + (self.poses.delay_ns or 0)
        readings = sensor_readings(self._pairs.recording)
        return tuple(int(np.searchsorted(stamps, due_ns, side="right")) for stamps, *_ in readings)


class LiveMap:
    """Locates pairs as they arrive and fuses them; its tiles and surfaces are stored in `folder`.

    With settings that make poses final at once (`is_final`), `end` stores the trajectory and the map in
    `checkpoints`, identical to what measuring the same pairs yields. beat: called for each finished pair and
    tile.
    """

    def __init__(
        self, pairs: RectifiedPairs, settings: MeasureSettings, folder: Path, checkpoints: Path | None,
        placer: PairPlacer, match: PairChain | MatchedAhead, beat: Callable[[], None] = unwatched,
    ) -> None:  # fmt: skip
        self._beat = beat
        self._pairs, self._settings, self._folder, self._match = pairs, settings, folder, match
        self._reference = "world" if pairs.recording.crane() is None else "yard"
        self._placer = placer
        self._checkpoints = checkpoints if is_final(settings) else None
        self._waiting: list[PosedFrame] = []
        self._passed: tuple[RectifiedPair, PosedFrame] | None = None
        self._held: tuple[RectifiedPair, PosedFrame] | None = None
        self._taken: list[PosedFrame] = []
        self._map: tuple[MapBuilder, PointBinner] | None = None
        self._selection: KeyframeSelection | None = None

    @property
    def delay_ns(self) -> int:
        """Return the delay after a frame until all readings that it needs are recorded."""
        return self._placer.poses.delay_ns or 0

    @property
    def stamps_ns(self) -> list[int]:
        """Return the stamps of the frames fused so far."""
        return [] if self._map is None else self._map[0].stamps_ns

    def add(self, pair: RectifiedPair | RefusedFrame) -> None:
        """Locate the next pair, and fuse the one before. Pairs wait unread until one of them can be matched,
        and a pair whose picture has hardly moved is left out.
        """
        posed = self._placer.push(pair)
        if not isinstance(posed, PosedFrame):
            return
        self._passed = None
        if not isinstance(pair, RectifiedPair):
            return
        way = Trajectory(self._reference, (posed,), (), ())
        (placed,) = placed_in_yard(way, frame_of(self._pairs.recording)).frames
        if self._map is None:
            self._waiting.append(placed)
            found = find_disparity_range(pair)
            if isinstance(found, Failed) and found.code != "swapped":
                return
            try:
                self._map = self._begun()
            except MeasurementError:
                return
            for waiting in self._waiting[:-1]:
                (before,) = self._pairs(frozenset((waiting.stamp_ns,)))
                if isinstance(before, RectifiedPair):
                    self._take(self._map[0], before, waiting)
            self._waiting.clear()
        self._take(self._map[0], pair, placed)

    def snapshot(self, owner: object) -> Snapshot:
        """Elect the current surface; only tiles that changed since the last snapshot are elected again.

        The last selected view isn't in it until the next one is selected, which shows what the crane carries:
        while the crane stands, none is.
        """
        frames = len(self.stamps_ns)
        if self._map is None or frames < 2:
            return Snapshot(None, frames)
        return Snapshot(self._map[0].snapshot(), frames, owner)

    def end(self) -> None:
        """Store trajectory and map in the checkpoints, if all readings were there when they were needed.

        Raises InputError where the pictures contradict a sensor.
        """
        if self._checkpoints is None or self._map is None or self._placer.finish() is None:
            return
        builder, binner = self._map
        if self._passed is not None and check_pair(self._passed[0], self._settings.stereo) is None:
            self._fuse_held(builder, self._passed)
        self._fuse_held(builder, None)
        if builder.placed and all(self._match.holds(one.stamp_ns) for one in self._taken):
            checkpointed(self._checkpoints, map_name(tuple(self._taken), binner), builder.finish)

    def _begun(self) -> tuple[MapBuilder, PointBinner]:
        settings, rectifier = self._settings, self._pairs.rectifier
        first, cell_m, sigma_px = look_at(self._pairs, settings, self._checkpoints)
        self._selection = KeyframeSelection(rectifier, first.range_m, settings.map.min_shift)
        binner = PointBinner(
            replace(settings.stereo, calibration_sigma_px=sigma_px), rectifier.body_from_rect0, cell_m,
            points_per_pixel(first, cell_m), settings.map.max_sigma_m, Stopwatch(),
        )  # fmt: skip
        yard = frame_of(self._pairs.recording)
        return MapBuilder(binner, rectifier.camera, self._folder, settings.map, yard, self._beat), binner

    def _take(self, builder: MapBuilder, pair: RectifiedPair, posed: PosedFrame) -> None:
        """Select a pair for the map unless its picture has hardly moved or can't be matched."""
        assert self._selection is not None
        if not self._selection.is_due(posed):
            self._passed = pair, posed
            return
        if check_pair(pair, self._settings.stereo) is not None:
            return
        self._selection.take(posed)
        self._fuse_held(builder, (pair, posed))
        builder.settle()

    def _fuse_held(self, builder: MapBuilder, after: tuple[RectifiedPair, PosedFrame] | None) -> None:
        """Match and fuse the pending pair now that the next one is known, which becomes the pending one."""
        if self._held is not None:
            pair, posed = self._held
            builder.add(self._match(pair), posed, after)
            self._taken.append(posed)
            self._beat()
        self._held = after


def is_final(settings: MeasureSettings) -> bool:
    """Check whether each pair's pose and disparity are final at once, the same as measured at the end."""
    return make_estimator(settings.motion).begins_early and settings.self_calibrate == "none"
