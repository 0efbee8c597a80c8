"""Judge a stereo calibration property by property and advise on views to add."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from barsight.calibration.boards.board import BoardKind
from barsight.calibration.boards.board_views import common_corners
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.calibration import StereoCalibration
from barsight.calibration.stereo.cross_validation import CrossValidation, cross_validate
from barsight.calibration.stereo.projection_uncertainty import (
    COLUMNS,
    ROWS,
    depth_sigma,
    picture_grid,
    projection_sigma,
)
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, MeasurementError

RANGES_M = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0)
CROSS_RANGES_M = (2.0, 4.0, 7.0, 12.0)
FEWEST_TILT_DEG = 25.0
MIN_RANGE_M, MAX_RANGE_M = 0.05, 1000.0
"""Range of working distances."""


class Verdict(StrEnum):
    """Good: proceed. Usable: works, but more views would help. Redo: do not measure with it."""

    GOOD = "good"
    USABLE = "usable"
    REDO = "redo"


@dataclass(frozen=True)
class Line:
    """A judged property: its measured value as text, the verdict, and the reason with the limits."""

    name: str
    value: str
    verdict: Verdict
    reason: str


@dataclass(frozen=True, eq=False)
class Assessment:
    """Verdict on a calibration, as the report shows it.

    lines: judged properties. advice: views to add. projection_sigma_px: (ROWS, COLUMNS) per camera.
    epipolar_px: (N,) row differences of matching corners after rectification. ranges_m (R,) and depth_sigma_m
    (R, 2): median and largest over the picture. cross: comparison of the two halves, or why there is none.
    """

    lines: tuple[Line, ...]
    advice: tuple[str, ...]
    projection_sigma_px: tuple[Float64, Float64]
    epipolar_px: Float64
    ranges_m: tuple[float, ...]
    depth_sigma_m: Float64
    cross: CrossValidation | Failed

    @property
    def verdict(self) -> Verdict:
        """Return the worst verdict among the lines."""
        order = list(Verdict)
        return max((line.verdict for line in self.lines), key=order.index)


def assess(calibration: StereoCalibration, working_range_m: float) -> Assessment:
    """Judge a calibration for measuring at `working_range_m`."""
    ranges = tuple(sorted({*RANGES_M, working_range_m}))
    sigma = tuple(
        projection_sigma(calibration, camera, calibration.covariance).reshape(ROWS, COLUMNS)
        for camera in (0, 1)
    )
    epipolar = epipolar_errors(calibration)
    depth = depth_sigma(calibration, ranges)
    cross = cross_validate(calibration, CROSS_RANGES_M)
    covered = [float(picture_grid(calibration, camera).covered.mean()) for camera in (0, 1)]
    both = sum(view.cam0 is not None and view.cam1 is not None for view in calibration.views)
    lines = (
        judge("views of both cameras", both, "", 10, 5, "more views average the corners' noise", above=True),
        judge("coverage", 100 * min(covered), "% of the picture", 75, 40,
               "beyond the corners the lens is extrapolated", above=True),
        judge("reprojection", calibration.rms_px, "px RMS", 0.3, 0.8,
               "larger means blur, a bent board or the wrong lens model"),
        judge("epipolar", float(np.sqrt((epipolar**2).mean())), "px RMS", 0.3, 0.7,
               "matches must lie on one row"),
        judge("projection uncertainty", float(np.median(np.concatenate([s.ravel() for s in sigma]))),
               "px (median over the pictures)", 0.2, 0.6, "how far the lens may be off"),
        judge(f"depth at {working_range_m:g} m", 1e3 * float(depth[ranges.index(working_range_m), 0]), "mm",
               10, 30, "what the calibration alone costs, the same in every picture"),
        _judge_cross(cross),
    )  # fmt: skip
    return Assessment(lines, _advice(calibration), (sigma[0], sigma[1]), epipolar, ranges, depth, cross)


def epipolar_errors(calibration: StereoCalibration) -> Float64:
    """Compute row errors (N,) px after rectification, right minus left, of the corners that both cameras
    see.
    """
    rig = calibration.rig
    rectifier = Rectifier(rig)
    left_turn = rectifier.body_from_rect0.rotation
    right_turn = rig.cam0_from_cam1.rotation.T @ left_turn
    rows = []
    for view in calibration.views:
        _, left, right = common_corners(view)
        if len(left):
            first, second = rig.cam0.rays(left) @ left_turn, rig.cam1.rays(right) @ right_turn
            rows.append(rectifier.camera.focal_px * (second[:, 1] / second[:, 2] - first[:, 1] / first[:, 2]))
    return np.concatenate(rows)


def tilts(calibration: StereoCalibration) -> Float64:
    """Compute each board's tilt (V, 2), in degrees, about the picture's vertical and horizontal axes."""
    normal = calibration.state.board_rotation[:, :, 2]
    normal = normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)
    return np.degrees(np.arctan2(normal[:, :2], normal[:, 2:]))


def judge(
    name: str, value: float, unit: str, good: float, usable: float, why: str, *, above: bool = False
) -> Line:
    """Judge a value against two limits; `above` where larger values are better."""
    sign = -1.0 if above else 1.0
    is_good, is_usable = sign * value <= sign * good, sign * value <= sign * usable
    verdict = Verdict.GOOD if is_good else Verdict.USABLE if is_usable else Verdict.REDO
    side = "at least" if above else "at most"
    reason = f"good is {side} {good:g}, usable {side} {usable:g}: {why}"
    text = f"{value:.3g}" if np.isfinite(value) and value < 1000 else f"{value:.0f}"
    return Line(name, f"{text} {unit}".strip(), verdict, reason)


def _judge_cross(cross: CrossValidation | Failed) -> Line:
    name = "cross-validation"
    if isinstance(cross, Failed):
        return Line(name, "not possible", Verdict.USABLE, cross.reason)
    why = "halves that differ by more than their sigmas hide an error that the residuals don't show"
    return judge(name, cross.ratio, "sigma", 2, 3, why)


def _advice(calibration: StereoCalibration) -> tuple[str, ...]:
    advice = []
    for camera in (0, 1):
        empty = ~picture_grid(calibration, camera).covered.reshape(ROWS, COLUMNS)
        share = empty.reshape(3, ROWS // 3, 4, COLUMNS // 4).mean(axis=(1, 3))
        names = [
            f"{row} {column}".replace("middle middle", "middle")
            for i, row in enumerate(("upper", "middle", "lower"))
            for column, j in (("left", [0]), ("middle", [1, 2]), ("right", [3]))
            if share[i, j].mean() > 0.6
        ]
        if names:
            advice.append(f"cam{camera}: hold the board into the {', '.join(names)} of the picture")
    spread = np.ptp(tilts(calibration), axis=0)
    for angle, axis in zip(spread, ("vertical", "horizontal"), strict=True):
        if angle < FEWEST_TILT_DEG:
            advice.append(
                f"tilt the board about its {axis} axis: the views span {angle:.0f} degrees, "
                f"{FEWEST_TILT_DEG:.0f} or more fix the focal length"
            )
    if calibration.correlation > 4:
        what = "" if calibration.board.kind is not BoardKind.CHECKERBOARD else " and edge to edge flat"
        advice.append(
            f"the views disagree {np.sqrt(calibration.correlation):.1f} times as much as their corners' "
            f"noise allows: trigger both cameras at once, hold the board still{what}"
        )
    return tuple(advice)


def summary_sentence(lines: Sequence[Line]) -> str:
    """Summarise in one sentence what prevents the calibration from being good."""
    weak = [
        f"{line.name} {line.value} ({line.verdict})" for line in lines if line.verdict is not Verdict.GOOD
    ]
    return "good in every line" if not weak else "; ".join(weak)


def expect_usable(lines: Sequence[Line], path: Path) -> None:
    """Raise MeasurementError if a line says that the calibration in a file must be redone."""
    redo = [line for line in lines if line.verdict is Verdict.REDO]
    if redo:
        told = "; ".join(f"{line.name} {line.value}" for line in redo)
        raise MeasurementError(
            f"{path}: redo the calibration, don't measure with it ({told}); see its report"
        )
