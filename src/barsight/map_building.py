"""Build the map: recording -> trajectory and matched pairs -> votes in the map's cells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np

import barsight
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px, rig_covariance
from barsight.checkpoint import checkpoint_folder, checkpointed, pictures_digest
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.json_values import json_digest, json_value
from barsight.core.memory import trim_heap
from barsight.core.notices import Notice
from barsight.core.parallel import WORKERS, prefetched_map
from barsight.core.pose import Pose
from barsight.core.timing import Stopwatch, count_frames
from barsight.core.types import PosedFrame, RectifiedPair, RefusedFrame, Trajectory
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
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.tiles import TileStore
from barsight.mapping.top_photo import TopPhoto
from barsight.mapping.view import MatchedFrame, Matcher, Neighbour, PointBinner, PosedView
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Preview, Refusal
from barsight.motion.rig_check.self_calibration import residual_covariance, self_calibrate
from barsight.motion.settings import make_estimator
from barsight.pair_chain import PairChain
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


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """All views' votes. placed: reference_from_rect0 of the views used, stamps_ns theirs. preview: of a view
    in the middle.
    """

    store: TileStore
    free: FreeSpace
    tops: TopPhoto
    placed: tuple[Pose, ...]
    stamps_ns: tuple[int, ...]
    refusals: tuple[Refusal, ...]
    preview: Preview | None


class FusedViews:
    """Fuses posed views, one after the other, into the tiles of `store`.

    placed: reference_from_rect0 of the views used, stamps_ns theirs.
    """

    def __init__(
        self, binner: PointBinner, store: TileStore, settings: MapSettings, yard: YardFrame | None = None
    ) -> None:
        self._binner, self.store, self._settings, self._yard = binner, store, settings, yard
        self.placed: list[Pose] = []
        self.stamps_ns: list[int] = []

    def add(
        self, frame: MatchedFrame | Refusal, posed: PosedFrame, beside: Sequence[Neighbour] = ()
    ) -> PosedView | Refusal:
        """Bin a matched frame's points at its pose and fuse them. beside: see `PointBinner`."""
        view = frame if isinstance(frame, Refusal) else self._binner(frame, posed, beside)
        if isinstance(view, Failed):
            return Refusal("stereo", RefusedFrame(posed.stamp_ns, view.reason))
        if isinstance(view, PosedView):
            view = self._with_shared(view, posed)
            with self._binner.watch("fuse", 1):
                fuse_view(self.store, view.cells, self._settings)
            self.placed.append(posed.reference_from_body @ self._binner.body_from_rect0)
            self.stamps_ns.append(posed.stamp_ns)
        return view

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
        frame = frame_of(source)
        placed = inputs if frame is None else {**inputs, "yard": frame.digest}
        checkpoints = checkpoint_folder(resume, checkpoint_key(recording, configuration, placed))
    with watch("look"):
        pairs = RectifiedPairs(source, Rectifier(source.rig), checkpoints or scratch, watch)
        first = probe_recording(pairs)
        cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=source.crane() is not None)
    known_px = disparity_sigma_px(settings.recording.rig, first.range_m)
    calibration_px = settings.stereo.calibration_sigma_px if known_px is None else known_px
    return ProbedRecording(
        source, pairs, first, cell_m, calibration_px, doubts(source), configuration, inputs, checkpoints,
        watch,
    )  # fmt: skip


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
                trajectory = checkpointed(
                    probed.checkpoints, "trajectory", lambda: estimate(source, rectifier, count, pairs)
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
    """Fuse each matched pair into the map's tiles, and carve its lines of sight.

    Raises MeasurementError where no frame could be measured.
    """
    source, watch = probed.source, probed.watch
    camera = way.rectifier.camera
    refusals = [Refusal("recording", frame) for frame in source.index.unpaired]
    refusals += [Refusal("trajectory", frame) for frame in way.trajectory.refused]
    binner = PointBinner(
        way.stereo, way.rectifier.body_from_rect0, probed.cell_m, probed.per_pixel, settings.map.max_sigma_m,
        watch,
    )  # fmt: skip
    views = FusedViews(
        binner, TileStore(scratch, settings.map.resident_tiles), settings.map, frame_of(source)
    )
    free, tops, preview = FreeSpace(probed.cell_m), TopPhoto(probed.cell_m), None
    for done, (frame, posed, neighbours) in enumerate(_placed(way.matched, way.poses), start=1):
        view = views.add(frame, posed, neighbours)
        if isinstance(view, Refusal):
            refusals.append(view)
        else:
            with watch("free space", 1):
                free.carve(view.cells, ViewFrusta.of(views.placed[-1:], camera).eyes[0])
            with watch("top photo", 1):
                tops.add(view.cells, view.pair, views.placed[-1])
            if preview is None or abs(done - len(way.poses) / 2) < 1:
                preview = Preview(view.pair.left, view.disparity_px)
        if done % _TIDIED_EVERY == 1:
            trim_heap()
        advance("map", done, len(way.poses))
    if not views.placed:
        raise MeasurementError(f"{source.path}: no frame could be measured; {_first_reason(refusals)}")
    return BuiltMap(
        views.store, free, tops, tuple(views.placed), tuple(views.stamps_ns), tuple(refusals), preview
    )  # fmt: skip


def checkpoint_key(recording: Recording, configuration: dict[str, Any], inputs: dict[str, str]) -> str:
    """Return a digest of all that trajectory and disparities depend on."""
    stages = {name: part for name, part in configuration.items() if name not in ("bundles", "lift")}
    rig = json_value(recording.rig)
    return json_digest([barsight.__version__, stages, inputs, rig, pictures_digest(recording)])


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


@contextmanager
def _matched_ahead(
    match: PairChain, pairs: Iterator[RectifiedPair | RefusedFrame], max_waiting: int
) -> Iterator[Iterator[MatchedFrame | Refusal]]:
    """Match pairs ahead, whole chains side by side; about `max_waiting` of them may wait."""
    chains = max(max_waiting // match.length, WORKERS)
    with prefetched_map(match.match_all, match.split(pairs), chains) as matched:
        yield chain.from_iterable(matched)


def _placed(
    matched: Iterator[MatchedFrame | Refusal], poses: dict[int, PosedFrame]
) -> Iterator[tuple[MatchedFrame | Refusal, PosedFrame, list[Neighbour]]]:
    """Yield the posed frames, each with those before and after it."""
    known = ((frame, poses[frame.stamp_ns]) for frame in matched if frame.stamp_ns in poses)
    before = None
    for here, after in pairwise(chain(known, (None,))):
        assert here is not None
        both = (other for other in (before, after) if other is not None)
        yield *here, [(frame, pose) for frame, pose in both if not isinstance(frame, Refusal)]
        before = here


def _first_reason(refusals: list[Refusal]) -> str:
    return f"first: {refusals[0].frame.reason}" if refusals else "it has no frames"
