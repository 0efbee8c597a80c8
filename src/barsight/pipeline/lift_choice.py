"""Find the bundles of a mapped yard, choose lifts, and collect all results."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from barsight.core.errors import BarsightError
from barsight.core.json_values import json_digest, json_value
from barsight.core.memory import peak_memory_mib
from barsight.core.notices import Notice
from barsight.core.stamps import seconds_to_ns
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap, Measurement, PassRecord, StageTime
from barsight.pipeline.bundle_search import carve_gullies, find_yard_bundles
from barsight.pipeline.further_passes import find_unseen
from barsight.pipeline.mapped_yard import MappedYard
from barsight.pipeline.notices import stage_notices, stock_notices
from barsight.reconstruction.joined_passes import MappedPass
from barsight.reconstruction.probed_recording import ProbedRecording
from barsight.reconstruction.tracked_recording import TrackedRecording
from barsight.yard.cameras import Cameras
from barsight.yard.events import YardEvent, events_since
from barsight.yard.inventory.stock_list import StockMatch, contradicted_bundles, match_stock
from barsight.yard.lifting.targets import LiftPlan, map_vetoes, offset_vetoes, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, load_magnet
from barsight.yard.sections import surface_map
from barsight.yard.types import Bundle, YardMap
from barsight.yard_frame import calibration_id, frame_of, with_shared, yard_frame_id


@dataclass(frozen=True)
class LiftRequest:
    """A request for lifts.

    magnet: magnet that they are chosen for; without one they are judged for the package's example, and all
    are forbidden (`no-magnet`). judged_at: time for which they are judged: now, or the recording's last
    frame, to look back. notices: warnings of the caller. events: reported before the yard was measured again;
    those that the new map may not show count. surveys: folder of the same yard's results, in which they are
    reported too. magnet_file: of the magnet.
    """

    magnet: Magnet | None = None
    judged_at: Literal["now", "end"] = "now"
    notices: tuple[Notice, ...] = ()
    events: tuple[YardEvent, ...] = ()
    surveys: Path | None = None
    magnet_file: Path | None = None

    @classmethod
    def of(
        cls, magnet: Path | None, judged_at: Literal["now", "end"] = "now", surveys: Path | None = None
    ) -> LiftRequest:
        """Request lifts for the magnet of a file; none is offered without one. Raises a BarsightError."""
        loaded = None if magnet is None else load_magnet(magnet)
        return cls(loaded, judged_at, surveys=surveys, magnet_file=magnet)

    def read_again(self) -> tuple[LiftRequest, str]:
        """Read the magnet's file again, which may have been changed since; return what to tell, "" if
        nothing. Without a valid file any more, no lift is offered.
        """
        if self.magnet_file is None:
            return self, ""
        try:
            magnet = load_magnet(self.magnet_file)
        except BarsightError as error:
            why = f"the magnet's file was changed meanwhile: {error}"
            return replace(self, magnet=None, notices=(*self.notices, Notice("live-state", why))), why
        told = "" if magnet == self.magnet else f"{self.magnet_file}: was changed; it counts as it is now"
        return replace(self, magnet=magnet), told


def find_lifts(mapped: MappedYard, request: LiftRequest) -> Measurement:
    """Find the bundles of a mapped yard and choose lifts."""
    settings, newest, trajectory = mapped.settings, mapped.newest, mapped.trajectory
    watch, profiles = mapped.watch, mapped.profiles
    heights = surface_map(mapped.surface, mapped.free, mapped.tops, mapped.history)
    bundles = find_yard_bundles(mapped, heights)
    if settings.map.carve_gullies:
        carve_gullies(mapped, heights, bundles)
        heights = surface_map(mapped.surface, mapped.free, mapped.tops, mapped.history)
    listed = mapped.stock if trajectory.reference == "yard" else None
    stock = None if listed is None else match_stock(listed, bundles)
    warnings = [*stage_notices(mapped), *stock_notices(mapped.stock, stock), *request.notices]
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
        frames_passed_over=sum(one.way.passed_over for one in mapped.passes),
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


def _input_hashes(passes: Sequence[MappedPass]) -> dict[str, str]:
    """Collect the inputs' digests, prefixed with the pass's number if there are several."""
    if len(passes) == 1:
        return passes[0].probed.inputs
    return {
        f"pass_{number}/{name}": digest
        for number, one in enumerate(passes, start=1) for name, digest in one.probed.inputs.items()
    }  # fmt: skip


def _stages(mapped: MappedYard) -> tuple[StageTime, ...]:
    """Sum the stages' times over the passes, in the order of the first pass."""
    watches = [one.probed.watch for one in mapped.passes]
    if mapped.joined is not None:
        watches.append(mapped.watch)
    total = dict[str, tuple[float, int]]()
    for name, seconds, frames in (entry for watch in watches for entry in watch.entries()):
        before = total.get(name, (0.0, 0))
        total[name] = before[0] + seconds, before[1] + frames
    return tuple(StageTime(name, *spent) for name, spent in total.items())


def _records(mapped: MappedYard, travels: Sequence[Travel]) -> tuple[PassRecord, ...]:
    """Describe each pass for result.json if there are several."""
    if mapped.joined is None:
        return ()
    ties = mapped.joined.ties
    return tuple(
        PassRecord(
            one.probed.source.path.resolve(), one.probed.source.format, one.probed.inputs,
            one.way.trajectory.length_m, travel.captured_ns, int(one.way.trajectory.stamp_ns[0]),
            int(one.way.trajectory.stamp_ns[-1]), len(one.built.placed), one.probed.frames_total,
            correction, tuple(pair for pair in ties.pairs if pair.second == number),
            tuple(change for change in mapped.joined.history.changes if change.pass_index == number),
            tuple(move for move in mapped.joined.history.moves if move.pass_index == number),
        )
        for number, (one, travel, correction) in enumerate(
            zip(mapped.passes, travels, ties.corrections, strict=True)
        )
    )  # fmt: skip


def _travel(
    probed: ProbedRecording, way: TrackedRecording, built: BuiltMap, settings: MeasureSettings
) -> Travel:
    """Estimate the uncertainty of the frames' path, and its deviation from the encoders."""
    source = probed.source
    shift_ns, window_ns = source.rig.timeshift_cam_imu_ns, seconds_to_ns(settings.motion.crane.window_s)
    camera = way.rectifier.camera
    range_m = probed.first.range_m
    trajectory = with_shared(way.trajectory, frame_of(source))
    travel = Travel.of(trajectory, source.crane(), shift_ns, window_ns, range_m, camera, built.stamps_ns)
    middle = trajectory.frames[len(trajectory.frames) // 2].reference_from_body
    return replace(travel, cameras=Cameras.of(middle, way.rectifier.body_from_rect0, camera))


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
    plan = plan_lifts(
        heights,
        bundles,
        request.magnet or load_magnet(None),
        settings,
        forbidden,
        travel,
        now_ns,
        events_since(request.events, travel.captured_ns),
        listed,
    )
    return replace(plan, unseen=find_unseen(plan, heights, bundles))
