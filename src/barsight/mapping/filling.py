"""Heights between seen cells: what a gap may be filled with."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float32


def bridge(z: Float32, sigma: Float32, seen: Bool, reach: int) -> tuple[Float32, Float32, Float32]:
    """Along each row: height, sigma and gap (cells, inf if too wide) between the seen cells on both sides."""
    width = z.shape[1]
    index = np.arange(width)[None, :]
    before = np.maximum.accumulate(np.where(seen, index, -(10**6)), axis=1)
    after = np.minimum.accumulate(np.where(seen, index, 10**6)[:, ::-1], axis=1)[:, ::-1]
    to_before, to_after = index - before, after - index
    bridged = (to_before <= reach) & (to_after <= reach)
    left = np.take_along_axis(z, before.clip(0, width - 1), axis=1)
    right = np.take_along_axis(z, after.clip(0, width - 1), axis=1)
    gap = np.maximum(to_before + to_after, 1)
    share = (to_before / gap).astype(np.float32)
    worst = np.maximum(
        np.take_along_axis(sigma, before.clip(0, width - 1), axis=1),
        np.take_along_axis(sigma, after.clip(0, width - 1), axis=1),
    )
    height = left * (1 - share) + right * share
    return (
        height.astype(np.float32),
        np.hypot(worst, np.abs(right - left) / 2).astype(np.float32),
        np.where(bridged, gap, np.inf).astype(np.float32),
    )
