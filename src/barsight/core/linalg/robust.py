"""Estimate scatter and level robustly against a few gross errors."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

SIGMA_PER_MAD = 1.4826
"""Ratio of the sigma of normal errors to their median absolute deviation."""
SIGMAS_95 = 1.96
"""Half width of the interval that holds 95 % of normal errors, in sigmas."""
CHI2_3_MEDIAN = 2.366
"""Median of chi2 with three degrees of freedom."""


@overload
def mad_sigma(deviation: NDArray[Any]) -> float: ...
@overload
def mad_sigma(deviation: NDArray[Any], axis: int) -> NDArray[Any]: ...
def mad_sigma(deviation: NDArray[Any], axis: int | None = None) -> float | NDArray[Any]:
    """Compute sigma = 1.4826 median |deviation|, of all values or along an axis."""
    median = np.median(np.abs(deviation), axis=axis)
    return SIGMA_PER_MAD * (float(median) if axis is None else median)


def known_median(values: NDArray[Any]) -> NDArray[Any]:
    """Compute the lower median (1, U) of the known values of each column (V, U); NaN where none is known."""
    middle = np.maximum(np.isfinite(values).sum(axis=0) - 1, 0)[None] // 2
    return np.take_along_axis(np.sort(values, axis=0), middle, axis=0)


def nan_medians(values: NDArray[Any]) -> NDArray[Any]:
    """Compute the median (U,) of each column (V, U) without its NaN, as `np.nanmedian` does, which takes ten
    times as long for a few hundred values each.
    """
    known = (~np.isnan(values)).sum(axis=0)[None]
    ordered = np.sort(values, axis=0)  # NaN last
    low, high = (
        np.take_along_axis(ordered, np.maximum(at, 0), axis=0)[0] for at in ((known - 1) // 2, known // 2)
    )
    return np.asarray(np.where(known[0] > 0, (low + high) / 2, np.nan), values.dtype)


def running_median(values: NDArray[Any], count: int) -> NDArray[Any]:
    """Compute the median of `count` (odd) rows around each, (N, M); the first and last rows are repeated.

    All columns go through SciPy's 1-D filter as one line, which takes a fraction of the 2-D filter's time.
    """
    rim = count // 2
    line = np.pad(values.T, ((0, 0), (rim, rim)), mode="edge")
    medians = ndimage.median_filter(line.ravel(), count).reshape(line.shape)
    return np.asarray(medians[:, rim : rim + len(values)].T)
