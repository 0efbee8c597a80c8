"""Columns picked on the page by their tops, in rendered yards: how far axis and top are off, against sigma.

`python benchmarks/picked_columns.py FIRST LAST ABOVE_FLOOR_M FOLDER`: a yard a seed, six square columns each.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.page.targets import Pick, place_pick
from barsight.result_folder import read_heights, read_summary
from barsight.simulation.scene import Primitives, Scene, build_grid, plain_material
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import LaidYard, laid_stock, simulate, stream
from barsight.yard.lifting.travel_accuracy import Travel

ASIDE_M, APART_M = 0.06, 0.9
"""How far a click lies beside the axis at most, along each axis; columns keep so far apart."""


def drawn(seed: int) -> Float64:
    """Draw columns (6, 4): x, y, height and width, m."""
    rng, columns = np.random.default_rng((seed, 7)), np.empty((0, 4))
    while len(columns) < 6:
        x, y = rng.uniform((-0.6, -1.4), (4.2, 1.4))
        one = np.array([x, y, rng.uniform(0.9, 1.8), rng.uniform(0.2, 0.45)])
        if np.all(np.linalg.norm(columns[:, :2] - one[:2], axis=1) > APART_M):
            columns = np.vstack([columns, one])
    return columns


def lay_columns(columns: Float64, settings: SimulationSettings) -> LaidYard:
    """Stand square columns through the stock, each turned by chance."""
    laid, rng = laid_stock(settings), stream(settings, 15)
    old, boxes = laid.scene.primitives, []
    for x, y, z, wide in columns:
        c, s = np.cos(turn := rng.uniform(0, np.pi)), np.sin(turn)
        boxes.append([x, y, z / 2, c, s, 0, -s, c, 0, 0, 0, 1, wide / 2, wide / 2, z / 2])
    paints = [plain_material(float(rng.uniform(0.2, 0.6)), 0.0, rng, weight=1.0) for _ in columns]
    material = np.concatenate([old.material, np.array(paints)]).astype(np.float32)
    primitives = Primitives(np.concatenate([old.shape, np.array(boxes)]), material, old.cylinders)
    cell = float(laid.scene.grid.cell[0]), float(laid.scene.grid.cell[1])
    return LaidYard(Scene(primitives, build_grid(primitives, cell)), laid.truth, laid.codes)


def picked(folder: Path, seed: int, above_m: float) -> list[str]:
    """Draw, measure and pick one yard; a row for each column, mm: off, sigma."""
    columns, rng = drawn(seed), np.random.default_rng(seed)
    settings = SimulationSettings(
        length_m=3.6, frames=12, seed=seed, depth_views=0,
        camera=CameraSettings(width_px=640, height_px=512, focal_px=625, above_floor_m=above_m),
        yard=YardSettings(max_layers=2, bar_length_m=5),
    )  # fmt: skip
    if not (folder / "out" / "result.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        simulate(folder / "recording", settings, laid=lay_columns(columns, settings))
        assert run(["measure", str(folder / "recording"), "-o", str(folder / "out")]) == 0
    heights, told = read_heights(folder / "out"), []
    travel = Travel.read(read_summary(folder / "out"))
    for k, (x, y, z, wide) in enumerate(columns):
        aside = rng.uniform(-ASIDE_M, ASIDE_M, 2)
        try:
            one = place_pick(heights, travel, Pick(f"column {k}", x + aside[0], y + aside[1], width_m=wide))
        except InputError as error:
            told.append(f"{seed} {error}")
            continue
        off = one.place_m - (x, y, z)
        told.append(f"{seed} {k} {one.found} " + " ".join(f"{1e3 * v:.2f}" for v in (*off, *one.sigma_m)))
    return told


if __name__ == "__main__":
    for number in range(int(sys.argv[1]), int(sys.argv[2])):
        print(*picked(Path(sys.argv[4]) / str(number), number, float(sys.argv[3])), sep="\n", flush=True)
