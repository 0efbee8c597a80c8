"""Remove what misleads a stereo calibration: repeated and blurred pictures, views of another board,
misdetected corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.calibration.boards.board_views import BoardView, Corners, Removed
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.stereo.bundle_adjustment import AdjustmentResult, AdjustmentState, CornerTable
from barsight.calibration.stereo.initialization import board_pose
from barsight.core.arrays import Float64

FEWEST_VIEWS = 3
FEWEST_CORNERS = 8
BLUR_FACTOR, BLUR_MARGIN_PX = 1.6, 1.0
MISFIT_FACTOR, MISFIT_MARGIN_PX = 3.0, 0.3
CORNER_SIGMAS = 4.5
MAX_CORNERS_OUT = 0.3
MAX_ALONE_PX = 2.0
TRIM_RATIO = 0.1
MIN_SCALE_OFF = 0.05
SAME_TURN_RAD, SAME_SHIFT = 0.05, 0.15


def drop_small(views: Sequence[BoardView]) -> tuple[list[BoardView], list[Removed]]:
    """Drop pictures that show fewer than eight corners."""
    kept, removed = [], []
    for view in views:
        for camera, corners in enumerate(view.cameras):
            if corners is not None and corners.ids.size < FEWEST_CORNERS:
                reason = f"{corners.ids.size} corners in sight, {FEWEST_CORNERS} are needed"
                removed.append(Removed(view.name, f"cam{camera}", reason))
                view = _without(view, camera)
        if view.cam0 is not None or view.cam1 is not None:
            kept.append(view)
    return kept, removed


def drop_repeats(views: Sequence[BoardView]) -> tuple[list[BoardView], list[Removed]]:
    """Drop views whose corners are exactly those of an earlier one: counted again, their noise would seem to
    be averaged.
    """
    first, removed = dict[tuple[bytes, ...], BoardView](), []
    for view in views:
        key = tuple(b"" if c is None else c.ids.tobytes() + c.pixels.tobytes() for c in view.cameras)
        same = first.setdefault(key, view)
        if same is not view:
            removed.append(Removed(view.name, "both", f"is the same picture as {same.name}"))
    return list(first.values()), removed


def drop_blurred(views: Sequence[BoardView]) -> tuple[list[BoardView], list[Removed]]:
    """Drop pictures whose edges are much wider than the median for the same camera."""
    kept, removed = list(views), []
    for camera in (0, 1):
        widths = np.array([np.nan if c is None else c.edge_px for c in (v.cameras[camera] for v in kept)])
        if not np.isfinite(widths).any():
            continue
        usual = float(np.nanmedian(widths))
        for number, width in enumerate(widths):
            if width > BLUR_FACTOR * usual and width > usual + BLUR_MARGIN_PX:
                reason = f"blurred: its edges are {width:.1f} px wide, the other pictures' {usual:.1f} px"
                removed.append(Removed(kept[number].name, f"cam{camera}", reason))
                kept[number] = _without(kept[number], camera)
    return [view for view in kept if view.cam0 is not None or view.cam1 is not None], removed


def drop_misfits(
    views: Sequence[BoardView],
    observed: tuple[CornerTable, ...],
    solved: AdjustmentResult,
    start: AdjustmentState,
    cameras: tuple[Camera, Camera],
    points_m: Float64,
) -> tuple[list[BoardView], list[Removed]]:
    """Drop the worst views, those where most corners have residuals far above the other views'.

    A few misdetected corners don't condemn a view; `drop_corners` removes them.

    start: the rig before this solve, which the bad views haven't affected; it serves to name the cause.
    """
    errors = _trimmed_rms(observed, solved.residuals_px, len(views))
    usual = float(np.median(errors))
    limit = max(MISFIT_FACTOR * usual, usual + MISFIT_MARGIN_PX)
    worst = float(errors.max())
    out = {int(n) for n in np.flatnonzero((errors > limit) & (errors > 0.4 * worst))}
    if len(out) > len(views) // 2:
        out = set()
    removed = []
    for number in sorted(out):
        cause = _cause(views[number], start, cameras, points_m)
        reason = f"{cause}: its corners lie {errors[number]:.1f} px off, the other views' {usual:.2f} px"
        removed.append(Removed(views[number].name, "both", reason))
    return [view for number, view in enumerate(views) if number not in out], removed


def drop_corners(
    views: Sequence[BoardView], observed: tuple[CornerTable, ...], solved: AdjustmentResult
) -> tuple[list[BoardView], list[Removed], float | None]:
    """Drop corners beyond 4.5 robust sigma, and pictures that would lose a third of theirs.

    The third value is the limit (px), or None where every corner is within it. `corner_notes` gives the
    reasons.
    """
    lengths = [np.linalg.norm(residual, axis=1) for residual in solved.residuals_px]
    sigma = float(np.median(np.concatenate(lengths))) / np.sqrt(2 * np.log(2))
    limit = CORNER_SIGMAS * max(sigma, 1e-3)
    kept, removed, clean = list(views), [], True
    for camera, (seen, length) in enumerate(zip(observed, lengths, strict=True)):
        for number in np.unique(seen.view[length > limit]):
            corners = kept[number].cameras[camera]
            if corners is None:
                continue
            clean = False
            bad = length[seen.view == number] > limit
            if bad.mean() > MAX_CORNERS_OUT or (~bad).sum() < FEWEST_CORNERS:
                reason = f"{bad.sum()} of {bad.size} corners lie more than {limit:.2f} px off"
                removed.append(Removed(views[number].name, f"cam{camera}", reason))
                kept[number] = _without(kept[number], camera)
            else:
                kept[number] = _with(kept[number], camera, corners.keep(~bad))
    kept = [view for view in kept if view.cam0 is not None or view.cam1 is not None]
    return kept, removed, None if clean else limit


def corner_notes(before: dict[str, BoardView], after: Sequence[BoardView]) -> list[Removed]:
    """List the corners removed from pictures that are still used."""
    notes = []
    for view in after:
        for camera, corners in enumerate(view.cameras):
            whole = before[view.name].cameras[camera]
            if corners is None or whole is None or whole.ids.size == corners.ids.size:
                continue
            count = whole.ids.size - corners.ids.size
            reason = f"{count} of {whole.ids.size} corners lie more than {CORNER_SIGMAS:g} sigma off"
            notes.append(Removed(view.name, f"cam{camera}", reason))
    return notes


def view_rms(observed: tuple[CornerTable, ...], residuals: tuple[Float64, ...], views: int) -> Float64:
    """Compute each view's RMS residual (V,) px over both cameras."""
    squares, counts = np.zeros(views), np.zeros(views)
    for seen, residual in zip(observed, residuals, strict=True):
        squares += np.bincount(seen.view, (residual**2).sum(axis=1), views)
        counts += np.bincount(seen.view, minlength=views)
    rms: Float64 = np.sqrt(squares / np.maximum(counts, 1))
    return rms


def _trimmed_rms(observed: tuple[CornerTable, ...], residuals: tuple[Float64, ...], views: int) -> Float64:
    """Compute each view's RMS residual (V,) px over the best nine tenths of its corners."""
    view = np.concatenate([seen.view for seen in observed])
    squares = np.concatenate([(residual**2).sum(axis=1) for residual in residuals])
    errors = np.zeros(views)
    for number in range(views):
        own = np.sort(squares[view == number])
        if own.size:
            errors[number] = np.sqrt(own[: max(int(own.size * (1 - TRIM_RATIO)), 1)].mean())
    return errors


def _cause(view: BoardView, state: AdjustmentState, cameras: tuple[Camera, Camera], points_m: Float64) -> str:
    """Name the fault of a view as far as the rig it implies on its own reveals it."""
    if view.cam0 is None or view.cam1 is None:
        return "the board is another one, or bent or badly found"
    turn, shift, fit = _implied(view.cam0, view.cam1, cameras, points_m)
    if fit > MAX_ALONE_PX:
        return "shows another board, or was taken by another camera"
    exchanged = _implied(view.cam1, view.cam0, cameras, points_m)
    length = float(np.linalg.norm(state.translation_m))
    if _near(exchanged[0], state.rotation) and np.linalg.norm(exchanged[1] - state.translation_m) < (
        SAME_SHIFT * length
    ):
        return "left and right pictures are exchanged"
    size = float(np.linalg.norm(shift))
    aligned = size > 0 and np.linalg.norm(shift / size - state.translation_m / length) < SAME_SHIFT
    if _near(turn, state.rotation) and aligned and abs(length / size - 1) > MIN_SCALE_OFF:
        return f"shows another board, about {length / size:.1f} times as large"
    if not _near(turn, state.rotation) or np.linalg.norm(shift - state.translation_m) > SAME_SHIFT * length:
        return "left and right don't show the same board at the same moment"
    return "doesn't fit (board bent, moving, or badly found)"


def _implied(
    left: Corners, right: Corners, cameras: tuple[Camera, Camera], points_m: Float64
) -> tuple[Float64, Float64, float]:
    """Estimate cam1_from_cam0 (rotation, translation) from one view alone, and the larger of both cameras'
    RMS (px).
    """
    first, second = board_pose(cameras[0], left, points_m), board_pose(cameras[1], right, points_m)
    turn = second[0] @ first[0].T
    return turn, second[1] - turn @ first[1], max(first[2], second[2])


def _near(a: Float64, b: Float64) -> bool:
    return bool(np.linalg.norm(a - b) < SAME_TURN_RAD * np.sqrt(2))


def _without(view: BoardView, camera: int) -> BoardView:
    return replace(view, cam0=None) if camera == 0 else replace(view, cam1=None)


def _with(view: BoardView, camera: int, corners: Corners) -> BoardView:
    return replace(view, cam0=corners) if camera == 0 else replace(view, cam1=corners)
