"""Detect a board's corners to sub-pixel accuracy and measure edge blur."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.calibration.boards.board import Board, BoardKind
from barsight.calibration.boards.board_views import Corners
from barsight.calibration.boards.marker_detection import detect_aprilgrid, detect_charuco
from barsight.core.arrays import Float64, UInt8
from barsight.core.errors import Failed

MAX_WINDOW_PX = 11
EDGE_RATIO = 0.35
MAX_CROSSINGS, MIN_ALIKE = 0.75, 0.6


def detect(board: Board, image: UInt8) -> Corners | Failed:
    """Detect the board's corners in one gray picture (H, W).

    Failed `no-board` where the board isn't found; for a checkerboard, the reason names the other checkerboard
    that the picture shows, if any. An AprilGrid or ChArUco board may be partly visible; a checkerboard must
    be whole.
    """
    if board.kind is BoardKind.APRILGRID:
        return detect_aprilgrid(board, image)
    if board.kind is BoardKind.CHARUCO:
        return detect_charuco(board, image)
    return _detect_checkerboard(board, image)


def _detect_checkerboard(board: Board, image: UInt8) -> Corners | Failed:
    size = (board.columns, board.rows)
    corners = _chessboard_corners(image, size)
    if corners is None:
        return Failed(
            "no-board", f"no {size[0]}x{size[1]} checkerboard found{_remark(_shown_size(board, image))}"
        )
    grid = corners.reshape(board.rows, board.columns, 2)
    if not _is_grid(grid):
        return Failed("no-board", f"no {size[0]}x{size[1]} checkerboard found (its corners form no grid)")
    grid = _refine(image, grid)
    if _goes_on(image, grid):
        shown = _shown_size(board, image)
        if shown is not None and shown[0] * shown[1] > size[0] * size[1]:
            return Failed("no-board", f"no {size[0]}x{size[1]} checkerboard found{_remark(shown)}")
    grid = _canonical(board, grid, image)
    ids = np.arange(board.rows * board.columns)
    return Corners(ids, grid.reshape(-1, 2), edge_width(image, grid))


def _chessboard_corners(image: UInt8, size: tuple[int, int]) -> Float64 | None:
    """Find a checkerboard's corners (N, 1, 2) with three detectors, the fastest first.

    The last one, sector-based and exhaustive [Duda 2018], takes about a second on a 1.3 MP picture without a
    board, and finds small, tilted and badly lit boards that the others miss.
    """
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(image, size, flags=flags | cv2.CALIB_CB_FAST_CHECK)
    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for more in (0, thorough):
        if not found:
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE | more
            found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    return np.asarray(corners, dtype=np.float64) if found else None


def _refine(image: UInt8, grid: Float64) -> Float64:
    """Refine corners by gradient orthogonality [Foerstner 1987] in a window that stays within the adjoining
    squares.
    """
    steps = np.concatenate([
        np.linalg.norm(np.diff(grid, axis=0), axis=2).ravel(),
        np.linalg.norm(np.diff(grid, axis=1), axis=2).ravel(),
    ])  # fmt: skip
    half = int(np.clip(0.4 * steps.min(), 2, MAX_WINDOW_PX))
    start = grid.reshape(-1, 1, 2).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    refined = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), criteria)
    moved = np.linalg.norm(refined - start, axis=2)
    refined = np.where((moved < half)[:, :, None], refined, start)
    return np.asarray(refined, dtype=np.float64).reshape(grid.shape)


def _is_grid(grid: Float64) -> bool:
    """Check that neighbouring grid steps change slowly; in a false detection they jump."""
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis)
        bends = np.linalg.norm(np.diff(steps, axis=axis), axis=2)
        if bends.size and bends.max() > 0.6 * np.linalg.norm(steps, axis=2).max():
            return False
    return True


def _goes_on(image: UInt8, grid: Float64) -> bool:
    """Check whether the pattern continues beyond a side of the grid: the points one step out are crossings
    too.
    """
    for side in (grid, grid[::-1], grid.transpose(1, 0, 2), grid.transpose(1, 0, 2)[::-1]):
        outward = side[0] - side[1]
        steps = np.linalg.norm(outward, axis=1)
        shrink = np.clip(steps / np.linalg.norm(side[1] - side[2], axis=1), 0.7, 1.4)[:, None]
        place = side[0] + outward * shrink
        margin = 3 + 0.4 * steps[:, None]
        inside = (place > margin) & (place < np.array(image.shape[::-1]) - margin)
        known = inside.all(axis=1)
        if known.sum() < max(3, side.shape[1] // 2):
            continue
        crossings = [_is_crossing(image, p, s) for p, s in zip(place[known], steps[known], strict=True)]
        if np.mean(crossings) > MAX_CROSSINGS:
            return True
    return False


def _is_crossing(image: UInt8, place: Float64, step: float) -> bool:
    """Check for a saddle point near a place: a ring around it shows four changes, with opposite sides
    alike.
    """
    half = max(int(0.25 * step), 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    start = place.reshape(1, 1, 2).astype(np.float32)
    x, y = cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria).ravel()
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    radius = 0.35 * step
    ring = cv2.remap(
        image, (x + radius * np.cos(angle))[None].astype(np.float32),
        (y + radius * np.sin(angle))[None].astype(np.float32), cv2.INTER_LINEAR,
    ).ravel().astype(np.float64)  # fmt: skip
    level = (ring.min() + ring.max()) / 2
    light = ring > level
    changes = int((light != np.roll(light, 1)).sum())
    alike = float(np.corrcoef(ring, np.roll(ring, 16))[0, 1]) if np.ptp(ring) > 40 else 0.0
    return changes == 4 and alike > MIN_ALIKE


def _canonical(board: Board, grid: Float64, image: UInt8) -> Float64:
    """Order the corners so that both cameras agree.

    Mirrored orders are made right-handed. Where columns + rows is odd, the colours distinguish the two ends
    (the square inside the first corner is dark). Otherwise the board looks the same after half a turn, and
    the order that runs to the right (or down) is taken, which is the same for two cameras side by side.
    """
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if (board.columns + board.rows) % 2 == 1:
        first, last = (_square_brightness(image, g) for g in (grid, grid[::-1, ::-1]))
        return grid if first < last else grid[::-1, ::-1]
    along = grid[-1, -1] - grid[0, 0]
    return grid if along[0] + along[1] >= 0 else grid[::-1, ::-1]


def _square_brightness(image: UInt8, grid: Float64) -> float:
    x, y = np.round(grid[:2, :2].reshape(-1, 2).mean(axis=0)).astype(int)
    patch = image[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
    return float(patch.mean()) if patch.size else 0.0


def edge_width(image: UInt8, grid: Float64) -> float:
    """Measure the edge width (px) between a checkerboard's squares as the brightness step over the steepest
    slope.

    grid: (rows, columns, 2) corners. Returns the larger of the medians of the two directions, so that smear
    along one of them shows; NaN where no edge has contrast.
    """
    widths = []
    for axis in (0, 1):
        ends = (grid[:-1], grid[1:]) if axis == 0 else (grid[:, :-1], grid[:, 1:])
        middle = ((ends[0] + ends[1]) / 2).reshape(-1, 2)
        along = (ends[1] - ends[0]).reshape(-1, 2)
        length = np.linalg.norm(along, axis=1)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None]
        reach = np.linspace(-EDGE_RATIO, EDGE_RATIO, 41)
        place = middle[:, None] + normal[:, None] * (length[:, None] * reach)[:, :, None]
        profile = cv2.remap(
            image.astype(np.float32), place[..., 0].astype(np.float32), place[..., 1].astype(np.float32),
            cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        span = np.ptp(profile, axis=1)
        stride = length * (reach[1] - reach[0])
        apart = np.maximum(np.round(1 / stride).astype(int), 1)
        lines = zip(profile, apart, stride, strict=True)
        slope = np.array([np.abs(row[k:] - row[:-k]).max() / (k * d) for row, k, d in lines])
        clear = (span > 20) & (slope > 0)
        if clear.any():
            widths.append(float(np.median(span[clear] / slope[clear])))
    return max(widths) if widths else float("nan")


def _shown_size(board: Board, image: UInt8) -> tuple[int, int] | None:
    """Find the columns and rows of a different checkerboard in the picture; None where there is none or only
    part of the wanted board.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
    if not found or corners is None:
        return None
    columns, rows = max(meta.shape), min(meta.shape)
    is_part = columns <= max(board.columns, board.rows) and rows <= min(board.columns, board.rows)
    return None if is_part else (columns, rows)


def _remark(shown: tuple[int, int] | None) -> str:
    return "" if shown is None else f"; the picture shows one of {shown[0]}x{shown[1]} inner corners"
