"""Find circular coded targets: a dark disc on white paper, surrounded by a coded ring [Schneider 1991].

The ring extends from 2 to 3 disc radii in twelve sectors, each white or dark, and the white paper to 4. A
target's number is the index of its code among all codes that differ by more than a rotation.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64, Int64, UInt8

SECTORS = 12
INNER, OUTER, PAPER = 2.0, 3.0, 4.0
"""Inner and outer radius of the ring and radius of the paper, in disc radii."""
MIN_RADIUS_PX = 2.5
MIN_CONTRAST = 25.0
"""Minimum contrast between the disc and the paper around it, in gray levels."""
WINDOWS = 11, 23, 51
"""Window sides (px) of the adaptive threshold that separates dark pixels."""
SAMPLES = 10
"""Number of samples along each sector of the ring."""
MIN_AGREE = 0.85
"""Minimum share of a sector's samples that must agree, not counting the samples at its two ends."""
RAYS = 64
MAX_OVAL = 1.15
"""Maximum ratio of the axes of a disc that counts as round; clutter next to a disc elongates its outline."""


@cache
def ring_codes() -> tuple[int, ...]:
    """List the codes, each as the smallest of its rotations. They have 4, 6 or 8 dark sectors, so a single
    misread sector never yields another code.
    """
    smallest = sorted({min(_rotated(code, by) for by in range(SECTORS)) for code in range(1 << SECTORS)})
    return tuple(code for code in smallest if code.bit_count() in (4, 6, 8))


def _rotated(code: int, by: int) -> int:
    return (code >> by | code << (SECTORS - by)) & ((1 << SECTORS) - 1)


def ring_pattern(number: int, cells: int = 240) -> UInt8:
    """Draw a target (cells, cells) up to the edge of its paper, 0 for dark."""
    code = ring_codes()[number]
    y, x = (np.indices((cells, cells)) + 0.5) * 2 * PAPER / cells - PAPER
    radius, sector = np.hypot(x, y), np.floor(np.arctan2(y, x) % (2 * np.pi) / (2 * np.pi) * SECTORS)
    coded = (code >> sector.astype(int)) & 1
    dark = (radius < 1) | ((radius >= INNER) & (radius < OUTER) & (coded == 1))
    return np.where(dark, 0, 255).astype(np.uint8)


def find_rings(image: UInt8) -> tuple[Int64, Float64]:
    """Find coded targets: numbers (N,) in ascending order and, for each, a square (N, 4, 2) around the disc
    centre.

    The centre is that of the ellipse fitted to the disc's edge, accurate to a few hundredths of a pixel. The
    true centre of a tilted disc differs from it by no more than its image size squared over the focal length.
    """
    found: dict[tuple[int, int], tuple[int, Float64]] = {}
    smooth = image.astype(np.float32)
    for seen in _dark_discs(image):
        number = _number(smooth, seen)
        if number is not None:
            middle, radius = seen[:2], float(np.sqrt(seen[2] * seen[3]))
            square = middle + radius * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            found.setdefault((round(middle[0] / 4), round(middle[1] / 4)), (number, square))
    ones = _without_doubles(sorted(found.values(), key=lambda one: one[0]))
    numbers = np.array([number for number, _ in ones], np.int64)
    return numbers, np.array([square for _, square in ones], np.float64).reshape(-1, 4, 2)


def nearest_disc(image: UInt8, pixel: Float64, reach_px: float) -> Float64 | None:
    """Find the round disc, dark on bright or bright on dark, whose centre is nearest to a pixel (2,). Returns
    centre and radius (3,) in px, or None where there is none within reach.
    """
    best, nearest = None, reach_px
    for gray in (image, 255 - image):
        for ellipse in _dark_discs(gray):
            away = float(np.linalg.norm(ellipse[:2] - pixel))
            if away < nearest and max(ellipse[2:4]) < MAX_OVAL * min(ellipse[2:4]):
                best, nearest = np.append(ellipse[:2], np.sqrt(ellipse[2] * ellipse[3])), away
    return best


def _dark_discs(image: UInt8) -> Iterator[Float64]:
    """Yield ellipses (5,) fitted to the edges of dark discs; some discs occur more than once."""
    smooth = image.astype(np.float32)
    for window in WINDOWS:
        dark = cv2.adaptiveThreshold(
            image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, MIN_CONTRAST / 5
        )
        for ellipse in _discs(dark):
            seen = _fitted(smooth, ellipse)
            if seen is not None:
                yield seen


def _without_doubles(ones: list[tuple[int, Float64]]) -> list[tuple[int, Float64]]:
    """Keep only one of several targets found within three pixels of each other."""
    kept: list[tuple[int, Float64]] = []
    for number, square in ones:
        if all(np.linalg.norm(square.mean(0) - other.mean(0)) > 3 for _, other in kept):
            kept.append((number, square))
    return kept


def _discs(dark: UInt8) -> list[Float64]:
    """List the ellipses (5,) of roughly elliptical dark spots: x, y, semi-axes (px) and rotation (rad)."""
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    out = []
    for contour in contours:
        if len(contour) < 8:
            continue
        (x, y), (a, b), turn = cv2.fitEllipse(contour)
        if min(a, b) / 2 < MIN_RADIUS_PX - 1 or max(a, b) > 2.5 * min(a, b):
            continue
        area = cv2.contourArea(contour)
        if abs(area - np.pi * a * b / 4) < 0.2 * np.pi * a * b / 4:
            out.append(np.array([x, y, a / 2 + 0.5, b / 2 + 0.5, np.radians(turn)]))
    return out


def _fitted(image: Float32, ellipse: Float64) -> Float64 | None:
    """Refit the ellipse to the points where the edge is halfway between dark and bright; None where it is not
    a dark disc on bright paper.
    """
    angles = np.arange(RAYS) * 2 * np.pi / RAYS
    for _ in range(2):
        if not (np.sqrt(ellipse[2] * ellipse[3]) >= MIN_RADIUS_PX and _inside(image, ellipse)):
            return None
        shares = np.linspace(0.4, 1.6, 49)
        gray = _sampled(image, ellipse, angles, shares)
        low, high = float(np.median(gray[:, :6])), float(np.median(gray[:, -6:]))
        if high - low < MIN_CONTRAST:
            return None
        above = gray > (low + high) / 2
        first = above.argmax(axis=1)
        if (first == 0).any():
            return None
        rows = np.arange(RAYS)
        under, over = gray[rows, first - 1], gray[rows, first]
        at = shares[first - 1] + (shares[1] - shares[0]) * ((low + high) / 2 - under) / (over - under)
        if at.std() > 0.15:
            return None
        edge = _places(ellipse, angles, at[:, None])[:, 0].astype(np.float32)
        (x, y), (a, b), turn = cv2.fitEllipseDirect(edge)
        ellipse = np.array([x, y, a / 2, b / 2, np.radians(turn)], np.float64)
    return ellipse


def _number(image: Float32, ellipse: Float64) -> int | None:
    """Read the target's number from the ring; None where there is no valid ring."""
    count = SECTORS * SAMPLES
    angles = (np.arange(count) + 0.5) * 2 * np.pi / count
    disc, gap, ring, paper = _sampled(image, ellipse, angles, np.array([0.3, 1.5, 2.5, 3.5])).T
    middle = (float(np.median(disc)) + float(np.median(gap))) / 2
    if (gap < middle).mean() > 0.05 or (paper < middle).mean() > 0.1:
        return None
    dark = ring < middle
    # Sector borders are where the most changes between dark and white are.
    changes = np.flatnonzero(dark != np.roll(dark, 1)) % SAMPLES
    if changes.size < 2:
        return None
    turns = np.exp(2j * np.pi * changes / SAMPLES).sum()
    begin = round(float(np.angle(turns)) * SAMPLES / (2 * np.pi)) % SAMPLES
    read = np.roll(dark, -begin).reshape(SECTORS, SAMPLES)[:, 1:-1].mean(axis=1)
    if (np.maximum(read, 1 - read) < MIN_AGREE).any():
        return None
    code = int(((read > 0.5) * (1 << np.arange(SECTORS))).sum())
    smallest = min(_rotated(code, by) for by in range(SECTORS))
    return ring_codes().index(smallest) if smallest in ring_codes() else None


def _places(ellipse: Float64, angles: Float64, shares: Float64) -> Float64:
    """Compute points (A, S, 2) at given angles and fractions (S,) or (A, S) of the ellipse's radius.

    The angles refer to the picture's axes; the rotation of the ellipse's own axes is taken off first.
    """
    x, y, a, b, turn = ellipse
    c, s = np.cos(angles - turn)[:, None], np.sin(angles - turn)[:, None]
    u, v = a * c * shares, b * s * shares
    return np.stack(
        [x + np.cos(turn) * u - np.sin(turn) * v, y + np.sin(turn) * u + np.cos(turn) * v], axis=2
    )


def _sampled(image: Float32, ellipse: Float64, angles: Float64, shares: Float64) -> Float32:
    places = _places(ellipse, angles, shares).astype(np.float32)
    x, y = places[..., 0], places[..., 1]
    gray: Float32 = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return gray


def _inside(image: Float32, ellipse: Float64) -> bool:
    reach = OUTER * max(ellipse[2], ellipse[3])
    size = np.array([image.shape[1], image.shape[0]])
    return bool((ellipse[:2] > reach).all() and (ellipse[:2] < size - 1 - reach).all())
