"""Keep the record of a watched rig: its surveys with their figures, and the approvals."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.json_values import json_value
from barsight.core.reading.json_schema import expect_schema, list_schema, record_schema
from barsight.core.reading.sealed_json import read_sealed, write_sealed

SCHEMA_VERSION = 1
REMEDY = "give the record that barsight verify wrote, or another name to begin a new one"
_TEXT = {"type": "string"}
_FIGURE = record_schema(name=_TEXT, value={"type": "number"}, sigma={"type": "number", "exclusiveMinimum": 0})
_SURVEY = record_schema(
    recording=_TEXT, recording_id=_TEXT, calibration_id=_TEXT, figures=list_schema(_FIGURE)
)
_SURVEY["properties"]["yard_frame_id"] = {"type": ["string", "null"]}  # earlier versions didn't write it
_APPROVAL = record_schema(
    who=_TEXT, why=_TEXT, at=_TEXT, calibration_id=_TEXT, surveys_before={"type": "integer", "minimum": 0}
)
_SCHEMA = record_schema(
    schema_version={"const": SCHEMA_VERSION}, content_sha256=_TEXT, surveys=list_schema(_SURVEY),
    approvals=list_schema(_APPROVAL),
)  # fmt: skip


@dataclass(frozen=True)
class WatchedFigure:
    """A figure of one survey with its sigma, in the unit stated in its name."""

    name: str
    value: float
    sigma: float


@dataclass(frozen=True)
class WatchedSurvey:
    """A survey: digests of its recording's inputs and of its calibration, its figures, and the digest of its
    yard frame, which is None where there is none or it wasn't recorded.
    """

    recording: str
    recording_id: str
    calibration_id: str
    figures: tuple[WatchedFigure, ...]
    yard_frame_id: str | None = None


@dataclass(frozen=True)
class Approval:
    """Approval of a calibration: by whom, why, when (UTC), and the number of surveys before it."""

    who: str
    why: str
    at: str
    calibration_id: str
    surveys_before: int


@dataclass(frozen=True)
class WatchRecord:
    """All surveys and approvals, oldest first."""

    surveys: tuple[WatchedSurvey, ...] = ()
    approvals: tuple[Approval, ...] = ()

    @property
    def since_approval(self) -> tuple[WatchedSurvey, ...]:
        """Return the surveys since the last approval."""
        return self.surveys[self.approvals[-1].surveys_before if self.approvals else 0 :]


def read_watch(path: Path) -> WatchRecord:
    """Read a record, empty where the file doesn't exist. Raises InputError where it was altered."""
    if not path.exists():
        return WatchRecord()
    content = read_sealed(path, SCHEMA_VERSION, REMEDY)
    expect_schema(content, _SCHEMA, path, REMEDY)
    return WatchRecord(
        tuple(_survey(one) for one in content["surveys"]),
        tuple(Approval(**one) for one in content["approvals"]),
    )


def write_watch(record: WatchRecord, path: Path) -> None:
    """Write a record completely or not at all."""
    content: dict[str, Any] = json_value({"schema_version": SCHEMA_VERSION, **asdict(record)})
    write_sealed(content, path)


def with_survey(record: WatchRecord, survey: WatchedSurvey, path: Path) -> WatchRecord:
    """Add a survey. Raises InputError for one that is already in the record, or whose calibration or yard
    frame hasn't been approved.
    """
    if any(one.recording_id == survey.recording_id for one in record.surveys):
        raise InputError(survey.recording, f"is in {path.name} already", "record a new survey")
    known = record.approvals[-1].calibration_id if record.approvals else (
        record.surveys[0].calibration_id if record.surveys else survey.calibration_id
    )  # fmt: skip
    if survey.calibration_id != known:
        problem = f"has calibration {survey.calibration_id}, but {path.name} watches {known}"
        raise InputError(survey.recording, problem, "approve the new calibration: --approve WHO --why WHY")
    for before in record.since_approval[-1:]:
        if None not in (ids := (survey.yard_frame_id, before.yard_frame_id)) and ids[0] != ids[1]:
            problem = f"lies in yard frame {ids[0]}, but {path.name} watches {ids[1]}"
            raise InputError(survey.recording, problem, "approve the new yard frame: --approve WHO --why WHY")
    return replace(record, surveys=(*record.surveys, survey))


def _survey(one: dict[str, Any]) -> WatchedSurvey:
    figures = tuple(WatchedFigure(**figure) for figure in one["figures"])
    identity = one["recording"], one["recording_id"], one["calibration_id"]
    return WatchedSurvey(*identity, figures, one.get("yard_frame_id"))
