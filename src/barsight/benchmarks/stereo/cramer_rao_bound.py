"""Compute the Cramer-Rao bound of a match from the images' noise [Cramer 1946, Rao 1945]."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.direct.refinement import RefinementSettings
from barsight.stereo.noise import image_noise

_WINDOW_PX = 21


def noise_limit_px(pair: RectifiedPair, where: Bool) -> float:
    """Compute the Cramer-Rao bound, px, of a match over our elongated support, the median over `where`.

    The bound is the root of twice the noise variance over the sum of the squared gradients in the support.
    The noise is measured in the images, and its contribution to the squared gradients is subtracted. A
    Gaussian support of sigmas a and b counts as 4 pi a b fully weighted pixels.
    """
    shape = RefinementSettings()
    noise = (image_noise(pair.left) ** 2 + image_noise(pair.right) ** 2) / 2
    # A central difference halves the noise's variance.
    slope = cv2.Sobel(pair.left, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    power = cv2.boxFilter(slope * slope, -1, (_WINDOW_PX, _WINDOW_PX)) - noise / 2
    heard = 4 * np.pi * shape.along_px * shape.across_px
    return float(np.median(np.sqrt(2 * noise / (heard * np.maximum(power[where], 0.1)))))
