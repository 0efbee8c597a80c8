"""Read plain numbers on labels with Tesseract."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64, UInt8
from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.labels.placing import PlacedCamera

DIGITS, TURNABLE, MIN_DIGITS = "0123456789", set("01689"), 3
"""TURNABLE: digits that are digits upside down too; a number made only of these is ambiguous. MIN_DIGITS:
minimum length of a number; a shorter run of strokes is too often something else.
"""
MIN_CONFIDENCE = 90
"""Minimum confidence of a number, in percent, as reported by Tesseract."""
AROUND_RATIO = 1.8
"""Ratio of the patch's side to the label's longer side."""
MIN_LABEL_PX = 80.0
"""Minimum length of a label in the picture for its digits to be readable."""
PATCH_PX, HEIGHT_PX, MARGIN_PX = 360, 72, 14
"""Side of a patch, height of the label image given to Tesseract, and width of the white margin around it."""
MAX_SIDE_RATIO, MIN_FULL_RATIO = 1.25, 0.85
"""Maximum ratio between a label's sides and the stated ones, either way; minimum share of its rectangle
that is bright.
"""
INNER_RATIO = 0.05
"""Margin cut off inside the label's edge so that no bar shows, as a share of its sides."""
FOLDERS = (
    "/usr/share/tesseract-ocr",
    "/usr/share/tessdata",
    "/usr/local/share/tessdata",
    "/opt/homebrew/share",
)


def data_folder() -> Path:
    """Find the folder of Tesseract's English data; raises ConfigError where there is none."""
    named = os.environ.get("TESSDATA_PREFIX")
    for folder in map(Path, (named,) if named else FOLDERS):
        for found in sorted(folder.glob("**/eng.traineddata")):
            return found.parent
    raise ConfigError(
        "labels.numbers needs Tesseract's English data (eng.traineddata; Debian's tesseract-ocr-eng); "
        "install it, or name its folder in TESSDATA_PREFIX"
    )


@contextmanager
def number_reader() -> Iterator[Any]:
    """Open Tesseract for single lines of digits; raises ConfigError without it or its data."""
    with extra("numbers"):
        import tesserocr
    with tesserocr.PyTessBaseAPI(
        path=str(data_folder()), lang="eng", psm=tesserocr.PSM.SINGLE_LINE, oem=tesserocr.OEM.LSTM_ONLY
    ) as reader:
        reader.SetVariable("tessedit_char_whitelist", DIGITS)
        yield reader


def read_number(reader: Any, patch: UInt8, size_ratio: float) -> str | None:
    """Read the number on the label in the middle of a patch (S, S); None if none is certain.

    size_ratio: width of the label over its length. A number that can be read upside down, such as 1689, is
    uncertain.
    """
    label = cut_label(patch, size_ratio)
    if label is None:
        return None
    both_ways = (_read_line(reader, image) for image in (label, label[::-1, ::-1]))
    found = [text for text in both_ways if text is not None]
    return found[0] if len(found) == 1 and not set(found[0]) <= TURNABLE else None


def _read_line(reader: Any, image: UInt8) -> str | None:
    scale = HEIGHT_PX / image.shape[0]
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    white = int(np.quantile(large, 0.9))
    large = np.pad(large, MARGIN_PX, constant_values=white)
    height, width = large.shape
    reader.SetImageBytes(np.ascontiguousarray(large).tobytes(), width, height, 1, width)
    text, sure = reader.GetUTF8Text().strip(), min(reader.AllWordConfidences(), default=0)
    return text if text.isdigit() and len(text) >= MIN_DIGITS and sure >= MIN_CONFIDENCE else None


def cut_label(patch: UInt8, size_ratio: float) -> UInt8 | None:
    """Cut the label out of the middle of a patch (S, S), with its longer side horizontal; None if nothing
    bright there has a label's size.

    Bars may be nearly as bright as the label: of several thresholds, the one that best shows a label's shape
    is used.
    """
    smooth = cv2.GaussianBlur(patch, (0, 0), 2)
    levels = np.linspace(np.quantile(smooth, 0.3), np.quantile(smooth, 0.98), 12)
    fullest, best = MIN_FULL_RATIO, None
    for level in levels:
        rectangle, full = _bright_rectangle(smooth > level, size_ratio)
        if full > fullest:
            fullest, best = full, rectangle
    if best is None:
        return None
    middle, sides, angle = best
    if sides[0] < sides[1]:
        sides, angle = sides[::-1], angle + 90
    level_patch = cv2.warpAffine(
        patch, cv2.getRotationMatrix2D(middle, angle, 1.0), patch.shape[::-1], flags=cv2.INTER_CUBIC
    )
    half = (0.5 - INNER_RATIO) * np.array(sides)
    (left, top), (right, bottom) = (np.array(middle) + way * half for way in (-1, 1))
    cut: UInt8 = level_patch[round(top) : round(bottom), round(left) : round(right)]
    return cut


def _bright_rectangle(bright: Bool, size_ratio: float) -> tuple[Any, float]:
    """Find the smallest rectangle around the bright region in the middle, and the share of it that is
    filled; 0 if it doesn't have a label's size.
    """
    side = bright.shape[0]
    opened = cv2.morphologyEx(bright.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side // 40,) * 2, np.uint8))
    outlines, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        if cv2.pointPolygonTest(outline, (side / 2, side / 2), measureDist=False) >= 0:
            rectangle = cv2.minAreaRect(outline)
            sides = np.sort(rectangle[1])[::-1] * AROUND_RATIO / side / (1.0, size_ratio)
            if (sides > 1 / MAX_SIDE_RATIO).all() and (sides < MAX_SIDE_RATIO).all():
                return rectangle, cv2.contourArea(outline) / float(np.prod(rectangle[1]))
    return None, 0.0


def label_patch(
    image: UInt8, camera: PlacedCamera, place_m: Float64, size_m: tuple[float, float]
) -> UInt8 | None:
    """Cut a square patch around a position (3,) of the map out of a rectified picture; None if it isn't
    fully in view or a label would be too small there.
    """
    middle, depth = camera.project(place_m)
    if depth <= 0:
        return None
    length_px = camera.focal_px * max(size_m) / depth
    half = AROUND_RATIO * length_px / 2
    height, width = image.shape
    if (
        length_px < MIN_LABEL_PX
        or (middle - half < 0).any()
        or (middle + half > (width - 1, height - 1)).any()
    ):
        return None
    scale = PATCH_PX / (2 * half)
    at = np.array([[scale, 0, scale * (half - middle[0])], [0, scale, scale * (half - middle[1])]])
    patch: UInt8 = cv2.warpAffine(image, at, (PATCH_PX, PATCH_PX), flags=cv2.INTER_CUBIC)
    return patch
