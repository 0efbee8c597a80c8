"""Stores for the tests of the page: a yard surveyed twice, with lifts, a stock list and a change between."""

from __future__ import annotations

import json
import time
from pathlib import Path

import cv2
import numpy as np
import tifffile

from barsight.core.stamps import NS_PER_S
from barsight.result_folder import seal_map
from barsight.store.adding import add_survey, read_survey
from barsight.store.opening import open_store
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.inventory.stock_list import ListedBundle, match_stock
from barsight.yard.types import HeightMap
from lift_yards import laid, map_of, record, sure_travel
from result_folders import summary
from yard_folders import lifts, write_heights
from yard_maps import Laid

FIRST = [laid(0.3), laid(1.4), laid(2.5), laid(3.6), laid(4.7, y_m=0.4)]
SECOND = [laid(0.3), laid(1.4), laid(2.5), laid(4.7, y_m=0.4), laid(5.8)]
"""Between the two the fourth went and a sixth came. The second yard's last bundle has an open end."""
DISCS = ((-1.0, -3.0), (0.85, 2.0), (2.0, -1.0), (3.05, 2.5))
"""Middles of dark discs on white paper, painted on the floor where the map has it."""
HOLE = (-1.2, 0.0)
"""Nothing was measured 50 mm about it."""
STOCK = (
    *(ListedBundle(f"A{k + 1}", one.x_m, one.y_m) for k, one in enumerate(SECOND[:3])),
    ListedBundle("A4", 3.6, 0.0),
)


def survey(folder: Path, stock: list[Laid], age_s: float, *, with_lifts: bool = True) -> Path:
    """Write a measured folder whose last frame is so old, with its orthophoto."""
    folder.mkdir(parents=True)
    heights = map_of(stock)
    x, y = np.meshgrid(heights.x_m - HOLE[0], heights.y_m - HOLE[1])
    for layer, nothing in ((heights.z_m, np.nan), (heights.sigma_m, np.nan), (heights.source, 0)):
        layer[np.hypot(x, y) < 0.05] = nothing
    place = write_heights(heights, folder / "height.tif")
    gray = np.clip(90 + 300 * np.nan_to_num(heights.z_m), 1, 250).astype(np.uint8)[::-1]
    gray = cv2.add(gray, np.random.default_rng(3).integers(0, 25, gray.shape).astype(np.uint8))
    for x_m, y_m in DISCS:
        paint_disc(gray, heights, x_m, y_m)
    for name, photo in (("ortho.tif", gray), ("tops.tif", np.full(gray.shape, 90, np.uint8))):
        tifffile.imwrite(
            folder / name, np.ascontiguousarray(photo), photometric="minisblack", tile=(256, 256),
            metadata=None, extratags=place,
        )  # fmt: skip
    open_end = len(stock) - 1
    bundles = tuple(
        record(one, k, ends_open=(False, k == open_end and stock is SECOND)) for k, one in enumerate(stock)
    )
    stamps = np.array([time.time_ns() - round((age_s + k) * NS_PER_S) for k in (2, 1, 0)], np.int64)
    ways = np.array([(one.x_m, 0.0) for one in (stock[0], stock[len(stock) // 2], stock[-1])])
    captured = {"captured_from_ns": int(stamps[0]), "captured_to_ns": int(stamps[-1])}
    content = summary() | {"agreement": [], "travel": sure_travel(ways, stamps).content(), **captured}
    identity = seal_map(content, folder)
    (folder / "result.json").write_text(json.dumps(content), encoding="utf-8")
    match = match_stock(STOCK, bundles) if stock is SECOND else None
    write_bundles(bundles, match, "yard", identity, folder / "bundles.json")
    (folder / "report.html").write_text("<!doctype html><title>Report</title><p>report</p>", encoding="utf-8")
    if with_lifts:
        assert lifts(folder) == 0
    return folder


def paint_disc(gray: np.ndarray, heights: HeightMap, x_m: float, y_m: float) -> None:
    """Paint a disc of 60 mm radius on paper of 140 mm, in tenths of a cell, row 0 at the highest y."""
    x, y = (x_m - heights.x0_m) / heights.cell_m, (y_m - heights.y0_m) / heights.cell_m
    column, row, fine = round(x), round(len(gray) - 1 - y), 10
    at = (np.arange(-15 * fine, 16 * fine) + 0.5 - fine / 2) / fine
    away = np.hypot(at[None, :] - (x - column), at[:, None] - (len(gray) - 1 - y - row))
    drawn = np.where(away < 6, 30.0, 220.0).reshape(31, fine, 31, fine).mean(axis=(1, 3))
    if 15 <= row < len(gray) - 15 and 15 <= column < gray.shape[1] - 15:
        gray[row - 15 : row + 16, column - 15 : column + 16] = drawn.round().astype(np.uint8)


def fill_store(folder: Path, *, surveys: int = 2) -> str:
    """Make a store with the first survey, an hour old, and the second, a minute old; return its URL."""
    url = f"sqlite:///{folder / 'yard.db'}"
    with open_store(url, create=True) as store:
        add_survey(store, read_survey(survey(folder / "first", FIRST, 3600.0, with_lifts=False)), "ann")
        if surveys > 1:
            add_survey(store, read_survey(survey(folder / "second", SECOND, 60.0)), "ann")
    return url
