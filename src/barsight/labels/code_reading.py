"""Read 1D and 2D codes in a picture with zxing-cpp."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float64, UInt8
from barsight.core.extras import extra

KINDS = ("DataMatrix", "QRCode", "MicroQRCode", "Aztec", "PDF417", "Code128", "Code93")
"""Kinds of code with a built-in check. Code39 and ITF have none, so noise can be read as one."""
MAX_TEXT = 200
ENLARGED = 2
"""Scale by which pictures are enlarged before reading, so that small modules are recognised."""


@dataclass(frozen=True, eq=False)
class SeenCode:
    """A code in one picture. kind: one of `KINDS`. corners_px: (4, 2), starting at its own upper left."""

    text: str
    kind: str
    corners_px: Float64

    @property
    def middle_px(self) -> Float64:
        """Return the middle (2,) of its corners."""
        middle: Float64 = self.corners_px.mean(axis=0)
        return middle


def read_codes(image: UInt8) -> tuple[SeenCode, ...]:
    """Read all codes of a gray picture (H, W) that pass their check and whose text is printable."""
    with extra("labels"):
        import zxingcpp

    formats = [getattr(zxingcpp.BarcodeFormat, kind) for kind in KINDS]
    large = cv2.resize(image, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
    found = []
    for code in zxingcpp.read_barcodes(large, formats, try_downscale=False):
        text, at = code.text, code.position
        if not code.valid or not 0 < len(text) <= MAX_TEXT or not text.isprintable():
            continue
        corners = [[c.x, c.y] for c in (at.top_left, at.top_right, at.bottom_right, at.bottom_left)]
        places = (np.array(corners, dtype=np.float64) + 0.5) / ENLARGED - 0.5
        found.append(SeenCode(text, code.format.name, places))
    return tuple(found)
