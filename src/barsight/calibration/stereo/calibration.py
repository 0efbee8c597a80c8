"""Calibrate a stereo rig from views of a board: each camera alone, then both in one least-squares problem.

Repeated and blurred pictures, outlying corners and misfitting views are removed in turn, each with a reason.
The covariance is that of the least squares, widened where the residuals within a view are more correlated
than independent corner noise would be (a warped board, cameras not triggered together).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView, Corners, Removed
from barsight.calibration.boards.board_warp import BoardShape, board_shape, shape_basis
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.bundle_adjustment import (
    AdjustmentResult,
    AdjustmentState,
    CornerTable,
    adjust,
    observe,
)
from barsight.calibration.stereo.covariance_inflation import common_covariance
from barsight.calibration.stereo.initialization import board_pose, start_lens, start_rig
from barsight.calibration.stereo.outlier_removal import (
    FEWEST_VIEWS,
    corner_notes,
    drop_blurred,
    drop_corners,
    drop_misfits,
    drop_repeats,
    drop_small,
)
from barsight.core.arrays import Float64, rms
from barsight.core.errors import CalibrationError, Failed
from barsight.core.pose import Pose

HUBER_PX = 1.0
MAX_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """A calibrated rig and its uncertainty.

    rig: its body is cam0. views: those used, without the corners removed. removed: what was removed, and why.
    residuals_px: (N, 2) per camera, observed minus projected, in the order of `observed`. sigma_px: noise of
    one corner coordinate. correlation: factor on the variances, from how much more views scatter than
    independent corners would (1: no more). parameter_names: (C,). covariance: (C, C), including the
    uncertainty of the board's shape; the rig's rotation is a small rotation (rad) of cam1_from_cam0 from the
    left. information: (C, C), the inverse covariance at unit noise. shape: the board's, solved with the rest.
    alone_rms_px: RMS residual of each camera solved alone, with a flat board.
    """

    source: Path
    board: Board
    lens: Lens
    rig: StereoRig
    state: AdjustmentState
    views: tuple[BoardView, ...]
    observed: tuple[CornerTable, ...]
    removed: tuple[Removed, ...]
    residuals_px: tuple[Float64, ...]
    sigma_px: float
    correlation: float
    parameter_names: tuple[str, ...]
    covariance: Float64
    information: Float64
    shape: BoardShape
    alone_rms_px: tuple[float, float]

    @property
    def rms_px(self) -> float:
        """Return the RMS reprojection error (px) of both cameras together."""
        return rms(np.concatenate(self.residuals_px))

    @property
    def baseline_sigma_m(self) -> float:
        """Return the standard deviation of the baseline."""
        direction = self.state.translation_m / np.linalg.norm(self.state.translation_m)
        return float(np.sqrt(direction @ self.covariance[-3:, -3:] @ direction))

    def save(self, path: Path | str) -> None:
        """Write the rig file, which states the covariance too: a map's sigma then contains it."""
        write_rig_file(Path(path), self.rig, rig_file_section(self))


def rig_file_section(calibration: StereoCalibration) -> dict[str, object]:
    """Form the `calibration` section of a rig file: parameters with sigmas and covariance, and the board's
    shape.
    """
    sigmas = np.sqrt(np.diag(calibration.covariance))
    return {
        "board": str(calibration.board),
        "lens": str(calibration.lens),
        "views": len(calibration.views),
        "rms_px": calibration.rms_px,
        "corner_sigma_px": calibration.sigma_px,
        "baseline_sigma_m": calibration.baseline_sigma_m,
        "board_shape": {
            name: {"value": float(value), "sigma": float(sigma)}
            for name, value, sigma in zip(
                calibration.shape.names, calibration.shape.values, calibration.shape.sigma, strict=True
            )
        },
        "parameters": list(calibration.parameter_names),
        "sigmas": [float(value) for value in sigmas],
        "covariance": [[float(value) for value in row] for row in calibration.covariance],
    }


def calibrate_stereo(
    views: Sequence[BoardView], board: Board, lens: Lens, sizes: tuple[tuple[int, int], tuple[int, int]],
    source: Path, left_out: Sequence[Removed] = (),
) -> StereoCalibration:  # fmt: skip
    """Calibrate from detections; sizes: width and height of cam0's and cam1's pictures.

    source: path of the pictures, for messages. left_out: what was rejected before, for the report.
    Raises CalibrationError where too few views remain, the cameras are swapped, or the equations leave a
    parameter undetermined.
    """
    points, basis = board.points_m, shape_basis(board)
    kept, repeated = drop_repeats(views)
    kept, small = drop_small(kept)
    removed = [*left_out, *repeated, *small]
    _expect_views(kept, source, removed)
    kept, blurred = drop_blurred(kept)
    removed += blurred
    lenses, alone = [], []
    for camera in (0, 1):
        own = [view for view in kept if view.cameras[camera] is not None]
        solved = _solve_alone(lens, own, camera, points, sizes[camera], source)
        lenses.append(solved.state.lenses[0])
        alone.append(rms(solved.residuals_px[0]))
    cameras = (_camera(lens, lenses[0], sizes[0], source), _camera(lens, lenses[1], sizes[1], source))
    before = {view.name: view for view in kept}
    start = _start(cameras, (lenses[0], lenses[1]), kept, points, source, removed)
    start = replace(start, shape=np.zeros(basis.shape[2]))
    for _ in range(MAX_ROUNDS):
        observed = observe(kept, points, basis, 2)
        solved = adjust(lens, observed, start, HUBER_PX)
        _expect_order(solved.state, source)
        remaining, out = drop_misfits(kept, observed, solved, start, cameras, points)
        limit = None
        if not out:
            solved = adjust(lens, observed, solved.state, None)
            remaining, out, limit = drop_corners(kept, observed, solved)
        removed += out
        if not out and limit is None:
            break
        start = _select_boards(solved.state, kept, remaining)
        kept = remaining
        _expect_views(kept, source, removed)
    removed += corner_notes(before, kept)
    return _finish(kept, board, lens, sizes, source, observed, solved, removed, (alone[0], alone[1]))


def parameter_names(lens: Lens) -> tuple[str, ...]:
    """Return the names of the common parameters in the order of the covariance."""
    own = [f"cam{camera}.{name}" for camera in (0, 1) for name in lens.parameter_names]
    rig = [f"cam1_from_cam0.{part}" for part in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")]
    return (*own, *rig)


def calibrated_rig(lens: Lens, state: AdjustmentState, sizes: Sequence[tuple[int, int]]) -> StereoRig:
    """Build the rig from a solved state, with its body at cam0. Raises ValueError where the rig is
    invalid.
    """
    cam1_from_cam0 = Pose("cam1", "cam0", state.rotation, state.translation_m)
    body_from_cam0 = Pose.identity("body", "cam0")
    cameras = [lens.camera(state.lenses[n], *sizes[n]) for n in (0, 1)]
    return StereoRig(cameras[0], cameras[1], body_from_cam0, body_from_cam0 @ cam1_from_cam0.inverse())


def _start(
    cameras: tuple[Camera, Camera], lenses: tuple[Float64, Float64], views: Sequence[BoardView],
    points: Float64, source: Path, removed: Sequence[Removed],
) -> AdjustmentState:  # fmt: skip
    _expect_views(views, source, removed)
    start = start_rig(cameras, lenses, views, points)
    if isinstance(start, Failed):
        raise CalibrationError(source, start.reason, "check that left and right show the same moments")
    return start


def _select_boards(
    state: AdjustmentState, views: Sequence[BoardView], kept: Sequence[BoardView]
) -> AdjustmentState:
    """Select the board poses of the kept views."""
    number = {view.name: n for n, view in enumerate(views)}
    rows = np.array([number[view.name] for view in kept])
    return replace(
        state, board_rotation=state.board_rotation[rows], board_translation_m=state.board_translation_m[rows]
    )


def _solve_alone(
    lens: Lens, views: Sequence[BoardView], camera: int, points: Float64, size: tuple[int, int], source: Path
) -> AdjustmentResult:
    corners = [c for c in (view.cameras[camera] for view in views) if isinstance(c, Corners)]
    start = start_lens(lens, corners, points, size)
    if isinstance(start, Failed):
        raise CalibrationError(source, f"cam{camera}: {start.reason}", "check the board and the pictures")
    guess = lens.camera(start, *size)
    poses = [board_pose(guess, c, points) for c in corners]
    state = AdjustmentState(
        (start,), np.eye(3), np.zeros(3), np.array([p[0] for p in poses]), np.array([p[1] for p in poses]),
        np.zeros(0),
    )  # fmt: skip
    single = [BoardView(view.name, c, None) for view, c in zip(views, corners, strict=True)]
    return adjust(lens, observe(single, points, np.zeros((*points.shape, 0)), 1), state, HUBER_PX)


def _camera(lens: Lens, parameters: Float64, size: tuple[int, int], source: Path) -> Camera:
    try:
        return lens.camera(parameters, *size)
    except ValueError as error:
        raise CalibrationError(
            source,
            f"the views don't determine the lens: {error}",
            "add tilted views, or take the lens radtan4",
        ) from None


def _expect_order(state: AdjustmentState, source: Path) -> None:
    x, y, z = -state.rotation.T @ state.translation_m
    if x < 0 and abs(x) > max(abs(y), abs(z)):
        raise CalibrationError(
            source,
            f"left and right are swapped: cam1 lies {-x * 1e3:.1f} mm to the left of cam0",
            "exchange the two folders of pictures",
        )


def _expect_views(views: Sequence[BoardView], source: Path, removed: Sequence[Removed]) -> None:
    both = sum(view.cam0 is not None and view.cam1 is not None for view in views)
    if both >= FEWEST_VIEWS:
        return
    reasons = "; ".join(text for text, _ in Counter(entry.reason for entry in removed).most_common(1))
    raise CalibrationError(
        source,
        f"only {both} views show the board to both cameras, {FEWEST_VIEWS} are needed"
        + (f" ({reasons})" if reasons else ""),
        "check the board and that left and right are of the same moments, or take more views",
    )


def _finish(
    kept: list[BoardView], board: Board, lens: Lens, sizes: tuple[tuple[int, int], tuple[int, int]],
    source: Path, observed: tuple[CornerTable, ...], solved: AdjustmentResult, removed: list[Removed],
    alone: tuple[float, float],
) -> StereoCalibration:  # fmt: skip
    try:
        corners = sum(seen.ids.size for seen in observed)
        covariance, sigma, correlation = common_covariance(solved, corners, len(kept))
        rig = calibrated_rig(lens, solved.state, sizes)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            source,
            "the views leave a direction of the calibration undetermined",
            "add views with the board tilted about both axes and near the picture's corners",
        ) from None
    except ValueError as error:
        raise CalibrationError(source, str(error), "check the pictures' order and the board") from None
    names = parameter_names(lens)
    count = len(names)
    return StereoCalibration(
        source, board, lens, rig, solved.state, tuple(kept), observed, tuple(removed),
        solved.residuals_px, sigma, correlation, names, covariance[:count, :count], solved.rig_information,
        board_shape(board, solved.state.shape, covariance[count:, count:]), alone,
    )  # fmt: skip
