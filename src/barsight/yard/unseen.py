"""Distinguish unseen places that may hide an obstacle from those that are too narrow to."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, UInt8


def wide_parts(unseen: Bool | UInt8, cells: int) -> UInt8:
    """Keep the parts (V, U) of the unseen cells, 1 or 0, into which a square of this many cells fits."""
    square = np.ones((cells, cells), np.uint8)
    # OpenCV's own opening shifts everything by a cell where a square has no middle cell.
    fits = cv2.erode(unseen.astype(np.uint8), square)
    return np.asarray(cv2.dilate(fits, square, anchor=((cells - 1) // 2,) * 2), np.uint8)
