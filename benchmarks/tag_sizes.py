"""Measure how small AprilTags are found, and how well they are placed: `python benchmarks/tag_sizes.py 7000`.

Renders a yard with six tags for each size, finds them in every pair at the true poses, and holds the places
against the list that they were laid by. The number is the first size's seed; each size has a seed of its own.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.records.trajectory import PosedFrame
from barsight.recording.open import open_recording
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.registration.tags import MAX_CHI2, SeenTags, see_tags
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import World, laid_stock, simulate
from barsight.simulation.worlds.tags import lay_tags

SIZES_PX = (8, 10, 12, 16, 20, 30, 40)
RANGE_M = 5.0
TAGS = 6
EDGE_PX = 3.0


def main() -> None:
    """Measure each size and print a row of the table."""
    print("| pixels | seed | in view | found | rows, sigma (px) | one pair: x, y, z (mm RMS) | strays |")
    print("|---|---|---|---|---|---|---|")
    for seed, size_px in enumerate(SIZES_PX, start=int(sys.argv[1])):
        print(measured(seed, size_px), flush=True)


def measured(seed: int, size_px: int) -> str:
    """Render a yard with tags of one size; the row of the table."""
    settings = SimulationSettings(
        length_m=3.6, frames=6, seed=seed, depth_views=0,
        camera=CameraSettings(width_px=640, height_px=512, focal_px=625, above_floor_m=RANGE_M + 1),
        yard=YardSettings(max_layers=2, bar_length_m=5),
    )  # fmt: skip
    rng = np.random.default_rng((seed, 1))
    column, row = np.divmod(np.arange(TAGS), 2)
    x, y = 0.3 + 1.5 * column, -1.0 + 2.2 * row
    places = np.column_stack([x, y, np.full(TAGS, 1.0)]) + rng.uniform(-0.2, 0.2, (TAGS, 3))
    numbers = rng.choice(587, TAGS, replace=False)
    nothing = np.full(TAGS, np.nan), np.zeros(TAGS, bool)
    side_m = size_px * RANGE_M / settings.camera.focal_px
    laid = lay_tags(laid_stock(settings), SurveyedTags(numbers, places, *nothing), side_m, settings)
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder) / "recording", settings, laid=laid)
        recording = open_recording(Path(folder) / "recording")
        world = World.over(laid, settings)
        posed = {
            stamp: PosedFrame(stamp, world.yard_from_body(stamp), np.zeros((6, 6)))
            for stamp in recording.index.stamps_ns
        }
        seen = see_tags(recording.frames(posed), Rectifier(recording.rig), posed, lambda: None)
        in_view = sum(_in_view(world, posed[stamp], places, 0.8 * side_m) for stamp in posed)
    return f"| {size_px} | {seed} | {in_view} | {_errors(seen, dict(zip(numbers, places, strict=True)))} |"


def _in_view(world: World, frame: PosedFrame, places: Float64, reach_m: float) -> int:
    """Count the tags that lie in both pictures whole."""
    rig, inside = world.mounted.rig, np.ones(len(places), bool)
    corners = places[:, None] + reach_m * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    for camera, mounting in ((rig.cam0, rig.body_from_cam0), (rig.cam1, rig.body_from_cam1)):
        here = (frame.reference_from_body @ mounting).inverse().apply(corners.reshape(-1, 3))
        pixels = camera.project(here).reshape(-1, 4, 2)
        size = np.array([camera.width, camera.height])
        inside &= ((pixels > EDGE_PX) & (pixels < size - EDGE_PX)).all(axis=(1, 2))
    return int(inside.sum())


def _errors(seen: SeenTags, places: dict[int, Float64]) -> str:
    """Write found, false ones beside, noise and errors of single pairs, and how many of 1000 to 1 stray."""
    found = [(one, places[n]) for n, ones in seen.sightings.items() if n in places for one in ones]
    false = sum(len(ones) for n, ones in seen.sightings.items() if n not in places)
    if not found:
        return f"0 ({false} false) | | |"
    off = np.stack([one.place_m - place for one, place in found])
    rows = np.array([one.rows_px for one, _ in found])
    noise = seen.sigma_px**2 * np.stack([one.noise_m2 for one, _ in found])
    strays = int((np.einsum("ki,kij,kj->k", off, np.linalg.inv(noise), off) > MAX_CHI2).sum())
    told = ", ".join(f"{1e3 * value:.2f}" for value in np.sqrt((off**2).mean(axis=0)))
    spread = f"{np.sqrt((rows**2).mean()):.3f}, {seen.sigma_px:.3f}"
    return f"{len(found)} ({false} false) | {spread} | {told} | {strays}"


if __name__ == "__main__":
    main()
