"""Weight the four coefficients around a point as the uniform cubic B-spline does."""

from __future__ import annotations

from typing import Any

import numpy as np

from barsight.core.arrays import kernel

_ONE, _THREE, _FOUR, _SIX = np.float32(1), np.float32(3), np.float32(4), np.float32(6)


@kernel()
def sixfold_weights(t: Any) -> tuple[Any, Any, Any, Any]:
    """Compute six times the weights of the two coefficients on either side of a point.

    (1 - t)^3, 4 - 6 t^2 + 3 t^3, 1 + 3 t + 3 t^2 - 3 t^3 and t^3, in t's precision: t is 0 at the second
    coefficient, 1 at the third.
    """
    t2 = t * t
    t3 = t2 * t
    return (
        _ONE - _THREE * t + _THREE * t2 - t3,
        _FOUR - _SIX * t2 + _THREE * t3,
        _ONE + _THREE * t + _THREE * t2 - _THREE * t3,
        t3,
    )
