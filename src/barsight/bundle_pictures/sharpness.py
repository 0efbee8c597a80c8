"""Check that a picture is sharp enough to measure the pitch of its bars: blur makes bars look thicker."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import UInt8

_STRIDE = 4
"""Stride of the rows and columns that are examined."""
_MIN_CONTRAST, _REACH_PX = 50, 8
"""Minimum difference in gray level between the two sides of an edge, and maximum number of pixels of its
rise.
"""
_MIN_EDGES, _SHARPEST = 100, 0.05
"""Minimum number of edges, and the quantile of their widths that stands for the picture."""
_MAX_EDGE_PX = 1.65
"""Maximum edge width of a sharp picture. Sharp pictures, drawn and path traced, have 1.0 to 1.62 px both
ways; a blur of 1 px (one sigma) gives 1.68 or more, of 0.7 px mostly, motion blur of 4 px 1.7 or more along
it.
"""


def is_sharp(picture: UInt8) -> bool:
    """Check that the edges of a picture (H, W) are narrow both along its rows and along its columns."""
    rows, columns = picture[::_STRIDE], np.ascontiguousarray(picture[:, ::_STRIDE].T)
    return all(sharpest_edge_width(lines) <= _MAX_EDGE_PX for lines in (rows, columns))


def sharpest_edge_width(lines: UInt8) -> float:
    """Compute the width of the sharpest edges along lines (N, W), contrast over slope, px; NaN if there are
    too few edges.
    """
    steps = cv2.absdiff(lines[:, 1:], lines[:, :-1])
    around = np.ones((1, _REACH_PX), np.uint8)
    contrast = cv2.subtract(cv2.dilate(lines, around), cv2.erode(lines, around))[:, :-1]
    steepest = cv2.dilate(steps, np.ones((1, _REACH_PX - 1), np.uint8))
    edges = (contrast > _MIN_CONTRAST) & (steps == steepest) & (steps > 0)
    if np.count_nonzero(edges) < _MIN_EDGES:
        return float("nan")
    return float(np.quantile(contrast[edges] / steepest[edges].astype(np.float32), _SHARPEST))
