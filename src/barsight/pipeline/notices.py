"""Collect the warnings of a measurement: what its stages assumed, left out or doubted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from barsight.core.notices import Notice
from barsight.core.records.trajectory import Trajectory
from barsight.measurement import BuiltMap
from barsight.pipeline.mapped_yard import MappedYard
from barsight.reconstruction.probed_recording import ProbedRecording
from barsight.reconstruction.tracked_recording import TrackedRecording
from barsight.yard.inventory.stock_list import ListedBundle, StockMatch, list_contradiction, stock_warnings
from barsight.yard_frame import frame_notes, frame_of

MIN_DOWN_COSINE = 0.5
"""Minimum cosine between the optical axis and straight down; a rig over a yard looks down."""
MAX_BELOW_FLOOR_RATIO = 0.3
"""Maximum depth of the seen surface under the floor, as a share of the working distance; depths of one
pair are rough.
"""


def stage_notices(mapped: MappedYard) -> list[Notice]:
    """Collect what every stage of every pass had to assume or leave out."""
    warnings, profiles = list[Notice](), mapped.profiles
    for number, one in enumerate(mapped.passes, start=1):
        own = _pass_notices(one.probed, one.way, one.built)
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
            refused = Counter(refusal.frame.reason for refusal in one.built.refusals)
            (most, count), total = refused.most_common(1)[0], one.probed.frames_total
            why = f"{'first' if count == 1 else f'most often ({count})'}: {most}"
            reason = f"{refused.total()} of {total} frames were refused; {why}"
            warnings.append(Notice("frames-refused", reason))
    return warnings


def stock_notices(listed: tuple[ListedBundle, ...] | None, stock: StockMatch | None) -> Iterator[Notice]:
    """Yield the disagreements between the stock list and the map; nothing without a list."""
    if listed is None:
        return
    yield from (Notice("stock-list", text) for text in stock_warnings(listed, stock))
    contradiction = None if stock is None else list_contradiction(listed, stock)
    if contradiction:
        yield Notice("stock-contradicts", contradiction)


def _pass_notices(probed: ProbedRecording, way: TrackedRecording, built: BuiltMap) -> list[Notice]:
    """Collect what a pass's sensors, calibration and trajectory had to assume or leave out."""
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
    """Warn if what the cameras see is far below the yard's floor, or not below the cameras."""
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
