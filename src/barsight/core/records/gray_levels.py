"""Convert pictures of other kinds to (H, W) uint8 gray.

Colour becomes gray with the weights 0.299 R + 0.587 G + 0.114 B [ITU-R BT.601]; 16 bits become 8 by the same
fixed scale for every frame (65535 -> 255), so that brightness stays comparable along a recording.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import UInt8

MIN_BRIGHTEST = 1 << 14
"""Minimum of the brightest value of a 16-bit picture; a lower one is that of a camera with 10, 12 or 14 bits,
unscaled, or of a dark picture.
"""
MIN_DARK, DARK_STEP, DARK_LEVELS = 1 << 12, 16, 8
"""Minimum of the brightest value of a dark picture, minimum difference between its neighbouring levels, which
one of 12 bits or fewer has when it is scaled to all 16, and minimum number of its levels.
"""
_NARROWED = ((np.arange(1 << 16) + 128) // 257).astype(np.uint8)
"""Lookup table from 16-bit to 8-bit values."""


class TornImageError(ValueError):
    """A picture that can't be used; the text gives the reason, without the file's name."""


def to_gray(image: NDArray[Any]) -> UInt8:
    """Convert (H, W), (H, W, 3) BGR or (H, W, 4) BGRA, 8 or 16 bits, to (H, W) uint8.

    Raises `TornImageError` for other kinds, for masked pixels, and for 16-bit pictures that use only the
    lower 14 bits or fewer, unless their levels show that they were scaled: others would be too dark.
    """
    if np.ma.is_masked(image):
        raise TornImageError("has masked pixels, which would be matched: fill them")
    image = np.asarray(image)
    if image.ndim not in (2, 3):
        raise TornImageError(f"has the shape {image.shape}; (H, W) or (H, W, 3) is needed")
    image = eight_bits(image)
    if image.ndim == 3:
        if image.shape[2] == 1:
            image = image[:, :, 0]
        elif image.shape[2] in (3, 4):
            code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
            image = cv2.cvtColor(image, code)
        else:
            raise TornImageError(f"has {image.shape[2]} channels; 1, 3 or 4 are needed")
    return np.ascontiguousarray(image, dtype=np.uint8)


def split_colour(image: NDArray[Any]) -> tuple[UInt8, UInt8 | None]:
    """Convert to gray and to (H, W, 3) uint8 BGR, None if the picture contains only gray values."""
    gray = to_gray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        return gray, None
    colour = np.ascontiguousarray(eight_bits(image)[:, :, :3])
    return gray, colour if (colour != colour[:, :, :1]).any() else None


def eight_bits(image: NDArray[Any]) -> UInt8:
    """Convert 16 bits to 8. Raises `TornImageError` as `to_gray` does."""
    if image.dtype.newbyteorder("=") == np.uint16:
        brightest = int(image.max(initial=0))
        if 0 < brightest < MIN_BRIGHTEST and not _is_dark(image, brightest):
            problem = f"is a 16-bit picture whose brightest value is {brightest}"
            raise TornImageError(f"{problem}: scale it to the full 16 bits, or to 8")
        narrow = np.empty(image.shape, np.uint8)
        for row, wide in zip(narrow, image, strict=True):
            row[:] = _NARROWED[wide]
        return narrow
    if image.dtype != np.uint8:
        raise TornImageError(f"has {image.dtype} pixels; 8 or 16 bits are needed")
    return np.asarray(image, dtype=np.uint8)


def _is_dark(image: NDArray[np.uint16], brightest: int) -> bool:
    """Check whether a 16-bit picture without bright values was scaled to all 16 bits, so that it leaves
    levels out.
    """
    if brightest < MIN_DARK:
        return False
    levels = np.flatnonzero(np.bincount(image.ravel()))
    return levels.size >= DARK_LEVELS and int(np.diff(levels).min()) >= DARK_STEP
