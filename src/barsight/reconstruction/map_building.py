"""Build the map: recording -> trajectory and matched pairs -> votes in the map's cells."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px, rig_covariance
from barsight.core.arrays import Float64
from barsight.core.compiling.sources import sources_digest
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.json_values import json_digest, json_value
from barsight.core.memory import trim_heap
from barsight.core.notices import Notice
from barsight.core.parallel import WORKERS, prefetched_chain
from barsight.core.pose import Pose
from barsight.core.timing import Stopwatch, count_frames, unwatched
from barsight.core.types import PosedFrame, RectifiedCamera, RectifiedPair, RefusedFrame, Trajectory
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.fusion import fuse_view
from barsight.mapping.keyframes import select_keyframes, select_keyframes_by_encoders
from barsight.mapping.recording_probe import (
    RecordingProbe,
    choose_cell_size,
    points_per_pixel,
    probe_recording,
)
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import SpilledTiles
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.incremental import SurfaceElection
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore
from barsight.mapping.top_photo import TopPhoto
from barsight.mapping.view import MatchedFrame, Matcher, Neighbour, PointBinner, PosedView
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap, Preview, Refusal
from barsight.motion.rig_check.self_calibration import residual_covariance, self_calibrate
from barsight.motion.settings import make_estimator
from barsight.reconstruction.checkpoint import (
    checkpoint_folder,
    checkpointed,
    pictures_digest,
    trajectory_name,
)
from barsight.reconstruction.pair_chain import PairChain
from barsight.recording.base import Recording
from barsight.recording.plausibility import clock_faults, doubts
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.registration.yard_file import YardFrame
from barsight.stereo.settings import StereoSettings, make_map_method
from barsight.yard_frame import frame_of, in_yard, placed_in_yard, shared_height_sigma_m

ProgressCallback = Callable[[str, int, int], None]
"""Told of progress: stage, frames done, frames in all."""

_MATCHED_AHEAD, _MATCHED_AFTER = 16, 4
"""Pairs that may wait, matched, beside the trajectory and after it: 13 MB each at 1280x1024."""
_TIDIED_EVERY = 8
"""Frames between which freed memory may pile up."""


@dataclass(frozen=True, eq=False)
class ProbedRecording:
    """A recording as it was first looked at. calibration_px: sigma of the disparity by the calibration.
    doubts: what can't be right in the samples. inputs: SHA-256 of the files. checkpoints: their folder, if
    any. watch: times the stages.
    """

    source: Recording
    pairs: RectifiedPairs
    first: RecordingProbe
    cell_m: float
    calibration_px: float
    doubts: tuple[Notice, ...]
    configuration: dict[str, Any]
    inputs: dict[str, str]
    checkpoints: Path | None
    watch: Stopwatch

    @property
    def per_pixel(self) -> int:
        """Return the points per pixel and side that the cells need."""
        return points_per_pixel(self.first, self.cell_m)


@dataclass(frozen=True, eq=False)
class TrackedRecording:
    """The trajectory, and the pairs that the map is made of. rectifier: as corrected in service. stereo: with
    the disparity's calibration sigma. rig_covariance: of yaw, baseline and focal length (3, 3), None where no
    rig file says it. poses: of the frames taken, by stamp. matched: those frames, in order.
    """

    trajectory: Trajectory
    rectifier: Rectifier
    stereo: StereoSettings
    rig_covariance: Float64 | None
    drift_warnings: tuple[str, ...]
    poses: dict[int, PosedFrame]
    matched: Iterator[MatchedFrame | Refusal]


class MapBuilder:
    """Fuses posed frames, one after the other, into the tiles of `folder`, and carves their lines of sight.

    placed: reference_from_rect0 of the views used, stamps_ns theirs. beat: called for each tile that is done.
    """

    def __init__(
        self, binner: PointBinner, camera: RectifiedCamera, folder: Path, settings: MapSettings,
        yard: YardFrame | None = None, beat: Callable[[], None] = unwatched,
    ) -> None:  # fmt: skip
        self._binner, self._camera, self._settings, self._yard = binner, camera, settings, yard
        self._store = TileStore(folder, settings.resident_tiles)
        self._election = SurfaceElection(self._store, folder, binner.cell_m, settings, beat)
        self._free = FreeSpace(binner.cell_m, SpilledTiles(folder))
        self._tops = TopPhoto(binner.cell_m, SpilledTiles(folder))
        self._before: Neighbour | None = None
        self._previews: list[tuple[int, Preview]] = []
        self.placed: list[Pose] = []
        self.stamps_ns: list[int] = []
        self.refusals: list[Refusal] = []

    def add(self, frame: MatchedFrame | Refusal, posed: PosedFrame, after: Neighbour | None) -> None:
        """Bin a frame's points and fuse them. after: the next frame; against it and the one before the
        crane's own parts stand still.
        """
        beside = [other for other in (self._before, after) if other is not None]
        self._before = None if isinstance(frame, Refusal) else (frame.pair, posed)
        view = frame if isinstance(frame, Refusal) else self._binner(frame, posed, beside)
        if isinstance(view, Failed):
            view = Refusal("stereo", RefusedFrame(posed.stamp_ns, view.reason))
        if isinstance(view, Refusal):
            self.refusals.append(view)
            return
        view, watch = self._with_shared(view, posed), self._binner.watch
        with watch("fuse", 1):
            fuse_view(self._store, view.cells, self._settings)
        self.placed.append(posed.reference_from_body @ self._binner.body_from_rect0)
        self.stamps_ns.append(posed.stamp_ns)
        with watch("free space", 1):
            self._free.carve(view.cells, ViewFrusta.of(self.placed[-1:], self._camera).eyes[0])
        with watch("top photo", 1):
            self._tops.add(view.cells, view.pair, self.placed[-1])
        count = len(self.placed)
        if count & (count - 1) == 0:
            self._previews = [*self._previews[-1:], (count, Preview(view.pair.left, view.disparity_px))]

    def settle(self) -> None:
        """Elect the tiles that the views have left; called after each view, it leaves less for the end."""
        self._election.settle(self._min_views, self._frusta)

    def snapshot(self) -> Surface:
        """Elect the surface as it stands; only tiles that changed since the last one are elected anew."""
        return self._election.snapshot(self._min_views, self._frusta())

    def finish(self) -> BuiltMap:
        """Elect the surface of all views, of which there is one at least; the tiles are given up."""
        with self._binner.watch("surface"):
            surface = self._election.finish(self._min_views, self._frusta())
        trim_heap()
        middle = len(self.placed) / 2
        _, preview = min(self._previews, key=lambda one: abs(one[0] - middle))
        return BuiltMap(
            surface, self._free, self._tops, tuple(self.placed), tuple(self.stamps_ns), tuple(self.refusals),
            preview,
        )  # fmt: skip

    @property
    def _min_views(self) -> int:
        return self._settings.min_views if len(self.placed) > 1 else 1

    def _frusta(self) -> ViewFrusta:
        return ViewFrusta.of(self.placed, self._camera, self._binner.per_pixel)

    def _with_shared(self, view: PosedView, posed: PosedFrame) -> PosedView:
        """Add what the yard frame may be off to what the heights' errors share."""
        if self._yard is None:
            return view
        cells, size = view.cells, self._binner.cell_m
        body_m = posed.reference_from_body.translation
        x_m, y_m = (np.multiply(of, size, dtype=np.float64) for of in (cells.x, cells.y))
        off = shared_height_sigma_m(self._yard, x_m, y_m, body_m)
        shared = np.hypot(cells.shared_m, off).astype(np.float32)
        return replace(view, cells=replace(cells, shared_m=shared))


def inspect_recording(
    recording: Recording, settings: MeasureSettings, scratch: Path, resume: Path | None
) -> ProbedRecording:
    """Look at a recording: how far the scene is, how large the cells, how sure the calibration.

    Raises InputError where the sensors' clocks differ.
    """
    source: Recording = SelectedSensors(recording, settings.use)
    source, watch = in_yard(source, settings.yard), Stopwatch()
    if faults := clock_faults(source):
        raise InputError(source.path, "; ".join(faults), "or leave the sensor out of use")
    configuration, inputs = json_value(settings), source.digests()
    checkpoints = None
    if resume is not None:
        checkpoints = checkpoint_folder(resume, checkpoint_key(recording, source, settings, inputs))
    with watch("look"):
        pairs = RectifiedPairs(source, Rectifier(source.rig), checkpoints or scratch, watch)
        first, cell_m, calibration_px = look_at(pairs, settings, checkpoints)
    return ProbedRecording(
        source, pairs, first, cell_m, calibration_px, doubts(source), configuration, inputs, checkpoints,
        watch,
    )  # fmt: skip


def look_at(
    pairs: RectifiedPairs, settings: MeasureSettings, checkpoints: Path | None
) -> tuple[RecordingProbe, float, float]:
    """Look at the first usable pair; return what it shows, the side of the map's cells (m) and the sigma of
    the disparity by the calibration (px).
    """
    first = checkpointed(checkpoints, "look", lambda: probe_recording(pairs))
    has_crane = pairs.recording.crane() is not None
    cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=has_crane)
    known_px = disparity_sigma_px(settings.recording.rig, first.range_m)
    return first, cell_m, settings.stereo.calibration_sigma_px if known_px is None else known_px


@contextmanager
def estimate_trajectory(
    probed: ProbedRecording, settings: MeasureSettings, advance: ProgressCallback
) -> Iterator[TrackedRecording]:
    """Estimate the trajectory while the first pairs are matched on the core that it leaves idle."""
    source, pairs, watch = probed.source, probed.pairs, probed.watch
    rectifier, total = pairs.rectifier, len(source.index.stamps_ns)
    match = matching(pairs, settings, probed.checkpoints, watch)
    early = _known_early(source, settings, rectifier, probed.first.range_m)
    begun = islice(pairs(early), len(early))
    with ExitStack() as pools:
        ahead = pools.enter_context(_matched_ahead(match, begun, _MATCHED_AHEAD))
        with watch("trajectory", total):
            estimate = make_estimator(settings.motion)
            count = count_frames("trajectory", total, advance)
            with _naming(probed):
                name = trajectory_name(source, estimate.delay_ns)
                trajectory = checkpointed(
                    probed.checkpoints, name, lambda: estimate(source, rectifier, count, pairs)
                )
            trajectory = placed_in_yard(trajectory, frame_of(source))
            trim_heap()
            calibrated = self_calibrate(
                source.rig, rectifier, trajectory.drift, probed.calibration_px,
                correct=settings.self_calibrate == "yaw",
            )  # fmt: skip
        if calibrated.rectifier is not rectifier:
            rectifier = calibrated.rectifier
            pairs = RectifiedPairs(source, rectifier, watch=watch)
            match = matching(pairs, settings, probed.checkpoints, watch)
        stereo = replace(settings.stereo, calibration_sigma_px=calibrated.sigma_px)
        taken = select_keyframes(trajectory.frames, rectifier, probed.first.range_m, settings.map.min_shift)
        poses = {frame.stamp_ns: frame for frame in trajectory.frames if frame.stamp_ns in taken}
        late = min((stamp for stamp in poses if stamp not in early), default=None)
        matched: Iterator[MatchedFrame | Refusal] = ahead
        if late is not None:
            rest = pairs({stamp for stamp in poses if stamp >= late})
            after = pools.enter_context(_matched_ahead(match, rest, _MATCHED_AFTER))
            matched = chain(takewhile(lambda frame: frame.stamp_ns < late, ahead), after)
        rig = rig_covariance(settings.recording.rig, probed.first.range_m)
        if rig is not None:
            corrected = settings.self_calibrate == "yaw"
            rig = residual_covariance(rig, trajectory.drift, corrected=corrected)
        yield TrackedRecording(trajectory, rectifier, stereo, rig, calibrated.warnings, poses, matched)


@contextmanager
def _naming(probed: ProbedRecording) -> Iterator[None]:
    """Name what can't be right in the samples as the cause, where nothing can be estimated from them."""
    try:
        yield
    except (InputError, MeasurementError) as error:
        if not probed.doubts:
            raise
        told = "; ".join(doubt.message for doubt in probed.doubts)
        raise InputError(probed.source.path, told, str(error)) from error


def build_map(
    probed: ProbedRecording,
    way: TrackedRecording,
    settings: MeasureSettings,
    scratch: Path,
    advance: ProgressCallback,
) -> BuiltMap:
    """Build the map of all matched pairs, or take the one that is kept of just these at these poses.

    Raises MeasurementError where no frame could be measured, or no place was seen often enough.
    """
    source, path = probed.source, probed.source.path
    refusals = [Refusal("recording", frame) for frame in source.index.unpaired]
    refusals += [Refusal("trajectory", frame) for frame in way.trajectory.refused]
    binner = PointBinner(
        way.stereo, way.rectifier.body_from_rect0, probed.cell_m, probed.per_pixel, settings.map.max_sigma_m,
        probed.watch,
    )  # fmt: skip

    def build() -> BuiltMap:
        builder = MapBuilder(binner, way.rectifier.camera, scratch, settings.map, frame_of(source))
        known = (frame for frame in way.matched if frame.stamp_ns in way.poses)
        for done, (frame, after) in enumerate(pairwise(chain(known, (None,))), start=1):
            assert frame is not None
            beside = None
            if isinstance(after, MatchedFrame):
                beside = after.pair, way.poses[after.stamp_ns]
            builder.add(frame, way.poses[frame.stamp_ns], beside)
            if done % _TIDIED_EVERY == 1:
                trim_heap()
            advance("map", done, len(way.poses))
        if not builder.placed:
            reason = _first_reason([*refusals, *builder.refusals])
            raise MeasurementError(f"{path}: no frame could be measured; {reason}")
        return builder.finish()

    name = map_name(tuple(way.poses.values()), binner)
    built = checkpointed(probed.checkpoints, name, build)
    if built.surface.seen == 0:
        least = settings.map.min_views if len(built.placed) > 1 else 1
        raise MeasurementError(f"{path}: no place was seen by {least} frames; lower map.min_views")
    return replace(built, refusals=(*refusals, *built.refusals))


def map_name(poses: tuple[PosedFrame, ...], binner: PointBinner) -> str:
    """Name the checkpoint of the map of frames at these poses by what it rests on beside `checkpoint_key`."""
    asked = [binner.stereo.calibration_sigma_px, binner.cell_m, binner.per_pixel]
    return f"map_{json_digest([json_value(poses), asked])[:32]}"


def checkpoint_key(
    recording: Recording, source: Recording, settings: MeasureSettings, inputs: dict[str, str]
) -> str:
    """Return a digest of all that trajectory, disparities and map depend on, the package's sources among it.

    source: the recording with the sensors in use, in the yard. inputs: SHA-256 of its files.
    """
    sources = sources_digest(Path(barsight.__file__).parent)
    configuration, frame = json_value(settings), frame_of(source)
    stages = {name: part for name, part in configuration.items() if name not in ("bundles", "lift")}
    placed = inputs if frame is None else {**inputs, "yard": frame.digest}
    rig = json_value(recording.rig)
    return json_digest([sources, stages, placed, rig, pictures_digest(recording)])


def _known_early(
    source: Recording, settings: MeasureSettings, rectifier: Rectifier, range_m: float
) -> frozenset[int]:
    """Select stamps of frames that may be matched before the trajectory is known: all, or the first few that
    lie apart by the encoders. Where the trajectory says otherwise, it decides.
    """
    stamps, min_shift = source.index.stamps_ns, settings.map.min_shift
    if settings.self_calibrate != "none":
        return frozenset()
    if min_shift == 0:
        return frozenset(stamps)
    crane = source.crane()
    if crane is None or crane.stamp_ns.size == 0:
        return frozenset()
    shift_ns = source.rig.timeshift_cam_imu_ns
    chosen = select_keyframes_by_encoders(stamps, crane, shift_ns, rectifier.camera, range_m, min_shift)
    return frozenset(chosen[:_MATCHED_AHEAD])


def matching(
    pairs: RectifiedPairs, settings: MeasureSettings, checkpoints: Path | None, watch: Stopwatch
) -> PairChain:
    """Make what matches the pairs of a recording for its map."""
    stereo, every = settings.stereo, settings.map.min_shift == 0
    chained = every and stereo.method == "barsight" and stereo.barsight.preset == "best"
    matcher = Matcher(stereo, make_map_method(stereo), watch)
    return PairChain(pairs, matcher, stereo.confirmed_pairs + 1 if chained else 1, checkpoints)


def _matched_ahead(
    match: PairChain, pairs: Iterator[RectifiedPair | RefusedFrame], max_waiting: int
) -> AbstractContextManager[Iterator[MatchedFrame | Refusal]]:
    """Match pairs ahead, whole chains side by side; about `max_waiting` of them may wait."""
    chains = max(max_waiting // match.length, WORKERS)
    return prefetched_chain(partial(map, match), match.split(pairs), chains)


def _first_reason(refusals: list[Refusal]) -> str:
    return f"first: {refusals[0].frame.reason}" if refusals else "it has no frames"
