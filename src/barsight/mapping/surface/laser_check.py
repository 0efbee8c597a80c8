"""Check a laser profile against the map of vision: whether it is off, and whether an offset would be
noticed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement import profile_difference, smooth_places
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.contours import SPACING_M

FALSE_RATIO, CONTRADICTS_SIGMAS = 0.01, 2.576
"""Significance level of the tests (share of correct profiles that are rejected), and the same in sigmas."""
PLACE_SIGMA_M = 0.002
"""Sigma of the map's own position along x, common to a whole profile."""
MIN_ALIKE_RATIO = 0.7
"""Minimum share of a profile's points that lie on the map's surface, there or within two samples along x."""
MAX_SLOPE = 2.0
"""Maximum slope of places used to fit the offset."""
_STRETCH_POINTS, _MIN_SAMPLES, _MIN_STRETCHES = 50, 100, 3
"""Number of points of a stretch; minimum numbers of measured points and of stretches for an offset."""
_SHORT_POINTS, _CAP_M = 25, 0.03
"""Number of points of a stretch whose mean difference is compared; maximum difference that counts."""
_REACH = 2
"""Number of samples along x by which a point may lie off the map's surface."""
_ROUNDS, _TUKEY = 15, 4.685
"""Rounds of the robust fit; deviation in sigmas from which a point has no weight."""


@dataclass(frozen=True)
class LaserOffset:
    """A profile's offset from vision, along x and in height (laser minus vision), with sigmas.
    alike_ratio: share of its points on the map's surface.
    """

    x_offset_m: float
    x_sigma_m: float
    z_offset_m: float
    z_sigma_m: float
    alike_ratio: float

    def contradiction(self) -> str:
        """Describe how the profile contradicts vision; empty if it doesn't."""
        if not self.alike_ratio >= MIN_ALIKE_RATIO:
            return f"only {100 * self.alike_ratio:.0f} % of its points lie on the map's surface"
        for way, offset, sigma in (
            ("along x", self.x_offset_m, self.x_sigma_m),
            ("in height", self.z_offset_m, self.z_sigma_m),
        ):
            if not abs(offset) <= CONTRADICTS_SIGMAS * sigma:
                return f"it lies {1e3 * offset:+.1f} mm off the map {way} (sigma {1e3 * sigma:.1f} mm)"
        return ""


@dataclass(frozen=True)
class LaserCheck:
    """Result of checking a profile. samples: number of its points that vision has measured too. offset:
    None if they are too few. reason: why the profile is rejected, empty if it is accepted.
    """

    profile: int
    samples: int
    offset: LaserOffset | None
    reason: str

    @property
    def is_believed(self) -> bool:
        """Check that the profile may be fused."""
        return not self.reason


def check_laser(contour: Contour, laser: LaserProfile, settings: MapSettings) -> LaserCheck:
    """Check a profile against vision's contour at its y; a correct profile contradicts it in at most 1 % of
    cases.

    A profile that doesn't contradict vision is accepted only where an offset would show: by laser_off_m in
    height, or by twice that along x. A profile with such an offset is thus accepted in at most 1 % of cases.
    """
    known = np.isfinite(profile_difference(contour, laser))
    samples = int(known.sum())
    offset = _offset(contour, laser, settings) if samples >= _MIN_SAMPLES else None
    if offset is None:
        reason = f"vision has {samples} of its {known.size} points, too few on smooth places to tell"
        return LaserCheck(laser.profile, samples, None, reason)
    reason = offset.contradiction() or _sideways(contour, laser, 2 * settings.laser_off_m)
    certain = abs(offset.z_offset_m) + CONTRADICTS_SIGMAS * offset.z_sigma_m <= settings.laser_off_m
    if not reason and not certain:
        off, sigma = 1e3 * settings.laser_off_m, 1e3 * offset.z_sigma_m
        reason = f"were it {off:.0f} mm off in height, that could stay unseen (sigma {sigma:.1f} mm)"
    return LaserCheck(laser.profile, samples, offset, reason)


def _sideways(contour: Contour, laser: LaserProfile, off_m: float) -> str:
    """Explain why a profile fits better when shifted by off_m along x, or not clearly worse; empty if
    neither.

    Compares the mean differences over stretches of a quarter of a metre, each difference limited to 30 mm,
    with those of the shifted profile: signed ranks [Wilcoxon 1945], 1 %.
    """
    from scipy.stats import wilcoxon  # half a second to import, and only a map with the laser needs it

    for move in (off_m, -off_m):
        gain = _costs(contour, replace(laser, x_m=laser.x_m + move)) - _costs(contour, laser)
        gain = gain[np.isfinite(gain)]
        if gain.size < _MIN_STRETCHES or not gain.any():
            better, worse = 1.0, 1.0
        else:
            better, worse = (float(wilcoxon(gain, alternative=side).pvalue) for side in ("less", "greater"))
        if better < FALSE_RATIO:
            return f"it fits better {1e3 * move:+.0f} mm along x"
        if worse > FALSE_RATIO:
            return f"were it {1e3 * off_m:.0f} mm off along x, that could stay unseen"
    return ""


def _costs(contour: Contour, laser: LaserProfile) -> Float64:
    """Compute the mean capped difference (m) of each stretch; NaN where vision covers less than half of
    it.
    """
    size: Float64 = np.minimum(np.abs(profile_difference(contour, laser)), _CAP_M)
    count = -(-size.size // _SHORT_POINTS)
    padded = np.full(count * _SHORT_POINTS, np.nan)
    padded[: size.size] = size
    rows = padded.reshape(count, _SHORT_POINTS)
    known = np.isfinite(rows)
    enough = 2 * known.sum(axis=1) >= _SHORT_POINTS
    return np.where(enough, np.where(known, rows, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.nan)


def _offset(contour: Contour, laser: LaserProfile, settings: MapSettings) -> LaserOffset | None:
    """Fit a shift along x and in z to the differences at smooth places by iteratively reweighted least
    squares [Tukey]; None if fewer than three stretches of half a metre have such places.

    The sigmas are jackknife estimates that leave out one stretch at a time. To the height's sigma is added
    the error common to all heights of the map, for which their lowest sigmas (1 %) are an upper bound.
    """
    above = -profile_difference(contour, laser)
    slope = np.gradient(laser.z_m, laser.x_m)
    used = np.isfinite(above) & smooth_places(laser.z_m) & (np.abs(slope) <= MAX_SLOPE)
    stretch = (np.arange(above.size) // _STRETCH_POINTS)[used]
    numbers = np.unique(stretch)
    if numbers.size < _MIN_STRETCHES:
        return None
    design, above = np.stack([-slope[used], np.ones(used.sum())], axis=1), above[used]
    fit = _robust_fit(design, above)
    without = np.array([_robust_fit(design[stretch != k], above[stretch != k]) for k in numbers])
    spread = np.sqrt((numbers.size - 1) * np.mean((without - without.mean(axis=0)) ** 2, axis=0))
    shared = float(np.nanpercentile(contour.sigma_m[contour.source == HeightSource.VISION], 1))
    return LaserOffset(
        float(fit[0]), float(np.hypot(spread[0], PLACE_SIGMA_M)),
        float(fit[1]), float(np.hypot(spread[1], shared)), _alike_ratio(contour, laser, settings),
    )  # fmt: skip


def _robust_fit(design: Float64, values: Float64) -> Float64:
    """Solve design (N, 2) x = values (N,) with Tukey's weights; on level ground, x[0] stays near 0."""
    weight: Float64 = np.ones(values.size)
    found: Float64 = np.zeros(2)
    ridge = np.diag([1e-6 * values.size, 0.0])
    for _ in range(_ROUNDS):
        turned = (design * weight[:, None]).T
        found = np.asarray(np.linalg.solve(turned @ design + ridge, turned @ values), np.float64)
        rest = values - design @ found
        reach = _TUKEY * (mad_sigma(rest) + 1e-6)
        weight = np.where(np.abs(rest) < reach, (1 - (rest / reach) ** 2) ** 2, 0.0)
    return found


def _alike_ratio(contour: Contour, laser: LaserProfile, settings: MapSettings) -> float:
    """Compute the share of the laser's points seen by vision whose height it has there or within _REACH
    samples.
    """
    known = np.isfinite(profile_difference(contour, laser))
    alike: Bool = np.zeros(laser.x_m.size, np.bool_)
    gate = max(settings.min_gate_m, settings.gate_sigma * float(np.nanmedian(contour.sigma_m)))
    for way in range(-_REACH, _REACH + 1):
        moved = replace(laser, x_m=laser.x_m + way * SPACING_M)
        alike |= np.abs(profile_difference(contour, moved)) <= gate
    return float(np.mean(alike[known]))
