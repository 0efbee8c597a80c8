"""Measure pitch, roll and focal ratio between the cameras from the rows of matches.

A point of the scene lies on the same row in both pictures of a rectified pair, at any depth. Where it
doesn't, the right camera has turned or zoomed: at x, y (right picture, in focal lengths) the row is off by
f (pitch (1 + y^2) - roll x + ratio y - yaw x y).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, RefusedFrame
from barsight.features.patch_alignment import align_patches, patch_image
from barsight.features.tracks import TrackSettings, detect_corners
from barsight.recording.base import Recording
from barsight.stereo.search_range import coarse_disparity

COLUMNS, ROWS = 8, 6
MIN_IN_CELL = 8
MIN_CELLS = 12
TRIM_SIGMAS = 4.0
MATCHING_BIAS_PX = 0.015
"""Row error common to the whole picture that matching itself causes (1 sigma)."""
MIN_SIGMA_PX = 0.002
"""Lower bound of a cell mean's sigma, however many matches the cell has."""


@dataclass(frozen=True, eq=False)
class RowDrift:
    """values: (4,) pitch, roll (rad), ratio of the focal lengths minus 1, yaw (rad): turn and zoom of cam1
    against its calibration, in rectified axes. covariance: (4, 4). pattern_px: standard deviation over the
    picture of what these leave unexplained, noise subtracted. matches, frames: their numbers. rms_px: of
    single matches. seen_px, left_px: (ROWS * COLUMNS,) mean row error of the picture's cells, as matched and
    after the fit; NaN where matches are few.
    """

    values: Float64
    covariance: Float64
    pattern_px: float
    rms_px: float
    matches: int
    frames: int
    seen_px: Float64
    left_px: Float64

    @property
    def sigmas(self) -> Float64:
        """Return the standard deviations (4,) of the values."""
        return np.sqrt(np.diag(self.covariance))


def measure_row_drift(recording: Recording, rectifier: Rectifier, max_frames: int) -> RowDrift | Failed:
    """Fit the rows of corners matched in at most `max_frames` pairs, evenly spread over the recording."""
    total = len(recording.index.stamps_ns)
    chosen = set(np.linspace(0, total - 1, min(max_frames, total)).astype(int).tolist())
    found = []
    for number, frame in enumerate(recording.frames()):
        if number not in chosen or isinstance(frame, RefusedFrame):
            continue
        pair = rectifier(frame)
        if isinstance(pair, Failed):
            return pair
        found.append(match_off_rows(pair))
    if not found:
        return Failed("no-frames", "no pair can be read")
    return fit_rows(np.vstack(found), rectifier.camera, len(found))


def match_off_rows(pair: RectifiedPair) -> Float64:
    """Match corners within a few rows of each other; return right u, right v (px) and right v minus left v
    (N, 3).
    """
    corners = detect_corners(pair.left, TrackSettings(), np.empty((0, 2))).astype(np.float64)
    coarse = coarse_disparity(pair.left, pair.right, pair.camera.doffs_px)
    row = (corners[:, 1] * coarse.shape[0] / pair.camera.height).astype(int)
    column = (corners[:, 0] * coarse.shape[1] / pair.camera.width).astype(int)
    guess = coarse[row, column].astype(np.float64)
    places, guess = corners[np.isfinite(guess)], guess[np.isfinite(guess)]
    start = places - np.column_stack([guess, np.zeros_like(guess)])
    right = align_patches(patch_image(pair.left), patch_image(pair.right), places, start)
    off = right.pixels[:, 1] - places[:, 1]
    matches: Float64 = np.column_stack([right.pixels, off])[right.found]
    return matches


def fit_rows(matches: Float64, camera: RectifiedCamera, frames: int) -> RowDrift | Failed:
    """Fit the drift to matches (N, 3) from `match_off_rows`.

    Matches are first averaged over the cells of a grid. The error of a cell's mean has a noise part and a
    part that more matches don't average out (lens, texture), estimated from the cells' scatter in excess of
    their noise [DerSimonian & Laird 1986]. Failed `few-matches`.
    """
    design = _design(matches, camera)
    kept = np.ones(len(matches), np.bool_)
    values = np.zeros(4)
    for _ in range(5):
        if kept.sum() < MIN_CELLS * MIN_IN_CELL:
            return Failed("few-matches", f"only {int(kept.sum())} corners match between left and right")
        values = np.linalg.lstsq(design[kept], matches[kept, 2], rcond=None)[0]
        off = matches[:, 2] - design @ values
        middle = float(np.median(off[kept]))
        spread = mad_sigma(off[kept] - middle)
        kept = np.abs(off - middle) < TRIM_SIGMAS * max(spread, 0.01)
    cells, rows, means, variances = _cells(matches[kept], design[kept], camera)
    if len(means) < MIN_CELLS:
        return Failed(
            "few-matches", f"matches fill only {len(means)} of {COLUMNS * ROWS} parts of the picture"
        )
    pattern = 0.0
    for _ in range(30):
        weight = 1 / (variances + pattern)
        covariance = np.asarray(np.linalg.inv((rows * weight[:, None]).T @ rows), np.float64)
        values = covariance @ (rows.T @ (weight * means))
        excess = float((weight * (means - rows @ values) ** 2).sum()) / (len(means) - 4)
        if excess <= 1 and pattern == 0:
            break
        # Find the scatter for which chi2 equals its degrees of freedom.
        pattern = max(0.0, pattern + (excess - 1) / float(weight.mean()))
    covariance[0, 0] += (MATCHING_BIAS_PX / camera.focal_px) ** 2
    rms = float(np.sqrt(((matches[kept, 2] - design[kept] @ values) ** 2).mean()))
    seen, left = np.full((2, COLUMNS * ROWS), np.nan)
    seen[cells], left[cells] = means, means - rows @ values
    return RowDrift(values, covariance, float(pattern**0.5), rms, int(kept.sum()), frames, seen, left)


def _design(matches: Float64, camera: RectifiedCamera) -> Float64:
    """Compute the design matrix (N, 4) in px per unit of pitch, roll, focal ratio and yaw."""
    f = camera.focal_px
    x = (matches[:, 0] - camera.cx_px - camera.doffs_px) / f
    y = (matches[:, 1] - camera.cy_px) / f
    return f * row_design(x, y)


def row_design(x: Float64, y: Float64) -> Float64:
    """Compute the derivatives (N, 4) of the row by pitch, roll, focal ratio and yaw at points of the right
    picture, all in focal lengths.
    """
    return np.column_stack([1 + y**2, -x, y, -x * y])


def _cells(
    matches: Float64, design: Float64, camera: RectifiedCamera
) -> tuple[list[int], Float64, Float64, Float64]:
    """Average matches by cell: the cells, design (C, 4), mean (C,) and the mean's variance (C,)."""
    column = np.clip(matches[:, 0] * COLUMNS / camera.width, 0, COLUMNS - 1).astype(int)
    row = np.clip(matches[:, 1] * ROWS / camera.height, 0, ROWS - 1).astype(int)
    cells, rows, means, variances = [], [], [], []
    for cell in range(COLUMNS * ROWS):
        inside = row * COLUMNS + column == cell
        if (count := int(inside.sum())) >= MIN_IN_CELL:
            cells.append(cell)
            rows.append(design[inside].mean(0))
            means.append(matches[inside, 2].mean())
            variances.append(matches[inside, 2].var(ddof=1) / count + MIN_SIGMA_PX**2)
    return cells, np.array(rows).reshape(-1, 4), np.array(means), np.array(variances)
