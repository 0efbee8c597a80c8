"""The way of the data, whole: a recording in, a measured yard out.

recording -> rectified pair -> disparity -> points --+
crane or matched features -> trajectory -------------+-> map -> height surface -> contours -> agreement
"""

from __future__ import annotations

import hashlib
import json
import math
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from barsight.calibration.rectification import Rectifier
from barsight.core.errors import ConfigError, Failed, InputError, MeasurementError
from barsight.core.parallel import ordered_map
from barsight.core.timing import Stopwatch
from barsight.core.types import (
    Agreement,
    DisparityRange,
    PosedFrame,
    RectifiedPair,
    RefusedFrame,
    StereoFrame,
)
from barsight.evaluation.agreement import agree
from barsight.mapping.contours import cut_contours
from barsight.mapping.fusion import fuse
from barsight.mapping.observation import CellObservations, observe
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface import finish
from barsight.mapping.tiles import TileStore
from barsight.measurement import Measurement, Notice, Preview, Refusal, StageTime
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.base import Recording, RecordingSettings
from barsight.recording.selection import SelectedSensors
from barsight.recording.sensors import imu_hints
from barsight.stereo.disparity_range import find_range
from barsight.stereo.gaps import without_gaps
from barsight.stereo.method import StereoMethod
from barsight.stereo.points import triangulate
from barsight.stereo.settings import StereoSettings, make_method

Advance = Callable[[str, int, int], None]
"""Told of progress: stage, frames done, frames in all."""

WORKERS = 2
CELL_SIDES_M = (0.01, 0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class MeasureSettings:
    """Everything that `barsight measure` can be told; each stage gets its own part only."""

    use: tuple[Literal["stereo", "imu", "crane"], ...] = ("stereo", "imu", "crane")
    """Sensors that may be used, where the recording has them."""
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    stereo: StereoSettings = field(default_factory=StereoSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    map: MapSettings = field(default_factory=MapSettings)

    def __post_init__(self) -> None:
        if "stereo" not in self.use:
            raise ConfigError("stereo can't be left out of --use: it is what measures")


def measure(recording: Recording, settings: MeasureSettings, scratch: Path, advance: Advance) -> Measurement:
    """Measure a recording. `scratch` is an empty folder for the map's tiles; the caller removes it.

    Raises InputError or MeasurementError where nothing can be measured; single frames that fail are refused
    and listed instead.
    """
    source = SelectedSensors(recording, settings.use)
    watch = Stopwatch()
    start = time.perf_counter()
    with watch("look"):
        rectifier = Rectifier(source.rig)
        first = first_look(source, rectifier)
        imu = source.imu()
        hints = imu_hints(imu) if imu is not None else ()
        cell_m = settings.map.cell_m or choose_cell(first, has_crane=source.crane() is not None)
    total = len(source.index.stamps_ns)

    with watch("trajectory", total):
        estimate = make_estimator(settings.motion, has_crane=source.crane() is not None)
        trajectory = estimate(source, rectifier, _counter("trajectory", total, advance))

    poses = {frame.stamp_ns: frame for frame in trajectory.frames}
    refusals = [Refusal("recording", frame) for frame in source.index.unpaired]
    refusals += [Refusal("trajectory", frame) for frame in trajectory.refused]
    method = make_method(settings.stereo)
    turn = threading.Lock() if method.uses_all_cores else nullcontext()
    view = _View(settings, rectifier, method, turn, cell_m, points_per_pixel(first, cell_m), watch)
    store = TileStore(scratch, settings.map.resident_tiles)
    used, preview = 0, None
    for done, outcome in enumerate(ordered_map(view, _placed(source, poses), WORKERS), start=1):
        if isinstance(outcome, Refusal):
            refusals.append(outcome)
        else:
            with watch("fuse", 1):
                fuse(store, outcome.cells, settings.map)
            used += 1
            if preview is None or abs(done - total / 2) < 1:
                preview = outcome.preview
        advance("map", done, len(poses))
    if used == 0:
        raise MeasurementError(f"{source.path}: no frame could be measured; {_first_reason(refusals)}")

    with watch("surface"):
        min_views = settings.map.min_views if used > 1 else 1
        surface = finish(store, scratch, cell_m, min_views, settings.map)
    if surface.seen == 0:
        raise MeasurementError(f"{source.path}: no place was seen by {min_views} frames; lower map.min_views")
    with watch("contours"):
        laser = source.laser()
        contours = cut_contours(surface, laser, settings.map.profile_y_m)
        by_number = {contour.profile: contour for contour in contours}
        agreed = [agree(by_number[p.profile], p) for p in laser if p.profile in by_number]

    warnings = [Notice("assumed", text) for text in source.notes]
    warnings += [Notice("imu", text) for text in hints]
    warnings += [Notice("trajectory", text) for text in trajectory.warnings]
    warnings += [Notice(a.code, a.reason) for a in agreed if isinstance(a, Failed)]
    if refusals:
        warnings.append(Notice("frames-refused", f"{len(refusals)} of {total} frames were refused"))
    configuration = _plain(asdict(settings))
    return Measurement(
        recording_path=source.path,
        recording_format=source.format,
        is_simulated=source.is_simulated,
        calibration_hash=_hash(_plain(asdict(source.rig))),
        configuration_hash=_hash(configuration),
        input_hashes=source.digests(),
        configuration=configuration,
        trajectory=trajectory,
        frames_total=total + len(source.index.unpaired),
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
        peak_memory_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        preview=preview,
    )


@dataclass(frozen=True, eq=False)
class FirstLook:
    """The first usable pair's disparity range and the size of its pixels on the surface (median, m)."""

    candidates: DisparityRange
    pixel_on_surface_m: float


def first_look(source: Recording, rectifier: Rectifier) -> FirstLook:
    """Look for the first frame that can be matched.

    Raises InputError where left and right are swapped, MeasurementError where no frame can be used.
    """
    reasons: list[str] = []
    swapped = 0
    for frame in source.frames():
        if isinstance(frame, RefusedFrame):
            reasons.append(frame.reason)
            continue
        pair = _rectified(rectifier, frame)
        found = pair if isinstance(pair, Failed) else find_range(pair)
        if isinstance(pair, RectifiedPair) and isinstance(found, DisparityRange):
            camera = rectifier.camera
            middle = (found.lowest_px + found.highest_px) / 2 + camera.doffs_px
            return FirstLook(found, camera.baseline_m / max(middle, 1.0))
        assert isinstance(found, Failed)
        reasons.append(found.reason)
        swapped += found.code == "swapped"
        if swapped >= 2:
            break
    if swapped:
        raise InputError(
            source.path, reasons[-1], "exchange the folders or topics of cam0 (left) and cam1 (right)"
        )
    if not reasons:
        raise InputError(source.path, "no stereo pair at all", "check the cameras' time stamps")
    raise MeasurementError(
        f"{source.path}: none of the {len(reasons)} frames can be used; first: {reasons[0]}"
    )


def choose_cell(first: FirstLook, *, has_crane: bool) -> float:
    """10 mm in the yard; elsewhere the first round size that holds one and a half pixels."""
    if has_crane:
        return CELL_SIDES_M[0]
    wanted = 1.5 * first.pixel_on_surface_m
    return next((side for side in CELL_SIDES_M if side >= wanted), CELL_SIDES_M[-1])


def points_per_pixel(first: FirstLook, cell_m: float) -> int:
    """Points along each axis of a pixel so that no cell between two pixels stays empty."""
    return min(max(1, math.ceil(first.pixel_on_surface_m / (0.9 * cell_m))), 4)


@dataclass(frozen=True, eq=False)
class _Seen:
    cells: CellObservations
    preview: Preview


@dataclass(frozen=True, eq=False)
class _View:
    """From a frame and its pose to what it says of the map's cells: pure, so that frames run side by side."""

    settings: MeasureSettings
    rectifier: Rectifier
    method: StereoMethod
    turn: AbstractContextManager[object]
    cell_m: float
    per_pixel: int
    watch: Stopwatch

    def __call__(self, placed: tuple[StereoFrame | RefusedFrame, PosedFrame]) -> _Seen | Refusal:
        frame, posed = placed
        if isinstance(frame, RefusedFrame):
            return Refusal("recording", frame)
        stereo = self.settings.stereo
        with self.watch("rectify", 1):
            pair = _rectified(self.rectifier, frame)
        if isinstance(pair, Failed):
            return Refusal("rectify", RefusedFrame(frame.stamp_ns, pair.reason))
        candidates = _candidates(stereo, pair)
        if isinstance(candidates, Failed):
            return Refusal("stereo", RefusedFrame(frame.stamp_ns, candidates.reason))
        with self.turn, self.watch("stereo", 1):
            matched = self.method(pair, candidates)
            disparity = without_gaps(matched, pair.left, stereo.gap_darkness)
        with self.watch("points", 1):
            points = triangulate(
                pair,
                disparity,
                stereo.calibration_sigma_px,
                stereo.max_depth_m,
                self.settings.map.max_sigma_m,
                self.per_pixel,
            )
            body = posed.reference_from_body
            cells = observe(
                points,
                body @ self.rectifier.body_from_rect0,
                body.translation,
                posed.covariance,
                self.cell_m,
            )
        return _Seen(cells, Preview(pair.left, disparity.disparity_px))


def _candidates(stereo: StereoSettings, pair: RectifiedPair) -> DisparityRange | Failed:
    low, high = stereo.lowest_disparity_px, stereo.highest_disparity_px
    if low is not None and high is not None:
        return DisparityRange(low, high)
    found = find_range(pair)
    if isinstance(found, Failed):
        return found
    low = found.lowest_px if low is None else low
    high = found.highest_px if high is None else high
    if high <= low:
        return Failed("empty-range", f"the disparity range {low}:{high} is empty")
    return DisparityRange(low, high)


def _rectified(rectifier: Rectifier, frame: StereoFrame) -> RectifiedPair | Failed:
    try:
        return rectifier(frame)
    except ValueError as error:
        return Failed("wrong-size", str(error))


def _placed(
    source: Recording, poses: dict[int, PosedFrame]
) -> Iterator[tuple[StereoFrame | RefusedFrame, PosedFrame]]:
    """The frames that have a pose; those without one were refused by the trajectory already."""
    for frame in source.frames():
        if frame.stamp_ns in poses:
            yield frame, poses[frame.stamp_ns]


def _counter(stage: str, total: int, advance: Advance) -> Callable[[], None]:
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        advance(stage, done, total)

    return count


def _first_reason(refusals: list[Refusal]) -> str:
    return f"first: {refusals[0].frame.reason}" if refusals else "it has no frames"


def _plain(value: Any) -> Any:
    """Settings and calibrations as JSON knows them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
