"""Monitor a rig over the years with control charts (CUSUM) on the figures of every survey since the last
approval.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from barsight.acceptance.observation import Observation
from barsight.acceptance.pictures import PictureHealth
from barsight.artefacts.plan import AcceptancePlan, ErrorLimits
from barsight.core.errors import Failed, InputError
from barsight.core.json_values import json_value
from barsight.core.reading.json_schema import expect_schema, list_schema, record_schema
from barsight.core.reading.sealed_json import read_sealed, write_sealed
from barsight.motion.rig_check.drift_check import RigCheck
from barsight.registration.agreement import DOUBTFUL
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.registration.tags import PlacedTag

SCHEMA_VERSION = 1
REMEDY = "give the record that barsight verify wrote, or another name to begin a new one"
LEARNED = 8
"""Number of surveys after an approval from which the normal mean and scatter are learned."""
SLACK, ALARM = 1.8, 2.8
"""Slack and alarm threshold of the CUSUM, in sigmas of a survey's deviation from the learned mean [Page
1954].

A jump of four sigma is detected within three surveys, and a dozen charts of healthy rigs raise fewer than one
alarm in a thousand surveys. Where stated sigmas are half as large as the scatter, one chart in twelve raises
an alarm within sixty surveys.
"""
DOUBTED, BELIEVED = 0.02, 6
"""Chance below which a scatter as large as that of the surveys so far contradicts the stated sigmas, and the
number of degrees of freedom that the stated sigmas count for where they are then widened.
"""
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
TAGS = "place of tags along"
"""Name of the tags' figures, without the axis."""
SHARPNESS_SIGMA = 0.15
"""Standard deviation of the logarithm of a picture's sharpness, which varies between yards."""


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


@dataclass(frozen=True)
class ControlChart:
    """A figure's control chart.

    value: of the latest survey, NaN if it doesn't show the figure. mean, sigma: the normal ones, NaN while
    they are being learned. cusum: larger of both sums. alarmed_at: number of the survey since the approval
    (from 1) that first raised an alarm, None for no alarm.
    """

    name: str
    value: float
    mean: float
    sigma: float
    cusum: float
    alarmed_at: int | None


def rig_figures(check: RigCheck) -> tuple[WatchedFigure, ...]:
    """Extract the rig's figures from rows and travel: baseline, pitch, roll, focal ratio, and the yaw by each
    of both. The calibration's uncertainty is the same in all surveys, so sigmas cover noise only.

    It shifts the yaw by rows against that by travel, which therefore aren't averaged: their weights change
    with the travel.
    """
    noise = {} if isinstance(check.rows, Failed) else dict(
        zip(("pitch", "roll", "focal ratio"), check.rows.sigmas / check.row_sigmas, strict=False)
    )  # fmt: skip
    figures = [
        WatchedFigure(f"{line.name} / {line.unit}", line.value, line.sigma * float(noise.get(line.name, 1)))
        for line in check.lines
        if isfinite(line.value) and isfinite(line.sigma) and not line.name.startswith("yaw")
    ]
    if not isinstance(check.rows, Failed):
        yaw, sigma = np.degrees([check.rows.values[3], check.rows.sigmas[3]]).tolist()
        figures.append(WatchedFigure("yaw by rows / deg", yaw, sigma))
    if not isinstance(check.drift, Failed):
        yaw, sigma = np.degrees([check.drift.yaw_rad, check.drift.yaw_sigma_rad]).tolist()
        figures.append(WatchedFigure("yaw by travel / deg", yaw, sigma))
    return tuple(figures)


def picture_figures(health: tuple[PictureHealth, ...] | Failed) -> tuple[WatchedFigure, ...]:
    """Compute the logarithm of each camera's sharpness."""
    if isinstance(health, Failed):
        return ()
    return tuple(
        WatchedFigure(f"sharpness of {one.camera} / log", float(np.log(one.sharpness)), SHARPNESS_SIGMA)
        for one in health
    )


def feature_figures(plan: AcceptancePlan, seen: Observation) -> tuple[WatchedFigure, ...] | Failed:
    """Compute the mean errors (mm) of fixed features: heights of plates and places of surveyed spheres.
    Failed `not-found` where none of either was found: the rig may see the yard too far off.
    """
    surveyed = [one for one in plan.sphere if one.place_sigma_m is not None]
    for kind in ([seen.plates[one.name] for one in plan.plate], [seen.spheres[one.name] for one in surveyed]):
        lost = [str(found) for found in kind if isinstance(found, Failed)]
        if kind and len(lost) == len(kind):
            return Failed("not-found", "; ".join(lost))
    z = [
        1e3 * (found.z_m - one.z_m)
        for one in plan.plate
        if not isinstance(found := seen.plates[one.name], Failed)
    ]
    places = [
        1e3 * (ball.centre_m - (one.x_m, one.y_m, one.z_m))
        for one in surveyed
        if not isinstance(ball := seen.spheres[one.name], Failed)
    ]
    px_mm = 1e3 * seen.view.px_m(0.0)
    figures = []
    if z:
        figures.append(WatchedFigure("height of plates / mm", float(np.mean(z)), 0.02 * px_mm))
    if places:
        ground_mm = 1e3 * float(seen.view.camera_m[2]) / seen.view.focal_px
        x, y, _ = np.mean(places, axis=0)
        figures += [
            WatchedFigure("place of spheres along x / mm", float(x), 0.15 * ground_mm),
            WatchedFigure("place of spheres along y / mm", float(y), 0.15 * ground_mm),
        ]
    return tuple(figures)


def beyond_limits(limits: ErrorLimits, figures: Sequence[WatchedFigure]) -> list[str]:
    """List the fixed features whose mean error is beyond its limit by over two sigmas: what is normal is
    learned, so that a rig that moved before its first survey raises no alarm by the charts.
    """
    found = []
    for figure in figures:
        name = figure.name.partition(" / ")[0]
        limit = limits.height_mm if name in ("height of plates", f"{TAGS} z") else limits.position_mm
        is_fixed = name.startswith(("height of plates", "place of spheres", TAGS))
        if is_fixed and abs(figure.value) - 2 * figure.sigma > limit:
            found.append(f"{name} is {figure.value:+.1f} mm off, the limit is {limit:g}")
    return found


def tag_figures(
    listed: SurveyedTags, placed: Sequence[PlacedTag | Failed]
) -> tuple[WatchedFigure, ...] | Failed:
    """Compute the mean error (mm) along each axis of surveyed tags on columns and floor, with their common
    sigma. Failed `not-found` where no tag was located.
    """
    found = [
        (1e3 * (tag.place_m - place), 1e6 * np.diag(tag.covariance_m2))
        for tag, place in zip(placed, listed.yard_m, strict=True)
        if not isinstance(tag, Failed)
    ]
    if not found:
        return Failed("not-found", "; ".join(one.reason for one in placed if isinstance(one, Failed)))
    off, variance = (np.mean(part, axis=0) for part in zip(*found, strict=True))
    return tuple(
        WatchedFigure(f"{TAGS} {axis} / mm", float(off[k]), float(variance[k] ** 0.5))
        for k, axis in enumerate("xyz")
    )


def control_charts(surveys: Sequence[WatchedSurvey]) -> tuple[ControlChart, ...]:
    """Compute the control charts of all figures over the surveys of one approval, oldest first."""
    names = dict.fromkeys(figure.name for survey in surveys for figure in survey.figures)
    return tuple(_chart(name, surveys) for name in names)


def _chart(name: str, surveys: Sequence[WatchedSurvey]) -> ControlChart:
    rows = [
        (number, figure)
        for number, survey in enumerate(surveys, 1)
        for figure in survey.figures
        if figure.name == name
    ]
    value = rows[-1][1].value if rows[-1][0] == len(surveys) else np.nan
    if len(rows) < LEARNED:
        return ControlChart(name, value, np.nan, np.nan, 0.0, None)
    normal = _LearnedValue.without_stray([figure for _, figure in rows[:LEARNED]])
    up = down = 0.0
    alarmed, sigma, before = None, np.nan, None
    for number, figure in rows[LEARNED:]:
        sigma, off = normal.ratio * figure.sigma, normal.deviation(figure)
        up, down = max(up + off - SLACK, 0.0), max(down - off - SLACK, 0.0)
        if max(up, down) > ALARM and alarmed is None:
            alarmed = number
        normal = normal if before is None else normal.after(before, figure)
        before = figure
    return ControlChart(name, value, normal.mean, sigma, max(up, down), alarmed)


@cache
def _doubted_squares(freedom: float) -> float:
    """Return the sum of squares from which on the stated sigmas are doubted."""
    return float(chi2.isf(DOUBTED, freedom))


@dataclass(frozen=True)
class _LearnedValue:
    """The normal value of a figure: weighted mean of some surveys and its stated sigma. squares, freedom: the
    surveys' scatter by their stated sigmas, as a sum of squares with so many degrees of freedom.
    """

    mean: float
    sigma: float
    squares: float
    freedom: float

    @property
    def ratio(self) -> float:
        """Return the ratio by which the stated sigmas are widened: 1 unless the scatter contradicts them."""
        if self.squares <= _doubted_squares(self.freedom):
            return 1.0
        return self._believed_ratio

    @property
    def _believed_ratio(self) -> float:
        """Return the ratio of the scatter to the stated sigmas, to which these contribute."""
        return math.sqrt((BELIEVED + self.squares) / (BELIEVED + self.freedom))

    @classmethod
    def of(cls, figures: Sequence[WatchedFigure]) -> _LearnedValue:
        """Learn it from surveys."""
        values = np.array([figure.value for figure in figures])
        weights = np.array([figure.sigma for figure in figures]) ** -2.0
        mean = float(weights @ values / weights.sum())
        squares = float(weights @ (values - mean) ** 2)
        return cls(mean, float(weights.sum() ** -0.5), squares, len(values) - 1)

    def after(self, before: WatchedFigure, figure: WatchedFigure) -> _LearnedValue:
        """Learn the scatter, not the mean, from two surveys in sequence: a drift or a jump adds little to
        their differences, each of which counts for two thirds of a degree of freedom.
        """
        step = (figure.value - before.value) / float(np.hypot(figure.sigma, before.sigma))
        return replace(self, squares=self.squares + 2 / 3 * step**2, freedom=self.freedom + 2 / 3)

    @classmethod
    def without_stray(cls, figures: Sequence[WatchedFigure]) -> _LearnedValue:
        """Learn it without one that lies far from the others, by Grubbs' test with their stated sigmas and
        their scatter; it would widen what is normal so far that no jump raised an alarm.
        """
        middle = np.median([figure.value for figure in figures])
        far = max(figures, key=lambda figure: abs(figure.value - middle) / figure.sigma)
        others = cls.of([figure for figure in figures if figure is not far])
        ratio = max(others._believed_ratio, 1.0) / others.ratio
        chance = len(figures) * 2 * student.sf(abs(others.deviation(far)) / ratio, BELIEVED + others.freedom)
        return others if chance < DOUBTFUL else cls.of(figures)

    def deviation(self, figure: WatchedFigure) -> float:
        """Compute a figure's deviation in sigmas of its own and of the mean."""
        return (figure.value - self.mean) / (self.ratio * float(np.hypot(figure.sigma, self.sigma)))


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
