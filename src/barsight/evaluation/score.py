"""Score a measured folder against its (simulated) recording's truth; only for evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import InputError
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.reading.bounded_reading import read_arrays
from barsight.core.reading.geotiff import HEIGHT_BANDS, open_geotiff
from barsight.core.records.heights import HeightSource
from barsight.mapping.agreement import smooth_places
from barsight.mapping.surface.contours import SAME_Y_M
from barsight.result_folder import read_contours

_SPACING_M = 0.01

Figures = dict[str, float]


def score_folder(recording: Path, out: Path) -> dict[str, Figures]:
    """Score contours and heights in mm against `truth/height.npz` of the recording.

    `smooth` places have no step above 30 mm within two samples, in the height map along x and along y; `seen
    by two` are those that at least two frames see in both cameras. coverage is the share of those for which
    vision gives a height; within_95 is the share of errors within 1.96 stated sigma. Raises InputError if
    such a file is missing on either side.
    """
    truth_file = recording / "truth" / "height.npz"
    for file in (truth_file, out / "contour.csv", out / "height.tif"):
        if not file.exists():
            raise InputError(file, "no such file", "give a simulated recording and its measured folder")
    content = read_arrays(truth_file)
    try:
        return {**_score_contours(content, out), **_score_height(content, out)}
    except (KeyError, ValueError, TypeError, IndexError, OverflowError) as error:
        problem = f"doesn't fit this truth ({type(error).__name__}: {error})"
        raise InputError(out, problem, "give a simulated recording and its measured folder") from error


def _score_contours(truth: dict[str, Float64], out: Path) -> dict[str, Figures]:
    x_true = truth["profile_x"]
    heights: dict[int, Float64] = {}
    for contour in read_contours(out):
        # Without a laser the contours' numbers are their own.
        same = np.flatnonzero(np.abs(truth["profile_ys"] - contour.y_m[0]) < SAME_Y_M)
        if not same.size:
            continue
        places = np.round((contour.x_m - x_true[0]) / _SPACING_M)
        shown = HeightSource.measured(contour.source) & (places >= 0) & (places < x_true.size)
        measured = heights[int(same[0])] = np.full((2, x_true.size), np.nan)
        measured[:, places[shown].astype(int)] = contour.z_m[shown], contour.sigma_m[shown]
    errors, sigmas, smooth, covered = [], [], [], []
    for profile, (z, sigma) in heights.items():
        z_true = truth[f"profile_y{profile}"].astype(np.float64)
        level = smooth_places(z_true)
        seen = truth[f"profile_visible{profile}"] >= 2
        errors.append(z - z_true)
        sigmas.append(sigma)
        smooth.append(level)
        covered.append(np.isfinite(z)[seen & level])
    if not errors:
        return {}
    error, sigma, level = np.concatenate(errors), np.concatenate(sigmas), np.concatenate(smooth)
    return {
        "contour, smooth places": _figures(error[level], sigma[level], np.concatenate(covered)),
        "contour, everywhere": _figures(error, sigma, None),
    }


def _score_height(truth: dict[str, Float64], out: Path) -> dict[str, Figures]:
    with open_geotiff(out / "height.tif", HEIGHT_BANDS) as file:
        z, sigma, _, source = file.page.asarray()
    z_true = truth["z"].astype(np.float64)
    x, y = np.meshgrid(truth["x"], truth["y"], indexing="ij")
    column, row = (
        np.floor((x - file.left_m) / file.cell_m).astype(int),
        np.floor((file.top_m - y) / file.cell_m).astype(int),
    )
    inside = (column >= 0) & (row >= 0) & (column < z.shape[1]) & (row < z.shape[0])
    column, row = column * inside, row * inside
    seen = inside & HeightSource.measured(source[row, column])
    error = np.where(seen, z[row, column] - z_true, np.nan)
    spread = np.where(seen, sigma[row, column], np.nan)
    level = smooth_places(z_true) & smooth_places(z_true.T).T
    visible = truth["visible"] >= 2
    stack = level & (z_true > 0.2)
    return {
        "height, smooth stack": _figures(error[stack], spread[stack], seen[stack & visible]),
        "height, seen by two": _figures(error[visible], spread[visible], seen[visible]),
    }


def _figures(error_m: Float64, sigma_m: Float64, claimed: Bool | None) -> Figures:
    known = np.isfinite(error_m)
    error = error_m[known] * 1e3
    if error.size == 0:
        return {"samples": 0.0}
    size = np.abs(error)
    figures = {
        "samples": float(error.size),
        "bias_mm": error.mean(),
        "median_mm": np.median(size),
        "mae_mm": size.mean(),
        "p95_mm": np.percentile(size, 95),
        "max_mm": size.max(),
        "within_95_pct": 100 * np.mean(size <= SIGMAS_95 * 1e3 * sigma_m[known]),
    }
    if claimed is not None and claimed.size:
        figures["coverage_pct"] = 100 * claimed.mean()
    return {name: round(float(value), 3) for name, value in figures.items()}
