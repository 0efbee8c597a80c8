"""Score what is found of drawn yards' labels, and what is taken for one.

`python benchmarks/labels.py KEEP SEED...`: KEEP is a folder of `bench lifts --rendered --full-size --keep`.
Labels are the drawn solids; bundles are those that were measured, and only what lies no lower than 40 mm
under a bundle's top is looked at.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy import ndimage

from barsight.benchmarks.lift_judge.magnet import read_magnet
from barsight.benchmarks.yard.drawn_worlds import judged_yard
from barsight.core.arrays import Bool, Float32, Float64
from barsight.result_folder import read_heights
from barsight.simulation.worlds.solids import Solid
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.magnet.description import example_magnet
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.placement.labels import mark_labels
from barsight.yard.types import Bundle, HeightMap

STEP_M, ASIDE_M, DEEP_M, POLE_M = 0.01, 0.12, 0.04, 0.09
"""Cells, margin beside a bundle, depth under its top, and half the width that tells its usual level."""
SAME_M, NEAR_CELLS, FAR_CELLS = 0.02, (3, 2), (10, 6)
"""A label's height over or under the map's where it is in sight, and the cells along and across within which
a mark is its own, and beyond which it is not."""


def strip_of(bundle: Bundle, heights: HeightMap) -> tuple[Float32, Float64, Float64]:
    """Look up gray levels, heights and places across (V, U) over a bundle and beside it."""
    half_u, half_v = bundle.width_m / 2 + ASIDE_M, bundle.length_m / 2
    u, v = (STEP_M * np.arange(-int(half / STEP_M), int(half / STEP_M) + 1) for half in (half_u, half_v))
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    x = bundle.centre_m[0] + c * u - s * v[:, None]
    y = bundle.centre_m[1] + s * u + c * v[:, None]
    column, row, inside = nearest_cells(heights, x, y)
    assert heights.gray is not None
    gray = np.where(inside, heights.gray[row, column], 0).astype(np.float32)
    return gray, np.where(inside, heights.z_m[row, column], np.nan), u


def places_of(labels: list[Solid], bundle: Bundle, shape: tuple[int, int]) -> list[tuple[int, int, float]]:
    """List rows and columns of labels in a bundle's strip, and their heights."""
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    found = []
    for label in labels:
        away = label.centre[:2] - bundle.centre_m[:2]
        row = round(float(away @ (-s, c)) / STEP_M) + shape[0] // 2
        column = round(float(away @ (c, s)) / STEP_M) + shape[1] // 2
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            found.append((row, column, float(label.centre[2])))
    return found


def around(row: int, column: int, cells: tuple[int, int]) -> tuple[slice, slice]:
    """Cut the cells about a place."""
    rows = slice(max(row - cells[0], 0), row + cells[0] + 1)
    return rows, slice(max(column - cells[1], 0), column + cells[1] + 1)


def score(marked: Bool, top: Bool, places: list[tuple[int, int]]) -> tuple[int, int]:
    """Count the labels that are marked, and the patches marked elsewhere on top."""
    hits = sum(bool(marked[around(*place, NEAR_CELLS)].any()) for place in places)
    other = marked & top
    for place in places:
        other[around(*place, FAR_CELLS)] = False
    return hits, ndimage.label(other)[1]


def main(arguments: list[str]) -> None:
    """Score the seeds that are kept."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "magnet.toml"
        path.write_text(example_magnet(), encoding="utf-8")
        magnet = read_magnet(path)
    seen = hits = patches = 0
    free_m = 0.0
    for seed in map(int, arguments[1:]):
        out = Path(arguments[0]) / f"seed_{seed}" / "measured"
        solids = judged_yard(seed, magnet).yard.solids
        labels = [solid for solid in solids if solid.part == "tag"]
        yard = read_heights(out)
        heights = yard.part(slice(0, yard.shape[0]), slice(0, yard.shape[1]))
        for bundle in read_bundles(out / "bundles.json"):
            gray, z_m, u = strip_of(bundle, heights)
            top = (z_m > bundle.top_z_m - DEEP_M) & (np.abs(u) <= bundle.width_m / 2) & (gray > 0)
            load = top & (np.abs(u) <= POLE_M)
            marked = mark_labels(gray, load)
            in_sight = [
                (r, c) for r, c, z in places_of(labels, bundle, gray.shape) if abs(z - z_m[r, c]) < SAME_M
            ]
            own, other = score(marked, top, in_sight)
            seen, hits = seen + len(in_sight), hits + own
            if bundle.is_free:
                patches, free_m = patches + other, free_m + bundle.length_m
    print(f"labels in sight: {hits} of {seen} found")
    print(f"other patches marked: {patches} on {free_m:.0f} m of free bundles")


if __name__ == "__main__":
    main(sys.argv[1:])
