"""Define the protocol of every stereo method."""

from __future__ import annotations

from typing import Protocol

from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair


class StereoMethod(Protocol):
    """Protocol of a method that matches a rectified pair to the left image's disparity. A method keeps no
    state between calls, so that pairs can be matched in parallel.
    """

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match within `candidates`; NaN where there is no match or either image is invalid."""
        ...
