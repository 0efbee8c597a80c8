"""B-spline weights against SciPy's basis."""

import numpy as np
from scipy.interpolate import BSpline

from barsight.core.linalg.bspline import sixfold_weights


def test_weights_are_the_basis_in_both_precisions() -> None:
    basis = BSpline.basis_element(np.arange(-2, 3), extrapolate=False)
    for t in np.linspace(0, 0.999, 50):
        wanted = 6 * basis(t - np.arange(-1, 3))
        np.testing.assert_allclose(sixfold_weights(t), np.nan_to_num(wanted), rtol=1e-12, atol=1e-14)
        short = np.array(sixfold_weights(np.float32(t)))
        np.testing.assert_array_equal(short, short.astype(np.float32))
        np.testing.assert_allclose(short, np.nan_to_num(wanted), atol=2e-6)
