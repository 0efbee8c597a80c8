"""Register a recording's frame in the yard by surveyed AprilTags that its pictures show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from barsight.calibration.boards.marker_detection import TAG_FAMILY
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.progress import stages
from barsight.core.errors import Failed, InputError, MeasurementError
from barsight.core.timing import count_frames
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.base import Recording, RecordingSettings
from barsight.recording.formats.surveyed_targets import SurveyedTags, read_tags
from barsight.recording.open import open_recording
from barsight.recording.plausibility import clock_faults
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
from barsight.yard_frame import calibration_id, mounting_id, recording_id


def calibrate_by_tags(
    path: Path, list_path: Path, sigma_m: float, reading: RecordingSettings, console: Console
) -> tuple[YardCalibration, dict[str, str | None]]:
    """Find the listed tags in a recording, and register the frame that `measure` maps it in.

    sigma_m: of a coordinate's survey, where the list doesn't say it. Returns the calibration and whose it is.
    """
    listed, recording = read_tags(list_path), open_recording(path, reading)
    if faults := clock_faults(recording):
        raise InputError(path, "; ".join(faults), "record again with one clock")
    reference, seen = _see(recording, console)
    placed = [seen.place(int(number)) for number in listed.numbers]
    for one in placed:
        if isinstance(one, Failed) and one.code == "ambiguous":
            raise MeasurementError(f"{path}: {one.reason}")
    frame = "encoders" if reference == "yard" else "world"
    found = _registered(path, listed, placed, sigma_m, frame, _told(recording, seen, placed))
    _print(listed, seen, placed, list_path, console)
    crane = recording.crane() if frame == "encoders" else None
    return found, {
        "calibration_id": calibration_id(recording.rig),
        "mounting_id": None if crane is None else mounting_id(crane),
        "recording_id": recording_id(recording.digests()) if crane is None else None,
    }


def _see(recording: Recording, console: Console) -> tuple[str, SeenTags]:
    """Estimate the trajectory as `measure` does and find the tags in its pairs; its reference, and them."""
    rectifier = Rectifier(recording.rig)
    with stages(console) as advance:
        count = count_frames("travel", len(recording.index.stamps_ns), advance)
        trajectory = make_estimator(MotionSettings())(recording, rectifier, count)
        posed = {frame.stamp_ns: frame for frame in trajectory.frames}
        count = count_frames("tags", len(posed), advance)
        return trajectory.reference, see_tags(recording.frames(posed), rectifier, posed, count)


def _registered(
    path: Path, listed: SurveyedTags, placed: list[PlacedTag | Failed], sigma_m: float, frame: str, told: str
) -> YardCalibration:
    """Fit the tags that were placed. told: why others weren't, for where too few are left."""
    kept = np.array([isinstance(one, PlacedTag) for one in placed], bool)
    tags = tuple(one for one in placed if isinstance(one, PlacedTag))
    yard_m, checks = listed.yard_m[kept], listed.checks[kept]
    if (~checks).sum() < 3:
        counted = f"{kept.sum()} of {kept.size} listed tags were placed, 3 besides checks are the least"
        raise MeasurementError(f"{path}: {counted}: {told}")
    survey = np.where(np.isnan(listed.sigma_m), sigma_m, listed.sigma_m)[kept]
    found = calibrate_yard(
        tuple(f"tag {one.number}" for one in tags), np.stack([one.place_m for one in tags]), yard_m,
        turned_covariance(tags, yard_m, survey), checks, frame,
    )  # fmt: skip
    if isinstance(found, Failed):
        raise MeasurementError(f"{path}: {found.reason}; survey three tags or more, well apart")
    if is_mirrored(tags, yard_m, found.alignment):
        raise MeasurementError(f"{path}: the listed places are mirrored; are yard_x and yard_y swapped?")
    return found


def _told(recording: Recording, seen: SeenTags, placed: list[PlacedTag | Failed]) -> str:
    """Say why tags weren't placed."""
    if not seen.sightings:
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
        strays = f", {one.left_out} that don't agree left out" if one.left_out else ""
        console.print(
            f"tag {one.number}: {one.pairs} pairs{strays}, {one.side_px:.0f} pixels wide, sigma "
            f"{1e3 * np.sqrt(np.trace(one.covariance_m2) / 3):.1f} mm", highlight=False,
        )  # fmt: skip
    known = set(listed.numbers.tolist())
    strange = [n for n, ones in sorted(seen.sightings.items()) if n not in known and len(ones) >= MIN_PAIRS]
    if strange:
        told = f"seen, but not in {list_path}: tag {', '.join(map(str, strange))}; left out"
        console.print(f"[yellow]{escape(told)}[/yellow]", soft_wrap=True, highlight=False)
