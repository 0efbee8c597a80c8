"""Run the whole measurement: a recording in, a measured yard out.

recording -> rectified pair -> disparity -> points --+
crane or matched features -> trajectory -------------+-> map -> height surface -> contours -> agreement
                                                              +-> bundles -> their flanks, bars -> lifts
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.core.errors import InputError
from barsight.core.json_values import json_digest, json_value
from barsight.core.memory import peak_memory_mib
from barsight.core.notices import Notice
from barsight.core.parallel import single_opencv_thread
from barsight.core.stamps import seconds_to_ns
from barsight.core.timing import ProgressCallback, Stopwatch
from barsight.core.types import Trajectory
from barsight.labels.bundle_labels import expect_readers, label_bundles
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.laser_profiles import Profiles, cut_profiles
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap, Measurement, PassRecord, StageTime
from barsight.reconstruction.joined_passes import JoinedPasses, MappedPass, in_order, join_passes
from barsight.reconstruction.map_building import build_map
from barsight.reconstruction.probed_recording import ProbedRecording, inspect_recording
from barsight.reconstruction.tracked_recording import TrackedRecording, estimate_trajectory
from barsight.recording.base import Recording
from barsight.yard.bundles.bundle_kinds import listed_diameter
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.inventory.stock_list import (
    ListedBundle,
    StockMatch,
    contradicted_bundles,
    list_contradiction,
    match_stock,
    read_stock,
    stock_warnings,
)
from barsight.yard.lifting.targets import LiftPlan, map_vetoes, offset_vetoes, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, load_magnet
from barsight.yard.sections import surface_map
from barsight.yard.types import Bundle, YardMap
from barsight.yard_frame import (
    calibration_id,
    frame_name,
    frame_notes,
    frame_of,
    with_shared,
    yard_frame_id,
)

MIN_DOWN_COSINE = 0.5
"""Cosine between the optical axis and straight down; a rig over a yard looks down."""
MAX_BELOW_FLOOR_RATIO = 0.3
"""Depth under the floor over the working distance, at most; depths of one pair are rough."""


@dataclass(frozen=True)
class LiftRequest:
    """Lifts that are asked for.

    magnet: what they are chosen for; where there is none, they are judged for the package's example and all
    forbidden (`no-magnet`). judged_at: when they are judged: now, or at the recording's last frame, to look
    back. notices: warnings that the caller has.
    """

    magnet: Magnet | None = None
    judged_at: Literal["now", "end"] = "now"
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True, eq=False)
class MappedYard:
    """The first half's results: trajectories, map and contours. passes: the oldest first. joined: how several
    became one map. trajectory: of all. watch: times what is done for all. began_s: the clock when it was
    begun.
    """

    settings: MeasureSettings
    passes: tuple[MappedPass, ...]
    joined: JoinedPasses | None
    trajectory: Trajectory
    surface: Surface
    free: FreeSpace
    tops: TopPhoto
    profiles: Profiles
    stock: tuple[ListedBundle, ...] | None
    watch: Stopwatch
    began_s: float

    @property
    def newest(self) -> MappedPass:
        """Return the pass that was recorded last."""
        return self.passes[-1]

    @property
    def frame_id(self) -> str:
        """Return the name of the frame that all places are in."""
        return frame_name(self.newest.probed.source, self.trajectory, self.newest.probed.inputs)

    @property
    def history(self) -> PlaceHistory | None:
        """Return which pass saw each place last, and what changed; None of one pass."""
        return None if self.joined is None else self.joined.history


@single_opencv_thread()
def map_yard(
    recordings: Sequence[Recording], settings: MeasureSettings, scratch: Path, advance: ProgressCallback,
    resume: Path | None = None,
) -> MappedYard:  # fmt: skip
    """Measure the surface. `scratch` is an empty folder for tiles and pictures; the caller removes it.

    recordings: passes over one yard, in any order; each is measured by itself, one after the other, then they
    are tied and joined. resume: a folder that keeps the trajectory and each frame's disparity (about 19 MB
    for 1.3 megapixels), so that a killed run goes on where it was; the caller removes it when all is written.

    Raises InputError or MeasurementError where nothing can be measured, ConfigError where labels are to be
    read without what reads them; single frames that fail are refused and listed instead.
    """
    began_s, settings = time.perf_counter(), settings.chosen()
    stock = read_stock(settings.bundles.stock_list) if settings.bundles.stock_list else None
    expect_readers(settings.labels)
    ordered = in_order(recordings, settings)
    several = len(ordered) > 1
    passes, surfaces = [], []
    for number, recording in enumerate(ordered, start=1):
        own, kept = scratch, resume
        if several:
            own = scratch / f"pass_{number}"
            own.mkdir()
            kept = None if resume is None else resume / own.name
        probed = inspect_recording(recording, settings, own, kept)
        with estimate_trajectory(probed, settings, advance) as way:
            built = build_map(probed, way, settings, own, advance)
        surfaces.append(built.surface)
        passes.append(MappedPass(probed, way, built))
        if several:
            _expect_same_cells(passes)
            _remove_pictures(own)
    joined, watch = None, passes[0].probed.watch
    if several:
        watch = Stopwatch()
        with watch("join"):
            folder = scratch / "joined"
            folder.mkdir()
            joined = join_passes(passes, surfaces, folder)
    done = joined.passes if joined else tuple(passes)
    surface = joined.surface if joined else surfaces[0]
    free, tops = (joined.free, joined.tops) if joined else (passes[0].built.free, passes[0].built.tops)
    trajectory = _whole([one.way.trajectory for one in done])
    with watch("contours"):
        profiles = cut_profiles(done[-1].probed.source, trajectory, surface, settings.map, scratch)
    surface = profiles.surface
    return MappedYard(
        settings, done, joined, trajectory, surface, free, tops, profiles, stock, watch, began_s
    )


def _expect_same_cells(passes: Sequence[MappedPass]) -> None:
    first, last = (one.probed for one in (passes[0], passes[-1]))
    if last.cell_m != first.cell_m:
        problem = f"its map has cells of {last.cell_m:g} m, those before of {first.cell_m:g} m"
        raise InputError(last.source.path, problem, "set map.cell_m")


def _remove_pictures(folder: Path) -> None:
    """Remove a finished pass's rectified pictures: the next one's shall have their room."""
    for path in folder.glob("rectified_*.npy"):
        path.unlink()


def _whole(trajectories: Sequence[Trajectory]) -> Trajectory:
    """Chain the trajectories of passes, the oldest first; what only one of them knows is left to it. Of two
    pairs on one body, the first one's frame of a stamp counts.
    """
    if len(trajectories) == 1:
        return trajectories[0]
    frames = {frame.stamp_ns: frame for one in reversed(trajectories) for frame in one.frames}
    return Trajectory(
        trajectories[0].reference,
        tuple(frames[stamp_ns] for stamp_ns in sorted(frames)),
        tuple(frame for one in trajectories for frame in one.refused),
        tuple(dict.fromkeys(name for one in trajectories for name in one.sensors)),
    )


def find_lifts(mapped: MappedYard, request: LiftRequest) -> Measurement:
    """Find the bundles of a mapped yard and choose lifts."""
    settings, newest, trajectory = mapped.settings, mapped.newest, mapped.trajectory
    watch, profiles = mapped.watch, mapped.profiles
    heights = surface_map(mapped.surface, mapped.free, mapped.tops, mapped.history)
    bundles = _bundles(mapped, heights)
    listed = mapped.stock if trajectory.reference == "yard" else None
    stock = None if listed is None else match_stock(listed, bundles)
    warnings = [*_warnings(mapped), *_stock_notices(mapped.stock, stock), *request.notices]
    with watch("lifts"):
        travels = [_travel(one.probed, one.way, one.built, settings) for one in mapped.passes]
        travel = travels[0] if len(travels) == 1 else Travel.joined(travels)
        lifts = _lifts(heights, bundles, request, mapped, warnings, travel, stock)
    source = newest.probed.source
    return Measurement(
        recording_path=source.path.resolve(),
        recording_format=source.format,
        is_simulated=any(one.probed.source.is_simulated for one in mapped.passes),
        calibration_hash=json_digest(json_value(source.rig)),
        configuration_hash=json_digest(newest.probed.configuration),
        input_hashes=_input_hashes(mapped.passes),
        configuration=newest.probed.configuration,
        trajectory=trajectory,
        frames_total=sum(one.probed.frames_total for one in mapped.passes),
        frames_used=sum(len(one.built.placed) for one in mapped.passes),
        refusals=tuple(refusal for one in mapped.passes for refusal in one.built.refusals),
        sensors_used=tuple(dict.fromkeys(("stereo", *trajectory.sensors, *profiles.sensors))),
        surface=mapped.surface,
        contours=profiles.contours,
        laser=profiles.laser,
        agreements=profiles.agreements,
        laser_checks=profiles.checks,
        stages=_stages(mapped),
        warnings=tuple(warnings),
        seconds=time.perf_counter() - mapped.began_s,
        peak_memory_mib=peak_memory_mib(),
        preview=newest.built.preview,
        bundles=bundles,
        lifts=lifts,
        stock=stock,
        travel=travel,
        rig_covariance=newest.way.rig_covariance,
        yard_frame_id=yard_frame_id(source, trajectory),
        frame_id=mapped.frame_id,
        passes=_records(mapped, travels),
    )


def _bundles(mapped: MappedYard, heights: YardMap) -> tuple[Bundle, ...]:
    """Find the bundles, and look at their bars, straps and labels in the newest pass's pictures: what lay
    there before may be gone.
    """
    settings, newest = mapped.settings, mapped.newest
    poses = {frame.stamp_ns: frame.reference_from_body for frame in newest.way.trajectory.frames}
    with mapped.watch("bundles"):
        bundles = find_bundles(heights, settings.bundles)
        if mapped.joined is not None:
            bundles = mapped.joined.doubted(bundles)
    with mapped.watch("pictures"):
        used = set(newest.built.stamps_ns)
        seen = {stamp: pose for stamp, pose in poses.items() if stamp in used}
        measured = measure_from_pictures(newest.probed.pairs, seen, heights, bundles)
        bundles = tuple(listed_diameter(bundle, settings.bundles.catalogue_mm) for bundle in measured)
    if not settings.labels.read:
        return bundles
    with mapped.watch("labels"):
        return label_bundles(newest.probed.pairs, poses, heights, bundles, settings.labels)


def _input_hashes(passes: Sequence[MappedPass]) -> dict[str, str]:
    """Gather the inputs' digests, by the pass's number where there are several."""
    if len(passes) == 1:
        return passes[0].probed.inputs
    return {
        f"pass_{number}/{name}": digest
        for number, one in enumerate(passes, start=1) for name, digest in one.probed.inputs.items()
    }  # fmt: skip


def _stages(mapped: MappedYard) -> tuple[StageTime, ...]:
    """Sum the stages' times over the passes, in the order in which the first pass did them."""
    watches = [one.probed.watch for one in mapped.passes]
    if mapped.joined is not None:
        watches.append(mapped.watch)
    total = dict[str, tuple[float, int]]()
    for name, seconds, frames in (entry for watch in watches for entry in watch.entries()):
        before = total.get(name, (0.0, 0))
        total[name] = before[0] + seconds, before[1] + frames
    return tuple(StageTime(name, *spent) for name, spent in total.items())


def _records(mapped: MappedYard, travels: Sequence[Travel]) -> tuple[PassRecord, ...]:
    """Describe each of several passes for result.json."""
    if mapped.joined is None:
        return ()
    ties = mapped.joined.ties
    return tuple(
        PassRecord(
            one.probed.source.path.resolve(), one.probed.source.format, one.probed.inputs,
            one.way.trajectory.length_m, travel.captured_ns, int(one.way.trajectory.stamp_ns[0]),
            int(one.way.trajectory.stamp_ns[-1]), len(one.built.placed), one.probed.frames_total,
            correction, tuple(pair for pair in ties.pairs if pair.second == number),
            tuple(change for change in mapped.joined.history.changes if change.pass_number == number),
            tuple(move for move in mapped.joined.history.moves if move.pass_number == number),
        )
        for number, (one, travel, correction) in enumerate(
            zip(mapped.passes, travels, ties.corrections, strict=True)
        )
    )  # fmt: skip


def _warnings(mapped: MappedYard) -> list[Notice]:
    """Gather what every stage of every pass had to assume or leave out."""
    warnings, profiles = list[Notice](), mapped.profiles
    for number, one in enumerate(mapped.passes, start=1):
        own = _pass_warnings(one.probed, one.way, one.built)
        if mapped.joined is not None:
            own = [Notice(notice.code, f"pass {number}: {notice.message}") for notice in own]
        warnings += own
    warnings += mapped.joined.notices() if mapped.joined is not None else ()
    warnings += profiles.notices()
    for one in mapped.passes:
        if len(one.built.placed) == 1:
            reason = "one frame made the map: no height is confirmed by another"
            warnings.append(Notice("one-view", reason))
        if one.built.refusals:
            reason = f"{len(one.built.refusals)} of {one.probed.frames_total} frames were refused"
            warnings.append(Notice("frames-refused", reason))
    return warnings


def _stock_notices(listed: tuple[ListedBundle, ...] | None, stock: StockMatch | None) -> Iterator[Notice]:
    """Yield what the stock list and the map disagree on; nothing where there is no list."""
    if listed is None:
        return
    yield from (Notice("stock-list", text) for text in stock_warnings(listed, stock))
    contradiction = None if stock is None else list_contradiction(listed, stock)
    if contradiction:
        yield Notice("stock-contradicts", contradiction)


def _pass_warnings(probed: ProbedRecording, way: TrackedRecording, built: BuiltMap) -> list[Notice]:
    """Gather what a pass's sensors, calibration and trajectory had to assume or leave out."""
    warnings = [Notice("assumed", text) for text in probed.source.notes]
    warnings += [Notice("assumed", text) for text in frame_notes(frame_of(probed.source))]
    warnings += probed.doubts
    warnings += [Notice("calibration", text) for text in probed.first.warnings]
    warnings += [Notice("calibration-drift", text) for text in way.drift_warnings]
    warnings += [Notice("trajectory", text) for text in way.trajectory.warnings]
    warnings += [Notice("trajectory-degraded", text) for text in way.trajectory.doubts]
    if way.trajectory.reference == "yard" and "stereo" not in way.trajectory.sensors:
        warnings.append(Notice("trajectory-degraded", "no picture was held against the encoders"))
    return warnings + _floor_doubts(probed, built, way.trajectory)


def _floor_doubts(probed: ProbedRecording, built: BuiltMap, trajectory: Trajectory) -> list[Notice]:
    """Warn where the cameras' view lies below the yard's floor, or not below the cameras."""
    if trajectory.reference != "yard":
        return []
    ahead = np.array([0.0, 0.0, probed.first.range_m])
    seen_z_m = float(np.median([pose.apply(ahead)[2] for pose in built.placed]))
    eye_z_m = float(np.median([pose.translation[2] for pose in built.placed]))
    if eye_z_m - seen_z_m < MIN_DOWN_COSINE * probed.first.range_m:
        where = "not below them"
    elif seen_z_m < -MAX_BELOW_FLOOR_RATIO * probed.first.range_m:
        where = f"{-seen_z_m:.1f} m below the yard's floor (z = 0)"
    else:
        return []
    remedy = "check the hoist's sign and unit, p_crane_body, R_yard_body and the cameras' T_BS"
    return [Notice("mounting-doubtful", f"what the cameras see lies {where}: {remedy}")]


def _travel(
    probed: ProbedRecording, way: TrackedRecording, built: BuiltMap, settings: MeasureSettings
) -> Travel:
    """Tell how sure the frames' way is, and how far off the encoders."""
    source = probed.source
    shift_ns, window_ns = source.rig.timeshift_cam_imu_ns, seconds_to_ns(settings.motion.crane.window_s)
    camera = way.rectifier.camera
    range_m = probed.first.range_m
    trajectory = with_shared(way.trajectory, frame_of(source))
    return Travel.of(trajectory, source.crane(), shift_ns, window_ns, range_m, camera, built.stamps_ns)


def _lifts(
    heights: YardMap, bundles: tuple[Bundle, ...], request: LiftRequest, mapped: MappedYard,
    warnings: list[Notice], travel: Travel, stock: StockMatch | None,
) -> LiftPlan:  # fmt: skip
    """Choose lifts, judged now or at the last frame."""
    settings, trajectory, source = mapped.settings.lift, mapped.trajectory, mapped.newest.probed.source
    told = [(notice.code, notice.message) for notice in warnings]
    captured_to_ns = int(travel.stamp_ns[travel.measured][-1])
    now_ns = time.time_ns() if request.judged_at == "now" else captured_to_ns
    forbidden = map_vetoes(
        told, trajectory.reference, captured_to_ns, now_ns, settings, has_magnet=request.magnet is not None
    )
    if request.magnet is not None:
        own = calibration_id(source.rig), yard_frame_id(source, trajectory)
        forbidden += offset_vetoes(request.magnet, *own)
    listed = {} if stock is None else contradicted_bundles(stock)
    return plan_lifts(
        heights,
        bundles,
        request.magnet or load_magnet(None),
        settings,
        forbidden,
        travel,
        now_ns,
        contradicted=listed,
    )
