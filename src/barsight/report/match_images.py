"""Draw matches on pictures as in the paper's figures 5, 8 and 9: features, raw and filtered, guided."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64, UInt8
from barsight.features.guided_matching import GATE_SIGMAS
from barsight.motion.frontend.matching_example import MatchingExample
from barsight.report.map_images import data_uri
from barsight.report.plots import Picture

MAX_SIDE_PX = 1280
"""Maximum length of a picture's longer side."""
ZOOM, CROP_PX = 4, (200, 320)
"""Magnification of the enlarged picture, and the part that it shows: height and width."""
GREEN, RED, ORANGE, BLUE = (57, 211, 83), (255, 90, 79), (242, 177, 52), (96, 190, 255)
SHIFT = 4
"""Number of fractional bits of OpenCV's drawing coordinates: 16ths of a pixel."""


def draw_matches(example: MatchingExample) -> tuple[Picture, ...]:
    """Draw features, raw and filtered matches, guided matches in full and enlarged."""
    scale = min(1.0, MAX_SIDE_PX / max(example.old.shape))
    wrong = ~example.filtered
    agreed, lost = example.agreed, ~example.agreed & np.isfinite(example.found).all(axis=1)
    source = "encoders and gyro" if example.by_sensors else "the pictures themselves"
    return (
        Picture(
            "features", "Features",
            f"{len(example.features)} ORB features (blue) and {len(example.followed)} corners that are "
            "followed (green), both spread over the picture's cells.", _features(example, scale),
        ),
        Picture(
            "raw", "Raw matches",
            f"Each feature's nearest descriptor in the next frame, {len(example.raw)} of them, as a line "
            "from the old place to the new one.",
            _lines(example.new, example.raw, [(np.ones(len(wrong), np.bool_), ORANGE)], scale),
        ),
        Picture(
            "filtered", "Filtered matches",
            f"Of these the {int(example.filtered.sum())} that are mutual and lie on one homography.",
            _lines(example.new, example.raw, [(example.filtered, GREEN)], scale),
        ),
        Picture(
            "guided", "Guided matches",
            f"Where {source} say that the corners must be: ellipses of {GATE_SIGMAS:g} sigma. "
            f"{int(agreed.sum())} are found in theirs and agree on one motion (green), {int(lost.sum())} "
            f"are found but disagree (red), {int(example.ambiguous.sum())} are refused since the ellipse "
            "reaches to what looks alike (orange).",
            _guided(example, scale, (0, 0), example.new.shape),
        ),
        Picture(
            "enlarged", "Enlarged", f"The same, {ZOOM} times enlarged where most are.", _enlarged(example),
        ),
    )  # fmt: skip


def _features(example: MatchingExample, scale: float) -> str:
    canvas = canvas_of(example.old, scale)
    for x, y in example.features * scale:
        _circle(canvas, x, y, 2.5, BLUE)
    for x, y in example.followed * scale:
        _circle(canvas, x, y, 3.5, GREEN)
    return _uri(canvas)


def _lines(
    image: UInt8, pairs: Float64, groups: list[tuple[Bool, tuple[int, int, int]]], scale: float
) -> str:
    canvas = canvas_of(image, scale)
    for shown, colour in groups:
        for x0, y0, x1, y1 in pairs[shown] * scale:
            cv2.line(canvas, _at(x0, y0), _at(x1, y1), colour, 1, cv2.LINE_AA, SHIFT)
            _circle(canvas, x1, y1, 1.5, colour)
    return _uri(canvas)


def _guided(example: MatchingExample, scale: float, corner: tuple[int, int], shape: tuple[int, ...]) -> str:
    top, left = corner
    canvas = canvas_of(example.new[top : top + shape[0], left : left + shape[1]], scale)
    found = np.atleast_1d(np.isfinite(example.found).all(axis=1))
    for k in np.flatnonzero(np.isfinite(example.predicted).all(axis=1)):
        x, y = (example.predicted[k] - (left, top)) * scale
        if not (0 <= x < canvas.shape[1] and 0 <= y < canvas.shape[0]):
            continue
        sizes, axes = np.linalg.eigh(example.covariance[k])
        half = GATE_SIGMAS * scale * np.sqrt(np.maximum(sizes, 0))
        angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
        colour = ORANGE if example.ambiguous[k] else BLUE
        reach = (round(half[1] * 2**SHIFT), round(half[0] * 2**SHIFT))
        cv2.ellipse(canvas, _at(x, y), reach, angle, 0, 360, colour, 1, cv2.LINE_AA, SHIFT)
        if found[k]:
            u, v = (example.found[k] - (left, top)) * scale
            _circle(canvas, u, v, 1.8, GREEN if example.agreed[k] else RED)
    return _uri(canvas)


def _enlarged(example: MatchingExample) -> str:
    """Find the window of the new picture with the most agreed points."""
    shown = example.found[example.agreed]
    best, most = (0, 0), -1
    height, width = CROP_PX
    for top in range(0, max(1, example.new.shape[0] - height), height // 4):
        for left in range(0, max(1, example.new.shape[1] - width), width // 4):
            inside = (shown >= (left, top)).all(axis=1) & (shown < (left + width, top + height)).all(axis=1)
            if inside.sum() > most:
                best, most = (top, left), int(inside.sum())
    return _guided(example, ZOOM, best, CROP_PX)


def canvas_of(image: UInt8, scale: float) -> UInt8:
    """Stretch the contrast of a gray picture (H, W) to (h, w, 3), slightly darkened to show lines."""
    low, high = np.percentile(image, (1, 99.5))
    light = np.clip((image - low) * (215 / max(high - low, 1.0)), 0, 230).astype(np.uint8)
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    sized = light if scale == 1 else cv2.resize(light, None, fx=scale, fy=scale, interpolation=interpolation)
    return np.ascontiguousarray(np.dstack([sized] * 3))


def _at(x: float, y: float) -> tuple[int, int]:
    return round(x * 2**SHIFT), round(y * 2**SHIFT)


def _circle(canvas: UInt8, x: float, y: float, radius: float, colour: tuple[int, int, int]) -> None:
    cv2.circle(canvas, _at(x, y), round(radius * 2**SHIFT), colour, 1, cv2.LINE_AA, SHIFT)


def _uri(canvas: UInt8) -> str:
    opaque = np.full((*canvas.shape[:2], 1), 255, np.uint8)
    return data_uri(np.dstack([canvas, opaque]), lossless=False)
