"""Check the rig for drift by the rows of matches and the crane's known travel, one verdict per line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, MeasurementError
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.trajectory import RigDrift
from barsight.core.settings.values import POSITIVE, expect_ranges
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.motion.rig_check.calibration_part import FAR_BASELINES, calibration_covariance
from barsight.motion.rig_check.epipolar_error import RowDrift, measure_row_drift
from barsight.motion.rig_check.rig_override import RecordingWithRig
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.base import Recording


class DriftState(StrEnum):
    """Good: go on. Recalibrate: it has drifted, and by enough to matter. Contradiction: two sensors disagree.
    Not seen: this recording can't tell.
    """

    GOOD = "good"
    RECALIBRATE = "recalibrate"
    CONTRADICTION = "contradiction"
    NOT_SEEN = "not seen"


@dataclass(frozen=True)
class CheckSettings:
    """Thresholds from which a drift matters."""

    range_m: float | None = None
    """Range at which the rig measures; if not given, the median depth of what it saw. Where that isn't known,
    15 baselines are assumed for what the rows cost.
    """
    max_depth_error_mm: float = 3.0
    """Maximum depth error that a drift may cause; a drift that causes more, and is beyond 3 sigma, asks for a
    new calibration.
    """
    max_row_error_px: float = 0.3
    """Maximum distance of matches from their rows; matches further off spoil stereo matching."""
    frames: int = 30
    """Number of pairs whose rows are measured."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "", range_m=(0.1, 1000), max_depth_error_mm=POSITIVE, max_row_error_px=POSITIVE,
            frames=POSITIVE,
        )  # fmt: skip


@dataclass(frozen=True)
class CheckLine:
    """One drift: its value and sigma in `unit`, its cost (mm of depth error at the working range, at the
    worst point of the picture; NaN where there is none), the state and the reason.
    """

    name: str
    value: float
    sigma: float
    unit: str
    cost_mm: float
    state: DriftState
    reason: str


BAD_STATES = (DriftState.RECALIBRATE, DriftState.CONTRADICTION)


@dataclass(frozen=True, eq=False)
class RigCheck:
    """lines: the judged drifts. rows, drift: the measurements, or why there are none. range_m: the working
    range. row_sigmas: (4,) of the rows' values, including the calibration's own uncertainty; those in `rows`
    are noise only.
    """

    lines: tuple[CheckLine, ...]
    rows: RowDrift | Failed
    drift: RigDrift | Failed
    range_m: float
    row_sigmas: Float64

    @property
    def state(self) -> DriftState:
        """Return the worst state of the lines; a drift that can't be seen is no fault of the rig."""
        found = {line.state for line in self.lines}
        order = (*BAD_STATES, DriftState.GOOD)
        return next((state for state in order if state in found), DriftState.NOT_SEEN)

    @property
    def is_bad(self) -> bool:
        """Check whether the rig has drifted, or sensors contradict each other."""
        return self.state in BAD_STATES


def check_rig(
    recording: Recording, fusion: FusionSettings, settings: CheckSettings, advance: Callable[[], None],
    rig_file: Path | None = None,
) -> RigCheck:  # fmt: skip
    """Check for drift. rig_file: the file that the rig was read from, for its covariance. Raises
    MeasurementError where neither rows nor travel show anything.
    """
    rig = recording.rig
    rows = measure_row_drift(recording, Rectifier(rig), settings.frames)
    if not isinstance(rows, Failed):
        # The travel's yaw is estimated on matching rows; the rows' own yaw is compared with it later.
        pitch, roll = rows.values[:2]
        rig = turn_right_camera(rig, np.array([pitch, 0.0, roll]))
    rectifier = Rectifier(rig)
    drift = _by_travel(RecordingWithRig(recording, rig), rectifier, fusion, advance)
    if isinstance(rows, Failed) and isinstance(drift, Failed):
        raise MeasurementError(f"{recording.path}: nothing to check by: {rows.reason}; {drift.reason}")
    range_m = settings.range_m or (drift.range_m if isinstance(drift, RigDrift) else np.nan)
    own = np.zeros(4) if isinstance(rows, Failed) else rows.sigmas
    sigmas = np.sqrt(own**2 + np.diag(calibration_covariance(rig_file, range_m)))
    lines = _row_lines(rows, sigmas, rectifier.camera, range_m, settings)
    lines += _travel_lines(drift, rows, sigmas, range_m, settings)
    return RigCheck(tuple(lines), rows, drift, range_m, sigmas)


def _by_travel(
    recording: Recording, rectifier: Rectifier, fusion: FusionSettings, advance: Callable[[], None]
) -> RigDrift | Failed:
    if recording.crane() is None:
        return Failed("no-encoders", "the recording has no encoders, so no travel is known")
    trajectory = BatchFusion(fusion, CraneSettings())(recording, rectifier, advance)
    if trajectory.drift is None or not trajectory.drift.by_encoders:
        return Failed("no-travel", "pictures and encoders together place too little of the way")
    if trajectory.length_m < recording.rig.baseline_m:
        return Failed("no-travel", f"the crane travels only {trajectory.length_m:.2f} m")
    return trajectory.drift


def _row_lines(
    rows: RowDrift | Failed, sigmas: Float64, camera: RectifiedCamera, range_m: float, settings: CheckSettings
) -> list[CheckLine]:
    if isinstance(rows, Failed):
        return [_unseen(name, "deg", rows.reason) for name in ("pitch", "roll", "focal ratio")]
    f, baseline = camera.focal_px, camera.baseline_m
    at = f"{range_m:.1f} m"
    if not np.isfinite(range_m):
        range_m = FAR_BASELINES * baseline
        at = f"{range_m:.1f} m, which is assumed"
    x, y = camera.width / 2 / f, camera.height / 2 / f
    # Errors at the picture's corner per unit: of rows in px, of columns in focal lengths.
    off_row = {"pitch": f, "roll": f * x, "focal ratio": f * y}
    off_column = {"pitch": x * y, "roll": y, "focal ratio": x}
    lines = []
    for name, value, sigma in zip(off_row, rows.values[:3], sigmas[:3], strict=True):
        cost = 1e3 * abs(value) * off_column[name] * range_m**2 / baseline
        px = abs(value) * off_row[name]
        real = abs(value) > 3 * sigma
        turns = real and cost > settings.max_depth_error_mm
        bad = turns or (real and px > settings.max_row_error_px)
        reason = f"rows are off by up to {px:.2f} px ({settings.max_row_error_px:g} are fine)"
        if turns:
            reason += f", depth by {cost:.1f} mm at {at} ({settings.max_depth_error_mm:g} are fine)"
        scale, unit = (1e2, "%") if name == "focal ratio" else (float(np.degrees(1)), "deg")
        lines.append(
            CheckLine(
                name,
                scale * value,
                scale * sigma,
                unit,
                cost,
                DriftState.RECALIBRATE if bad else DriftState.GOOD,
                reason,
            )
        )
    return lines


def _travel_lines(
    drift: RigDrift | Failed, rows: RowDrift | Failed, sigmas: Float64, range_m: float,
    settings: CheckSettings,
) -> list[CheckLine]:  # fmt: skip
    if isinstance(drift, Failed):
        return [_unseen("yaw", "deg", drift.reason), _unseen("baseline", "%", drift.reason)]
    yaw, sigma = np.degrees([drift.yaw_rad, drift.yaw_sigma_rad])
    cost = 1e3 * drift.depth_error_m(range_m)
    bad = abs(yaw) > 3 * sigma and abs(cost) > settings.max_depth_error_mm
    reason = "the crane's known travel against the disparities"
    if bad:
        reason += "; measuring with self_calibrate: yaw takes it off"
    lines = [
        CheckLine("yaw", yaw, sigma, "deg", cost, DriftState.RECALIBRATE if bad else DriftState.GOOD, reason),
        _scale_line(drift, range_m),
    ]
    if not isinstance(rows, Failed):
        off = float(rows.values[3] - drift.yaw_rad)
        spread = float(np.hypot(sigmas[3], drift.yaw_sigma_rad))
        agree = abs(off) <= 3 * spread
        why = (
            "rows and travel agree on the yaw" if agree
            else "rows see another yaw than the travel: the lens has changed, or the encoders are wrong"
        )  # fmt: skip
        lines.append(
            CheckLine(
                "yaw, rows minus travel", float(np.degrees(off)), float(np.degrees(spread)), "deg", np.nan,
                DriftState.GOOD if agree else DriftState.CONTRADICTION, why,
            )
        )  # fmt: skip
    return lines


def _scale_line(drift: RigDrift, range_m: float) -> CheckLine:
    ratio = drift.scale_sigma / float(drift.prior_sigma[1])
    contradicts = abs(drift.scale) > 3 * drift.scale_sigma
    if contradicts:
        state, reason = (
            DriftState.CONTRADICTION,
            "baseline and encoders disagree: one of them has a wrong metre",
        )
    elif ratio > 0.8:
        state = DriftState.NOT_SEEN
        reason = f"not told apart from the yaw by these depths: held at ± {100 * drift.prior_sigma[1]:.2g} %"
    else:
        state, reason = DriftState.GOOD, "baseline and encoders agree"
    return CheckLine(
        "baseline", 100 * drift.scale, 100 * drift.scale_sigma, "%", 1e3 * abs(drift.scale) * range_m, state,
        reason,
    )  # fmt: skip


def _unseen(name: str, unit: str, reason: str) -> CheckLine:
    return CheckLine(name, np.nan, np.nan, unit, np.nan, DriftState.NOT_SEEN, reason)
