"""Locate targets picked on a survey's orthophoto, and register its map to them, for `calibrate yard`."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy import ndimage

from barsight.calibration.boards.ring_detection import nearest_disc
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import MEASURE_AGAIN, ConfigError, Failed, InputError
from barsight.core.extras import extra
from barsight.core.reading.geotiff import open_geotiff
from barsight.page.layers import MAX_PIXELS
from barsight.page.survey_files import expect_map, survey_folder
from barsight.registration.surveyed_targets import SAME_M, Targets, read_places, write_targets
from barsight.registration.yard import calibrate_yard
from barsight.result_folder import read_heights
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.types import HeightMap, YardMap
from barsight.yard_frame import measured_owners

with extra("store"):
    from sqlalchemy import Connection

Found = Literal["disc", "column", "hand"]
CLOSE_M = 0.08
"""Largest distance in metres from a pick to the centre of a disc for the disc to be the target."""
AROUND_M = 0.5
"""Half side in metres of the part of the photo that is searched for the disc."""
SIDE: dict[Found, float] = {"disc": 0.12, "column": 0.35, "hand": 0.7}
"""Sigma of x and y by kind of target, in cells of the map, or in pixels if these are coarser."""
LEVEL_M, DISC_RATIO = 0.03, 2.0
"""Radius around a pick within which heights are used: in metres, or for a disc in its radii, since a black
disc itself has no heights.
"""
TOP_M = 0.03
"""Largest height difference in metres of cells of a column's top from the height at the pick."""
WIDER_PX, MAX_OFF_RATIO = 2.0, 0.25
"""Widening of a top by matching in pixels, and largest remaining error of its width relative to the
column's.
"""
JUMP_M = 0.02
"""Minimum threshold in metres, beside twice sigma, above which a height belongs to another face."""
MIN_SHARE, MIN_LEVEL = 0.3, 0.8
"""Minimum share of the cells around a pick that are measured, and of these that are on one face."""
MIN_TARGETS = 3
LISTED = Path("list of places")


@dataclass(frozen=True)
class Pick:
    """A target's pick in the map, m. is_exact: use the picked position, even with a disc near it.

    width_m: of a column whose top is the target; None for other targets.
    """

    name: str
    x_m: float
    y_m: float
    is_exact: bool = False
    width_m: float | None = None


@dataclass(frozen=True, eq=False)
class PickedPlace:
    """place_m (3,) in the map's frame, sigma_m (3,) of each coordinate; found: source of x and y."""

    place_m: Float64
    sigma_m: Float64
    found: Found


@dataclass(frozen=True, eq=False)
class _PickedSurvey:
    """A survey in whose map targets can be picked. frame: frame of its coordinates."""

    folder: Path
    frame: str
    heights: YardMap
    travel: Travel | None


def picking_record(connection: Connection, map_id: str) -> dict[str, Any]:
    """Return a survey's grid, its folder, and what `calibrate yard --measured` needs of it.

    Raises AccessError if there is no such survey, InputError if its map can't be registered.
    """
    survey = _opened(survey_folder(connection, map_id), map_id)
    rows, columns = survey.heights.shape
    cell_m = survey.heights.cell_m
    left_m, low_m = survey.heights.x0_m - cell_m / 2, survey.heights.y0_m - cell_m / 2
    return {
        "map_id": map_id, "folder": str(survey.folder), "frame": survey.frame, "cell_m": cell_m,
        "left_m": left_m, "low_m": low_m, "columns": columns, "rows": rows,
    }  # fmt: skip


def paint_photo(
    connection: Connection, map_id: str, columns: tuple[int, int], rows: tuple[int, int]
) -> bytes:
    """Paint a range of cells of the orthophoto as PNG, gray with alpha, row 0 at the highest y; coarser if
    there are many.
    """
    survey = _opened(survey_folder(connection, map_id), map_id)
    high, wide = survey.heights.shape
    if not (0 <= columns[0] < columns[1] <= wide and 0 <= rows[0] < rows[1] <= high):
        raise ConfigError(f"the map has {wide} columns and {high} rows")
    with open_geotiff(survey.folder / "ortho.tif") as file:
        gray = file.rectangle(1, slice(*rows), slice(*columns))[0][::-1]
    step = max(1, math.ceil(math.sqrt(gray.size / MAX_PIXELS)))
    size = math.ceil(gray.shape[1] / step), math.ceil(gray.shape[0] / step)
    gray = cv2.resize(gray, size, interpolation=cv2.INTER_NEAREST)
    picture = np.dstack([gray, gray, gray, np.where(gray > 0, 255, 0).astype(np.uint8)])
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes())


def fit_targets(
    connection: Connection, map_id: str, listed: str, sigma_m: float, picks: Sequence[Pick]
) -> dict[str, Any]:
    """Locate all picks of a list's targets, fit the yard frame, and write the list for `calibrate yard`.

    The fit needs three targets that aren't checks. listed: CSV as `read_places` reads it. sigma_m: survey
    accuracy of a coordinate, if the list has none. Raises InputError naming the line of the list, or the
    target whose pick can't be located.
    """
    survey = _opened(survey_folder(connection, map_id), map_id)
    names, places = read_places(LISTED, listed)
    if not names:
        raise InputError(LISTED, "has no target", "give one a line")
    if not 0 < sigma_m < 1:
        raise ConfigError(f"a survey's sigma of {sigma_m:g} m can't be")
    numbers = list[int]()
    for pick in picks:
        if pick.name not in names:
            raise InputError(pick.name, "is picked but isn't in the list", "choose one that is")
        if (number := names.index(pick.name)) in numbers:
            raise InputError(pick.name, "is picked twice", "pick it once")
        numbers.append(number)
    assert places.width_m is not None
    widths = [None if np.isnan(width) else float(width) for width in places.width_m[numbers]]
    meant = [replace(pick, width_m=width) for pick, width in zip(picks, widths, strict=True)]
    found = [place_pick(survey.heights, survey.travel, pick) for pick in meant]
    _expect_apart(picks, found)
    surveyed = np.where(np.isnan(places.sigma_m), sigma_m, places.sigma_m)[numbers]
    own = np.array([one.sigma_m for one in found]).reshape(-1, 3)
    targets = Targets(
        tuple(names[number] for number in numbers), places.yard_m[numbers],
        np.array([one.place_m for one in found]).reshape(-1, 3),
        np.sqrt(surveyed**2 + (own**2).mean(axis=1)), places.checks[numbers],
    )  # fmt: skip
    fit, off_m = _fitted(targets, survey.frame)
    rows = [
        {
            "name": name, "found": one.found, "place_m": one.place_m.tolist(),
            "sigma_m": one.sigma_m.tolist(), "off_m": None if off_m is None else off_m[k].tolist(),
        }
        for k, (name, one) in enumerate(zip(targets.names, found, strict=True))
    ]  # fmt: skip
    checks = places.checks.tolist()
    return {
        "names": [{"name": name, "check": check} for name, check in zip(names, checks, strict=True)],
        "targets": rows, "fit": fit, "csv": write_targets(targets) if off_m is not None else None,
    }  # fmt: skip


def place_pick(heights: YardMap, travel: Travel | None, pick: Pick) -> PickedPlace:
    """Locate a pick: x and y of its column, of the disc near it or of itself, and the height of its face.

    Raises InputError naming the target if that wasn't measured, if the height jumps, or if there is no such
    column.
    """
    part = _around(heights, pick)
    cell_m, corner = part.cell_m, (part.x0_m, part.y0_m)
    pixel = (np.array([pick.x_m, pick.y_m]) - corner) / cell_m
    is_measured = np.isfinite(part.z_m) & part.is_seen
    found: Found = "hand"
    reach, off_m = LEVEL_M / cell_m, 0.0
    if pick.width_m is not None and not pick.is_exact:
        found, reach = "column", pick.width_m / 3 / cell_m
        pixel, off_m = _column_top(part, travel, pixel, pick)
    elif part.gray is not None and not pick.is_exact:
        disc = nearest_disc(part.gray, pixel, CLOSE_M / cell_m)
        if disc is not None:
            found, pixel, reach = "disc", disc[:2], DISC_RATIO * float(disc[2])
    column, row = np.rint(pixel).astype(int)
    if found == "hand" and not is_measured[row, column]:
        raise InputError(pick.name, "its pick lies where no height was measured", "pick a place that was")
    rows, columns = np.indices(part.shape)
    near = np.hypot(columns - pixel[0], rows - pixel[1]) < reach
    z, sigma_m = _face_height(part, near, near & is_measured, pick.name)
    side_m = math.hypot(SIDE[found] * max(cell_m, _pixel_m(travel, z, cell_m)), off_m / 2)
    place = np.append(pixel * cell_m + corner, z)
    return PickedPlace(place, np.array([side_m, side_m, np.hypot(*sigma_m)]), found)


def _face_height(part: HeightMap, near: Bool, known: Bool, name: str) -> tuple[float, tuple[float, float]]:
    """Compute the median height of the face around a pick from its known cells (rows, columns).

    Returns the height, the map's sigma of it, and the scatter of the heights.
    """
    if known.sum() < MIN_SHARE * near.sum():
        raise InputError(name, "about its pick too few heights were measured", "pick a place that was")
    z = float(np.median(part.z_m[known]))
    level = known & (np.abs(part.z_m - z) < np.maximum(JUMP_M, 2 * part.sigma_m))
    if level.sum() < MIN_LEVEL * known.sum():
        jump_m = float(np.ptp(np.percentile(part.z_m[known], (5, 95))))
        problem = f"about its pick the height jumps by {jump_m:.2f} m"
        raise InputError(name, problem, "pick a face's middle, not its edge")
    return z, (float(np.median(part.sigma_m[level])), float(part.z_m[level].std()))


def _column_top(part: HeightMap, travel: Travel | None, pixel: Float64, pick: Pick) -> tuple[Float64, float]:
    """Find the level top around a pick, with its holes filled.

    Returns its centre (2,) in column and row, and the error of its width relative to the column's, m. Raises
    InputError if there is no top of that width.
    """
    assert pick.width_m is not None
    remedy = "pick the column's top, and list its width"
    column, row = np.rint(pixel).astype(int)
    about = slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3)
    if not np.isfinite(part.z_m[about]).any():
        raise InputError(pick.name, "where its column is picked no height was measured", remedy)
    z = float(np.nanmedian(part.z_m[about]))
    labels, _ = ndimage.label(np.abs(part.z_m - z) < TOP_M)
    counts = np.bincount(labels[about].ravel(), minlength=2)
    rows, columns = np.nonzero(ndimage.binary_fill_holes(labels == 1 + counts[1:].argmax()))
    wide_m = math.sqrt(rows.size) * part.cell_m
    off_m = wide_m - WIDER_PX * _pixel_m(travel, z, part.cell_m) - pick.width_m
    if abs(off_m) > MAX_OFF_RATIO * pick.width_m:
        problem = f"where it is picked no column of {pick.width_m:g} m ends"
        raise InputError(pick.name, f"{problem}: the level place is {wide_m:.2f} m wide", remedy)
    return np.array([columns.mean(), rows.mean()]), off_m


def _pixel_m(travel: Travel | None, z_m: float, cell_m: float) -> float:
    """Return the size of a pixel at a height; that of a cell if unknown."""
    pixel_m = float("nan") if travel is None else travel.pixel_m(z_m)
    return pixel_m if math.isfinite(pixel_m) else cell_m


def _expect_apart(picks: Sequence[Pick], found: Sequence[PickedPlace]) -> None:
    for k, one in enumerate(found):
        for other, before in zip(picks[:k], found, strict=False):
            if np.linalg.norm(one.place_m - before.place_m) < SAME_M:
                raise InputError(picks[k].name, f"is picked where {other.name} is", "pick each where it is")


def _around(heights: YardMap, pick: Pick) -> HeightMap:
    """Read the map around a pick. Raises InputError if it is outside the map."""
    cell_m, (high, wide) = heights.cell_m, heights.shape
    x, y = (pick.x_m - heights.x0_m) / cell_m, (pick.y_m - heights.y0_m) / cell_m
    if not (-0.5 < x < wide - 0.5 and -0.5 < y < high - 0.5):
        raise InputError(pick.name, "its pick lies outside the map", "pick a place in it")
    column, row = round(x), round(y)
    reach = math.ceil(AROUND_M / cell_m)
    return heights.part(
        slice(max(row - reach, 0), min(row + reach + 1, high)),
        slice(max(column - reach, 0), min(column + reach + 1, wide)),
    )


def _fitted(targets: Targets, frame: str) -> tuple[dict[str, Any] | None, Float64 | None]:
    """Register the frame as `calibrate yard` does: its results and off_m (N, 3), None if it can't be."""
    if (~targets.checks).sum() < MIN_TARGETS:
        return None, None
    covariance = targets.sigma_m[:, None, None] ** 2 * np.eye(3)
    found = calibrate_yard(
        targets.names, targets.measured_m, targets.yard_m, covariance, targets.checks, frame
    )
    if isinstance(found, Failed):
        return {"problem": found.reason}, None
    content = {
        "turn_sigma_deg": found.turn_sigma_deg, "place_sigma_m": found.place_sigma_m,
        "scale": found.alignment.scale, "scale_sigma": found.alignment.scale_sigma,
        "doubts": [*found.contradictions, *found.doubts],
    }  # fmt: skip
    return content, found.off_m


@functools.lru_cache(maxsize=4)
def _opened(folder: Path, map_id: str) -> _PickedSurvey:
    summary, owners = expect_map(folder, map_id), measured_owners(folder)
    if not (folder / "ortho.tif").is_file():
        raise InputError(folder, "has no ortho.tif", MEASURE_AGAIN)
    frame = "world" if owners["mounting_id"] is None else "encoders"
    return _PickedSurvey(folder, frame, read_heights(folder), Travel.read(summary))
