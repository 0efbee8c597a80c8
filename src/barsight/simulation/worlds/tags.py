"""Lay surveyed AprilTags into a yard: thin level plates with their tops exactly at the listed positions."""

from __future__ import annotations

import numpy as np

from barsight.calibration.boards.marker_detection import TAG_MODULES, TAG_QUIET, tag_pattern
from barsight.calibration.boards.ring_detection import PAPER, ring_pattern
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.simulation.scene import CODE, Primitives, Scene, build_grid, plain_material
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import LaidYard, stream

HALF_THICK_M = 0.005
MIN_Z_M = 0.002
"""Minimum height of a plate's top above the floor, m, so that it is visible."""


def lay_tags(laid: LaidYard, tags: SurveyedTags, side_m: float, settings: SimulationSettings) -> LaidYard:
    """Add tags to a yard. side_m: side of the black square, m; the white paper extends one module beyond it.
    For coded circles it is the diameter of the disc.

    Each tag is rotated about the vertical by an angle drawn from the seed. Raises ConfigError for a tag below
    the floor, and if labels are drawn.
    """
    if laid.codes.size:
        raise ConfigError("simulate: --tags takes no labels; leave yard.label_m at 0 0")
    low = np.flatnonzero(tags.yard_m[:, 2] < MIN_Z_M)
    if low.size:
        raise ConfigError(
            f"simulate: tag {tags.numbers[low[0]]} must lie {MIN_Z_M:g} m or more over the floor"
        )
    rng, old = stream(settings, 14), laid.scene
    plates, papers = [], []
    for k, place in enumerate(tags.yard_m):
        paper = plain_material(0.75, 0.0, rng, weight=0.3)
        paper[CODE] = k + 1
        half_m = side_m * PAPER / 2 if tags.are_rings else side_m / 2 * (1 + 2 * TAG_QUIET / TAG_MODULES)
        plates.append(_plate(place, half_m, float(rng.uniform(0, 2 * np.pi))))
        papers.append(paper)
    shape = np.concatenate([old.primitives.shape, np.reshape(plates, (-1, 15))])
    material = np.concatenate([old.primitives.material, np.reshape(papers, (-1, 10))]).astype(np.float32)
    primitives = Primitives(shape, material, old.primitives.cylinders)
    grid = build_grid(primitives, (float(old.grid.cell[0]), float(old.grid.cell[1])))
    rows = [
        {"tag": int(number), "center": place.tolist(), "side_m": side_m}
        for number, place in zip(tags.numbers, tags.yard_m, strict=True)
    ]
    pattern = ring_pattern if tags.are_rings else tag_pattern
    codes = np.stack([pattern(int(number)) for number in tags.numbers])
    return LaidYard(Scene(primitives, grid), {**laid.truth, "tags.json": rows}, codes)


def _plate(place: Float64, half: float, yaw: float) -> Float64:
    c, s = np.cos(yaw), np.sin(yaw)
    centre = place - [0, 0, HALF_THICK_M]
    return np.array([*centre, c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, half, half, HALF_THICK_M])
