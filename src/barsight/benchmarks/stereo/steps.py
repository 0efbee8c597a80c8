"""Draw each step of our own stereo on a rendered glossy bar (`bench stereo-steps`)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from barsight.benchmarks.stereo.bar_renderer import render_pair
from barsight.benchmarks.stereo.bar_scenes import bar_over_floor
from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import OutputError
from barsight.core.files import atomic_path
from barsight.core.records.disparity import Disparity
from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo

_RANGE_M, _GLOSS = 2.8, 30.0
_SCALE = 0.45
_ERROR_PX, _SIGMA_PX = 0.5, 0.5


def steps_picture(seed: int = 3) -> UInt8:
    """Draw the steps, (0.9 H, 1.35 W, 3) BGR. Top row: left image, disparity, sigma. Bottom row: error of
    the disparity initially, after refinement, and after sharpened edges and guesses.
    """
    posed = bar_over_floor(np.random.default_rng(seed), _RANGE_M, _GLOSS, raised_m=0.15)
    rendered = render_pair(posed.scene, seed)
    whole = BarsightSettings()

    def matched(settings: BarsightSettings) -> Disparity:
        return BarsightStereo(settings)(rendered.pair, posed.candidates)

    no_guess = replace(
        whole, fill_occlusions=False, max_sigma_px=math.inf, wrong_side_px=0.0, other_side_error_ratio=0.0
    )
    start = matched(replace(no_guess, refinement=replace(whole.refinement, steps=0)))
    refined, final = matched(no_guess), matched(whole)
    truth = rendered.truth_px.astype(np.float32)
    low, high = float(truth.min()), float(truth.max())
    left = cv2.cvtColor(rendered.pair.left, cv2.COLOR_GRAY2BGR)
    above = [left, _coloured(final.disparity_px, low, high), _coloured(final.sigma_px, 0, _SIGMA_PX)]
    below = [_coloured(d.disparity_px - truth, -_ERROR_PX, _ERROR_PX) for d in (start, refined, final)]
    whole_picture = np.vstack([np.hstack(above), np.hstack(below)])
    picture: UInt8 = cv2.resize(whole_picture, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_AREA)
    return picture


def write_steps(target: Path) -> None:
    """Write `steps_picture` as a PNG file."""
    if target.suffix.lower() != ".png":
        raise OutputError(f"{target}: the picture is written as .png")
    with atomic_path(target) as temporary:
        temporary.write_bytes(cv2.imencode(".png", steps_picture())[1].tobytes())


def _coloured(values: Float32, low: float, high: float) -> UInt8:
    """Colour values by viridis in 32 steps from low to high; missing ones are black."""
    known = np.isfinite(values)
    share = np.where(known, (values - low) / (high - low), 0).clip(0, 1)
    coloured: UInt8 = cv2.applyColorMap((np.rint(share * 31) * 8).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    coloured[~known] = 0
    return coloured
