"""Run the whole measurement: a recording in, a measured yard out.

recording -> rectified pair -> disparity -> points --+
crane or matched features -> trajectory -------------+-> map -> height surface -> contours -> agreement
                                                              +-> bundles -> lifts
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, islice, pairwise, takewhile
from pathlib import Path
from typing import Any, Literal

import numpy as np

import barsight
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px
from barsight.checkpoint import checkpoint_folder, checkpointed, pictures_digest
from barsight.core.errors import ConfigError, Failed, MeasurementError
from barsight.core.memory import peak_memory_mib, trim_heap
from barsight.core.parallel import in_background, prefetched_map
from barsight.core.pose import Pose
from barsight.core.settings.numbers import expect_numbers
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.core.timing import Stopwatch, count_frames
from barsight.core.types import Agreement, PosedFrame, RefusedFrame, StereoFrame, Trajectory
from barsight.mapping.agreement import compute_agreement
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.fusion import fuse_view
from barsight.mapping.scene_extent import (
    choose_cell_size,
    points_per_pixel,
    probe_recording,
    select_keyframes,
    select_keyframes_by_encoders,
)
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.contours import cut_contours
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.incremental import SurfaceElection
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore
from barsight.mapping.view import MatchedFrame, Matcher, Neighbour, PointBinner
from barsight.measurement import Measurement, Notice, Preview, Refusal, StageTime, json_digest, to_json
from barsight.motion.rig_check.self_calibration import self_calibrate
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.base import Recording, RecordingSettings
from barsight.recording.sensor_samples import imu_hints
from barsight.recording.sensor_selection import SelectedSensors
from barsight.stereo.settings import StereoSettings, make_method
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.inventory.stock_list import match_stock, read_stock, stock_warnings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.magnet import Magnet, load_magnet
from barsight.yard.lifting.targets import LiftPlan, map_vetoes, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.sections import surface_map
from barsight.yard.types import Bundle, YardMap

Advance = Callable[[str, int, int], None]
"""Told of progress: stage, frames done, frames in all."""

_FAST_SHIFT = 0.1
_MATCHED_AHEAD, _MATCHED_AFTER = 16, 4
"""Pairs that may wait, matched, beside the trajectory and after it: 13 MB each at 1280x1024."""
_TIDIED_EVERY = 8
"""Frames between which freed memory may pile up."""


@dataclass(frozen=True)
class MeasureSettings:
    """Settings of `barsight measure`; each stage gets its own part only."""

    preset: Literal["best", "fast"] = "best"
    """fast: the stereo preset `fast`, and no more pictures matched than lie a tenth apart."""
    use: tuple[Literal["stereo", "imu", "crane"], ...] = ("stereo", "imu", "crane")
    """Sensors that may be used, where the recording has them."""
    self_calibrate: Literal["none", "yaw"] = "none"
    """yaw: turn the right camera as the crane's known travel asks for (see `barsight calibrate check`)."""
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    stereo: StereoSettings = field(default_factory=StereoSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    map: MapSettings = field(default_factory=MapSettings)
    bundles: BundleSettings = field(default_factory=BundleSettings)
    lift: LiftSettings = field(default_factory=LiftSettings)

    def __post_init__(self) -> None:
        if "stereo" not in self.use:
            raise ConfigError("stereo can't be left out of --use: it is what measures")
        expect_numbers(asdict(self))

    def chosen(self) -> MeasureSettings:
        """Apply the preset to the settings."""
        if self.preset == "best":
            return self
        stereo = replace(self.stereo, barsight=replace(self.stereo.barsight, preset="fast"))
        shift = max(self.map.min_shift, _FAST_SHIFT)
        return replace(self, stereo=stereo, map=replace(self.map, min_shift=shift))


def measure(
    recording: Recording,
    settings: MeasureSettings,
    scratch: Path,
    advance: Advance,
    resume: Path | None = None,
    magnet: Magnet | None = None,
    write: Callable[[Surface, FreeSpace], None] = lambda _surface, _free: None,
    judged_at: Literal["now", "end"] = "now",
) -> Measurement:
    """Measure a recording. `scratch` is an empty folder for the map's tiles; the caller removes it.

    resume: a folder that keeps the trajectory and each frame's disparity (about 16 MB for 1.3 megapixels), so
    that a killed run goes on where it was; the caller removes it when all is written.
    magnet: what lifts are chosen for; where there is none, they are judged for the package's example and
    all forbidden (`no-magnet`).
    write: given surface and free space as soon as they are finished, beside the search for bundles.
    judged_at: when lifts are judged: now, or at the recording's last frame, to look back.

    Raises InputError or MeasurementError where nothing can be measured; single frames that fail are refused
    and listed instead.
    """
    settings = settings.chosen()
    expected = read_stock(settings.bundles.stock_list) if settings.bundles.stock_list else None
    source = SelectedSensors(recording, settings.use)
    watch = Stopwatch()
    start = time.perf_counter()
    with watch("look"):
        rectifier = Rectifier(source.rig)
        first = probe_recording(source, rectifier)
        imu = source.imu()
        hints = imu_hints(imu) if imu is not None else ()
        cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=source.crane() is not None)
    known_px = disparity_sigma_px(settings.recording.rig, first.range_m)
    calibration_px = settings.stereo.calibration_sigma_px if known_px is None else known_px
    total = len(source.index.stamps_ns)
    configuration, inputs = to_json(asdict(settings)), source.digests()
    kept = None
    if resume is not None:
        kept = checkpoint_folder(resume, checkpoint_key(recording, configuration, inputs))

    matcher = Matcher(settings.stereo, make_method(settings.stereo.for_map()), rectifier, watch)
    early = _known_early(source, settings, rectifier, first.range_m)
    match = matching(matcher, kept)
    # Pictures are matched on the core that the trajectory leaves idle.
    begun = islice(source.frames(early), len(early))
    with ExitStack() as pools:
        ahead = pools.enter_context(prefetched_map(match, begun, _MATCHED_AHEAD))
        with watch("trajectory", total):
            estimate = make_estimator(settings.motion)
            count = count_frames("trajectory", total, advance)
            trajectory = checkpointed(kept, "trajectory", lambda: estimate(source, rectifier, count))
            trim_heap()
            calibrated = self_calibrate(
                source.rig, rectifier, trajectory.drift, calibration_px,
                correct=settings.self_calibrate == "yaw",
            )  # fmt: skip
            rectifier = calibrated.rectifier
            stereo = replace(settings.stereo, calibration_sigma_px=calibrated.sigma_px)
        taken = select_keyframes(trajectory.frames, rectifier, first.range_m, settings.map.min_shift)
        poses = {frame.stamp_ns: frame for frame in trajectory.frames if frame.stamp_ns in taken}
        late = min((stamp for stamp in poses if stamp not in early), default=None)
        matched: Iterator[MatchedFrame | Refusal] = ahead
        if late is not None:
            rest = source.frames({stamp for stamp in poses if stamp >= late})
            match = matching(replace(matcher, rectifier=rectifier), kept)
            after = pools.enter_context(prefetched_map(match, rest, _MATCHED_AFTER))
            matched = chain(takewhile(lambda frame: frame.stamp_ns < late, ahead), after)

        refusals = [Refusal("recording", frame) for frame in source.index.unpaired]
        refusals += [Refusal("trajectory", frame) for frame in trajectory.refused]
        per_pixel = points_per_pixel(first, cell_m)
        body_from_rect0 = rectifier.body_from_rect0
        placer = PointBinner(stereo, body_from_rect0, cell_m, per_pixel, settings.map.max_sigma_m, watch)
        store = TileStore(scratch, settings.map.resident_tiles)
        free = FreeSpace(cell_m)
        preview = None
        placed: list[Pose] = []
        for done, (frame, posed, neighbours) in enumerate(_placed(matched, poses), start=1):
            view = frame if isinstance(frame, Refusal) else placer(frame, posed, neighbours)
            if isinstance(view, Failed):
                view = Refusal("stereo", RefusedFrame(posed.stamp_ns, view.reason))
            if isinstance(view, Refusal):
                refusals.append(view)
            else:
                with watch("fuse", 1):
                    fuse_view(store, view.cells, settings.map)
                placed.append(posed.reference_from_body @ body_from_rect0)
                with watch("free space", 1):
                    free.carve(view.cells, ViewFrusta.of([placed[-1]], rectifier.camera).eyes[0])
                if preview is None or abs(done - len(poses) / 2) < 1:
                    preview = Preview(view.left, view.disparity_px)
            if done % _TIDIED_EVERY == 1:
                trim_heap()
            advance("map", done, len(poses))
    used = len(placed)
    if used == 0:
        raise MeasurementError(f"{source.path}: no frame could be measured; {_first_reason(refusals)}")

    with watch("surface"):
        min_views = settings.map.min_views if used > 1 else 1
        sights = ViewFrusta.of(placed, rectifier.camera, per_pixel)
        surface = SurfaceElection(store, scratch, cell_m, settings.map).finish(min_views, sights)
        trim_heap()
    if surface.seen == 0:
        raise MeasurementError(f"{source.path}: no place was seen by {min_views} frames; lower map.min_views")
    with watch("contours"):
        whole_laser = source.laser()
        # Laser profiles are places in the yard: a map in a frame of its own can't be held against them.
        laser = whole_laser if trajectory.reference == "yard" else ()
        contours = cut_contours(surface, laser, settings.map.profile_y_m, settings.map.contours)
        by_number = {contour.profile: contour for contour in contours}
        speed_mps = _speed_along_x(trajectory)
        agreed = [
            compute_agreement(by_number[p.profile], p, speed_mps) for p in laser if p.profile in by_number
        ]

    with watch("bundles"), in_background(lambda: write(surface, free)):
        heights = surface_map(surface, free)
        bundles = find_bundles(heights, settings.bundles)
        stock = (
            match_stock(expected, bundles)
            if expected is not None and trajectory.reference == "yard"
            else None
        )

    warnings = [Notice("assumed", text) for text in source.notes]
    warnings += [Notice("imu", text) for text in hints]
    warnings += [Notice("calibration", text) for text in first.warnings]
    warnings += [Notice("calibration-drift", text) for text in calibrated.warnings]
    warnings += [Notice("trajectory", text) for text in trajectory.warnings]
    if expected is not None:
        warnings += [Notice("stock-list", text) for text in stock_warnings(expected, stock)]
    warnings += [Notice(a.code, a.reason) for a in agreed if isinstance(a, Failed)]
    if len(laser) < len(whole_laser):
        warnings.append(
            Notice("laser-frame", "without a crane the map isn't in the laser's yard: no agreement")
        )
    if used == 1:
        warnings.append(Notice("one-view", "one frame made the map: no height is confirmed by another"))
    frames_total = total + len(source.index.unpaired)
    if refusals:
        warnings.append(Notice("frames-refused", f"{len(refusals)} of {frames_total} frames were refused"))
    with watch("lifts"):
        crane_shift_ns = source.rig.timeshift_cam_imu_ns
        window_ns = seconds_to_ns(settings.motion.crane.window_s)
        travel = Travel.of(
            trajectory, source.crane(), crane_shift_ns, window_ns, first.range_m, rectifier.camera
        )
        lifts = _lifts(heights, bundles, magnet, settings.lift, warnings, trajectory, travel, judged_at)
    return Measurement(
        recording_path=source.path,
        recording_format=source.format,
        is_simulated=source.is_simulated,
        calibration_hash=json_digest(to_json(asdict(source.rig))),
        configuration_hash=json_digest(configuration),
        input_hashes=inputs,
        configuration=configuration,
        trajectory=trajectory,
        frames_total=frames_total,
        frames_used=used,
        refusals=tuple(refusals),
        sensors_used=tuple(dict.fromkeys(("stereo", *trajectory.sensors))),
        surface=surface,
        contours=contours,
        laser=laser,
        agreements=tuple(a for a in agreed if isinstance(a, Agreement)),
        stages=tuple(StageTime(*entry) for entry in watch.entries()),
        warnings=tuple(warnings),
        seconds=time.perf_counter() - start,
        peak_memory_mib=peak_memory_mib(),
        preview=preview,
        bundles=bundles,
        lifts=lifts,
        stock=stock,
        travel=travel,
    )


def _lifts(
    heights: YardMap, bundles: tuple[Bundle, ...], magnet: Magnet | None, settings: LiftSettings,
    warnings: list[Notice], trajectory: Trajectory, travel: Travel, judged_at: Literal["now", "end"],
) -> LiftPlan:  # fmt: skip
    """Choose lifts, judged now or at the last frame."""
    told = [(notice.code, notice.message) for notice in warnings]
    captured_to_ns = int(trajectory.stamp_ns[-1])
    now_ns = time.time_ns() if judged_at == "now" else captured_to_ns
    forbidden = map_vetoes(
        told, trajectory.reference, captured_to_ns, now_ns, settings, has_magnet=magnet is not None
    )
    return plan_lifts(heights, bundles, magnet or load_magnet(None), settings, forbidden, travel, now_ns)


def checkpoint_key(recording: Recording, configuration: dict[str, Any], inputs: dict[str, str]) -> str:
    """Return a digest of all that trajectory and disparities depend on."""
    stages = {name: part for name, part in configuration.items() if name not in ("bundles", "lift")}
    rig = to_json(asdict(recording.rig))
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
    matcher: Matcher, kept: Path | None
) -> Callable[[StereoFrame | RefusedFrame], MatchedFrame | Refusal]:
    """Match frames, each once for all runs that keep checkpoints in `kept`."""

    def match(frame: StereoFrame | RefusedFrame) -> MatchedFrame | Refusal:
        if isinstance(frame, RefusedFrame):
            return Refusal("recording", frame)
        matched = checkpointed(kept, f"matched_{frame.stamp_ns}", lambda: matcher(frame))
        if isinstance(matched, Failed):
            return Refusal("stereo", RefusedFrame(frame.stamp_ns, matched.reason))
        return matched

    return match


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


def _speed_along_x(trajectory: Trajectory) -> float:
    """Estimate the velocity along X while travelling, signed, m/s: the median over the steps
    between frames.
    """
    seconds = np.diff(trajectory.stamp_ns) / NS_PER_S
    if seconds.size == 0:
        return float("nan")
    return float(np.median(np.diff(trajectory.positions_m[:, 0]) / seconds))


def _first_reason(refusals: list[Refusal]) -> str:
    return f"first: {refusals[0].frame.reason}" if refusals else "it has no frames"
