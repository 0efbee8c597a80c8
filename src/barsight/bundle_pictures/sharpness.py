"""Tell whether a picture is sharp enough for the pitch of its bars: blur looks like thicker bars."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import UInt8

_STRIDE = 4
"""Every such row and column is looked at."""
_MIN_CONTRAST, _REACH_PX = 50, 8
"""Gray levels between both sides of an edge, and pixels over which it may rise."""
_MIN_EDGES, _SHARPEST = 100, 0.05
"""Edges that are needed, and the quantile of their widths that is the picture's."""
_MAX_EDGE_PX = 1.65
"""Sharp pictures, drawn and path traced, have edges of 1.0 to 1.62 px both ways; a blur of 1 px (one sigma)
makes them 1.68 or more, of 0.7 px mostly, motion of 4 px 1.7 or more along it."""


def is_sharp(picture: UInt8) -> bool:
    """Check that the edges of a picture (H, W) are narrow along its rows and its columns."""
    rows, columns = picture[::_STRIDE], np.ascontiguousarray(picture[:, ::_STRIDE].T)
    return all(sharpest_edge_width(lines) <= _MAX_EDGE_PX for lines in (rows, columns))


def sharpest_edge_width(lines: UInt8) -> float:
    """Compute the width of the sharpest edges along lines (N, W), contrast over slope, px; NaN where too few
    are seen.
    """
    steps = cv2.absdiff(lines[:, 1:], lines[:, :-1])
    around = np.ones((1, _REACH_PX), np.uint8)
    contrast = cv2.subtract(cv2.dilate(lines, around), cv2.erode(lines, around))[:, :-1]
    steepest = cv2.dilate(steps, np.ones((1, _REACH_PX - 1), np.uint8))
    edges = (contrast > _MIN_CONTRAST) & (steps == steepest) & (steps > 0)
    if np.count_nonzero(edges) < _MIN_EDGES:
        return float("nan")
    return float(np.quantile(contrast[edges] / steepest[edges].astype(np.float32), _SHARPEST))
