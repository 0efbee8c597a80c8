"""Run an acceptance: measure each recording, find the artefacts, judge every quantity and name causes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

import numpy as np

from barsight.acceptance.causes import Cause, name_causes
from barsight.acceptance.observation import Observation, observe
from barsight.acceptance.pictures import FRAMES, PictureHealth, check_pictures
from barsight.acceptance.quantities import Decision, JudgedQuantity, decide, judge_all
from barsight.acceptance.uncertainty import combine
from barsight.artefacts.plan import AcceptancePlan, ErrorLimits
from barsight.core.errors import ConfigError, Failed, InputError
from barsight.core.records.pairs import StereoFrame
from barsight.core.timing import ProgressCallback
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.rig_check.drift_check import CheckSettings, RigCheck, check_rig
from barsight.recording.base import Recording
from barsight.recording.open import open_recording
from barsight.yard.magnet.description import MagnetOffset
from barsight.yard_frame import in_yard


@dataclass(frozen=True, eq=False)
class Acceptance:
    """The content of a certificate.

    rig, pictures: the check of the rig and of the pictures, one per recording. inputs: digests of each
    recording's inputs, by its path. offset: the magnet's offset, if touch-downs were judged with one.
    """

    plan: AcceptancePlan
    observations: tuple[Observation, ...]
    quantities: tuple[JudgedQuantity, ...]
    rig: tuple[RigCheck, ...]
    pictures: tuple[tuple[PictureHealth, ...] | Failed, ...]
    causes: tuple[Cause, ...]
    inputs: dict[str, dict[str, str]]
    offset: MagnetOffset | None = None

    @property
    def is_passed(self) -> bool:
        """Check that every quantity passed, no cause was found and no recording shows a drifted rig."""
        sound = not self.causes and not any(one.is_bad for one in self.rig)
        return sound and all(one.decision is Decision.PASSED for one in self.quantities)


def accept(
    plan: AcceptancePlan, recordings: Sequence[Path], settings: MeasureSettings, work: Path,
    advance: ProgressCallback, offset: MagnetOffset | None = None,
) -> Acceptance:  # fmt: skip
    """Accept or refuse a rig from one or several recordings of the artefacts; results are kept in folders of
    `work`.

    offset: of the magnet that touched down. Raises a BarsightError where a recording can't be measured at
    all.
    """
    _expect_other_touches(plan, offset)
    seen, rig, pictures, inputs = [], [], [], dict[str, dict[str, str]]()
    for number, path in enumerate(recordings, 1):
        folder = work / f"measured_{number}"
        source = in_yard(open_recording(path, settings.recording), settings.yard)
        own = dict(source.digests())
        _expect_another(path, own, inputs)
        measure_into(path, folder, settings, advance=advance, report=False)
        seen.append(observe(folder, plan, source.rig, str(path)))
        check, health = look_at_rig(source, settings.recording.rig)
        rig.append(check)
        pictures.append(health)
        inputs[str(path)] = own
    _expect_one_rig(seen)
    _expect_own_offset(offset, seen[0])
    judged = judge_all(plan, seen, offset) + tuple(_dirt(pictures, plan.limits))
    causes = name_causes(plan, seen, rig, pictures)
    return Acceptance(plan, tuple(seen), judged, tuple(rig), tuple(pictures), causes, inputs, offset)


def look_at_rig(
    source: Recording, rig_file: Path | None
) -> tuple[RigCheck, tuple[PictureHealth, ...] | Failed]:
    """Check the rig, which was read from rig_file, by the travel and the matched rows, and check the
    pictures.
    """
    check = check_rig(source, FusionSettings(), CheckSettings(), lambda: None, rig_file)
    return check, check_pictures(_some_frames(source))


def _expect_another(path: Path, own: dict[str, str], inputs: dict[str, dict[str, str]]) -> None:
    """Raise InputError for a recording given twice: it would repeat itself exactly."""
    for other, digests in inputs.items():
        if digests == own:
            problem = f"is the same recording as {other}"
            raise InputError(path, problem, "record the artefacts anew, or name it once")


def _expect_one_rig(seen: Sequence[Observation]) -> None:
    first = seen[0]
    for other in seen[1:]:
        for what in ("calibration_id", "yard_frame_id"):
            if getattr(other, what) != getattr(first, what):
                problem = f"has another {what.removesuffix('_id').replace('_', ' ')} than {first.recording}"
                raise InputError(other.recording, problem, "accept one rig at a time")


def _expect_own_offset(offset: MagnetOffset | None, first: Observation) -> None:
    if offset is None:
        return
    if (offset.calibration_id, offset.yard_frame_id) != (first.calibration_id, first.yard_frame_id):
        problem = "has another calibration or yard frame than the magnet's offset"
        raise InputError(first.recording, problem, "touch down with this one: accept without --magnet")


def _expect_other_touches(plan: AcceptancePlan, offset: MagnetOffset | None) -> None:
    """Raise ConfigError where the plan has no touch-down to verify the offset, or one that made it."""
    if offset is None:
        return
    own = [one.name for one in plan.touch_down if one.digest in offset.touch_downs]
    if own:
        problem = f"the magnet's offset is the mean of {', '.join(own[:3])}{' ...' if own[3:] else ''}"
        raise ConfigError(f"plan: {problem}, which can't verify it: touch down again, and list only those")
    if not plan.touch_down:
        raise ConfigError(
            "plan: has no touch_down to verify the magnet's offset: add some, or give no magnet"
        )


def _some_frames(source: Recording) -> Iterator[StereoFrame]:
    """Yield frames spread evenly over a recording, as many as the check of the pictures needs."""
    stamps = list(source.index.stamps_ns)
    chosen = np.linspace(0, max(len(stamps) - 1, 0), min(FRAMES, len(stamps))).astype(int)
    for frame in source.frames({stamps[k] for k in chosen.tolist()}):
        if isinstance(frame, StereoFrame):
            yield frame


def _dirt(
    pictures: Sequence[tuple[PictureHealth, ...] | Failed], limits: ErrorLimits
) -> Iterator[JudgedQuantity]:
    for side in range(2):
        shares = [nan if isinstance(row, Failed) else row[side].dirt_pct for row in pictures]
        why = "; ".join(str(row) for row in pictures if isinstance(row, Failed))
        worst = nan if np.isnan(shares).any() else max(shares)
        yield JudgedQuantity(
            f"cam{side}: dirt", "dirt_pct", "%", tuple(shares), worst, combine(()), (), limits.dirt_pct,
            decide(worst, 0.0, limits.dirt_pct), why,
        )  # fmt: skip
