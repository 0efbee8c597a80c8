"""Estimate scatter whatever a few gross errors are."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

SIGMA_PER_MAD = 1.4826
"""Sigma of normal errors over their median absolute deviation."""


@overload
def mad_sigma(deviation: NDArray[Any]) -> float: ...
@overload
def mad_sigma(deviation: NDArray[Any], axis: int) -> NDArray[Any]: ...
def mad_sigma(deviation: NDArray[Any], axis: int | None = None) -> float | NDArray[Any]:
    """Compute sigma = 1.4826 median |deviation|, of all values or along an axis."""
    median = np.median(np.abs(deviation), axis=axis)
    return SIGMA_PER_MAD * (float(median) if axis is None else median)
