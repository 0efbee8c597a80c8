"""Fill gaps between seen cells by interpolation."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float32, kernel


@kernel()
def bridge_gaps(z: Float32, sigma: Float32, seen: Bool, reach: int) -> Bool:
    """Interpolate height and sigma, in place, in unseen cells with seen ones within `reach` on opposite
    sides, along x or along y (the nearer pair wins). Returns a mask (H, W) of the filled cells.
    """
    filled = np.zeros(seen.shape, np.bool_)
    for i in range(seen.shape[0]):
        for j in range(seen.shape[1]):
            if seen[i, j]:
                continue
            least = 2 * reach + 1
            for di, dj in ((0, 1), (1, 0)):
                before, after = _steps(seen, i, j, -di, -dj, reach), _steps(seen, i, j, di, dj, reach)
                if before == 0 or after == 0 or before + after >= least:
                    continue
                least = before + after
                one, other = (i - before * di, j - before * dj), (i + after * di, j + after * dj)
                share = np.float32(before / least)
                z[i, j] = z[one] * (1 - share) + z[other] * share
                sigma[i, j] = np.hypot(max(sigma[one], sigma[other]), abs(z[other] - z[one]) / 2)
                filled[i, j] = True
    return filled


@kernel()
def _steps(seen: Bool, i: int, j: int, di: int, dj: int, reach: int) -> int:
    """Count the steps to the first seen cell in one direction, 0 if there is none within `reach`.

    seen: (H, W). i, j: row and column of the cell; di, dj: of a step.
    """
    for n in range(1, reach + 1):
        a, b = i + n * di, j + n * dj
        if a < 0 or b < 0 or a >= seen.shape[0] or b >= seen.shape[1]:
            return 0
        if seen[a, b]:
            return n
    return 0
