"""Match with the paper's method, taken literally [paper Figure 2, Eq. 4, Eq. 5; the loop is Yang, CVPR 2007].

An initial disparity D defines a cost space C(d) = min(eta L, (d - D)^2), which is filtered bilaterally,
guided by the image; winner takes all and the parabola through its neighbours yield a new D, which is fed back
until it settles. The cost space is never built: see `bilateral_update`. After the start, the images provide
no more evidence, so the loop smooths D and can't undo its bias.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Literal

import numpy as np

from barsight.core.arrays import Float32
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import POSITIVE, expect_ranges
from barsight.stereo.baselines.bilateral_filter import bilateral_update
from barsight.stereo.baselines.census import Census, CensusSettings
from barsight.stereo.baselines.postprocessing import OutputSettings, is_matchable, no_match, with_sigma
from barsight.stereo.sgbm import Sgbm, SgbmSettings

_SETTLED_RATIO = 0.95
"""Share of pixels that have settled when the loop ends."""
_MIN_WIDTH_PX = 16  # OpenCV rounds the number of candidates up to a multiple of this.


@dataclass(frozen=True)
class PaperSettings:
    """Settings of the paper's loop."""

    initial: Literal["sgbm", "census"] = "sgbm"
    """Method that computes the initial disparity."""
    sgbm: SgbmSettings = field(default_factory=lambda: SgbmSettings(mode="5path"))
    census: CensusSettings = field(default_factory=CensusSettings)
    eta: float = 0.1
    """Value at which the cost is truncated (px squared), as a multiple of the number of candidates."""
    radius_px: int = 5
    """Radius of the bilateral window."""
    sigma_px: float = 3.0
    """Sigma of the bilateral weights over distance."""
    sigma_gray: float = 10.0
    """Sigma of the bilateral weights over gray difference."""
    max_rounds: int = 3
    """Maximum number of rounds of the loop."""
    settled_px: float = 0.05
    """Change of the disparity below which a pixel has settled; the loop ends when 95 % of the pixels have."""
    output: OutputSettings = field(
        default_factory=lambda: OutputSettings(fill=False, subpixel_sigma_px=0.28, filled_sigma_px=9.0)
    )
    """The loop doesn't know what lies behind an edge: it fills occluded pixels from the nearer surface."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "paper.", eta=POSITIVE, sigma_px=POSITIVE, sigma_gray=POSITIVE, settled_px=POSITIVE,
            radius_px=(1, inf), max_rounds=(1, inf),
        )  # fmt: skip


@dataclass(frozen=True)
class Paper:
    """`StereoMethod`: the paper's loop from an initial disparity."""

    settings: PaperSettings

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`. Without `output.fill`, pixels without an initial disparity are NaN."""
        settings = self.settings
        too_narrow = pair.left.shape[1] + min(candidates.lowest_px, 0) <= _MIN_WIDTH_PX
        if too_narrow or not is_matchable(pair, candidates):
            return no_match(pair)
        start: Sgbm | Census = Sgbm(settings.sgbm) if settings.initial == "sgbm" else Census(settings.census)
        initial = start(pair, candidates)
        values = iterate_bilateral(pair, initial.disparity_px, candidates, settings)
        matched = np.isfinite(initial.disparity_px)
        return with_sigma(pair, values, matched, settings.output)


def iterate_bilateral(
    pair: RectifiedPair, initial_px: Float32, candidates: DisparityRange, settings: PaperSettings
) -> Float32:
    """Iterate (H, W) float32 `bilateral_update` until few disparities change or `max_rounds` is reached."""
    limit = settings.eta * candidates.count
    values = initial_px
    for _ in range(settings.max_rounds):
        before = values
        values = bilateral_update(
            values, pair.left, candidates, limit, settings.radius_px, settings.sigma_px, settings.sigma_gray
        )
        known = np.isfinite(before)
        still = np.abs(values[known] - before[known]) < settings.settled_px
        if np.count_nonzero(still) >= _SETTLED_RATIO * still.size:
            break
    return values
