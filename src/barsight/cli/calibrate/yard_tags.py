"""Register a recording's frame in the yard by surveyed AprilTags that its pictures show, or by targets picked
in them by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from barsight.calibration.boards.marker_detection import TAG_FAMILY
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.progress import stages
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import Trajectory
from barsight.core.timing import count_frames
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.base import Recording, RecordingSettings
from barsight.recording.open import open_recording
from barsight.recording.plausibility import clock_faults
from barsight.recording.wrapper import RecordingProxy
from barsight.registration.bending import STEPS, CraneBend, calibrate_bent_yard
from barsight.registration.picks import see_picks
from barsight.registration.surveyed_targets import SurveyedTags, read_picks, read_places, read_tags
from barsight.registration.tags import (
    MIN_PAIRS,
    PlacedTag,
    SeenTags,
    is_mirrored,
    other_family,
    see_tags,
    turned_covariance,
)
from barsight.registration.yard import YardCalibration, calibrate_yard
from barsight.yard_frame import (
    bent_crane,
    calibration_id,
    frame_of,
    mounting_id,
    placed_in_yard,
    recording_id,
)


@dataclass(frozen=True, eq=False)
class _BentRecording(RecordingProxy):
    """A recording whose encoder readings are corrected for the bending of the crane."""

    bend: CraneBend

    def crane(self) -> CraneSamples | None:
        crane = self.whole.crane()
        return None if crane is None else bent_crane(crane, self.bend)


def calibrate_by_tags(
    path: Path, list_path: Path, picks_path: Path | None, sigma_m: float, reading: RecordingSettings,
    bend: CraneBend | None, console: Console,
) -> tuple[YardCalibration, dict[str, str | None], CraneBend | None]:  # fmt: skip
    """Find the listed tags, or the picks of the listed targets, in a recording, and register the frame in
    which `measure` maps it.

    sigma_m: of a surveyed coordinate, where the list doesn't give it. bend: start value where the bending of
    the crane is calibrated too. Returns the calibration, the ids of its rig and crane, and the bending.
    """
    is_picked = picks_path is not None
    names, listed = read_places(list_path) if is_picked else (tuple[str, ...](), read_tags(list_path))
    recording = open_recording(path, reading)
    if faults := clock_faults(recording):
        raise InputError(path, "; ".join(faults), "record again with one clock")
    if bend is not None and recording.crane() is None:
        raise InputError(path, "has no encoders", "leave --girder-y-m out")
    if picks_path is None:
        reference, seen = _see(recording, console, are_rings=listed.are_rings)
    else:
        reference, seen = _see_picks(recording, read_picks(picks_path, names), names, picks_path, console)
    placed = [seen.place(int(number)) for number in listed.numbers]
    for one in placed:
        if isinstance(one, Failed) and one.code == "ambiguous":
            raise MeasurementError(f"{path}: {one.reason}")
    why = _why_unlocated(recording, seen, placed)
    if bend is None:
        frame = "encoders" if reference == "yard" else "world"
        found = _registered(path, listed, seen, placed, sigma_m, frame, why)
    else:
        found, bend = _bent(path, recording, listed, seen, placed, sigma_m, bend, why, console)
    _print(listed, seen, placed, list_path, console)
    crane = recording.crane() if reference == "yard" else None
    owners = {
        "calibration_id": calibration_id(recording.rig),
        "mounting_id": None if crane is None else mounting_id(crane),
        "recording_id": recording_id(recording.digests()) if crane is None else None,
    }
    return found, owners, bend


def place_in_yard(recording: Recording, listed: SurveyedTags, console: Console) -> list[PlacedTag | Failed]:
    """Locate listed tags in the yard from a recording, as `measure` maps it."""
    reference, seen = _see(recording, console, are_rings=listed.are_rings)
    if reference != "yard":
        raise InputError(recording.path, "isn't placed in the yard", "give encoders, or a yard file (--yard)")
    return [seen.place(int(number)) for number in listed.numbers]


def _see(recording: Recording, console: Console, *, are_rings: bool) -> tuple[str, SeenTags]:
    """Estimate the trajectory as `measure` does and find the tags in its pairs; returns its reference and
    the tags.
    """
    with stages(console) as advance:
        rectifier = Rectifier(recording.rig)
        trajectory = placed_in_yard(_trajectory(recording, advance), frame_of(recording))
        posed = {frame.stamp_ns: frame for frame in trajectory.frames}
        count = count_frames("tags", len(posed), advance)
        frames = recording.frames(posed)
        return trajectory.reference, see_tags(frames, rectifier, posed, count, are_rings=are_rings)


def _see_picks(
    recording: Recording, picks: dict[int, dict[int, Float64]], names: tuple[str, ...], path: Path,
    console: Console,
) -> tuple[str, SeenTags]:  # fmt: skip
    """Estimate the trajectory as `measure` does and locate the picks; returns its reference and the
    targets.
    """
    with stages(console) as advance:
        rectifier, trajectory = Rectifier(recording.rig), _trajectory(recording, advance)
        posed = {frame.stamp_ns: frame for frame in trajectory.frames if frame.stamp_ns in picks}
        strange = next((stamp for stamp in picks if stamp not in posed), None)
        if strange is not None:
            nearest = min((frame.stamp_ns for frame in trajectory.frames), key=lambda ns: abs(ns - strange))
            problem = f"there is no pair with a pose at {strange}; the nearest is at {nearest}"
            raise InputError(path, problem, "pick in pictures that measure uses")
        count = count_frames("picks", len(posed), advance)
        seen, lost = see_picks(recording.frames(posed), rectifier, posed, picks, names, count)
    for one in lost:
        console.print(f"[yellow]{escape(one)}: left out[/yellow]", soft_wrap=True, highlight=False)
    return trajectory.reference, seen


def _trajectory(recording: Recording, advance: Callable[[str, int, int], None]) -> Trajectory:
    count = count_frames("travel", len(recording.index.stamps_ns), advance)
    return make_estimator(MotionSettings())(recording, Rectifier(recording.rig), count)


def _bent(
    path: Path, recording: Recording, listed: SurveyedTags, seen: SeenTags, placed: list[PlacedTag | Failed],
    sigma_m: float, bend: CraneBend, why: str, console: Console,
) -> tuple[YardCalibration, CraneBend]:  # fmt: skip
    """Register frame and bending together. The derivatives of the tags' places with respect to the bending
    come from estimating the travel again with a small amount of each kind of bending.
    """

    def places(values: Float64) -> list[PlacedTag | Failed]:
        with stages(console) as advance:
            trajectory = _trajectory(_BentRecording(recording, bend.with_values(values)), advance)
        moved = seen.moved({frame.stamp_ns: frame for frame in trajectory.frames})
        return [moved.place(int(number)) for number in listed.numbers]

    first = _at(placed)
    slopes = np.stack([
        (_at(places(step * axis)) - first) / step if is_fitted else 0 * first
        for step, axis, is_fitted in zip(STEPS, np.eye(3), bend.fitted, strict=True)
    ], axis=2)  # fmt: skip
    for number in range(2):
        if number:  # only now do the sightings of a tag from several trolley positions agree
            placed = places(bend.values)
        known = np.column_stack([_at(placed), slopes.reshape(len(slopes), -1)])
        kept: Bool = np.all(np.isfinite(known), axis=1)
        tags, yard_m, checks, survey = _kept(path, listed, placed, kept, sigma_m, why)
        found = calibrate_bent_yard(
            tuple(seen.name(one.number) for one in tags), _at(tags), slopes[kept], yard_m,
            turned_covariance(tags, yard_m, survey), checks, "encoders", bend,
        )  # fmt: skip
        if isinstance(found, Failed):
            raise MeasurementError(f"{path}: {found.reason}; survey three tags or more, well apart")
        calibration, bend = found
    _expect_upright(path, tags, yard_m, calibration)
    return calibration, bend


def _at(placed: Sequence[PlacedTag | Failed]) -> Float64:
    """Stack places (N, 3), NaN where a tag wasn't located."""
    return np.array([one.place_m if isinstance(one, PlacedTag) else np.full(3, np.nan) for one in placed])


def _kept(
    path: Path, listed: SurveyedTags, placed: list[PlacedTag | Failed], kept: Bool, sigma_m: float, why: str
) -> tuple[tuple[PlacedTag, ...], Float64, Bool, Float64]:
    """Select the located tags, their surveyed places, which are checks, and the sigma of their survey. told:
    reason why others weren't located, for the error where too few remain.
    """
    tags = tuple(one for one, keep in zip(placed, kept, strict=True) if keep and isinstance(one, PlacedTag))
    checks = listed.checks[kept]
    if (~checks).sum() < 3:
        counted = f"{kept.sum()} of {kept.size} listed tags were placed, 3 besides checks are the least"
        raise MeasurementError(f"{path}: {counted}: {why}")
    survey = np.where(np.isnan(listed.sigma_m), sigma_m, listed.sigma_m)[kept]
    return tags, listed.yard_m[kept], checks, survey


def _registered(
    path: Path, listed: SurveyedTags, seen: SeenTags, placed: list[PlacedTag | Failed], sigma_m: float,
    frame: str, why: str,
) -> YardCalibration:  # fmt: skip
    """Fit the located tags. told: reason why others weren't located, for the error where too few remain."""
    kept = np.array([isinstance(one, PlacedTag) for one in placed], bool)
    tags, yard_m, checks, survey = _kept(path, listed, placed, kept, sigma_m, why)
    found = calibrate_yard(
        tuple(seen.name(one.number) for one in tags), np.stack([one.place_m for one in tags]), yard_m,
        turned_covariance(tags, yard_m, survey), checks, frame,
    )  # fmt: skip
    if isinstance(found, Failed):
        raise MeasurementError(f"{path}: {found.reason}; survey three tags or more, well apart")
    _expect_upright(path, tags, yard_m, found)
    return found


def _expect_upright(path: Path, tags: tuple[PlacedTag, ...], yard_m: Float64, found: YardCalibration) -> None:
    if is_mirrored(tags, yard_m, found.alignment):
        raise MeasurementError(f"{path}: the listed places are mirrored; are yard_x and yard_y swapped?")


def _why_unlocated(recording: Recording, seen: SeenTags, placed: list[PlacedTag | Failed]) -> str:
    """Explain why tags weren't located."""
    if not seen.sightings and seen.are_rings:
        return f"no coded circle is seen in both pictures of any of {seen.pairs} pairs"
    if not seen.sightings and not seen.names:
        family = other_family(recording.frames())
        if family is not None:
            return f"the pictures show tags of the family {family}; print {TAG_FAMILY}"
        return f"no tag of the family {TAG_FAMILY} is seen in both pictures of any of {seen.pairs} pairs"
    return "; ".join(one.reason for one in placed if isinstance(one, Failed)) or "list more of them"


def _print(
    listed: SurveyedTags, seen: SeenTags, placed: list[PlacedTag | Failed], list_path: Path, console: Console
) -> None:
    for one in placed:
        if isinstance(one, Failed):
            console.print(f"[yellow]{escape(one.reason)}: left out[/yellow]", highlight=False)
            continue
        wide = "" if seen.names else f", {one.side_px:.0f} pixels wide"
        strays = f", {one.left_out} that don't agree left out" if one.left_out else ""
        console.print(
            f"{seen.name(one.number)}: {one.pairs} pairs{strays}{wide}, sigma "
            f"{1e3 * np.sqrt(np.trace(one.covariance_m2) / 3):.1f} mm", highlight=False,
        )  # fmt: skip
    known = set(listed.numbers.tolist())
    strange = [n for n, ones in sorted(seen.sightings.items()) if n not in known and len(ones) >= MIN_PAIRS]
    if strange:
        warning = f"seen, but not in {list_path}: tag {', '.join(map(str, strange))}; left out"
        console.print(f"[yellow]{escape(warning)}[/yellow]", soft_wrap=True, highlight=False)


def print_bend(bend: CraneBend | None, console: Console) -> None:
    """Print the bending of the crane, if it was calibrated."""
    if bend is None:
        return
    words = (("girder's deflection", "mm"), ("girder out of square", "mm/m"), ("rails' depth", "mm"))
    for (what, unit), value, sigma, is_fitted in zip(
        words, bend.values, bend.sigma, bend.fitted, strict=True
    ):
        if is_fitted:
            console.print(f"{what}: {1e3 * value:+.2f} ± {1e3 * sigma:.2f} {unit}", highlight=False)
