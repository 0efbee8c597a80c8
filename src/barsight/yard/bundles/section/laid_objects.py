"""Measure what lies on a bundle by the sections along it: over a part of its width, or along on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.core.linalg.robust import known_median
from barsight.yard.bundles.fitting.outline_fit import SLOPE_U, SLOPE_Z, Fit, U, Z
from barsight.yard.bundles.fitting.rotated_map import AlignedMap

_LAID_M, _LAID_SIZE_M = 0.02, (0.04, 0.03)
"""Minimum rise of an object that lies over a part of a bundle's width, and its size along and across (m)."""
_LAID_CELLS = 2
"""Minimum size of such an object in cells: a steep flank is often off by one."""
_MIN_SEEN_RATIO = 0.75
"""Minimum share of such an object's places that is measured: matching loses places along its edges."""
_MIN_VIEWS_RATIO = 0.6
"""Minimum number of views that tell a place of such an object, as a share of the median of its row's and of
the bundle's. Matching smooths a flank over what lies beside it where a view sees it fall away: in its row the
other views contradict; beside the pictures' borders there may be no others.
"""
_MAX_BOW_CELLS, _BOW_COST_M, _BOW_STEP = 8, 2e-4, 4
"""Range of a bundle's bow, in cells between its middle and its ends; cost of each, m of mean misfit; step of
the rows by which it is found.
"""
_MAX_MISFIT_M = 0.03
"""Misfit (m) from which a place tells nothing of the shift: something lies there."""
_GULLY_RATIO = 0.3
"""Minimum depth, in widths, of the surface at a bundle's rim under its axis from which it isn't the bundle's.
The rim of an upright triangle of bars lies 0.22 under its axis, that of one turned by 25 degrees 0.24.
"""
_PART_M, _PART_WIDTH_M, _INNER_RATIO = 0.3, 0.02, 0.4
"""Length (m) of the parts of a bundle that are compared with each other, width (m) over which one of them is
higher, and maximum distance of that from the middle, in widths: steep flanks differ more.
"""
_LOWER_PCT, _MIN_PARTS, _MIN_PART_SEEN = 20, 3, 0.5
"""Percentile of the parts' heights that counts as the bundle's own; minimum number of parts; minimum share
of a part's rows that is measured.
"""
_SAG_PCT = 10
"""Percentile of a part's rises across its width by which all of the part lies higher."""


@dataclass(frozen=True, eq=False)
class StraightSections:
    """The heights (R, C) of a bundle's rows from flank to flank, less the rise along its axis, NaN where
    unknown. The rows of a bowed bundle are shifted sideways into line.

    unsure_m: by how much each height's sigma exceeds the bundle's median one. views: (R, C), how many tell a
    height, inf where that isn't known. axis_z_m: height of its axis. outline_z_m: that of the fitted
    outline's top.
    """

    z_m: Float64
    unsure_m: Float64
    views: Float64
    axis_z_m: float
    outline_z_m: float
    width_m: float
    cell_m: float

    @property
    def own_m(self) -> Float64:
        """Return the bundle's own section (1, C): the median along it at each place across."""
        return known_median(self.z_m)


def straight_sections(
    grid: AlignedMap, fit: Fit, rows: Int64, bounds_m: tuple[float, float], axis_z_m: float
) -> StraightSections:
    """Look up the sections of a bundle, in line with each other.

    The bow is the parabola b (x^2 - 1/3), x from -1 to 1 along the bundle, that brings all rows closest to
    their median section: the fitted axis is the mean of such a bundle.
    """
    low_m, high_m = bounds_m
    beside = np.arange(low_m, high_m + grid.cell_m / 2, grid.cell_m)
    parabola = grid.cell_m * (np.linspace(-1, 1, len(rows)) ** 2 - 1 / 3)[:, None]
    best, least = 0, np.inf
    for bow in sorted(range(-_MAX_BOW_CELLS, _MAX_BOW_CELLS + 1), key=abs):
        z = look_up(grid, fit, rows[::_BOW_STEP], beside + bow * parabola[::_BOW_STEP])
        misfit = np.minimum(np.abs(z - known_median(z)), _MAX_MISFIT_M)
        cost = float(np.nanmean(misfit)) + _BOW_COST_M * abs(bow) if np.isfinite(misfit).any() else np.inf
        if cost < least:
            best, least = bow, cost
    beside = beside + best * parabola
    z, views = look_up(grid, fit, rows, beside), _read_rows(grid, grid.views, fit, rows, beside)
    sigma = _read_rows(grid, grid.sigma_m, fit, rows, beside)
    unsure = np.maximum(sigma - np.nanmedian(sigma), 0) if np.isfinite(sigma).any() else np.zeros_like(z)
    outline_z_m = float(fit.values[Z]) + fit.width_m / 2
    return StraightSections(z, unsure, views, axis_z_m, outline_z_m, high_m - low_m, grid.cell_m)


def look_up(grid: AlignedMap, fit: Fit, rows: Int64, beside: Float64) -> Float64:
    """Look up the heights (R, C) of a bundle's rows at places beside its axis, (C,) or (R, C), less the rise
    along it; NaN where unknown.
    """
    along = grid.v0_m + grid.cell_m * rows[:, None] - fit.v_m
    z: Float64 = _read_rows(grid, grid.z_m, fit, rows, beside) - fit.values[SLOPE_Z] * along
    return z


def _read_rows(grid: AlignedMap, told: Float32, fit: Fit, rows: Int64, beside: Float64) -> Float64:
    """Read an array [v, u] of the map at a bundle's rows and places beside its axis, NaN outside."""
    along = grid.v0_m + grid.cell_m * rows[:, None] - fit.v_m
    column = np.rint((fit.values[U] + fit.values[SLOPE_U] * along + beside - grid.u0_m) / grid.cell_m)
    inside = (column >= 0) & (column < told.shape[1])
    read: Float64 = told[rows[:, None], np.where(inside, column, 0).astype(np.int64)].astype(np.float64)
    return np.where(inside, read, np.nan)


def measure_laid(sections: StraightSections | None) -> tuple[float, bool]:
    """Measure the rise (m) of the highest object that lies over a part of a bundle's width, as a beam's end
    does, 0 where there is none. Also return whether any object rises by _LAID_M over the section even if
    the section is shifted sideways by a cell, and where its heights are unsure, even if these are too high;
    where fewer views tell it than the rest of the bundle it doesn't count.

    Rises are measured over the bundle's own section. An object is a patch that everywhere holds a rectangle
    of _LAID_SIZE_M and rises by _LAID_M. An object no higher than the axis, where a gully shows at the rim,
    lies beside the bundle, as dunnage does. A steep flank that is off by a cell rises as much; an object on a
    bundle rests on its crest and rises over the shifted section too, and nearly all views see it.
    """
    if sections is None:
        return 0.0, False
    z, own = sections.z_m, sections.own_m
    sunken = (own < sections.axis_z_m - _GULLY_RATIO * sections.width_m)[0]
    gully = np.logical_and.accumulate(sunken) | np.logical_and.accumulate(sunken[::-1])[::-1]
    rises = np.isfinite(z) & ~(gully & (z < sections.axis_z_m)) & (z - own > _LAID_M)
    views = sections.views
    most = np.fmax(known_median(views.T).T, known_median(views.reshape(-1, 1)))
    laid, told = (
        _laid_patches(sections, part) for part in (rises, rises & (views >= _MIN_VIEWS_RATIO * most))
    )
    clear = told & (z - sections.unsure_m - _shifted(own) > _LAID_M)
    return float((z - own)[laid].max(initial=0.0)), bool(clear.any())


def _laid_patches(sections: StraightSections, rises: Bool) -> Bool:
    """Mark the places (R, C) of `rises` in patches that everywhere hold a rectangle of _LAID_SIZE_M; part of
    each may be unknown.
    """
    size = [max(round(side / sections.cell_m), _LAID_CELLS) for side in _LAID_SIZE_M]
    square = np.ones(size, bool)
    seen = ndimage.uniform_filter(rises.astype(np.float64), size, mode="constant")
    unknown = np.isnan(sections.z_m)
    fits = ndimage.binary_erosion(rises | unknown, square) & (seen > _MIN_SEEN_RATIO - 1e-6)
    marked: Bool = ndimage.binary_dilation(fits, square) & rises
    return marked


def measure_along(sections: StraightSections | None) -> tuple[float, float]:
    """Measure the rise (m) of what lies along on a bundle, 0 where none is known: that of its own section
    over the fitted outline's top, as with a bar as long as the bundle, or that of a part of it over its
    lower parts, even if these are shifted sideways by a cell, as with a shorter bar. Also return the rise
    that is left where unsure heights are too high.
    """
    if sections is None:
        return 0.0, 0.0
    cells = max(round(_LAID_SIZE_M[1] / sections.cell_m), 1)
    rises = []
    for unsure in (np.zeros_like(sections.z_m), sections.unsure_m):
        own = sections.own_m[0] - known_median(unsure)[0]
        ridge = ndimage.minimum_filter1d(_known(own), cells)
        rises.append(float(max(ridge.max() - sections.outline_z_m, _rise_of_part(sections, unsure), 0.0)))
    return rises[0], rises[1]


def _rise_of_part(sections: StraightSections, unsure_m: Float64) -> float:
    """Measure by how much (m) the highest part along a bundle rises over its lower parts; -inf if unknown.

    What all of a part's width rises by is no bar on it: bundles of thin bars sag between their timbers.
    """
    z, width = sections.z_m, sections.width_m
    beside = sections.cell_m * np.arange(z.shape[1]) - width / 2
    inner = np.abs(beside) < _INNER_RATIO * width - sections.cell_m / 2
    count = int(len(z) * sections.cell_m / _PART_M)
    if count < _MIN_PARTS or not inner.any():
        return -np.inf
    parts = np.concatenate([
        np.where(np.isfinite(part).mean(axis=0) > _MIN_PART_SEEN, known_median(part), np.nan)
        for part in np.array_split(z, count)
    ])  # fmt: skip
    unsure = np.concatenate([known_median(part) for part in np.array_split(unsure_m, count)])
    # NaN sorts last.
    known = np.isfinite(parts).sum(axis=0)
    at = np.maximum((known - 1) * _LOWER_PCT // 100, 0)
    lower = np.take_along_axis(np.sort(parts, axis=0), at[None], axis=0)
    raised = np.where(inner, parts - lower, np.nan).T
    at = np.maximum(np.isfinite(raised).sum(axis=0) - 1, 0) * _SAG_PCT // 100
    sag = np.take_along_axis(np.sort(raised, axis=0), at[None], axis=0).T
    over = parts - np.nan_to_num(unsure) - _shifted(lower) - np.fmax(sag, 0)
    rise = np.where(np.isfinite(parts) & inner, over, -np.inf)
    cells = max(round(_PART_WIDTH_M / sections.cell_m), 1)
    return float(ndimage.minimum_filter(rise, (1, cells), mode="constant", cval=-np.inf).max())


def _shifted(section: Float64) -> Float64:
    """Return the highest of a section (1, C) and of it shifted to either side by a cell."""
    return np.asarray(ndimage.maximum_filter(_known(section), (1, 3)), np.float64)


def _known(heights: Float64) -> Float64:
    """Replace unknown heights by -inf."""
    return np.where(np.isfinite(heights), heights, -np.inf)
