"""Tell unseen places that may hide what stands from those that are too narrow to."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, UInt8


def wide_parts(unseen: Bool | UInt8, cells: int) -> UInt8:
    """Keep the parts (V, U) of what is not seen, 1 or 0, that a square of so many cells fits into."""
    square = np.ones((cells, cells), np.uint8)
    # OpenCV's own opening moves everything by a cell where a square has no middle cell.
    fits = cv2.erode(unseen.astype(np.uint8), square)
    return np.asarray(cv2.dilate(fits, square, anchor=((cells - 1) // 2,) * 2), np.uint8)
