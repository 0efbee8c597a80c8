"""Hold the bounds by lines of sight against the true solids: `python benchmarks/unseen_posts.py KEEP/seed_*`.

Each folder is one that `barsight bench lifts --rendered --keep KEEP` has written. Counts the unseen cells
whose bound lies below the lowest true height within a cell, and the posts that the clearance misses: a face
of 100 mm, set down on a post and 50 mm to each side of it, at several depths below the post's top.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from barsight.benchmarks.lift_judge.magnet import read_magnet
from barsight.benchmarks.yard.drawn_worlds import CELL_M, exact_heights, judged_yard, measured_world
from barsight.core.records.heights import HeightSource
from barsight.simulation.worlds.yards import DrawnYard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import Beam, Pole, Tolerance, example_magnet, load_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.clearance import FacePlane, find_obstacle
from barsight.yard.types import Bundle, HeightMap

FACE = (Pole(0, 0, 0.1, 0.1),), Beam(0.1, 0.1, 0.35), Tolerance(0.005, 0.005, 0.0)
DEPTHS_M = (0.03, 0.06, 0.1, 0.2, 0.3)
ASIDE_M = ((0, 0), (0.05, 0), (-0.05, 0), (0, 0.05), (0, -0.05))


def count_bounds(world: DrawnYard, heights: HeightMap) -> Counter[str]:
    """Count the unseen cells by how far their bound lies from the truth."""
    true = exact_heights(world)
    lowest = ndimage.minimum_filter(np.nan_to_num(true.z.T), 3)
    column = np.rint((true.x0 + CELL_M * np.arange(lowest.shape[1]) - heights.x0_m) / CELL_M).astype(int)
    row = np.rint((true.y0 + CELL_M * np.arange(lowest.shape[0]) - heights.y0_m) / CELL_M).astype(int)
    rows, columns = (row >= 0) & (row < heights.shape[0]), (column >= 0) & (column < heights.shape[1])
    at = np.ix_(row[rows], column[columns])
    unseen = ~HeightSource.measured(heights.source[at])
    assert heights.free_m is not None
    off = (heights.free_m[at] - lowest[np.ix_(rows, columns)])[unseen]
    limits = {"within 0.1 m": off <= 0.1, "within 0.3 m": off <= 0.3, "30 mm too low": off < -0.03,
              "250 mm too low": off < -0.25}  # fmt: skip
    return Counter({"unseen": off.size} | {name: int(found.sum()) for name, found in limits.items()})


def count_posts(world: DrawnYard, heights: HeightMap, bundle: Bundle) -> Counter[str]:
    """Count the places of a face at which a post is found or missed, by its depth below the post's top."""
    poles, beam, tolerance = FACE
    magnet = replace(load_magnet(None), poles=poles, beam=beam, tolerance=tolerance)
    elsewhere = (replace(bundle, centre_m=np.add(bundle.centre_m, (100.0, 0.0, 0.0))),)
    found: Counter[str] = Counter()
    for post in (solid for solid in world.yard.solids if solid.part == "stanchion"):
        for depth_m in DEPTHS_M:
            plane = FacePlane(float(post.bounds[1, 2]) - depth_m, 0.0, 0.0, 0.002)
            for x, y in post.centre[:2] + ASIDE_M:
                missed = find_obstacle(Placement(x, y, 0.0), heights, magnet, plane, elsewhere) is None
                found[f"{1e3 * depth_m:.0f} mm below, {'missed' if missed else 'found'}"] += 1
    return found


def main(folders: list[Path]) -> None:
    """Print both counts of each folder, and their sums."""
    with tempfile.TemporaryDirectory() as scratch:
        described = Path(scratch) / "magnet.toml"
        described.write_text(example_magnet(), encoding="utf-8")
        judged = read_magnet(described)
    bounds, posts = Counter[str](), Counter[str]()
    for folder in folders:
        kind, seed = folder.name.rsplit("_", 1)
        world = judged_yard(int(seed), judged, None if kind == "seed" else kind)
        scene = measured_world(folder / "measured", LiftSettings()).scene
        counted, bundles = count_bounds(world, scene.heights), scene.table.bundles
        bounds += counted
        posts += count_posts(world, scene.heights, bundles[0]) if bundles else Counter()
        print(folder.name, dict(counted), flush=True)
    print("all", dict(bounds), dict(sorted(posts.items())))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
