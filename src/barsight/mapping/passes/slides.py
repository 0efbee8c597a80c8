"""Detect bundles that were moved along their axis or exchanged between two passes: the heights stay alike,
the pictures don't.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.heights import HeightSource
from barsight.mapping.passes.changes import BundleMove
from barsight.mapping.passes.joined_surface import PassSurface, moved_window

MAX_SHIFT_M = 2.0
STILL_M = 0.025
"""Maximum shift that errors of poses and matching can cause."""
MIN_SHARED_M = 1.0
"""Minimum length over which two pictures are compared; shorter ones agree at some shift by chance."""
MIN_AGREEMENT, MIN_GAIN = 0.4, 0.25
"""Minimum correlation of a moved bundle's pictures at their shift, and minimum gain over the correlation
without a shift.
"""
MAX_OTHER, MIN_SAME = 0.3, 0.6
"""Two pictures show different bundles if their correlation is at most the first, provided that the median
over the bundles that weren't moved is at least the second.
"""
_SLOW_M = 0.15
"""Sigma of the high-pass filter along the bars: slower changes of brightness are due to the light."""
_MAX_CONTRAST = 1.0
"""Clipping bound in standard deviations of a picture, so that a strap or a label weighs no more than a
rust spot of its size.
"""
_INSIDE_RATIO = 0.6
"""Share of the width that is compared; nearer the flanks, each pass sees another side."""


@dataclass(frozen=True, eq=False)
class SeenBundle:
    """A bundle's position in the joined map. ends_m: (2, 3) ends of its axis, the low-y end first."""

    ends_m: Float64
    width_m: float


@dataclass(frozen=True)
class PictureShift:
    """Shift of a bundle's picture from an older pass to a newer one: along_m towards its high-y end.

    agreement: correlation at that shift. still: highest correlation at shifts up to STILL_M.
    """

    along_m: float
    agreement: float
    still: float

    @property
    def is_move(self) -> bool:
        """Check whether the picture has clearly moved along the bundle."""
        is_away = abs(self.along_m) > STILL_M and self.agreement >= MIN_AGREEMENT
        return is_away and self.agreement - self.still >= MIN_GAIN


def find_moves(passes: Sequence[PassSurface], bundles: Sequence[SeenBundle]) -> list[BundleMove]:
    """Find moved and exchanged bundles by comparing the pictures of each in all passes that saw it, the
    oldest first.
    """
    pictures = [[picture_along(one, bundle) for one in passes] for bundle in bundles]
    moves = []
    for newer in range(1, len(passes)):
        for older in range(newer):
            if passes[older].since == passes[newer].since:
                continue
            shifts = {
                k: shift
                for k, seen in enumerate(pictures)
                if (shift := _shift(seen[older], seen[newer], passes[0].surface.cell_m)) is not None
            }
            still = [shift.still for shift in shifts.values() if not shift.is_move]
            usual = float(np.median(still)) if still else 0.0
            for k, shift in shifts.items():
                is_other = usual >= MIN_SAME and shift.still <= MAX_OTHER
                if shift.is_move or is_other:
                    along_m = shift.along_m if shift.is_move else None
                    one = bundles[k]
                    moves.append(BundleMove(passes[newer].since, one.ends_m, one.width_m, along_m))
    return moves


def picture_along(one: PassSurface, bundle: SeenBundle) -> Float32 | None:
    """Sample a pass's picture of a bundle, (lines, places) across and along from its low-y end; NaN where the
    pass saw nothing. None if it saw less than MIN_SHARED_M.

    Slow changes along the bundle are subtracted, and the contrast is clipped.
    """
    cell_m, ends_m = one.surface.cell_m, bundle.ends_m[:, :2]
    length_m = float(np.hypot(*(ends_m[1] - ends_m[0])))
    along = (ends_m[1] - ends_m[0]) / max(length_m, 1e-6)
    half_m = _INSIDE_RATIO * bundle.width_m / 2
    v, u = np.arange(0, length_m, cell_m), np.arange(-half_m, half_m + cell_m / 2, cell_m)
    at = ends_m[0] + u[:, None, None] * np.array([along[1], -along[0]]) + v[:, None] * along
    low = np.floor(at.min(axis=(0, 1)) / cell_m).astype(np.int64) - 1
    columns, rows = (np.ceil(at.max(axis=(0, 1)) / cell_m).astype(np.int64) + 2 - low).tolist()
    layers = moved_window(one, int(low[0]), int(low[1]), columns, rows)
    gray = np.where(layers.source == HeightSource.VISION, layers.intensity, np.float32(np.nan))
    place = (at / cell_m - low).astype(np.float32)
    gray = cv2.remap(gray, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=float("nan"))
    known = np.isfinite(gray)
    if known.any(axis=0).sum() * cell_m < MIN_SHARED_M:
        return None
    smooth, held = (
        cv2.GaussianBlur(part.astype(np.float32), (0, 0), _SLOW_M / cell_m, sigmaY=0.3)
        for part in (np.where(known, gray, 0), known)
    )
    fast = gray - smooth / np.maximum(held, 1e-3)
    bound = _MAX_CONTRAST * mad_sigma(fast[known])
    return np.asarray(np.clip(fast, -bound, bound), np.float32)


def _shift(older: Float32 | None, newer: Float32 | None, cell_m: float) -> PictureShift | None:
    """Find the shift along the bundle at which two pictures agree best; None if they overlap too little."""
    if older is None or newer is None:
        return None
    cells = older.shape[1]
    reach = min(round(MAX_SHIFT_M / cell_m), cells - round(MIN_SHARED_M / cell_m))
    told = {}
    for k in range(-reach, reach + 1):
        parts = older[:, max(-k, 0) : cells - max(k, 0)], newer[:, max(k, 0) : cells + min(k, 0)]
        agreement = _correlation(*parts, MIN_SHARED_M / cell_m)
        if agreement is not None:
            told[k] = agreement
    still = [agreement for k, agreement in told.items() if abs(k) * cell_m <= STILL_M]
    if not still:
        return None
    best = max(told, key=lambda k: told[k])
    return PictureShift(best * cell_m, told[best], max(still))


def _correlation(older: Float32, newer: Float32, min_cells: float) -> float | None:
    """Correlate two pictures where both are known; None if fewer than min_cells cells along are."""
    both = np.isfinite(older) & np.isfinite(newer)
    if both.any(axis=0).sum() < min_cells or both.sum() < min_cells * len(both) / 2:
        return None
    one, other = (part[both] - part[both].mean() for part in (older, newer))
    return float(one @ other / max(float(np.sqrt((one @ one) * (other @ other))), 1e-9))
