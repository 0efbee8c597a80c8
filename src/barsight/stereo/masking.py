"""Mask what must not enter a map: guesses; gaps between bars that are too dark to be matched themselves; and
bars along the rows that are matched only in pieces.

A gully whose floor neither camera sees is a black stripe between two edges of the same surface. It matches
perfectly at that surface's disparity, since both edges do, but nothing is there.

Where bars lie along the rows, as the baseline does, little distinguishes one place of a bar from the next. On
shiny steel it is mostly a lamp's highlight, which has no fixed position: it matches half a metre off in one
piece and not at all in the next, and no other view contradicts it since the highlight moves with the crane.
The sigma of such a match is no guide, but the holes beside it are: a true surface is matched all along its
bars. So is the floor beside them, but in a flank's shadow only in places; what is dark there, and lies at one
disparity, is no highlight.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8, kernel
from barsight.core.records.disparity import Disparity

_AROUND_PX = 41
_BLUR_PX = 0.7
_COARSE_PX = 4
_STREAKS = 11, 3
_BUNDLE = 41, 9
"""Sizes in coarse pixels, along the rows and across: of the window in which streaks are detected, and of the
patch of streaks that a bundle must contain; no edge, beam or row of bars' ends fills it.
"""
_ALONG_PX = 81, 3
"""Size of the window in which the share of matched pixels is computed."""
_MAX_SLOPE_RATIO = 0.35
"""Maximum ratio of the power of the gray gradient along the rows to that across them where there are only
streaks.
"""
_MIN_MATCHED_RATIO = 0.85
_BESIDE_PX, _MAX_SCATTER_PX = (41, 3), 0.3
"""Size of the window in which matches scatter, and maximum standard deviation of those of one surface."""
_MAX_DULL_RATIO = 0.8
"""Maximum ratio of the brightness of what is no highlight to that of all bars along the rows."""


def gap_mask(image: UInt8, darkness: float) -> Bool:
    """Mark pixels (H, W) whose 3 x 3 mean is darker than `darkness` times the mean of the 41 x 41 pixels
    around them.
    """
    own = cv2.blur(image, (3, 3))
    around = cv2.blur(image, (_AROUND_PX, _AROUND_PX))
    dark: Bool = own < darkness * around.astype(np.float32)
    return dark


def mask_gaps(disparity: Disparity, image: UInt8, darkness: float) -> Disparity:
    """Mask gaps; a darkness of 0 leaves the disparity as it is."""
    if darkness <= 0:
        return disparity
    return mask_disparity(disparity, ~gap_mask(image, darkness))


def mask_pieces(disparity: Disparity, image: UInt8) -> Disparity:
    """Mask bars along the rows where less than 85 % of the pixels along them are matched, unless these are
    dark and lie at one disparity.
    """
    streaks = streak_mask(image)
    if not streaks.any():
        return disparity
    known = np.isfinite(disparity.disparity_px)
    matched = cv2.boxFilter(known.view(np.uint8), cv2.CV_32F, _ALONG_PX)
    pieces = streaks & known & (matched < _MIN_MATCHED_RATIO)
    if not pieces.any():
        return disparity
    dull = cv2.blur(image, (3, 3)) < _MAX_DULL_RATIO * image[streaks].mean()
    level = _scatter_px(disparity.disparity_px, known) <= _MAX_SCATTER_PX
    return mask_disparity(disparity, ~pieces | (dull & level))


def _scatter_px(disparity: Float32, known: Bool) -> Float32:
    """Compute the standard deviation (H, W), px, of the known disparities in windows along the rows."""
    # Without their common part the squares keep their digits.
    off = np.where(known, disparity - disparity[known].mean(), np.float32(0))
    share, mean, square = (
        cv2.boxFilter(values, cv2.CV_32F, _BESIDE_PX) for values in (known.astype(np.float32), off, off * off)
    )
    np.maximum(share, np.float32(1e-3), out=share)
    mean /= share
    scatter: Float32 = np.sqrt(np.maximum(square / share - mean * mean, np.float32(0)))
    return scatter


def streak_mask(image: UInt8) -> Bool:
    """Mark bars along the rows (H, W): regions where gray values change across the rows and hardly along
    them, connected to a patch as large as a bundle.
    """
    height, width = image.shape
    small = height // _COARSE_PX, width // _COARSE_PX
    marked = np.zeros(image.shape, np.bool_)
    if min(small) == 0:
        return marked
    excess = np.empty(image.shape, np.float32)
    _note_slopes(cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX), excess)
    whole = tuple(slice(count * _COARSE_PX) for count in small)
    coarse = cv2.resize(excess[whole], small[::-1], interpolation=cv2.INTER_AREA)
    streaks = (cv2.boxFilter(coarse, -1, _STREAKS) < 0).view(np.uint8)
    patches = cv2.morphologyEx(streaks, cv2.MORPH_OPEN, np.ones(_BUNDLE[::-1], np.uint8))
    count, piece = cv2.connectedComponents(streaks, connectivity=4)
    kept = np.zeros(count, np.bool_)
    kept[piece[patches > 0]] = True
    marked[whole] = kept[piece].repeat(_COARSE_PX, axis=0).repeat(_COARSE_PX, axis=1)
    return marked


@kernel()
def _note_slopes(gray: Float32, excess: Float32) -> None:
    """Compute excess (H, W): the squared slope along the row minus _MAX_SLOPE_RATIO times that across it;
    0 at the border.
    """
    ratio = np.float32(_MAX_SLOPE_RATIO)
    excess[:] = 0
    for y in range(1, gray.shape[0] - 1):
        above, here, below, out = gray[y - 1], gray[y], gray[y + 1], excess[y]
        for x in range(1, gray.shape[1] - 1):
            along, across = here[x + 1] - here[x - 1], below[x] - above[x]
            out[x] = along * along - ratio * across * across


def mask_unsure(disparity: Disparity, max_sigma_px: float) -> Disparity:
    """Mask disparities whose sigma exceeds max_sigma_px, which includes guesses."""
    return mask_disparity(disparity, disparity.sigma_px <= max_sigma_px)


def mask_disparity(disparity: Disparity, kept: Bool) -> Disparity:
    """Mask everything that is not `kept` (H, W)."""
    return replace(
        disparity,
        disparity_px=mask_values(disparity.disparity_px, kept),
        sigma_px=mask_values(disparity.sigma_px, kept),
    )


def mask_values(values: Float32, kept: Bool) -> Float32:
    """Set values (H, W) that aren't `kept` to NaN, three times as fast as `np.where`."""
    masked = np.empty(values.shape, np.float32)
    _mask(np.ascontiguousarray(values), kept, masked)
    return masked


@kernel()
def _mask(values: Float32, kept: Bool, masked: Float32) -> None:
    """Fill masked (H, W) with values, NaN where not kept."""
    for i in range(values.shape[0]):
        row, held, out = values[i], kept[i], masked[i]
        for j in range(len(row)):
            out[j] = row[j] if held[j] else np.float32(np.nan)
