"""Detect AprilGrid and ChArUco boards, whose numbered markers identify the corners of a partly visible
board.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import Corners
from barsight.core.arrays import Float64, Int64, UInt8
from barsight.core.errors import ConfigError, Failed

FEWEST_TAGS = 4
FEWEST_CORNERS = 8
BORDER_BITS = (2, 1)
"""Border widths to try, in cells: Kalibr prints its tags with a black border of two cells, others use one."""
TAG_FAMILY = "36h11"
TAG_MODULES, TAG_QUIET = 8, 1
"""Modules along a side of a 36h11 tag including its black border, and modules of white quiet zone around
it.
"""
MAX_FIT_PX = 2.0
"""Maximum distance (px) that a fit may move a corner, or a tenth of the tag's side where that is more."""
BLUR_PX = 0.5
"""Blur (px) of lens and pixel with which the template of a tag is drawn for fitting."""


def detect_charuco(board: Board, image: UInt8) -> Corners | Failed:
    """Detect the inner corners of a ChArUco board with the current or the legacy pattern. Failed
    `no-board`.
    """
    dictionary = _dictionary(board.dictionary)
    size = (board.columns, board.rows)
    best: tuple[Int64, Float64] | None = None
    for legacy in (False, True):
        pattern = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary)
        pattern.setLegacyPattern(legacy)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(image)
        if ids is not None and (best is None or len(ids) > best[0].size):
            best = ids.ravel().astype(np.int64), pixels.reshape(-1, 2).astype(np.float64)
    if best is None or best[0].size < FEWEST_CORNERS:
        count = 0 if best is None else best[0].size
        return Failed("no-board", f"no ChArUco board found ({count} corners, {FEWEST_CORNERS} are needed)")
    ids, pixels = best
    points = board.points_m[ids, :2]
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-9) < 2:
        return Failed("no-board", "the board's corners in sight lie on one line")
    return Corners(ids, pixels)


def detect_aprilgrid(board: Board, image: UInt8) -> Corners | Failed:
    """Detect the tag corners of an AprilGrid (36h11).

    Printers differ in how they turn each tag on its place, so the orientation follows from the positions of
    the tag centres rather than from the tags. Failed `no-board` unless there are four tags that aren't in one
    row.
    """
    found = max((_tags(image, bits) for bits in BORDER_BITS), key=lambda tags: len(tags[0]))
    numbers, quads = found
    known = numbers < board.columns * board.rows
    strange = int((~known).sum())
    numbers, quads = numbers[known], quads[known]
    if numbers.size < FEWEST_TAGS:
        note = f", {strange} of another board" if strange else ""
        return Failed("no-board", f"no AprilGrid found ({numbers.size} tags{note}; {FEWEST_TAGS} are needed)")
    corners = board.points_m.reshape(-1, 4, 3)[numbers, :, :2]
    ordered = _turn(corners, quads)
    if isinstance(ordered, Failed):
        return ordered
    ids = (4 * numbers[:, None] + np.arange(4)).ravel()
    pixels = _refine(image, ordered)
    return Corners(ids, pixels.reshape(-1, 2))


def _tags(image: UInt8, border_bits: int) -> tuple[Int64, Float64]:
    """Detect tags: numbers (N,) and quads (N, 4, 2). A number seen twice is dropped."""
    ids, quads = find_tags(image, border_bits)
    numbers, counts = np.unique(ids, return_counts=True)
    once = np.isin(ids, numbers[counts == 1])
    return ids[once], quads[once]


def find_tags(image: UInt8, border_bits: int = 1, family: str = TAG_FAMILY) -> tuple[Int64, Float64]:
    """Detect AprilTags: numbers (N,) in ascending order, and corners (N, 4, 2) accurate to about a pixel, in
    each tag's own corner order.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerPerimeterRate = 0.01
    parameters.adaptiveThreshWinSizeMax = 43
    detector = cv2.aruco.ArucoDetector(_dictionary(f"DICT_APRILTAG_{family}"), parameters)
    quads, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    order = np.argsort(ids.ravel(), kind="stable")
    return ids.ravel()[order].astype(np.int64), np.asarray(quads, np.float64).reshape(-1, 4, 2)[order]


def tag_pattern(number: int) -> UInt8:
    """Draw a 36h11 tag (S, S) with its quiet zone, one cell per module, 0 for dark."""
    drawn = cv2.aruco.generateImageMarker(_dictionary(f"DICT_APRILTAG_{TAG_FAMILY}"), number, TAG_MODULES)
    return np.pad(np.asarray(drawn, np.uint8), TAG_QUIET, constant_values=255)


def fit_tag(image: UInt8, number: int, quad: Float64) -> Float64 | None:
    """Fit the whole pattern of a 36h11 tag to a picture [Evangelidis 2008], starting from corners (4, 2)
    accurate to about a pixel. Returns the corners, or None where the pattern doesn't fit.

    Every edge contributes, not just the outer corners, so blur that is equal on all sides causes no shift.
    """
    low = np.maximum(np.floor(quad.min(axis=0) - 0.4 * np.ptp(quad, axis=0)).astype(int), 0)
    high = np.ceil(quad.max(axis=0) + 0.4 * np.ptp(quad, axis=0)).astype(int) + 1
    patch = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    side = float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).mean())
    cell = max(2, int(np.ceil(side / TAG_MODULES)))
    drawn = np.kron(tag_pattern(number), np.ones((cell, cell))).astype(np.float32)
    drawn = cv2.GaussianBlur(drawn, (0, 0), BLUR_PX * cell * TAG_MODULES / side)
    edge = cell // 2  # the background blurs into the rim of the paper
    drawn = np.ascontiguousarray(drawn[edge:-edge, edge:-edge])
    near, far = TAG_QUIET * cell - edge - 0.5, (TAG_QUIET + TAG_MODULES) * cell - edge - 0.5
    corners = np.array([[near, near], [far, near], [far, far], [near, far]], np.float32)
    start = cv2.getPerspectiveTransform(corners, (quad - low).astype(np.float32)).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    try:
        _, found = cv2.findTransformECC(drawn, patch, start, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
    except cv2.error:  # no convergence
        return None
    fitted = cv2.perspectiveTransform(corners[None].astype(np.float64), found.astype(np.float64))[0] + low
    return fitted if np.abs(fitted - quad).max() <= max(MAX_FIT_PX, 0.1 * side) else None


def _turn(corners: Float64, quads: Float64) -> Float64 | Failed:
    """Reorder the corners of each quad (N, 4, 2) to match the board's `corners` (N, 4, 2)."""
    homography, _ = cv2.findHomography(corners.mean(axis=1), quads.mean(axis=1), cv2.RANSAC, 5.0)
    if homography is None or abs(np.linalg.det(homography)) < 1e-12:
        return Failed("no-board", "the tags in sight lie on one line")
    flat = np.column_stack([corners.reshape(-1, 2), np.ones(corners.size // 2)]) @ homography.T
    expected = (flat[:, :2] / flat[:, 2:]).reshape(-1, 4, 2)
    orders = [np.roll(q, -k, axis=1) for q in (quads, quads[:, ::-1]) for k in range(4)]
    errors = [float(np.median(np.linalg.norm(order - expected, axis=2))) for order in orders]
    side = float(np.median(np.linalg.norm(quads[:, 0] - quads[:, 1], axis=1)))
    if min(errors) > 0.25 * side:
        return Failed("no-board", "the tags don't lie as on this AprilGrid (another board or another size)")
    return orders[int(np.argmin(errors))]


def _refine(image: UInt8, quads: Float64) -> Float64:
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min()
    half = int(np.clip(0.1 * side, 1, 5))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    start = quads.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), criteria)
    near = np.linalg.norm(refined - start, axis=2) < half + 1
    return np.where(near[:, :, None], refined, start).astype(np.float64).reshape(quads.shape)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    spelt = {key.upper(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    if name.upper() not in spelt:
        raise ConfigError(f"{name!r} is not a marker dictionary; known are {', '.join(sorted(spelt))}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spelt[name.upper()]))
