"""Run the whole measurement: a recording in, a measured yard out.

recording -> rectified pair -> disparity -> points --+
crane or matched features -> trajectory -------------+-> map -> height surface -> contours -> agreement
                                                              +-> bundles -> lifts
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from barsight.core.errors import Failed, MeasurementError
from barsight.core.json_values import json_digest
from barsight.core.memory import peak_memory_mib, trim_heap
from barsight.core.notices import Notice
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.core.types import Agreement, Contour, CraneSamples, LaserProfile, Trajectory
from barsight.map_building import (
    BuiltMap,
    ProbedRecording,
    ProgressCallback,
    TrackedRecording,
    build_map,
    estimate_trajectory,
    inspect_recording,
)
from barsight.mapping.agreement import compute_agreement
from barsight.mapping.surface.contours import cut_contours
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.incremental import SurfaceElection
from barsight.mapping.surface.surface import Surface
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Measurement, StageTime, to_json
from barsight.recording.base import Recording
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.identity import ID_DIGITS
from barsight.yard.inventory.stock_list import (
    ListedBundle,
    StockMatch,
    contradicted_bundles,
    list_contradiction,
    match_stock,
    read_stock,
    stock_warnings,
)
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.targets import LiftPlan, map_vetoes, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, load_magnet
from barsight.yard.sections import surface_map
from barsight.yard.types import Bundle, YardMap

MIN_DOWN_COSINE = 0.5
"""Cosine between the optical axis and straight down; a rig over a yard looks down."""
MAX_BELOW_FLOOR_RATIO = 0.3
"""Depth under the floor over the working distance, at most; depths of one pair are rough."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """Contours, the laser's profiles in the map's frame, their agreement or why there is none."""

    contours: tuple[Contour, ...]
    laser: tuple[LaserProfile, ...]
    agreed: tuple[Agreement | Failed, ...]
    left_out: bool


@dataclass(frozen=True, eq=False)
class MappedYard:
    """The first half's results: trajectory, map and contours. began_s: the clock when it was begun."""

    settings: MeasureSettings
    probed: ProbedRecording
    way: TrackedRecording
    built: BuiltMap
    surface: Surface
    profiles: Profiles
    stock: tuple[ListedBundle, ...] | None
    began_s: float


def map_yard(
    recording: Recording, settings: MeasureSettings, scratch: Path, advance: ProgressCallback,
    resume: Path | None = None,
) -> MappedYard:  # fmt: skip
    """Measure the surface. `scratch` is an empty folder for tiles and pictures; the caller removes it.

    resume: a folder that keeps the trajectory and each frame's disparity (about 19 MB for 1.3 megapixels), so
    that a killed run goes on where it was; the caller removes it when all is written.

    Raises InputError or MeasurementError where nothing can be measured; single frames that fail are refused
    and listed instead.
    """
    began_s, settings = time.perf_counter(), settings.chosen()
    stock = read_stock(settings.bundles.stock_list) if settings.bundles.stock_list else None
    probed = inspect_recording(recording, settings, scratch, resume)
    with estimate_trajectory(probed, settings, advance) as way:
        built = build_map(probed, way, settings, scratch, advance)
    with probed.watch("surface"):
        surface = _elect(probed, way, built, settings, scratch)
    with probed.watch("contours"):
        profiles = _compare_with_laser(probed, way.trajectory, surface, settings)
    return MappedYard(settings, probed, way, built, surface, profiles, stock, began_s)


def find_lifts(
    mapped: MappedYard, magnet: Magnet | None = None, judged_at: Literal["now", "end"] = "now",
    notices: tuple[Notice, ...] = (),
) -> Measurement:  # fmt: skip
    """Find the bundles of a mapped yard and choose lifts.

    magnet: what lifts are chosen for; where there is none, they are judged for the package's example and all
    forbidden (`no-magnet`). judged_at: when lifts are judged: now, or at the recording's last frame, to look
    back. notices: warnings that the caller has.
    """
    settings, probed, way, built = mapped.settings, mapped.probed, mapped.way, mapped.built
    watch, trajectory, surface, profiles = probed.watch, way.trajectory, mapped.surface, mapped.profiles
    with watch("bundles"):
        heights = surface_map(surface, built.free, built.tops)
        bundles = find_bundles(heights, settings.bundles)
        placed_in_yard = mapped.stock is not None and trajectory.reference == "yard"
        stock = match_stock(mapped.stock, bundles) if placed_in_yard and mapped.stock is not None else None
    warnings = [*_warnings(probed, way, built, profiles), *notices]
    if mapped.stock is not None:
        warnings += [Notice("stock-list", text) for text in stock_warnings(mapped.stock, stock)]
        contradiction = None if stock is None else list_contradiction(mapped.stock, stock)
        warnings += [Notice("stock-contradicts", contradiction)] if contradiction else []
    with watch("lifts"):
        travel = _travel(probed, way, built, settings)
        lifts = _lifts(
            heights, bundles, magnet, settings.lift, warnings, trajectory, travel, judged_at, stock
        )
    source = probed.source
    return Measurement(
        recording_path=source.path.resolve(),
        recording_format=source.format,
        is_simulated=source.is_simulated,
        calibration_hash=json_digest(to_json(asdict(source.rig))),
        configuration_hash=json_digest(probed.configuration),
        input_hashes=probed.inputs,
        configuration=probed.configuration,
        trajectory=trajectory,
        frames_total=_frames_total(probed),
        frames_used=len(built.placed),
        refusals=built.refusals,
        sensors_used=tuple(dict.fromkeys(("stereo", *trajectory.sensors))),
        surface=surface,
        contours=profiles.contours,
        laser=profiles.laser,
        agreements=tuple(a for a in profiles.agreed if isinstance(a, Agreement)),
        stages=tuple(StageTime(*entry) for entry in watch.entries()),
        warnings=tuple(warnings),
        seconds=time.perf_counter() - mapped.began_s,
        peak_memory_mib=peak_memory_mib(),
        preview=built.preview,
        bundles=bundles,
        lifts=lifts,
        stock=stock,
        travel=travel,
        yard_frame_id=_yard_frame_id(source.crane(), trajectory),
    )


def _yard_frame_id(crane: CraneSamples | None, trajectory: Trajectory) -> str | None:
    """Compute a digest of how the body hangs from the crane, by which the map lies in the yard."""
    if crane is None or trajectory.reference != "yard":
        return None
    hung = {"crane_to_body_m": crane.crane_to_body_m, "yard_from_body": crane.yard_from_body_nominal}
    return json_digest(to_json(hung))[:ID_DIGITS]


def _elect(
    probed: ProbedRecording, way: TrackedRecording, built: BuiltMap, settings: MeasureSettings, scratch: Path
) -> Surface:
    """Elect the surface of all views. Raises MeasurementError where no place was seen often enough."""
    min_views = settings.map.min_views if len(built.placed) > 1 else 1
    frusta = ViewFrusta.of(built.placed, way.rectifier.camera, probed.per_pixel)
    election = SurfaceElection(built.store, scratch, probed.cell_m, settings.map)
    surface = election.finish(min_views, frusta)
    trim_heap()
    if surface.seen == 0:
        raise MeasurementError(
            f"{probed.source.path}: no place was seen by {min_views} frames; lower map.min_views"
        )
    return surface


def _compare_with_laser(
    probed: ProbedRecording, trajectory: Trajectory, surface: Surface, settings: MeasureSettings
) -> Profiles:
    """Cut contours and hold them against the laser's profiles.

    Profiles are places in the yard: a map in a frame of its own can't be held against them.
    """
    whole = probed.source.laser()
    laser = whole if trajectory.reference == "yard" else ()
    contours = cut_contours(surface, laser, settings.map.profile_y_m, settings.map.contours)
    by_number = {contour.profile: contour for contour in contours}
    speed_mps = _speed_along_x(trajectory)
    agreed = tuple(
        compute_agreement(by_number[p.profile], p, speed_mps) for p in laser if p.profile in by_number
    )
    return Profiles(contours, laser, agreed, len(laser) < len(whole))


def _warnings(
    probed: ProbedRecording, way: TrackedRecording, built: BuiltMap, profiles: Profiles
) -> list[Notice]:
    """Gather what every stage had to assume or leave out."""
    warnings = [Notice("assumed", text) for text in probed.source.notes]
    warnings += probed.doubts
    warnings += [Notice("calibration", text) for text in probed.first.warnings]
    warnings += [Notice("calibration-drift", text) for text in way.drift_warnings]
    warnings += [Notice("trajectory", text) for text in way.trajectory.warnings]
    warnings += [Notice("trajectory-degraded", text) for text in way.trajectory.doubts]
    if way.trajectory.reference == "yard" and "stereo" not in way.trajectory.sensors:
        warnings.append(Notice("trajectory-degraded", "no picture was held against the encoders"))
    warnings += _floor_doubts(probed, built, way.trajectory)
    warnings += [Notice(a.code, a.reason) for a in profiles.agreed if isinstance(a, Failed)]
    if profiles.left_out:
        reason = "without a crane the map isn't in the laser's yard: no agreement"
        warnings.append(Notice("laser-frame", reason))
    if len(built.placed) == 1:
        warnings.append(Notice("one-view", "one frame made the map: no height is confirmed by another"))
    if built.refusals:
        reason = f"{len(built.refusals)} of {_frames_total(probed)} frames were refused"
        warnings.append(Notice("frames-refused", reason))
    return warnings


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


def _frames_total(probed: ProbedRecording) -> int:
    return len(probed.source.index.stamps_ns) + len(probed.source.index.unpaired)


def _travel(
    probed: ProbedRecording, way: TrackedRecording, built: BuiltMap, settings: MeasureSettings
) -> Travel:
    """Tell how sure the frames' way is, and how far off the encoders."""
    source = probed.source
    shift_ns, window_ns = source.rig.timeshift_cam_imu_ns, seconds_to_ns(settings.motion.crane.window_s)
    camera = way.rectifier.camera
    range_m = probed.first.range_m
    return Travel.of(way.trajectory, source.crane(), shift_ns, window_ns, range_m, camera, built.stamps_ns)


def _lifts(
    heights: YardMap, bundles: tuple[Bundle, ...], magnet: Magnet | None, settings: LiftSettings,
    warnings: list[Notice], trajectory: Trajectory, travel: Travel, judged_at: Literal["now", "end"],
    stock: StockMatch | None,
) -> LiftPlan:  # fmt: skip
    """Choose lifts, judged now or at the last frame."""
    told = [(notice.code, notice.message) for notice in warnings]
    captured_to_ns = int(travel.stamp_ns[travel.measured][-1])
    now_ns = time.time_ns() if judged_at == "now" else captured_to_ns
    forbidden = map_vetoes(
        told, trajectory.reference, captured_to_ns, now_ns, settings, has_magnet=magnet is not None
    )
    listed = {} if stock is None else contradicted_bundles(stock)
    return plan_lifts(
        heights,
        bundles,
        magnet or load_magnet(None),
        settings,
        forbidden,
        travel,
        now_ns,
        contradicted=listed,
    )


def _speed_along_x(trajectory: Trajectory) -> float:
    """Estimate the velocity along X while travelling, signed, m/s: the median over the steps
    between frames.
    """
    seconds = np.diff(trajectory.stamp_ns) / NS_PER_S
    if seconds.size == 0:
        return float("nan")
    return float(np.median(np.diff(trajectory.positions_m[:, 0]) / seconds))
