"""Sample the pictures' gray levels across a bundle, over short lengths of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.samples import (
    DARKEST,
    BundleWindow,
    PlacedFrames,
    WindowPicture,
    bundle_axes,
    is_hidden,
)
from barsight.core.arrays import Float64
from barsight.labels.placing import heights_at
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, HeightMap, YardMap

STEP_M = 0.0015
"""Sample spacing across a bundle: a fifth of a pixel."""
_ROW_M, WINDOW_M = 0.02, 0.3
"""Row spacing along a bundle, and length of the rows whose median is a profile. Bars turn by less than a
pixel over that length.
"""
_MAX_WINDOWS = 5
"""Maximum number of windows along a bundle, each sampled in both pictures of one frame. The same bars lie
along the whole bundle, so sixteen windows in two frames give no more information.
"""
_BESIDE_ENDS_M, _TRIM_M = 0.1, 0.01
_SMOOTH_M = 0.015
_AROUND_M = 0.4
"""Distance beyond a bundle's flanks up to which the map is read, since what stands there may hide the
bundle.
"""


@dataclass(frozen=True, eq=False)
class PitchProfile:
    """Logarithm of the gray levels (N,) across a bundle, STEP_M apart, in one picture.

    pixel_m: size of the picture's pixels there.
    """

    levels: Float64
    pixel_m: float

    @classmethod
    def of(cls, picture: WindowPicture) -> PitchProfile:
        """Take the median of a window's rows."""
        return cls(np.log(np.median(picture.gray, axis=0) + DARKEST), picture.pixel_m)


def pitch_windows(
    frames: PlacedFrames, heights: YardMap, bundles: Sequence[Bundle]
) -> Iterator[tuple[int, BundleWindow]]:
    """List windows along each bundle with the nearest frames over them, leaving out those that something
    higher may hide.
    """
    for number, bundle in enumerate(bundles):
        for part, window in _windows(number, bundle, heights):
            k = frames.nearest(window)
            if k is not None and not is_hidden(part, window.middle_m, frames.eyes_m[k]):
                yield k, window


def _windows(number: int, bundle: Bundle, heights: YardMap) -> Iterator[tuple[HeightMap, BundleWindow]]:
    """Divide a bundle, inside its ends and flanks, into windows at the heights of the map around it."""
    half, reach = bundle.width_m / 2 - _TRIM_M, bundle.length_m / 2 - _BESIDE_ENDS_M
    if not (half > STEP_M and 2 * reach >= WINDOW_M and np.isfinite(bundle.centre_m).all()):
        return
    count = min(int(2 * reach / WINDOW_M), _MAX_WINDOWS)
    along, across = bundle_axes(bundle)
    beside = np.arange(-half, half, STEP_M)
    level = np.append(along[:2], 0.0)
    rows = np.arange(-WINDOW_M / 2, WINDOW_M / 2 + _ROW_M / 2, _ROW_M)[:, None] * level
    middle = np.append(bundle.centre_m[:2], bundle.top_z_m)
    edges = np.linspace(-reach, reach, count + 1)
    wide = np.array([-half - _AROUND_M, half + _AROUND_M])
    corners = middle + np.repeat(edges[[0, -1]], 2)[:, None] * along + np.tile(wide, 2)[:, None] * across
    part = part_about(heights, corners[:, 0], corners[:, 1])
    for at in (edges[1:] + edges[:-1]) / 2:
        line = middle + at * along + beside[:, None] * across
        z = heights_at(part, rows[:, None] + line)
        z = np.where(np.isfinite(z), z, line[:, 2])
        line[:, 2] = ndimage.gaussian_filter1d(np.median(z, axis=0), _SMOOTH_M / STEP_M, mode="nearest")
        yield part, BundleWindow(number, line, rows)
